"""The whole recipe of freq-statespace; runs in its environment, from and to a .npz file.

venv/bin/python peer_nl.py IN.npz OUT.npz: u, y (N, 1, R, 1) in steady state, lines, fs, nx, nw, nz,
degree, u_NAME of tests, which are simulated to their steady state, and the most iterations of BLA,
inference and learning, and all parameters by Levenberg-Marquardt (its own 1000, 1000 and 100 would
take hours); all else are its defaults.
"""

import json
import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import freq_statespace as fss  # noqa: E402
import numpy as np  # noqa: E402

given = np.load(sys.argv[1])
out, stages = {}, {}


def stage(name, work):
    """Do it, and note its duration and the outputs on the tests."""
    begin = time.perf_counter()
    found = work()
    model, details = found if isinstance(found, tuple) else (found, None)
    stages[name] = {
        "seconds": time.perf_counter() - begin,
        "iterations": None if details is None else int(details.iter_count),
        "seconds_per_iteration": None
        if details is None
        else details.wall_time / max(1, details.iter_count),
        "parameters": int(model.num_parameters()),
    }
    for test in (key for key in given.files if key.startswith("u_")):
        with np.errstate(all="ignore"):
            u = given[test]
            out[f"{name}_{test[2:]}"] = np.asarray(model.simulate(u, offset=len(u))[0])
    np.savez(sys.argv[2], stages=json.dumps(stages), **out)
    return model


limits = [int(limit) for limit in given["limits"]]
told = {"print_every": -1, "return_solve_details": True}
data = fss.create_data_object(given["u"], given["y"], float(given["fs"]), given["lines"])
model = stage(
    "subspace", lambda: fss.lin.subspace_id(data, int(given["nx"]), logging_enabled=False)
)
model = stage("BLA", lambda: fss.lin.optimize(model, data, max_iter=limits[0], **told))
phi = fss.static.basis.Polynomial(int(given["nz"]), int(given["degree"]))
model = stage(
    "inference and learning",
    lambda: fss.nonlin.inference_and_learning(
        model, data, phi, int(given["nw"]), max_iter=limits[1], **told
    ),
)
model = stage(
    "all parameters", lambda: fss.nonlin.optimize(model, data, max_iter=limits[2], **told)
)
