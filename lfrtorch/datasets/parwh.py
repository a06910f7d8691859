"""Parallel Wiener-Hammerstein benchmark: the official measurements, or a simulated stand-in.

Input u (V), output y (V), in steady state, at 78125 Hz: periods of 16384 samples of random-phase
multisines at five levels, and a test of growing amplitude, the arrow. The official file has two
periods of everything, and at each level 20 realisations for estimation and one more as a test. The
stand-in has records of the same shapes (:mod:`lfrtorch.datasets.parwh_simulator`); each record's
``source`` says whose it is, and a score on the stand-in is not one on the official data.

The official file is read here as it is laid out: the package nonlinear_benchmarks, whose function
for this benchmark downloads it, interleaves the two periods sample by sample and leaves the arrow
out.

References:
    M. Schoukens, A. Marconato, R. Pintelon, G. Vandersteen, Y. Rolain (2015), "Parametric
    identification of parallel Wiener-Hammerstein systems", Automatica 51.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lfrtorch._support.checks import integer, number
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.dataset import Dataset
from lfrtorch.datasets import official
from lfrtorch.datasets.parwh_simulator import FS, PERIOD, Signals, StandIn, multisine, simulate
from lfrtorch.records import Record

__all__ = ["LEVELS", "load", "multisine", "simulate"]

LEVELS = (100, 325, 550, 775, 1000)
"""Amplitudes of the records, mV rms."""

_ARROW_SKIP = 500  # samples, unscored
_WINDOW = 50  # samples that nonlinearbenchmark.org leaves unscored

_SOURCES = ("auto", "official", "stand-in")
_FILE = "ParWH/ParWHFiles/ParWHData.mat"  # below the benchmarks' folder
_ARCHIVE = "ParWH/ParWHFiles.zip"
_OTHERS = ("ParWH/ParWHData.mat", _ARCHIVE)
_MD5 = "5836dc66b0296b43ba4b8613a032408b"  # of the archive of 58203304 bytes
_PERIODS, _REALISATIONS = 2, 20  # of the estimation part, at each level
_SHAPES = {  # samples, periods, realisations, levels
    **dict.fromkeys(("uEst", "yEst"), (PERIOD, _PERIODS, _REALISATIONS, len(LEVELS))),
    **dict.fromkeys(("uVal", "yVal"), (PERIOD, _PERIODS, 1, len(LEVELS))),
    **dict.fromkeys(("uValArr", "yValArr"), (PERIOD, _PERIODS)),
}

_ADVICE = f"remove '{_FILE}' and '{_ARCHIVE}', and download them again."
_NOT_FOUND = (
    "the official data are not at hand: all records are the simulated stand-in's "
    "(source='official' downloads the data, root=DIR says where they are)"
)

_PAPER = "Schoukens and Tóth (2020), table 2, official data"


_PUBLISHED = official.published(
    [*(f"level_{level}" for level in LEVELS), "arrow"],
    (
        "linear (paper)",
        (0.83, 9.46, 19.9, 30.7, 37.7, 45.5),
        f"{_PAPER}; a model for each level, that of 1000 mV for the arrow",
    ),
    ("GRU", (1.75, 3.82, 5.61, 7.23, 10.5), official.BOARD),
    ("NL-LFR (paper)", (0.30, 0.51, 0.72, 1.03, 1.37, 1.42), _PAPER),
    (
        "parallel WH",
        (0.30, 0.50, 0.38, 0.57, 1.10, 2.66),
        "Schoukens et al. (2015), official data",
    ),
    (
        "NL-LFR, inferred",
        (0.200, 0.397, 0.412, 0.469, 0.827),
        f"{official.BOARD}; NL-LFR by inference and learning (2025), a model for each level",
    ),
    unit="mV",
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
    unscored. Of the two periods of a test the second is scored.

    Official data: the last of the 20 realisations validates, the others train. The stand-in's tests
    are noise free, its training and validation are not.

    Args:
        source: ``"official"``, downloaded by the package nonlinear_benchmarks if it is missing;
            ``"stand-in"``; or ``"auto"``, the official file if it is at hand, else the stand-in.
        root: folder that holds ``ParWH/ParWHFiles/ParWHData.mat`` (or ``ParWH/ParWHData.mat``, or
            ``ParWH/ParWHFiles.zip`` with the file in it). If given, ``"auto"`` requires the file.
        seed: of the official data, chooses what trains: record r of a level, counted from 0, is
            realisation ``(seed + r) % 19``. Of the stand-in, seeds all records: record r of a level
            (mV) and use, train 0, validation 1, level test 2 and arrow 3, draws first its phases,
            then its noise from the child
            ``numpy.random.SeedSequence(seed, spawn_key=(use, level, r))``: it stays the same
            whatever else is asked for.
        realisations: training records at each level; of the official data 1 to 19.
        periods: of each training and validation record; the input repeats, the noise does not. Of
            the official data 1, the second one, or 2.
        levels: of training and validation, mV rms.
        noise_rms: of white Gaussian noise on the stand-in's training and validation outputs, V.

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
    if path is None:
        data = StandIn(seed=seed, periods=periods, noise_rms=noise_rms)
        notes = (_NOT_FOUND,) if source == "auto" else ()
    else:
        data = _Official(path, seed=seed, realisations=realisations, periods=periods)
        archive = official.folder(root) / _ARCHIVE
        notes = (official.archive_note(archive, _MD5, Path(_FILE).name),)

    def record(name: str, u: Array, y: Array, *, skip: int = 0) -> Record:
        return official.record(
            u, y, {"u": "V"}, {"y": "V"}, fs=FS, start="periodic", skip=skip, name=name,
            source=data.source, period=PERIOD,
        )  # fmt: skip

    levels_alone = [record(f"level_{level}", *data.test(level)) for level in LEVELS]
    return Dataset(
        name="parwh",
        train=[
            record(name, *data.train(level, r))
            for level in chosen
            for r, name in enumerate(_names(level, realisations))
        ],
        validation=[record(f"validation_{level}", *data.validation(level)) for level in chosen],
        tests=[*levels_alone, record("arrow", *data.arrow(), skip=_ARROW_SKIP)],
        noise_rms=noise_rms if path is None else None,
        seed=seed,
        published=_PUBLISHED,
        notes=notes,
        linear=_linear(chosen, realisations),
        leaderboard=[] if path is None else [replace(test, skip=_WINDOW) for test in levels_alone],
    )


def _names(level: int, realisations: int) -> tuple[str, ...]:
    """Names of the training records of a level."""
    several = realisations > 1
    return tuple(f"train_{level}" + f"_{r + 1}" * several for r in range(realisations))


def _linear(levels: Sequence[int], realisations: int) -> dict[str, tuple[str, ...]]:
    """Training records of the linear model of each test, as published: those of its level; of
    1000 mV for the arrow."""
    of_level = {f"level_{level}": _names(level, realisations) for level in levels}
    return of_level | ({"arrow": of_level["level_1000"]} if "level_1000" in of_level else {})


class _Official:
    """Signals of the records, from the official file.

    Args:
        path: of the file, or of the archive that holds it.
        seed, realisations, periods: see :func:`load`.

    Raises:
        ValueError: more than the file has, or a file that cannot be used.
    """

    source = "official"

    def __init__(self, path: Path, *, seed: int, realisations: int, periods: int) -> None:
        for name, asked, most in (
            ("realisations", realisations, _REALISATIONS - 1),
            ("periods", periods, _PERIODS),
        ):
            if asked > most:
                raise InputError(
                    f"{name} is {asked}, and the official data have {most} for training; give "
                    f"1 to {most} (source='stand-in' simulates as many as are asked for)."
                )
        self.seed, self.periods = seed, periods
        self.arrays = official.read_arrays(path, _SHAPES, Path(_FILE).name, _ADVICE)

    def train(self, level: int, r: int) -> Signals:
        """Training record r of a level (mV rms)."""
        return self._estimation((self.seed + r) % (_REALISATIONS - 1), level)

    def validation(self, level: int) -> Signals:
        """The validation record of a level."""
        return self._estimation(_REALISATIONS - 1, level)

    def test(self, level: int) -> Signals:
        """The test record of a level."""
        last = np.s_[:, -1, 0, LEVELS.index(level)]
        return self.arrays["uVal"][last], self.arrays["yVal"][last]

    def arrow(self) -> Signals:
        """The test of growing amplitude."""
        return self.arrays["uValArr"][:, -1], self.arrays["yValArr"][:, -1]

    def _estimation(self, realisation: int, level: int) -> Signals:
        """The last periods, one after the other; copied, to let go of the whole arrays."""
        part = np.s_[:, -self.periods :, realisation, LEVELS.index(level)]
        u, y = (self.arrays[name][part].flatten(order="F") for name in ("uEst", "yEst"))
        return u, y


def _found(source: str, root: str | Path | None) -> Path | None:
    """The official file, or None for the stand-in."""
    if source == "stand-in":
        return None
    try:
        return official.find(root, _FILE, "ParWH", others=_OTHERS, download=source == "official")
    except FileNotFoundError:
        if source == "official" or root is not None:
            raise
        return None
