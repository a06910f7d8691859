"""From a measurement file to a model in use, as on the command line.

The file stands for yours: a pump fills a tank that empties through a hole, u the pump's voltage and
y the level, every 0.5 s.

    python examples/own_data.py

On the command line the same is

    lfrtorch preview tank.csv inputs=pump outputs=level
    lfrtorch fit tank.csv inputs=pump outputs=level fs=2 \\
        start=estimated nx=1 nz=1 nw=1 nn=5 starts=4
"""

from pathlib import Path

import numpy as np

import lfrtorch
from lfrtorch.survey.notes import notes_on


def write_measurement(path: Path) -> None:
    """Torricelli's law, the level read with 5 mm rms of noise."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.5, 3.0, 250), 12)
    level, levels = 1.0, []
    for voltage in u:
        levels.append(level)
        level += 0.5 * (0.05 * voltage - 0.06 * np.sqrt(max(level, 0.0)))
    y = np.array(levels) + 0.005 * rng.standard_normal(len(u))
    lines = [f"{a:.6g};{b:.6g}" for a, b in zip(u, y, strict=True)]
    path.write_text("\n".join(["pump (V);level (m)", *lines]) + "\n")


def main() -> None:
    """Look, identify, judge, write, use."""
    path = Path("tank.csv")
    write_measurement(path)

    data = lfrtorch.load_records(path, inputs="pump", outputs="level", fs=2, start="estimated")
    for sentence in (*data.notes, *notes_on(data.train)):
        print("note:", sentence)

    settings = lfrtorch.Settings(
        nx=1, nz=1, nw=1, nn=5, starts=4, trainer=lfrtorch.LevenbergMarquardt(max_iter=60)
    )
    run = lfrtorch.identify(data, settings)
    print(run, *run.advice, sep="\n")

    (test,) = data.tests
    for name, model in (("linear model", run.linear), ("NL-LFR", run.model)):
        error = lfrtorch.rmse(test, model.simulate(test))
        print(f"{name:13} {1e3 * error:6.2f} mm rms on the test, of which noise 5 mm")

    lfrtorch.reporting.write(run, "runs/tank")
    tank = lfrtorch.load("runs/tank")
    level = tank.simulate(np.full(600, 2.0))  # from rest at the mean level, at 2 V
    print(
        f"{tank.outputs[0]} at 2 V: {level[-1, 0]:.2f}, by Torricelli's law {(5 / 6 * 2) ** 2:.2f}"
    )


if __name__ == "__main__":
    main()
