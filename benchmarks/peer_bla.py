"""The linear fit of freq-statespace; runs in its environment, from and to a .npz file.

venv/bin/python peer_bla.py IN.npz OUT.npz: u (N, nu, R, P), y (N, ny, R, P), lines, fs, nx, and
once: only with its default tolerances, one time, 300 iterations at most (its limit is 1000).
"""

import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import freq_statespace as fss  # noqa: E402
import numpy as np  # noqa: E402
import optimistix as optx  # noqa: E402

given = np.load(sys.argv[1])
nx, f = int(given["nx"]), given["lines"] * float(given["fs"]) / len(given["u"])
SOLVERS = {
    "default": {},
    "converged": {"solver": optx.LevenbergMarquardt(rtol=1e-8, atol=1e-10)},
}
once = bool(given["once"])
if once:
    SOLVERS = {"default": {"max_iter": 300}}
out = {}
for name, options in SOLVERS.items():
    for turn in ("first",) if once else ("first", "again"):  # the first one compiles
        begin = time.perf_counter()
        data = fss.create_data_object(given["u"], given["y"], float(given["fs"]), given["lines"])
        model = fss.lin.subspace_id(data, nx, logging_enabled=False)
        model, details = fss.lin.optimize(
            model, data, print_every=-1, return_solve_details=True, **options
        )
        out[f"{name}_{turn}"] = time.perf_counter() - begin
    size = data.norm.y_std[:, None] / data.norm.u_std
    out[f"{name}_G"] = np.asarray(model._frequency_response(f)) * size
    out[f"{name}_iterations"] = details.iter_count
    out["G_bla"] = np.asarray(data.freq.G_bla.G) * size
    if data.freq.G_bla.var_tot is not None:
        out["var_total"] = np.asarray(data.freq.G_bla.var_tot) * size**2
np.savez(sys.argv[2], **out)
