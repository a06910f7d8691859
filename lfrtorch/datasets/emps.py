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

At the same speed the input drifts by 14 mV in the 25 s of the estimation file, since the friction
drifts and the feedback holds the position. A model that integrates turns 10 mV into 20 mm. So
training can have copies of the record whose input is shifted.

References:
    A. Janot, M. Gautier, M. Brunot (2019), "Data set and reference models of EMPS", Workshop on
    Nonlinear System Identification Benchmarks, Eindhoven.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lfrtorch._support.checks import number
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official

__all__ = ["load"]

_ESTIMATION, _TEST = "EMPS/DATA_EMPS.mat", "EMPS/DATA_EMPS_PULSES.mat"
_ARCHIVE = "EMPS/EMPS.zip"
_FS = 1000.0  # Hz
_SAMPLES = 24_841  # samples of each file
_WINDOW = 20  # samples, unscored, of the test
_SAME_PLACE = 1e-3  # m, between the first samples of files whose motions begin at one place


def load(
    *,
    validation: float = 0.0,
    drift: float = 0.0,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """Estimation measurement, cut in time into training and validation, and the test record.

    The motion begins at rest. So training, validation and a test that begins at the same position
    begin in the state 0, which a model with learned states may have anywhere. A test that begins
    elsewhere begins in a state that is fitted to its first samples. Validation is a simulation of
    all samples from the first one on, scored in those that do not train.

    Args:
        validation: last fraction of the estimation samples, which validates. With 0 all train.
        drift: shift of the input (V), up and down, in copies of the training and validation
            records with the same output. A model that is fitted to them does not integrate the
            drift of the friction. With 0 there are no copies.
        download: download missing files.
        root: folder that holds ``EMPS/DATA_EMPS.mat`` and ``EMPS/DATA_EMPS_PULSES.mat``, or
            ``EMPS/EMPS.zip`` with both in it.

    Shape:
        u (V), y (m) of training: (24841, 1), or (19873, 1) with ``validation=0.2``; of validation:
        (24841, 1), 4968 of them scored; of the test: (24841, 1), 24821 scored.

    Example:
        >>> data = lfrtorch.datasets.emps.load(download=True)  # doctest: +SKIP
    """
    number("drift", drift)
    trained = _SAMPLES - (official.held_out(_SAMPLES, validation) if validation else 0)
    path = official.find(root, _ESTIMATION, "EMPS", others=[_ARCHIVE], download=download)
    estimation = _measured(path, _ESTIMATION)
    found, notes = official.find_tests(
        root, {"test": _TEST}, "EMPS", others=[_ARCHIVE], download=download
    )

    def copies(first: int, last: int, name: str) -> list[Record]:
        whole = official.part(estimation, first, last, warm_up=first, name=name)
        others = {f"{name}_up": drift, f"{name}_down": -drift} if drift else {}
        return [whole, *(replace(whole, u=whole.u + d, name=n) for n, d in others.items())]

    tests = []
    for name, path in found.items():
        whole = _measured(path, _TEST)
        start = "zero" if abs(whole.y[0] - estimation.y[0]) < _SAME_PLACE else "estimated"
        tests.append(replace(whole, name=name, skip=_WINDOW, start=start))
    return Dataset(
        name="emps",
        train=copies(0, trained, "train"),
        validation=copies(trained, _SAMPLES, "validation") if validation else [],
        tests=tests,
        published=official.published("emps"),
        notes=notes,
        leaderboard=tests,
    )


def _measured(path: Path, file: str) -> Record:
    """Read one file, or the archive with it, as a record."""
    shapes = {"vir": (_SAMPLES, 1), "qm": (_SAMPLES, 1)}
    u, y = official.read_arrays(path, shapes, Path(file).name).values()
    return official.record(u, y, {"vir": "V"}, {"qm": "m"}, fs=_FS)
