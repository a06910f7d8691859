"""Parallel Wiener-Hammerstein benchmark: the official measurements, or a simulated stand-in.

Input u (V), output y (V), in steady state, at 78125 Hz: periods of 16384 samples of random-phase
multisines at five levels, and a test of growing amplitude, the arrow. The official file has two
periods of every record, and at each level 20 realisations for estimation and one more as a test.
The stand-in has records of the same shapes (:mod:`lfrtorch.datasets.parwh_simulator`). The
``source`` of each record names its origin: scores on the stand-in do not compare with scores on the
official data.

The official file is read directly. The package nonlinear_benchmarks, which downloads it,
interleaves the two periods sample by sample and leaves the arrow out.

References:
    M. Schoukens, A. Marconato, R. Pintelon, G. Vandersteen, Y. Rolain (2015), "Parametric
    identification of parallel Wiener-Hammerstein systems", Automatica 51.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lfrtorch._support.checks import integer, number
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official
from lfrtorch.datasets.parwh_simulator import FS, PERIOD, Signals, multisine, simulate, stand_in

__all__ = ["LEVELS", "load", "multisine", "simulate"]

LEVELS = (100, 325, 550, 775, 1000)
"""Amplitudes of the records, mV rms."""

_WINDOW = 50  # samples that nonlinearbenchmark.org leaves unscored

_SOURCES = ("auto", "official", "stand-in")
_FILE = "ParWH/ParWHFiles/ParWHData.mat"  # below the benchmarks' folder
_ARCHIVE = "ParWH/ParWHFiles.zip"
_OTHERS = ("ParWH/ParWHData.mat", _ARCHIVE)
_MD5 = "5836dc66b0296b43ba4b8613a032408b"  # checksum of the archive
_PERIODS, _REALISATIONS = 2, 20  # realisations of the estimation part, at each level
_SHAPES = {  # samples, periods, realisations, levels
    **dict.fromkeys(("uEst", "yEst"), (PERIOD, _PERIODS, _REALISATIONS, len(LEVELS))),
    **dict.fromkeys(("uVal", "yVal"), (PERIOD, _PERIODS, 1, len(LEVELS))),
    **dict.fromkeys(("uValArr", "yValArr"), (PERIOD, _PERIODS)),
}

_NOT_FOUND = (
    "the official data are not at hand: all records are the simulated stand-in's "
    "(source='official' downloads the data, root=DIR says where they are)"
)


def load(
    *,
    source: str = "auto",
    root: str | Path | None = None,
    seed: int = 0,
    realisations: int = 1,
    periods: int = 1,
    levels: Sequence[int] = LEVELS,
    noise_rms: float = 3e-4,
) -> Dataset:
    """Records in steady state: multisines at several levels, and the arrow test.

    Training has ``realisations`` records a level and validation one a level. The tests are another
    realisation at each of the five levels (``"level_100"`` .. ``"level_1000"``), and ``"arrow"``,
    noise in the band of the multisines with an amplitude that grows from 0, its first 500 samples
    unscored. The second of the two periods of a test is scored.

    Official data: the last of the 20 realisations validates, the others train. The stand-in's tests
    have no noise; its training and validation records have.

    Args:
        source: ``"official"``, downloaded by the package nonlinear_benchmarks if it is missing;
            ``"stand-in"``; or ``"auto"``, the official file if it is at hand, else the stand-in.
        root: folder that holds ``ParWH/ParWHFiles/ParWHData.mat`` (or ``ParWH/ParWHData.mat``, or
            ``ParWH/ParWHFiles.zip`` with the file in it). If given, ``"auto"`` requires the file.
        seed: choice of the official training records: record r of a level, counted from 0, is
            realisation ``(seed + r) % 19``. All records of the stand-in are drawn from it: record
            r of a level (mV) and use, train 0, validation 1, level test 2 and arrow 3, draws
            first its phases, then its noise from the child
            ``numpy.random.SeedSequence(seed, spawn_key=(use, level, r))``, independently of all
            other records.
        realisations: training records at each level; 1 to 19 of the official data.
        periods: periods of each training and validation record; the input repeats, the noise does
            not. The official data have 1, the second one, or 2.
        levels: levels of training and validation, mV rms.
        noise_rms: rms of white Gaussian noise on the stand-in's training and validation outputs, V.

    Shape:
        u, y (V) of training and validation: (16384 periods, 1); of the tests: (16384, 1).

    Example:
        >>> data = lfrtorch.datasets.parwh.load(source="stand-in", levels=[100], periods=2)
        >>> data.train[0].u.shape, len(data.tests)
        ((32768, 1), 6)
    """
    if source not in _SOURCES:
        raise InputError(f"source is {source!r}; give one of {', '.join(_SOURCES)}.")
    integer("seed", seed, 0)
    integer("realisations", realisations, 1)
    integer("periods", periods, 1)
    number("noise_rms", noise_rms)
    chosen = official.chosen_levels(levels, LEVELS)
    path = _found(source, root)
    signals: Callable[[str, int, int], Signals]
    if path is None:
        signals = partial(stand_in, seed=seed, periods=periods, noise_rms=noise_rms)
        notes = (_NOT_FOUND,) if source == "auto" else ()
    else:
        _check_official(realisations, periods)
        arrays = official.read_arrays(path, _SHAPES, Path(_FILE).name)
        signals = partial(_official, arrays, seed=seed, periods=periods)
        archive = official.folder(root) / _ARCHIVE
        notes = (official.archive_note(archive, _MD5, Path(_FILE).name),)

    def record(name: str, use: str, level: int, r: int = 0, *, skip: int = 0) -> Record:
        return official.record(
            *signals(use, level, r), {"u": "V"}, {"y": "V"}, fs=FS, start="periodic", skip=skip,
            name=name, source="stand-in" if path is None else "official", period=PERIOD,
        )  # fmt: skip

    levels_alone = [record(f"level_{level}", "level", level) for level in LEVELS]
    return Dataset(
        name="parwh",
        train=[
            record(name, "train", level, r)
            for level in chosen
            for r, name in enumerate(_names(level, realisations))
        ],
        validation=[record(f"validation_{level}", "validation", level) for level in chosen],
        tests=[*levels_alone, record("arrow", "arrow", 0, skip=500)],
        noise_rms=noise_rms if path is None else None,
        seed=seed,
        published=official.published("parwh"),
        notes=notes,
        linear=_linear(chosen, realisations),
        leaderboard=[] if path is None else [replace(test, skip=_WINDOW) for test in levels_alone],
    )


def _names(level: int, realisations: int) -> tuple[str, ...]:
    """Names of the training records of a level."""
    several = realisations > 1
    return tuple(f"train_{level}" + f"_{r + 1}" * several for r in range(realisations))


def _linear(levels: Sequence[int], realisations: int) -> dict[str, tuple[str, ...]]:
    """Training records of each test's linear model, as published: its level; 1000 mV for arrow."""
    of_level = {f"level_{level}": _names(level, realisations) for level in levels}
    return of_level | ({"arrow": of_level["level_1000"]} if "level_1000" in of_level else {})


