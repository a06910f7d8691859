"""lfrtorch, with the number of states given and else its defaults."""

import numpy as np
from given import every_u, fs, keep, left, order, u, y

import lfrtorch

skip, cut = min(50, len(u) // 20), 4 * len(u) // 5
unknown = np.zeros((len(every_u) - len(y), 1))  # outputs after the first are not used
train, validation, every = (
    lfrtorch.Record(*signals, fs=fs, start="estimated", skip=skip)
    for signals in ((u[:cut], y[:cut]), (u[cut:], y[cut:]), (every_u, np.vstack((y, unknown))))
)
settings = lfrtorch.Settings(nx=order)
dataset = lfrtorch.Dataset("given", [train], [validation])
run = lfrtorch.identify(dataset, settings, stop=lambda: left() < 8.0)
keep(run.model.simulate(every))
