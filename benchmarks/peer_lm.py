"""Levenberg-Marquardt of freq-statespace from its subspace model; runs in its environment.

venv/bin/python peer_lm.py IN.npz ITERATIONS: u (N, nu, R, P), y (N, ny, R, P), lines, fs, nx, nz,
nw, nn. Prints one line of JSON. Its linear model is not refined: at the sizes of the mirror that
takes more memory than a machine has (``run_fss_mirror.py`` of the peers' folder does it).
"""

import json
import sys

import jax

jax.config.update("jax_enable_x64", True)

import freq_statespace as fss  # noqa: E402
import numpy as np  # noqa: E402
import optimistix as optx  # noqa: E402

given = np.load(sys.argv[1])
nx, nz, nw, nn = (int(given[size]) for size in ("nx", "nz", "nw", "nn"))
data = fss.create_data_object(given["u"], given["y"], float(given["fs"]), given["lines"])
linear = fss.lin.subspace_id(data, nx, freq_weighting=False, logging_enabled=False)
network = fss.static.NeuralNetwork(
    nz=nz, nw=nw, layers=1, neurons_per_layer=nn, activation=jax.nn.tanh, seed=42
)
model, details = fss.nonlin.optimize(
    fss.nonlin.connect(linear, network),
    data,
    solver=optx.LevenbergMarquardt(rtol=1e-3, atol=1e-6),
    max_iter=int(sys.argv[2]),
    print_every=-1,
    freq_weighting=False,
    return_solve_details=True,
)
found = {
    "s_per_iter": details.wall_time / max(1, details.iter_count),
    "iters": details.iter_count,
    "n_par": int(model.num_parameters()),
    "losses": [float(loss) for loss in details.loss_history],
}
print("JSON " + json.dumps(found))
