"""Which starts find a system whose output hides its sign? Counts of 16 seeds, for six systems.

    python benchmarks/hidden.py

The output is |v|, without noise, of a linear system that a random sequence of -1 and 1 drives. A
start has found the system if a fit of 40 iterations to 300 samples ends below a tenth of the
output's deviation on 300 new samples. ``zero_output`` begins at the linear model, and the other
columns at random states, the best of so many draws.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.signal import lfilter

import lfrtorch
from lfrtorch._support import tables
from lfrtorch.fitting import random_states

POLES = {
    "z² - 1.9 z + 0.95": [1.0, -1.9, 0.95],
    "z² - 1.5 z + 0.8": [1.0, -1.5, 0.8],
    "z³ - 2.6 z² + 2.33 z - 0.71": [1.0, -2.6, 2.33, -0.71],
}
HOLDS = 1, 5  # samples between steps of the input
DRAWS = 4, 16, 64, 200
SAMPLES, SEEDS = 300, 16


def measured(poles: list[float], hold: int, seed: int) -> lfrtorch.Record:
    """A record of |v|."""
    steps = np.sign(np.random.default_rng(seed).normal(size=(SAMPLES // hold + 1, 1)))
    u = np.repeat(steps, hold, axis=0)[:SAMPLES]
    return lfrtorch.Record(u, np.abs(lfilter([0.0, 1.0], poles, u, axis=0)), fs=1.0)


def found(poles: list[float], hold: int, draws: int) -> int:
    """Number of seeds that find the system; from the linear model if there are no draws."""
    record, new = (measured(poles, hold, seed) for seed in (0, 1))
    bla = lfrtorch.estimate_bla(record, nx=len(poles) - 1)
    random_states._DRAWS = (draws, draws)
    trainer, count = lfrtorch.LevenbergMarquardt(max_iter=40), 0
    for seed in range(SEEDS):
        method = "random_states" if draws else "zero_output"
        model = lfrtorch.initialise(bla, record, nz=1, nw=1, nn=8, method=method, seed=seed)
        model = lfrtorch.fit(model, record, trainer=trainer, monitors=[]).model
        count += int(lfrtorch.rmse(new, model.simulate(new)) < 0.1 * new.y.std())
    return count


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    rows = [
        [name, hold, *(found(poles, hold, draws) for draws in (0, *DRAWS))]
        for name, poles in POLES.items()
        for hold in HOLDS
    ]
    head = ["poles", "samples a step", "zero_output", *(f"best of {draws}" for draws in DRAWS)]
    print(tables.table(head, rows))


if __name__ == "__main__":
    main()
