"""Wiener-Hammerstein benchmark with process noise: measurements of an electronic circuit.

Input u, output y (V), both measured, at 78125 Hz. A third-order low-pass filter, a saturating diode
network and an inverse Chebyshev filter (5 kHz, with a transmission zero in the band) follow one
another, and filtered Gaussian noise is added to the saturation's input. A file ``WH_*.mat`` holds
the struct ``dataMeas`` with a column for each record in its fields r (the generator's signal, not
used here), u and y. ``WH_EstimationExample.mat`` (10 records) is for estimation.
``WH_TestDataset.mat`` has the two tests, a random-phase multisine and a swept sine up to 15 kHz,
16384 samples and 0.71 V rms each, measured *without* process noise.

Noise before a nonlinearity is not noise at the output. The simulation error on records with such
noise has a large floor. A fit that minimises it tends to the mean output given the input,
E f(x + e) in place of f(x): a smoother saturation than in the tests. This bias does not fade with
more data. So errors on training and validation records do not predict errors on the tests: neither
their size nor, near the floor, their order.

There is no official split or window, and no statement that records begin at rest; none of this is
checked on the files. All records are simulated from zero state, whose effect lies in the first 100
samples; these are not scored, as in identibench.

References:
    M. Schoukens, J.P. Noël (2016), "Wiener-Hammerstein benchmark with process noise", Workshop on
    Nonlinear System Identification Benchmarks.

    D. Gedon, N. Wahlström, T.B. Schön, L. Ljung (2021), "Deep state space models for nonlinear
    system identification", 19th IFAC Symposium on System Identification.
"""

from __future__ import annotations

from pathlib import Path

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official

__all__ = ["load"]

_FILES = "WienHammer/WienerHammersteinFiles"
_ESTIMATION, _TEST = "WH_EstimationExample.mat", "WH_TestDataset.mat"
_LOADER = "not_splitted_benchmarks.WienerHammerstein_Process_Noise"
_FS = 78125.0  # Hz
_SKIP = 100  # unscored samples of all records
_TESTS = ("multisine", "sweep")  # the columns of the test file

_NOTE = (
    "training and validation records have process noise, a floor of their errors; the tests have "
    "none"
)


def load(*, validation: int = 2, download: bool = False, root: str | Path | None = None) -> Dataset:
    """Realisations of the estimation file, and the two tests.

    Without the test file there are no tests, and a note says so.

    Args:
        validation: number of last realisations that validate.
        download: download missing files (423 MB) by nonlinear_benchmarks.
        root: folder that holds ``WienHammer/WienerHammersteinFiles/WH_EstimationExample.mat`` and
            ``WH_TestDataset.mat`` beside it.

    Shape:
        u, y (V) of training and validation: (T, 1), as long as the file has them; of the tests
        ``"multisine"`` and ``"sweep"``: (16384, 1). The first 100 samples are not scored.

    Example:
        >>> data = lfrtorch.datasets.wh_process_noise.load(download=True)  # doctest: +SKIP
    """
    integer("validation", validation, 1)

    def columns(path: Path) -> tuple[Array, Array]:
        """Arrays u and y (samples, records)."""
        u, y = official.read_struct(path, "dataMeas", ("u", "y"))
        if len(u) <= _SKIP:
            raise InputError(
                f"'{path}': 'dataMeas.u' has shape {u.shape}; expected (samples, records) and more "
                f"than {_SKIP} samples; {official.again(path)}"
            )
        return u, y

    def record(name: str, u: Array, y: Array) -> Record:
        return official.record(u, y, {"u": "V"}, {"y": "V"}, fs=_FS, skip=_SKIP, name=name)

    path = official.find(root, f"{_FILES}/{_ESTIMATION}", _LOADER, download=download)
    u, y = columns(path)
    trained = u.shape[1] - validation
    if trained < 1:
        raise InputError(
            f"validation is {validation}, and '{path}' has {u.shape[1]} record(s), of which "
            f"one at least must train; give 1 to {u.shape[1] - 1}."
        )
    estimation = [
        record(f"train_{i + 1}" if i < trained else f"validation_{i - trained + 1}", *signals)
        for i, signals in enumerate(zip(u.T, y.T, strict=True))
    ]
    files = {" and ".join(_TESTS): f"{_FILES}/{_TEST}"}
    found, notes = official.find_tests(root, files, _LOADER, download=download)
    tests: list[Record] = []
    for path in found.values():
        u, y = columns(path)
        if u.shape[1] != len(_TESTS):
            raise InputError(
                f"'{path}': 'dataMeas.u' has shape {u.shape}; expected (samples, {len(_TESTS)}), "
                f"{' and '.join(_TESTS)}; {official.again(path)}"
            )
        tests = [record(*test) for test in zip(_TESTS, u.T, y.T, strict=True)]
    return Dataset(
        name="wh_process_noise",
        train=estimation[:trained],
        validation=estimation[trained:],
        tests=tests,
        notes=(*notes, _NOTE),
    )
