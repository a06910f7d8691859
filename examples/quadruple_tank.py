"""A quadruple tank to be controlled: a simulator in place of the plant, and a model of its data.

Two pumps fill four tanks, and the levels of the lower two are measured (K. H. Johansson, "The
quadruple-tank process", IEEE Transactions on Control Systems Technology 8(3), 2000). The examples
of control are about it: ``tank_mpc.py``, ``tank_do_mpc.py``, ``tank_lqg.py``.

    python examples/quadruple_tank.py
"""

import numpy as np

import lfrtorch

TS = 5.0  # s
LOW, HIGH = 0.5, 5.5  # V
NOISE = 0.03  # cm, of the levels


class QuadrupleTank:
    """The plant: levels in cm under the pumps' voltages, which are held over a sample."""

    AREA, HOLE = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057])  # cm²
    PUMP, SPLIT = np.array([3.33, 3.35]), np.array([0.7, 0.6])  # cm³/(V s); to the lower tank

    def __init__(self, seed: int) -> None:
        self.levels = np.array([12.0, 12.0, 2.0, 2.0])
        self._rng = np.random.default_rng(seed)

    def measured(self) -> np.ndarray:
        """The two lower levels, with noise."""
        return self.levels[:2] + NOISE * self._rng.standard_normal(2)

    def step(self, u: np.ndarray) -> None:
        """Go on by a sample."""
        for _ in range(20):
            out = self.HOLE * np.sqrt(2.0 * 981.0 * self.levels)
            pumped = self.PUMP * np.clip(u, 0.0, 10.0)
            into = np.append(out[2:] + self.SPLIT * pumped, ((1.0 - self.SPLIT) * pumped)[::-1])
            self.levels = np.maximum(self.levels + TS / 20 * (into - out) / self.AREA, 0.0)


def experiment(samples: int, seed: int) -> lfrtorch.Record:
    """Steps of both pumps."""
    rng, plant = np.random.default_rng(seed), QuadrupleTank(seed)
    u = np.empty((samples + 300, 2))
    for pump in range(2):
        lengths = rng.integers(4, 50, samples)
        u[:, pump] = np.repeat(rng.uniform(1.5, 4.5, samples), lengths)[: len(u)]
    y = []
    for voltages in u:
        y.append(plant.measured())
        plant.step(voltages)
    return lfrtorch.Record(
        u[300:],
        np.array(y[300:]),
        fs=1.0 / TS,
        start="estimated",
        inputs=(lfrtorch.Channel("pump1", "V"), lfrtorch.Channel("pump2", "V")),
        outputs=(lfrtorch.Channel("level1", "cm"), lfrtorch.Channel("level2", "cm")),
    )


def identified(
    samples: int = 3000, iterations: int = 60
) -> tuple[lfrtorch.Model, lfrtorch.NoiseCovariance]:
    """A model for control, in which no output depends on an input at the same sample."""
    data = lfrtorch.Dataset(
        "tanks",
        train=[experiment(samples, seed=1)],
        validation=[experiment(samples // 3, seed=2)],
        tests=[experiment(1000, seed=3)],
    )
    trainer = lfrtorch.LevenbergMarquardt(max_iter=iterations, guarantee="stable")
    settings = lfrtorch.Settings(
        nx=4, nz=2, nw=2, nn=10, feedthrough=False, z_feedthrough=False, trainer=trainer
    )
    run = lfrtorch.identify(data, settings)
    for name, model in (("linear model", run.linear), ("NL-LFR", run.model)):
        print(f"{name:13} {lfrtorch.rmse(data.tests[0], model.simulate(data.tests[0])):.3f} cm")
    return run.model, lfrtorch.estimate_noise(run.model, data.validation)


if __name__ == "__main__":
    identified()
