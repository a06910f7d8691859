"""F-16 ground vibration test: measurements of an aircraft on the ground, shaken below a wing.

Input: the measured force of the shaker below the right wing (N). Outputs: three accelerations
(m/s²), where the shaker acts (acc1), and on the wing's (acc2) and the payload's (acc3) side of the
mounting of a dummy payload at the wing tip, whose clearance and friction are the nonlinearity. The
modes are lightly damped. Sampled at 400 Hz; at each of seven levels (12.4, 24.6, 36.8, 61.4, 73.6,
85.7 and 97.8 N rms) one realisation of a random-phase multisine of 2 to 15 Hz, 9 periods of 8192
samples in a file of its own, the first of them a transient. Levels 1, 3, 5 and 7 are for
estimation; 2, 4 and 6, whose files end in ``_Validation``, are the tests.

What to know of the files and of the package nonlinear_benchmarks, which downloads them (all of it
from the package and from public code that reads the files, none of it checked on them):

- The force carries measurement noise, and the structure acts back on the shaker and so on the
  force: it is not the generator's signal (``Voltage``, not used here). Noise at the input biases a
  least squares fit; the mean over periods lessens it.
- The package returns the first acceleration alone unless it is told ``output_index``, and swept
  sines and multisines in one list.
- The package's window of 50 samples, 0.125 s, is no warm-up for modes that ring for seconds. The
  tests are therefore simulated from rest at their first sample, where the input begins, and the
  transient of their first period is scored.
- The swept sines (``SineSw``) are not used, nor the special odd multisines (``SpecialOddMSine``),
  whose arrays have three axes and which the package leaves out.
- A score here pools the three outputs; publications give one for each.

References:
    J.P. Noël, M. Schoukens (2017), "F-16 aircraft benchmark based on ground vibration test data",
    Workshop on Nonlinear System Identification Benchmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.dataset import Dataset, Published
from lfrtorch.datasets import official
from lfrtorch.metrics import rms
from lfrtorch.records import Channel, Record

__all__ = ["load"]

_FILE = "F16/F16GVT_Files/BenchmarkData/F16Data_FullMSine_Level{}.mat"
_FS = 400.0  # Hz
_PERIOD, _PERIODS = 8192, 9  # samples, and how many; the first is a transient
_SHAPES = {"Force": (1, _PERIODS * _PERIOD), "Acceleration": (3, _PERIODS * _PERIOD)}
_ESTIMATION, _TESTS = (1, 3, 5, 7), (2, 4, 6)  # levels
_SKIP = 50  # samples, unscored, of the tests

_PUBLISHED = (
    Published(
        "deep LRU",
        {"level_6": float(rms([0.180, 0.167, 0.368]))},
        "Forgione et al. (2024), fitted to multisines and swept sines; of its 0.180, 0.167 and "
        "0.368 m/s² for the three outputs",
    ),
)

_NOTE = "RMSE is that of the three accelerations together"


def load(
    *,
    levels: Sequence[int] = (1, 3, 7),
    validation_level: int = 5,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """Steady-state periods to fit, and whole records of other levels to choose by and to score.

    A training record is the mean of the last 8 of the 9 periods of a level: noise, that of the
    force included, is lower by √8. Validation is done as the tests are, ``"level_2"``,
    ``"level_4"`` and ``"level_6"``: on the whole record of a level that is not fitted, from rest,
    its first 50 samples unscored.

    Args:
        levels: that train, of 1, 3, 5 and 7.
        validation_level: another one of these.
        download: whether files that are missing are downloaded (148 MB) by nonlinear_benchmarks.
        root: folder that holds ``F16/F16GVT_Files/BenchmarkData/F16Data_FullMSine_Level1.mat`` and
            so on; by default the cache folder of the package nonlinear_benchmarks.

    Shape:
        u (N), y (m/s²) of training: (8192, 1), (8192, 3); of validation and of the tests:
        (73728, 1), (73728, 3), of which 73678 are scored.

    Raises:
        ValueError: an argument out of range, or a file that cannot be used.
        FileNotFoundError: no such file below ``root``, or nothing to download it with.
        OSError: the download fails.

    Example:
        >>> data = lfrtorch.datasets.f16.load(download=True)  # doctest: +SKIP
        >>> lfrtorch.datasets.f16.load(root="elsewhere")
        Traceback (most recent call last):
        FileNotFoundError: there is no '...' in 'elsewhere'. Give the folder that holds ...
    """
    trained = _checked(levels, validation_level)

    def whole(level: int, name: str) -> Record:
        """A file, from rest."""
        file = _FILE.format(f"{level}_Validation" if level in _TESTS else level)
        path = official.find(root, file, "F16", download=download)
        signals = official.read_arrays(path, _SHAPES, path.name)
        return Record(
            signals["Force"].T,
            signals["Acceleration"].T,
            fs=_FS,
            skip=_SKIP,
            name=name,
            source="official",
            inputs=(Channel("force", "N"),),
            outputs=tuple(Channel(f"acc{i}", "m/s²") for i in (1, 2, 3)),
            period=_PERIOD,
        )

    def steady(level: int) -> Record:
        """One period, the mean of those without transient."""
        record = whole(level, f"train_{level}")
        return replace(record, u=_mean(record.u), y=_mean(record.y), start="periodic", skip=0)

    return Dataset(
        name="f16",
        train=[steady(level) for level in trained],
        validation=[whole(validation_level, f"validation_{validation_level}")],
        tests=[whole(level, f"level_{level}") for level in _TESTS],
        published=_PUBLISHED,
        notes=(_NOTE,),
    )


def _mean(signal: Array) -> Array:
    """Mean of all periods but the first: (8192, channels)."""
    return signal.reshape(_PERIODS, _PERIOD, -1)[1:].mean(axis=0)


def _checked(levels: Sequence[int], validation_level: int) -> list[int]:
    """The levels that train as plain integers, in the order given."""
    try:
        chosen = [_ESTIMATION[_ESTIMATION.index(level)] for level in (*levels, validation_level)]
    except (TypeError, ValueError):
        chosen = []
    if len(chosen) < 2 or len(set(chosen)) < len(chosen):
        raise InputError(
            f"levels is {levels} and validation_level is {validation_level}; give one or "
            f"more of {', '.join(map(str, _ESTIMATION))} to train, as [1, 3, 7], and "
            "another one of them to validate on, each once."
        )
    return chosen[:-1]
