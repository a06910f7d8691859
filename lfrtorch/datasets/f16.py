"""F-16 ground vibration test: measurements of an aircraft on the ground, shaken below a wing.

Input: the measured force of the shaker below the right wing (N). Outputs: three accelerations
(m/s²), where the shaker acts (acc1), and on the wing's (acc2) and the payload's (acc3) side of the
mounting of a dummy payload at the wing tip, whose clearance and friction are the nonlinearity. The
modes are lightly damped. Sampled at 400 Hz, at seven levels (of the multisines 12.4, 24.6, 36.8,
61.4, 73.6, 85.7 and 97.8 N rms). At each level there is a random-phase multisine of 2 to 15 Hz, 9
periods of 8192 samples, the first of them a transient, and a swept sine from rest. Levels 1, 3, 5
and 7 are for estimation; 2, 4 and 6, whose files end in ``_Validation``, are the tests.

- The force is not the generator's signal: it carries measurement noise, and the structure acts back
  on the shaker and so on the force. Noise at the input biases a least squares fit; the mean over
  periods reduces it.
- The published scores are of the first acceleration alone. A score here pools the three outputs;
  ``rmse_by_output`` has each.
- The window of 50 samples, 0.125 s, is too short a warm-up for modes that ring for seconds. The
  tests are therefore simulated from rest at their first sample, where the input begins, and the
  transient of a multisine's first period is scored.
- The swept sines (``SineSw``) of levels 1, 3 and 5 end in zeros that fill the file, up to 1500 of
  all channels. Training and validation leave them out; the tests are scored as they are.
- The special odd multisines (``SpecialOddMSine``) are not used.

References:
    J.P. Noël, M. Schoukens (2017), "F-16 aircraft benchmark based on ground vibration test data",
    Workshop on Nonlinear System Identification Benchmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official

__all__ = ["load"]

_FILE = "F16/F16GVT_Files/BenchmarkData/F16Data_{}_Level{}.mat"
_KINDS = {"multisine": "FullMSine", "sweep": "SineSw"}
_FS = 400.0  # Hz
_PERIOD, _PERIODS = 8192, 9  # samples of a multisine, and how many; the first is a transient
_ESTIMATION, _TESTS = (1, 3, 5, 7), (2, 4, 6)  # levels
_SKIP = 50  # samples, unscored, of records from rest

_NOTE = "RMSE is that of the three accelerations together; published figures are of acc1 alone"


def load(
    *,
    train: Sequence[str] = (
        "multisine_1",
        "multisine_3",
        "multisine_5",
        "multisine_7",
        "sweep_3",
        "sweep_7",
    ),
    validation: Sequence[str] = ("sweep_5",),
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """Measurements for training, whole records of others for validation, and the six tests.

    A training multisine is the mean of the last 8 of its 9 periods, in steady state. Its noise,
    also in the force, is lower by √8, and its squared errors have the weight 8. Swept sines,
    validation and the tests are whole records from rest, their first 50 samples unscored.

    The tests are ``"multisine_2"``, ``"multisine_4"``, ``"multisine_6"``, ``"sweep_2"``,
    ``"sweep_4"`` and ``"sweep_6"``. If a test's file is missing, a note says so.

    Args:
        train: measurements to fit, ``"multisine_1"`` or ``"sweep_1"``, at the levels 1, 3, 5 and 7.
        validation: measurements for validation, of the same names; it may be empty.
        download: download missing files (148 MB) by nonlinear_benchmarks.
        root: folder that holds ``F16/F16GVT_Files/BenchmarkData/F16Data_FullMSine_Level1.mat`` and
            so on.

    Shape:
        u (N), y (m/s²) of a multisine that trains: (8192, 1), (8192, 3); of others: (73728, 1),
        (73728, 3); of swept sines: (T, 1), (T, 3), T about 108000.

    Example:
        >>> data = lfrtorch.datasets.f16.load(download=True)  # doctest: +SKIP
    """
    _check(train, validation)

    def measured(use: str, name: str) -> Record:
        path = official.find(root, _file(name), "F16", download=download)
        return _measured(path, name, f"{use}_{name}")

    fitted = [_fitted(measured("train", name)) for name in train]
    chosen_by = [measured("validation", name) for name in validation]
    names = [f"{kind}_{level}" for kind in _KINDS for level in _TESTS]
    files = {name: _file(name, "_Validation") for name in names}
    found, notes = official.find_tests(root, files, "F16", download=download)
    tests = [_whole(path, name, name) for name, path in found.items()]
    first = np.array([1.0, 0.0, 0.0])  # names of the outputs
    return Dataset(
        name="f16",
        train=fitted,
        validation=chosen_by,
        tests=tests,
        published=official.published("f16"),
        notes=(*notes, _NOTE),
        leaderboard=[replace(test, weight=first) for test in tests],
    )


def _file(name: str, end: str = "") -> str:
    kind, _, level = name.partition("_")
    return _FILE.format(_KINDS[kind], level + end)


def _whole(path: Path, name: str, called: str) -> Record:
    """Read a file as a record from rest."""
    period = _PERIOD if name.startswith("multisine") else None
    samples = None if period is None else _PERIODS * _PERIOD
    force = official.read_arrays(path, {"Force": (1, samples)})["Force"]
    shape = 3, force.shape[1]
    acceleration = official.read_arrays(path, {"Acceleration": shape})["Acceleration"]
    if force.shape[1] <= _SKIP:
        raise InputError(
            f"'{path}': 'Force' has {force.shape[1]} samples; expected more than {_SKIP}; "
            f"{official.again(path)}"
        )
    outputs = {f"acc{i}": "m/s²" for i in (1, 2, 3)}
    return official.record(
        force.T, acceleration.T, {"force": "N"}, outputs, fs=_FS, skip=_SKIP, name=called,
        period=period,
    )  # fmt: skip


def _measured(path: Path, name: str, called: str) -> Record:
    """Read a file; a sweep ends where its first channel is filled up with zeros."""
    record = _whole(path, name, called)
    if record.period is not None:
        return record
    signals = np.column_stack([record.u, record.y])
    end = min(int(np.max(np.nonzero(signal)[0], initial=-1)) + 1 for signal in signals.T)
    if not _SKIP < end < record.samples:
        return record
    return record.part(slice(end), start=record.start, skip=record.skip, period=None)


def _fitted(record: Record) -> Record:
    """Read a training record; a multisine becomes the mean of its periods without transient."""
    if record.period is None:
        return record
    return replace(record[_PERIOD:], start="periodic").mean_period()


def _check(train: Sequence[str], validation: Sequence[str]) -> None:
    """Refuse names that are not estimation measurements, and repetitions."""
    known = [f"{kind}_{level}" for kind in _KINDS for level in _ESTIMATION]
    for option, given in (("train", train), ("validation", validation)):
        listed = isinstance(given, Sequence) and not isinstance(given, str)
        if not listed or any(name not in known for name in given):
            raise InputError(
                f"{option} is {given}; give a list of {', '.join(known)}, for example "
                "[multisine_1, sweep_1]."
            )
    names = [*train, *validation]
    if not train or len(set(names)) < len(names):
        raise InputError(
            f"train is {list(train)} and validation is {list(validation)}; give one or more to "
            "train, and each once in all."
        )
