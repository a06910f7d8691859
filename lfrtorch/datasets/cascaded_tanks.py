"""Cascaded tanks benchmark: water levels with overflow, official split.

The input u (V) drives the pump that fills the upper tank. The output y (V) is the level of the
lower tank, into which the upper one drains. Estimation and test have 1024 samples each, 4 s apart.
The outflow is proportional to the root of the level. At large inputs the upper tank overflows,
partly into the lower one, and the sensor of the lower one saturates at 10 V (48 estimation
samples): a limit of the records.

The records do not begin at rest; their start states are unknown, but the same according to the
benchmark. Older versions of the package nonlinear_benchmarks left 5 samples of the test unscored,
version 1.0 leaves 50; published scores may have either.

References:
    M. Schoukens, P. Mattson, T. Wigren, J.P. Noël (2016), "Cascaded tanks benchmark combining soft
    and hard nonlinearities", Workshop on Nonlinear System Identification Benchmarks.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lfrtorch._support.checks import integer, number
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official

__all__ = ["load"]

_FILE = "Cascaded_Tanks/CascadedTanksFiles/dataBenchmark.mat"
_FS = 0.25  # Hz
_SAMPLES = 1024  # samples of each record
_MOST = 10.0  # saturation of the sensor, V
_WINDOW = 50  # samples that nonlinear_benchmarks leaves unscored


def load(
    *,
    validation: float = 0.0,
    first: int = 256,
    skip: int = _WINDOW,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """Estimation record, whole or cut in time for training and validation, and the test record.

    Training estimates its start states with the parameters. A validation record is the estimation
    record up to the last validation sample; it skips the samples before the first validation
    sample, to which its start state is fitted. The start state of the test is fitted to its first
    ``skip`` samples.

    Args:
        validation: fraction of the estimation samples that validate. With 0 all of them train, so
            that both overflows and the only inputs below 1.2 V (in the last quarter) are fitted.
        first: first validation sample, counted from 0; samples before and after them train.
        skip: samples at the beginning of the test that are not scored.
        download: download a missing file.
        root: folder that holds ``Cascaded_Tanks/CascadedTanksFiles/dataBenchmark.mat``.

    Shape:
        u, y (V) of training: (1024, 1), or (256, 1) and (512, 1) with ``validation=0.25``; of
        validation: (512, 1), 256 of them scored; of the test ``"test"``: (1024, 1), 974 scored.

    Example:
        >>> data = lfrtorch.datasets.cascaded_tanks.load(download=True)  # doctest: +SKIP
    """
    integer("skip", skip, 1)
    number("validation", validation)
    held_out = official.held_out(_SAMPLES, validation) if validation else 0
    latest = _SAMPLES - held_out
    integer("first", first, 1)
    if first > latest:
        raise InputError(
            f"first is {first}, and {held_out} samples are to validate from there on; there "
            f"are {_SAMPLES}: give {latest} at most, or a smaller validation."
        )
    path = official.find(root, _FILE, "Cascaded_Tanks", download=download)
    shapes = {name: (_SAMPLES,) for name in ("uEst", "yEst", "uVal", "yVal")}
    estimation_u, estimation_y, test_u, test_y = official.read_arrays(path, shapes).values()
    settings: dict[str, Any] = {"fs": _FS, "start": "estimated", "limits": (None, _MOST)}

    def record(name: str, u: Array, y: Array, skip: int = 0) -> Record:
        return official.record(u, y, {"u": "V"}, {"y": "V"}, name=name, skip=skip, **settings)

    whole, end = record("train", estimation_u, estimation_y), first + held_out

    def part(name: str, first: int, last: int, warm_up: int = 0) -> Record:
        return official.part(whole, first, last, warm_up=warm_up, name=name, start="estimated")

    train, chosen = [whole], []
    if held_out:
        train = [part("train", 0, first)]
        if end < _SAMPLES:
            train.append(part("train, after", end, _SAMPLES))
        chosen = [part("validation", first, end, first)]
    return Dataset(
        name="cascaded_tanks",
        train=train,
        validation=chosen,
        tests=[record("test", test_u, test_y, skip)],
        leaderboard=[record("test", test_u, test_y, _WINDOW)],
        published=official.published("cascaded_tanks"),
    )
