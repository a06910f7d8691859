"""freq-statespace as its README: a network, from the linear model."""

import freq_statespace as fss
import jax
import numpy as np
from given import affordable, every_u, first, fs, gap, keep, order, period, u, y

if period:  # realisations of one multisine, odd lines
    starts = range(first, len(u) - period + 1, period + gap)
    u4, y4 = (np.stack([s[k : k + period] for k in starts], axis=2)[..., None] for s in (u, y))
    lines = np.arange(1, 2 * 1342, 2)
else:  # it asks for periods: all of the record is one
    u4, y4, lines = u[:, :, None, None], y[:, :, None, None], np.arange(1, len(u) // 2)
data = fss.create_data_object(u4, y4, fs, lines)
bla = fss.lin.optimize(fss.lin.subspace_id(data, order), data)
network = fss.static.NeuralNetwork(1, 1, layers=1, neurons_per_layer=10, activation=jax.nn.relu)
start = fss.nonlin.connect(bla, network)
steps = affordable(lambda n: fss.nonlin.optimize(start, data, max_iter=n), 100)
model = fss.nonlin.optimize(start, data, max_iter=steps)
keep(model.simulate(every_u)[0])
