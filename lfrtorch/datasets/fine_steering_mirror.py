"""Fine steering mirror: measurements of a mirror on three piezo actuators.

Inputs u1, u2, u3 (V), outputs y1, y2, y3 (m), in steady state, at 6400 Hz. At each of three levels,
100, 200 and 300 mV rms, there are realisations of random-phase multisines up to 3000 Hz, orthogonal
in groups of three, with two periods of 8192 samples each: six realisations for estimation and three
for the test. The hysteresis of the actuators is the nonlinearity, and the structure resonates.

The score of a level is the mean over outputs, realisations and periods of the RMSE, without the
first 100 samples of each period. Published models simulate each period as a separate record, whose
start has faded by sample 100. Here a test is simulated in periodic steady state, from the inputs
alone, as it was measured; the same samples are scored.

All data are in one file, in arrays (samples, channels, realisations, periods) for each level and
use, ``u_100mV_train`` to ``y_300mV_test``. They are by M. Floren, CC BY 4.0.

References:
    https://www.nonlinearbenchmark.org, "Fine steering mirror".
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lfrtorch._support.checks import integer, true_or_false
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official

__all__ = ["LEVELS", "load"]

LEVELS = (100, 200, 300)
"""Amplitudes of the inputs, mV rms."""

_FILE = "FineSteeringMirror/combined_data.npz"
_FS = 6400.0  # Hz
_CHANNELS = 3  # inputs, and outputs
_WINDOW = 100  # samples, unscored, of each period


def load(
    *,
    levels: Sequence[int] = LEVELS,
    validation: int = 1,
    mean: bool = True,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """Realisations of several levels for training, others for validation, and the tests.

    A training record is the mean of the two periods of a realisation, with the weight 2. Each
    period of a validation or test realisation is a record. The records of a level form one score,
    the mean of the RMSE over outputs and records: ``"level_100"``, ``"level_200"`` and
    ``"level_300"``, and ``"validation_100"`` and so on. The linear model of a level is estimated
    from its training records.

    Without test arrays in the file there are no tests, and a note says so.

    Args:
        levels: levels of training and validation, mV rms.
        validation: number of last realisations of each level that validate; 0 for none.
        mean: a training record is the mean of the periods; otherwise it has them one after the
            other, and their difference shows the noise.
        download: download a missing file, by a package nonlinear_benchmarks that has this
            benchmark (version 1.0.1 does not).
        root: folder that holds ``FineSteeringMirror/combined_data.npz``.

    Shape:
        u (V), y (m): (8192, 3), of which 8092 are scored; of training without ``mean`` (16384, 3).

    Example:
        >>> data = lfrtorch.datasets.fine_steering_mirror.load(download=True)  # doctest: +SKIP
    """
    chosen = official.chosen_levels(levels, LEVELS)
    integer("validation", validation, 0)
    true_or_false("mean", mean)
    path = official.find(root, _FILE, "FineSteeringMirror", download=download)
    arrays = official.read_npz(path)

    def pair(level: int, use: str) -> tuple[Array, Array]:
        """Arrays u and y (samples, channels, realisations, periods)."""
        u, y = (arrays.get(f"{name}_{level}mV_{use}", np.zeros(0)) for name in "uy")
        if u.ndim != 4 or u.shape != y.shape or u.shape[1] != _CHANNELS or len(u) <= _WINDOW:
            raise InputError(
                f"'{path}': u_{level}mV_{use} has shape {u.shape} and y_{level}mV_{use} {y.shape}; "
                f"expected (samples, {_CHANNELS}, realisations, periods); {official.again(path)}"
            )
        return u, y

    train: list[Record] = []
    chosen_by: list[Record] = []
    tests: list[Record] = []
    for level in chosen:
        u, y = pair(level, "train")
        trained = u.shape[2] - validation
        if trained < 1:
            raise InputError(
                f"validation is {validation}, and there are {u.shape[2]} realisations of "
                f"{level} mV, of which one at least must train; give 0 to {u.shape[2] - 1}."
            )
        for r in range(trained):
            periods = [signal[:, :, r].transpose(2, 0, 1) for signal in (u, y)]  # first of all axes
            signals = [p.mean(axis=0) if mean else p.reshape(-1, _CHANNELS) for p in periods]
            whole = _record(f"train_{level}_{r + 1}", *signals, period=len(u))
            train.append(replace(whole, weight=float(u.shape[3])) if mean else whole)
        chosen_by += _each(f"validation_{level}", u, y, range(trained, u.shape[2]))
    for level in LEVELS:
        if any(f"{name}_{level}mV_test" in arrays for name in "uy"):
            u, y = pair(level, "test")
            tests += _each(f"level_{level}", u, y, range(u.shape[2]))

    def names(records: Sequence[Record], level: str) -> tuple[str, ...]:
        return tuple(record.name for record in records if record.name.startswith(f"{level}_"))

    of = [f"{use}_{level}" for use in ("level", "validation") for level in LEVELS]
    found = {score: names((*chosen_by, *tests), score) for score in of}
    groups = {score: records for score, records in found.items() if records}
    missing = [f"level_{level}" for level in LEVELS if f"level_{level}" not in groups]
    why = f"{path.name} has estimation data alone"
    return Dataset(
        name="fine_steering_mirror",
        train=train,
        validation=chosen_by,
        tests=tests,
        published=official.published("fine_steering_mirror"),
        notes=official.without_tests(missing, why, partly=bool(tests)),
        groups=groups,
        linear={
            f"level_{level}": names(train, f"train_{level}")
            for level in chosen
            if f"level_{level}" in groups
        },
        leaderboard=tests,
    )


def _record(name: str, u: Array, y: Array, *, period: int, skip: int = 0) -> Record:
    """Record of whole periods in steady state."""
    inputs, outputs = (
        {f"{letter}{i + 1}": unit for i in range(_CHANNELS)} for letter, unit in ("uV", "ym")
    )
    return official.record(
        u, y, inputs, outputs, fs=_FS, start="periodic", skip=skip, name=name, period=period
    )


def _each(name: str, u: Array, y: Array, realisations: Iterable[int]) -> list[Record]:
    """Records of each period of some realisations."""
    return [
        _record(
            f"{name}_{r + 1}_{p + 1}",
            *(signal[:, :, r, p].copy() for signal in (u, y)),
            period=len(u),
            skip=_WINDOW,
        )
        for r in realisations
        for p in range(u.shape[3])
    ]
