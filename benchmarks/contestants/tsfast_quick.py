"""tsfast as its quick start, with the windows of its tables: one epoch of 300 batches."""

import tempfile
from pathlib import Path

import h5py
from given import every_u, keep, u, y
from tsfast.basics import InferenceWrapper, RNNLearner, create_dls

cut, folder = 4 * len(u) // 5, Path(tempfile.mkdtemp())
for name, part in (("train", slice(cut)), ("valid", slice(cut, None))):
    with h5py.File(folder / f"{name}.hdf5", "w") as file:
        file["u"], file["y"] = u[part, 0], y[part, 0]
files = {name: [folder / f"{name}.hdf5"] for name in ("train", "valid")}
win_sz, bs = (200, 64) if len(u) > 4096 else (150, 16) if len(u) > 600 else (40, 16)
dls = create_dls(["u"], ["y"], files, win_sz=win_sz, bs=bs)
learner = RNNLearner(dls)
learner.fit_flat_cos(1)
keep(InferenceWrapper(learner)(every_u))
