"""tsfast an LSTM, scaled outputs, as many epochs as the two minutes allow."""

import tempfile
import time
from pathlib import Path

import h5py
from given import every_u, keep, left, u, y
from tsfast.basics import InferenceWrapper, RNNLearner, StandardScaler, create_dls

cut, folder = 4 * len(u) // 5, Path(tempfile.mkdtemp())
for name, part in (("train", slice(cut)), ("valid", slice(cut, None))):
    with h5py.File(folder / f"{name}.hdf5", "w") as file:
        file["u"], file["y"] = u[part, 0], y[part, 0]
files = {name: [folder / f"{name}.hdf5"] for name in ("train", "valid")}
win_sz, bs = (200, 64) if len(u) > 4096 else (150, 16) if len(u) > 600 else (40, 16)
options = {"rnn_type": "lstm", "output_norm": StandardScaler, "n_skip": win_sz // 4}
begin = time.perf_counter()
few = create_dls(["u"], ["y"], files, win_sz=win_sz, bs=bs, n_batches_train=10)
RNNLearner(few, **options).fit_flat_cos(1)
each = time.perf_counter() - begin  # of ten batches and the validation
dls = create_dls(["u"], ["y"], files, win_sz=win_sz, bs=bs, n_batches_train=50)
learner = RNNLearner(dls, **options)
learner.fit_flat_cos(max(1, int((left() - 10.0) / (5 * each))))
keep(InferenceWrapper(learner)(every_u))