def _check_official(realisations: int, periods: int) -> None:
    """Refuse to train on more than the official file has."""
    for name, asked, most in (
        ("realisations", realisations, _REALISATIONS - 1),
        ("periods", periods, _PERIODS),
    ):
        if asked > most:
            raise InputError(
                f"{name} is {asked}, and the official data have {most} for training; give "
                f"1 to {most} (source='stand-in' simulates as many as are asked for)."
            )


def _official(
    arrays: dict[str, Array], use: str, level: int, r: int, *, seed: int, periods: int
) -> Signals:
    """Return record r of a use and a level, from the official file."""
    if use == "arrow":
        return arrays["uValArr"][:, -1], arrays["yValArr"][:, -1]
    at = LEVELS.index(level)
    if use == "level":
        return arrays["uVal"][:, -1, 0, at], arrays["yVal"][:, -1, 0, at]
    last = _REALISATIONS - 1
    part = np.s_[:, -periods:, last if use == "validation" else (seed + r) % last, at]
    # The periods follow one another; a copy releases the whole arrays.
    u, y = (arrays[name][part].flatten(order="F") for name in ("uEst", "yEst"))
    return u, y


def _found(source: str, root: str | Path | None) -> Path | None:
    """Find the official file; None for the stand-in."""
    if source == "stand-in":
        return None
    try:
        return official.find(root, _FILE, "ParWH", others=_OTHERS, download=source == "official")
    except FileNotFoundError:
        if source == "official" or root is not None:
            raise
        return None
