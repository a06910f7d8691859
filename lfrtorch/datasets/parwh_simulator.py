"""Parallel Wiener-Hammerstein stand-in: a simulated system with the shapes of the official data.

Two Wiener-Hammerstein branches side by side, input u (V), output y (V), 12 states::

    y = 0.84 (H2 f1(H1 u) + 0.7 H4 f2(H3 u))

    H1 Chebyshev I, 0.5 dB, 4.4 kHz         H2 Chebyshev II, 40 dB, 9 kHz
    H3 Butterworth, 6 kHz                   H4 elliptic, 0.5 dB, 30 dB, 12 kHz      (order 3, all)
    f1(v) = v - 0.4 s(v - 0.2)              saturates on one side
    f2(v) = v - 0.4 s(v - 0.2) + 0.4 s(-v - 0.2)      on both
    s(v)  = 0.05 log(1 + exp(v / 0.05))

The official system is a circuit of this structure; the filters and saturations here are chosen so
that linear models leave about the errors that are published for it (0.83, 9.46, 19.9, 30.7 and
37.7 mV).
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import ArrayLike

from lfrtorch._support.checks import number
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.metrics import rms as rms_of

FS = 78125.0
"""Sampling frequency of the records, Hz."""

PERIOD = 16384
"""Samples of a period."""

_LINES = slice(1, 4096)  # excited lines of rfft: 2 to 4096 counted from 1 at DC

Signals = tuple[Array, Array]
"""Input and output, (samples,) each, V."""


def stand_in(use: str, level: int, r: int, *, seed: int, periods: int, noise_rms: float) -> Signals:
    """Return record r of a use and a level (mV rms), in steady state; tests are noise free."""
    key = ("train", "validation", "level", "arrow").index(use), level, r
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
    if use == "arrow":
        u = _arrow(rng)
        return u, simulate(u)
    u = multisine(rms=1e-3 * level, seed=rng)
    if use == "level":
        return u, simulate(u)
    noise = rng.standard_normal(periods * PERIOD)
    return np.tile(u, periods), np.tile(simulate(u), periods) + noise_rms * noise


def multisine(
    *, rms: float = 1.0, seed: int | np.random.SeedSequence | np.random.Generator = 0
) -> Array:
    """Period of a random-phase multisine: lines 1 to 4095 of 4.77 Hz, of equal magnitude.

    Args:
        rms: rms, V.
        seed: seed of the uniform phases, or a generator to draw them from.

    Shape:
        (16384,), V.

    Raises:
        ValueError: an rms that is not positive.

    Example:
        >>> u = lfrtorch.datasets.parwh.multisine(rms=0.5)
        >>> u.shape, round(float(np.std(u)), 2)
        ((16384,), 0.5)
    """
    number("rms", rms, positive=True)
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, _LINES.stop - _LINES.start)
    spectrum = np.zeros(PERIOD // 2 + 1, complex)
    spectrum[_LINES] = np.exp(1j * phase)
    u = np.fft.irfft(spectrum, PERIOD)
    return rms * u / rms_of(u)


def simulate(u: ArrayLike) -> Array:
    """Output in periodic steady state under the repeated input; noise free.

    The result is exact: a filter in steady state multiplies each spectral line by its frequency
    response, and the saturations act sample by sample.

    Args:
        u: one period, or several, of any length.

    Shape:
        u: (T,), V. Returns: (T,), V.

    Raises:
        ValueError: an input of wrong shape or with NaN.

    Example:
        >>> u = lfrtorch.datasets.parwh.multisine()
        >>> lfrtorch.datasets.parwh.simulate(u).shape
        (16384,)
    """
    u = np.asarray(u, dtype=np.float64)
    if u.ndim != 1 or not u.size or not np.isfinite(u).all():
        raise InputError(
            f"the input has shape {u.shape}; give one dimension of finite numbers, in V."
        )

    H1 = scipy.signal.cheby1(3, 0.5, 4.4e3, fs=FS)
    H2 = scipy.signal.cheby2(3, 40, 9e3, fs=FS)
    H3 = scipy.signal.butter(3, 6e3, fs=FS)
    H4 = scipy.signal.ellip(3, 0.5, 30, 12e3, fs=FS)

    def line_by_line(H: tuple, signal: Array) -> Array:
        w = 2 * np.pi * np.fft.rfftfreq(u.size)
        return np.fft.irfft(scipy.signal.freqz(*H, worN=w)[1] * np.fft.rfft(signal), u.size)

    v1, v2 = line_by_line(H1, u), line_by_line(H3, u)
    w1 = v1 - 0.4 * _s(v1 - 0.2)
    w2 = v2 - 0.4 * _s(v2 - 0.2) + 0.4 * _s(-v2 - 0.2)
    return 0.84 * (line_by_line(H2, w1) + 0.7 * line_by_line(H4, w2))


def _s(v: Array) -> Array:
    """Smooth max(v, 0)."""
    return 0.05 * np.logaddexp(0.0, v / 0.05)


def _arrow(rng: np.random.Generator) -> Array:
    """Gaussian noise (16384,) in the multisines' band, growing to 1 V rms in its last tenth."""
    white = np.fft.rfft(rng.standard_normal(PERIOD))
    spectrum = np.zeros_like(white)
    spectrum[_LINES] = white[_LINES]
    u = np.linspace(0, 1, PERIOD) * np.fft.irfft(spectrum, PERIOD)
    return u / rms_of(u[-PERIOD // 10 :])
