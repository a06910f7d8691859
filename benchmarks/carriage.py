"""An exact integrator behind one output of two: a carriage whose position and speed are measured.

    python benchmarks/carriage.py

A force that changes every 0.2 s drives a mass against a drag that grows with the square of its
speed; 4000 samples at 100 Hz, noise of 1 mm and 1 cm/s. Of them 2400 train, 800 validate and 800
test. Printed is the rms error of each output in the simulated test from an estimated start, for two
and three states with and without ``integrators=[1, 0]``.
"""

from __future__ import annotations

import numpy as np

import lfrtorch
from lfrtorch._support.types import Array


def carriage(samples: int = 4000) -> tuple[Array, Array]:
    """Force (T,) and measured position and speed (T, 2)."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=samples // 20), 20)
    y = np.zeros((samples, 2))
    for k in range(samples - 1):
        place, speed = y[k]
        y[k + 1] = (
            place + 0.01 * speed,
            speed + 0.01 * (5 * u[k] - speed - 0.5 * speed * abs(speed)),
        )
    return u, y + rng.normal(size=y.shape) * [1e-3, 1e-2]


def main() -> None:
    """Print a line for each structure."""
    u, y = carriage()
    parts = {"train": slice(0, 2400), "validation": slice(2400, 3200), "test": slice(3200, 4000)}
    train, validation, test = (
        lfrtorch.Record(u[p], y[p], 100.0, "estimated", 50, name=name) for name, p in parts.items()
    )
    for nx, integrators in ((2, [0, 0]), (3, [0, 0]), (2, [1, 0]), (3, [1, 0])):
        settings = lfrtorch.Settings(
            nx=nx, nz=2, nw=1, nn=8, starts=4, linear={"integrators": integrators}
        )
        run = lfrtorch.identify(lfrtorch.Dataset("carriage", [train], [validation]), settings)
        errors = (run.model.simulate(test) - test.y)[50:]
        place, speed = np.sqrt(np.mean(errors**2, axis=0))
        print(f"nx {nx}, integrators {integrators}: {place:.4f} m, {speed:.4f} m/s", flush=True)


if __name__ == "__main__":
    main()
