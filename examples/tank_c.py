"""The tanks under a controller in C: observer, disturbance and state feedback.

It exports the model, writes the gain of LQR, compiles ``tank_loop.c`` and runs it beside the plant
for 1000 samples. The disturbance that the observer finds takes the place of an integral.

    python examples/tank_c.py    # pip install 'lfrtorch[control]', and gcc
"""

import subprocess
import tempfile
from pathlib import Path

import control
import numpy as np
from quadruple_tank import HIGH, LOW, QuadrupleTank, identified

import lfrtorch


def gain(local: lfrtorch.LinearModel) -> np.ndarray:
    """LQR: errors of a cm count as much as steps of a volt."""
    weight = local.C.T @ local.C + 1e-6 * np.eye(len(local.A))
    return control.dlqr(local.to_control(), weight, np.eye(2))[0]


def compiled(
    model: lfrtorch.Model, noise: lfrtorch.NoiseCovariance, wanted: list[float], folder: Path
) -> Path:
    """The program that holds the wanted levels."""
    rest = lfrtorch.analysis.trim(model, y=wanted)
    local = lfrtorch.analysis.linearise(model, rest)
    law = {"U_REST[2]": rest.u, "X_REST[4]": rest.x, "GAIN[2][4]": gain(local)}
    lines = [f"static const double {name} = {_braces(value)};" for name, value in law.items()]
    lines += [f"#define LOW {LOW}", f"#define HIGH {HIGH}"]
    (folder / "law.h").write_text("\n".join(lines) + "\n")
    lfrtorch.export.write(model, "c", folder, name="tanks", observer=noise, disturbance="input")
    program, loop = folder / "loop", Path(__file__).with_name("tank_loop.c")
    sources = [loop, folder / "tanks.c", f"-I{folder}", "-lm"]
    subprocess.run(["gcc", "-std=c99", "-O2", "-o", program, *sources], check=True)
    return program


def _braces(value: np.ndarray) -> str:
    return str(np.asarray(value).tolist()).replace("[", "{").replace("]", "}")


def closed_loop(program: Path, samples: int = 1000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels, what was measured of them, and inputs; 0.4 V more on pump 1 from sample 300 on."""
    plant, signals = QuadrupleTank(seed=4), []
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([program], **pipes) as running:
        assert running.stdin is not None
        assert running.stdout is not None
        for k in range(samples):
            y = plant.measured()
            if k % 10 == 7:
                y[1] = np.nan  # a sample was lost
            print(f"{y[0]:.17g} {y[1]:.17g}", file=running.stdin, flush=True)
            u = np.array(running.stdout.readline().split(), dtype=float)
            signals.append((plant.levels[:2].copy(), y, u))
            plant.step(u + np.array([0.4 if k >= 300 else 0.0, 0.0]))
    levels, measured, inputs = (np.array(each) for each in zip(*signals, strict=True))
    return levels, measured, inputs


def main() -> None:
    """Identify, compile, control, say how well."""
    model, noise = identified()
    wanted = [13.0, 11.0]
    with tempfile.TemporaryDirectory() as folder:
        levels, _, _ = closed_loop(compiled(model, noise, wanted, Path(folder)))
    for name, end in (("before the load", 300), ("with 0.4 V more on pump 1", 1000)):
        print(f"offset {name}: {(levels[end - 200 : end] - wanted).mean(axis=0).round(3)} cm")


if __name__ == "__main__":
    main()
