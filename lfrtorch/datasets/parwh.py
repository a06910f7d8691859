"""Parallel Wiener-Hammerstein benchmark: a simulated stand-in with the shapes of the official data.

Two Wiener-Hammerstein branches side by side, input u (V), output y (V), 12 states::

    y = 0.84 (H2 f1(H1 u) + 0.7 H4 f2(H3 u))

    H1 Chebyshev I, 0.5 dB, 4.4 kHz         H2 Chebyshev II, 40 dB, 9 kHz
    H3 Butterworth, 6 kHz                   H4 elliptic, 0.5 dB, 30 dB, 12 kHz      (order 3, all)
    f1(v) = v - 0.4 s(v - 0.2)              saturates on one side
    f2(v) = v - 0.4 s(v - 0.2) + 0.4 s(-v - 0.2)      on both
    s(v)  = 0.05 log(1 + exp(v / 0.05))

The official system is a circuit of this structure; the filters and saturations here are chosen so
that linear models leave about the errors that are published for it (0.83, 9.46, 19.9, 30.7 and
37.7 mV). A score on these records says ``"stand-in"`` and is not one on the official data.

References:
    M. Schoukens, A. Marconato, R. Pintelon, G. Vandersteen, Y. Rolain (2015), "Parametric
    identification of parallel Wiener-Hammerstein systems", Automatica 51.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import butter, cheby1, cheby2, ellip, freqz

from lfrtorch.checks import integer, number
from lfrtorch.datasets import Dataset, Published
from lfrtorch.records import Channel, Record

__all__ = ["LEVELS", "load", "multisine", "simulate"]

LEVELS = (100, 325, 550, 775, 1000)
"""Amplitudes of the records, mV rms."""

_FS = 78125.0  # Hz
_PERIOD = 16384  # samples
_LINES = slice(1, 4096)  # of rfft, that are excited: 2 to 4096 counted from 1 at DC
_ARROW_SKIP = 500  # samples, unscored
_ARROW_RMS = 1.0  # V, of its last tenth

_H1 = cheby1(3, 0.5, 4.4e3, fs=_FS)
_H2 = cheby2(3, 40, 9e3, fs=_FS)
_H3 = butter(3, 6e3, fs=_FS)
_H4 = ellip(3, 0.5, 30, 12e3, fs=_FS)

_USES = ("train", "validation", "level", "arrow")  # first number of a record's seed

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
    if not np.isfinite(noise_rms):
        raise ValueError(f"data.noise_rms is {noise_rms} V; give 0 or more (officially 3e-4 V).")
    chosen = _checked(levels)

    def multisines(use: str, name: str, level: int, r: int = 0, **kwargs: Any) -> Record:
        rng = _generator(seed, use, level, r)
        return _record(name, multisine(rms=1e-3 * level, seed=rng), rng, **kwargs)

    noisy: dict[str, Any] = {"periods": periods, "noise_rms": noise_rms}
    several = realisations > 1
    arrow = _generator(seed, "arrow")
    return Dataset(
        name="parwh",
        train=[
            multisines("train", f"train_{level}" + f"_{r + 1}" * several, level, r, **noisy)
            for level in chosen
            for r in range(realisations)
        ],
        validation=[
            multisines("validation", f"validation_{level}", level, **noisy) for level in chosen
        ],
        tests=[
            *(multisines("level", f"level_{level}", level) for level in LEVELS),
            _record("arrow", _arrow(arrow), arrow, skip=_ARROW_SKIP),
        ],
        noise_rms=noise_rms,
        published=_PUBLISHED,
    )


def multisine(
    *, rms: float = 1.0, seed: int | np.random.SeedSequence | np.random.Generator = 0
) -> NDArray[np.float64]:
    """One period of a random-phase multisine: lines 1 to 4095 of 4.77 Hz, of equal magnitude.

    Args:
        rms: V.
        seed: of the phases, uniform, or a generator to draw them from.

    Shape:
        (16384,), V.

    Raises:
        ValueError: an rms that is not positive.
    """
    number("rms", rms, positive=True)
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, _LINES.stop - _LINES.start)
    spectrum = np.zeros(_PERIOD // 2 + 1, complex)
    spectrum[_LINES] = np.exp(1j * phase)
    u = np.fft.irfft(spectrum, _PERIOD)
    return rms * u / np.sqrt(np.mean(u**2))


def simulate(u: ArrayLike) -> NDArray[np.float64]:
    """Output in the steady state that the input, repeated for ever, leads to; noise free.

    Exact: a filter in steady state multiplies each spectral line by its frequency response, and the
    saturations act sample by sample.

    Args:
        u: one period, or several, of any length.

    Shape:
        u: (T,), V. Returns: (T,), V.

    Raises:
        ValueError: an input of wrong shape or with NaN.
    """
    u = np.asarray(u, dtype=np.float64)
    if u.ndim != 1 or not u.size or not np.isfinite(u).all():
        raise ValueError(
            f"the input has shape {u.shape}; give one dimension of finite numbers, in V."
        )

    def line_by_line(H: tuple, signal: NDArray[np.float64]) -> NDArray[np.float64]:
        w = 2 * np.pi * np.fft.rfftfreq(u.size)
        return np.fft.irfft(freqz(*H, worN=w)[1] * np.fft.rfft(signal), u.size)

    v1, v2 = line_by_line(_H1, u), line_by_line(_H3, u)
    w1 = v1 - 0.4 * _s(v1 - 0.2)
    w2 = v2 - 0.4 * _s(v2 - 0.2) + 0.4 * _s(-v2 - 0.2)
    return 0.84 * (line_by_line(_H2, w1) + 0.7 * line_by_line(_H4, w2))


def _s(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """A smooth max(v, 0)."""
    return 0.05 * np.logaddexp(0.0, v / 0.05)


def _arrow(rng: np.random.Generator) -> NDArray[np.float64]:
    """Gaussian noise (16384,) in the multisines' band, growing to 1 V rms in its last tenth."""
    white = np.fft.rfft(rng.standard_normal(_PERIOD))
    spectrum = np.zeros_like(white)
    spectrum[_LINES] = white[_LINES]
    u = np.linspace(0, 1, _PERIOD) * np.fft.irfft(spectrum, _PERIOD)
    return _ARROW_RMS * u / np.sqrt(np.mean(u[-_PERIOD // 10 :] ** 2))


def _record(
    name: str,
    u: NDArray[np.float64],
    rng: np.random.Generator,
    *,
    periods: int = 1,
    noise_rms: float = 0.0,
    skip: int = 0,
) -> Record:
    noise = rng.standard_normal(periods * _PERIOD)
    return Record(
        np.tile(u, periods),
        np.tile(simulate(u), periods) + noise_rms * noise,
        fs=_FS,
        start="periodic",
        skip=skip,
        name=name,
        source="stand-in",
        inputs=(Channel("u", "V"),),
        outputs=(Channel("y", "V"),),
        period=_PERIOD,
    )


def _generator(seed: int, use: str, level: int = 0, r: int = 0) -> np.random.Generator:
    key = (_USES.index(use), level, r)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


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
