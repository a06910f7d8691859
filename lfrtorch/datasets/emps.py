"""Electro-mechanical positioning system (EMPS): measurements of a drive of a linear axis.

The input vir (V) is the controller's output to the motor, the output qm (m) the position. Each of
two files has 24841 samples at 1 kHz. DATA_EMPS.mat is for estimation. DATA_EMPS_PULSES.mat, in
which pulses act in addition to the motion, is for the test, whose first 20 samples are not scored.
Scores are in metres here and published in millimetres.

A force moves a mass against viscous and dry friction: from the force to the position the system
integrates, the friction is the nonlinearity, and both measurements are under the feedback of a
position controller (its reference qg and the times t are in the files, too, and not read).

The input vir is a voltage; the authors' scripts convert it to a force by the drive gain gtau (N/V)
in the files, which does not change the scores of a model. The pulses of the test file (pulses_N)
are not an input in those scripts, nor here. The output is qm as stored, in metres.

References:
    A. Janot, M. Gautier, M. Brunot (2019), "Data set and reference models of EMPS", Workshop on
    Nonlinear System Identification Benchmarks, Eindhoven.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official

__all__ = ["load"]

_ESTIMATION, _TEST = "EMPS/DATA_EMPS.mat", "EMPS/DATA_EMPS_PULSES.mat"
_ARCHIVE = "EMPS/EMPS.zip"
_FS = 1000.0  # Hz
_SAMPLES = 24_841  # samples of each file
_WINDOW = 20  # samples, unscored, of the test


def load(
    *,
    validation: float = 0.0,
    warm_up: int = _WINDOW,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """Estimation measurement, cut in time into training and validation, and the test record.

    All start states are estimated. An integrator never forgets its initial state: the position
    error of a zero state is permanent, and no warm-up from zero state would remove it. Training
    fits the start with the parameters; in validation and test it is fitted to the first samples,
    which are not scored. Those of the validation record are the last ones of training.

    Args:
        validation: last fraction of the estimation samples, which validates. With 0 all samples
            train, and random starts are judged on them as on the test: from a start state that is
            fitted to the first samples alone.
        warm_up: first samples of the validation record, to which its start state is fitted; they
            train, too. Default: as many as for the test.
        download: download missing files.
        root: folder that holds ``EMPS/DATA_EMPS.mat`` and ``EMPS/DATA_EMPS_PULSES.mat``, or
            ``EMPS/EMPS.zip`` with both in it.

    Shape:
        u (V), y (m) of training: (24841, 1), or (19873, 1) with ``validation=0.2``; of validation:
        (4988, 1), 4968 of them scored; of the test: (24841, 1), 24821 scored.

    Example:
        >>> data = lfrtorch.datasets.emps.load(download=True)  # doctest: +SKIP
    """
    integer("warm_up", warm_up, 1)
    trained = _SAMPLES - (official.held_out(_SAMPLES, validation) if validation else 0)
    if warm_up > trained:
        raise InputError(
            f"warm_up is {warm_up}, and there are {trained} samples before the validation record; "
            "give fewer, or a smaller validation."
        )
    path = official.find(root, _ESTIMATION, "EMPS", others=[_ARCHIVE], download=download)
    estimation = _measured(path, _ESTIMATION)
    found, notes = official.find_tests(
        root, {"test": _TEST}, "EMPS", others=[_ARCHIVE], download=download
    )

    part = partial(official.part, start="estimated")

    def whole_but(unscored: int, name: str) -> Record:
        return part(estimation, unscored, _SAMPLES, warm_up=warm_up, name=name)

    tests = [
        part(_measured(path, _TEST), _WINDOW, _SAMPLES, warm_up=_WINDOW, name=name)
        for name, path in found.items()
    ]
    return Dataset(
        name="emps",
        train=[part(estimation, 0, trained, warm_up=0, name="train")],
        validation=[] if trained == _SAMPLES else [whole_but(trained, "validation")],
        tests=tests,
        selection=[] if trained < _SAMPLES else [whole_but(warm_up, "from the first samples")],
        published=official.published("emps"),
        notes=notes,
        leaderboard=tests,
    )


def _measured(path: Path, file: str) -> Record:
    """Read one file, or the archive with it, as a record."""
    shapes = {"vir": (_SAMPLES, 1), "qm": (_SAMPLES, 1)}
    u, y = official.read_arrays(path, shapes, Path(file).name).values()
    return official.record(u, y, {"vir": "V"}, {"qm": "m"}, fs=_FS)
