"""Parallel Wiener-Hammerstein benchmark: a simulated stand-in with the shapes of the official data.

Input u (V), output y (V), in steady state, at 78125 Hz. A score on these records says
``"stand-in"`` and is not one on the official data.

References:
    M. Schoukens, A. Marconato, R. Pintelon, G. Vandersteen, Y. Rolain (2015), "Parametric
    identification of parallel Wiener-Hammerstein systems", Automatica 51.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lfrtorch.checks import integer, number
from lfrtorch.datasets import Dataset, Published
from lfrtorch.datasets.parwh_simulator import FS, PERIOD, StandIn, multisine, simulate
from lfrtorch.records import Channel, Record

__all__ = ["LEVELS", "load", "multisine", "simulate"]

LEVELS = (100, 325, 550, 775, 1000)
"""Amplitudes of the records, mV rms."""

_ARROW_SKIP = 500  # samples, unscored

_PAPER = "Schoukens and Tóth (2020), table 2, official data"


def _published(label: str, millivolts: Sequence[float], reference: str = _PAPER) -> Published:
    names = [*(f"level_{level}" for level in LEVELS), "arrow"]
    scores = {name: 1e-3 * value for name, value in zip(names, millivolts, strict=True)}
    return Published(label, scores, reference)


_PUBLISHED = (
    _published(
        "LTI (paper)",
        (0.83, 9.46, 19.9, 30.7, 37.7, 45.5),
        f"{_PAPER}; a model for each level, that of 1000 mV for the arrow",
    ),
    _published("NL-LFR (paper)", (0.30, 0.51, 0.72, 1.03, 1.37, 1.42)),
    _published(
        "parallel WH",
        (0.30, 0.50, 0.38, 0.57, 1.10, 2.66),
        "Schoukens et al. (2015), official data",
    ),
)


def load(
    *,
    seed: int = 0,
    realisations: int = 1,
    periods: int = 1,
    levels: Sequence[int] = LEVELS,
    noise_rms: float = 3e-4,
) -> Dataset:
    """Simulated records in steady state: multisines at several levels, and the arrow test.

    Training has ``realisations`` records a level and validation one a level, all with measurement
    noise. The tests are noise free and always the same for a seed: another realisation at each of
    the five levels (``"level_100"`` .. ``"level_1000"``), and ``"arrow"``, Gaussian noise in the
    band of the multisines with an amplitude that grows from 0, its first 500 samples unscored. The
    arrow is one period in steady state, too: of two simulated periods the second is scored.

    (The official file has 20 realisations of 2 periods a level.)

    Args:
        seed: of all records. Record r of a level (mV) and use, train 0, validation 1, level test 2
            and arrow 3, draws first its phases, then its noise from the child
            ``numpy.random.SeedSequence(seed, spawn_key=(use, level, r))``: it stays the same
            whatever else is asked for.
        realisations: training records at each level.
        periods: of each training and validation record; the input repeats, the noise does not.
        levels: of training and validation, mV rms.
        noise_rms: of white Gaussian noise on the training and validation outputs, V.

    Shape:
        u, y (V) of training and validation: (16384 periods, 1); of the tests: (16384, 1).

    Raises:
        ValueError: an argument out of range.
    """
    integer("data.seed", seed, 0)
    integer("data.realisations", realisations, 1)
    integer("data.periods", periods, 1)
    number("data.noise_rms", noise_rms)
    chosen = _checked(levels)

    data = StandIn(seed=seed, periods=periods, noise_rms=noise_rms)
    several = realisations > 1

    def record(
        name: str, u: NDArray[np.float64], y: NDArray[np.float64], *, skip: int = 0
    ) -> Record:
        return Record(
            u,
            y,
            fs=FS,
            start="periodic",
            skip=skip,
            name=name,
            source=data.source,
            inputs=(Channel("u", "V"),),
            outputs=(Channel("y", "V"),),
            period=PERIOD,
        )

    return Dataset(
        name="parwh",
        train=[
            record(f"train_{level}" + f"_{r + 1}" * several, *data.train(level, r))
            for level in chosen
            for r in range(realisations)
        ],
        validation=[record(f"validation_{level}", *data.validation(level)) for level in chosen],
        tests=[
            *(record(f"level_{level}", *data.test(level)) for level in LEVELS),
            record("arrow", *data.arrow(), skip=_ARROW_SKIP),
        ],
        noise_rms=noise_rms,
        published=_PUBLISHED,
    )


def _checked(levels: Sequence[int]) -> list[int]:
    """The levels as plain integers, in the order given."""
    try:
        given = list(levels)
        chosen = [LEVELS[LEVELS.index(level)] for level in given]
    except (TypeError, ValueError):
        chosen = []
    if not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(
            f"data.levels is {levels}; give one or more of {', '.join(map(str, LEVELS))} (mV rms), "
            "each once, for example [100, 1000]."
        )
    return chosen
