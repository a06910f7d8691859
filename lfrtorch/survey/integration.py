"""Test for an output that integrates the inputs, by spectra at the lowest excited frequencies.

If an output integrates n times, its n-th difference V follows the inputs U at these frequencies
with a real gain that does not change with frequency. In any other stable system that gain is
imaginary and rises, or belongs to a resonance and changes quickly. A fit of first order, over a few
more lines, tells how soon the system forgets:

    V + a V / jω = (b + jω c) U,

where 1 / a is its time constant.

An output that is the integral of another output, as a position is of a speed, shows this without a
spectrum: its change over a stretch is a multiple of the other output's integral. A mass on a spring
shows it, too; without a spring the response to the inputs grows towards the lowest frequencies.
"""

from __future__ import annotations

import numpy as np

from lfrtorch._support.types import Array, Complex

_SHORTEST = 100  # samples of the shortest record that is tested

# Number of the first excited line at most, by number of integrators. Two need a lower line: above
# its resonance a mass on a spring looks like a free mass.
_LOWEST = {1: 12, 2: 4}
_EXCITED, _STRONG = 1e-3, 1e-2  # power of the first excited line, and of those in the fit, relative

# In the lower band V has coherence COHERENT with the inputs and phases of at most REAL degrees; in
# the upper band, where friction distorts, coherence UPPER. The ratio of its size to the inputs'
# differs between the bands by at most the factor EVEN.
_COHERENT, _REAL, _UPPER, _EVEN = 0.95, 25.0, 0.4, 0.6

# The fit has LINES lines and more for each input, and is conclusive if it explains FITTED of them.
# The output then integrates if the record is shorter than FORGETS time constants, b alone explains
# 1 ± GAIN of the lowest lines, and c is at most LAG of it there.
_LINES, _FITTED, _FORGETS, _GAIN, _LAG = 12, 0.75, 3.0, 0.5, 0.3

# Over one of so many stretches, the change of an output has this correlation with the integral of
# its rate.
_STRETCHES, _ALIKE = 200, 0.95

# Position, speed and acceleration of any mass are linked; more outputs show a mass without spring.
_LINKED = 3

# Smallest ratio of the response's power in the first band to the second: an integrator with a white
# input has 28, a spring 1.
_BANDS, _GROWS = (slice(1, 5), slice(5, 17)), 14.0


def integrators(u: Array, y: Array) -> int:
    """Return how many integrators, 0, 1 or 2, lie between inputs (T, nu) and an output (T,)."""
    # A system with a time constant longer than a third of the record counts as integrating.
    T, u = len(y), u[:, np.ptp(u, axis=0) > 0]
    if T < _SHORTEST or np.ptp(y) == 0 or not u.size:
        return 0
    U = _spectrum(u / u.std(axis=0), T)
    power = (np.abs(U) ** 2).sum(axis=1)
    power[0] = 0.0
    first = int(np.argmax(power > _EXCITED * power.max()))
    for n, lowest in _LOWEST.items():
        if first > lowest:
            break
        V, before = (_differenced(y, times) for times in (n, n - 1))
        fitted, integrates = _first_order(U, V, before, power, first)
        if integrates if fitted else _even(U, V, max(first, 2)):
            return n
    return 0


def rates(y: Array) -> list[int | None]:
    """Return for each output of y (T, ny) the number of the output that is its rate, or None."""
    T, ny = y.shape
    if T < _SHORTEST:
        return [None] * ny
    m = max(1, T // _STRETCHES)
    between = (y[1:] + y[:-1]) / 2
    integral = np.vstack([np.zeros(ny), np.cumsum(between - between.mean(axis=0), axis=0)])
    change, area = (s[m:] - s[:-m] for s in (y, integral))
    change, area = (s - s.mean(axis=0) for s in (change, area))
    sizes = np.linalg.norm(change, axis=0)[:, None] * np.linalg.norm(area, axis=0)
    alike = np.abs(change.T @ area) / np.maximum(sizes, 1e-300)
    np.fill_diagonal(alike, 0.0)
    best = alike.argmax(axis=1)
    return [int(j) if alike[i, j] > _ALIKE else None for i, j in enumerate(best)]


def grows(u: Array, y: Array) -> bool:
    """Return whether the response of an output (T,) to inputs (T, nu) grows as an integrator's."""
    T, u = len(y), u[:, np.ptp(u, axis=0) > 0]
    if T < _SHORTEST or not u.size:
        return False
    by_u, by_y = (
        (np.abs(_spectrum(s / np.maximum(s.std(axis=0), 1e-300), T)) ** 2).sum(axis=1)
        for s in (u, y[:, None])
    )
    low, high = (by_y[band].sum() / max(by_u[band].sum(), 1e-300) for band in _BANDS)
    return bool(low > _GROWS * high)


def chain(rate: list[int | None]) -> tuple[int, int] | None:
    """Return an output and its rate, if the rate is an integral as well."""
    for i in range(len(rate)):
        linked: list[int] = [i]
        while (j := rate[linked[-1]]) is not None and j not in linked:
            linked.append(j)
        if len(linked) > _LINKED:
            return linked[0], linked[1]
    return None


def _spectrum(signals: Array, T: int) -> Complex:
    """Spectrum of signals (up to T, n) under a Hann window, T lines."""
    window = np.hanning(len(signals))[:, None]
    return np.fft.rfft((signals - signals.mean(axis=0)) * window, T, axis=0)


def _differenced(y: Array, times: int) -> Complex:
    """Spectrum of a difference of y (T,), which lies between the samples."""
    T = len(y)
    V = _spectrum(np.diff(y, times)[:, None], T)[:, 0]
    return V * np.exp(-1j * np.pi * times * np.arange(len(V)) / T)


def _first_order(
    U: Complex, V: Complex, before: Complex, power: Array, first: int
) -> tuple[bool, bool]:
    """Tell if the fit of first order is conclusive, and if it finds an integrator."""
    nu = U.shape[1]
    k = np.arange(first, min(3 * first + _LINES * nu, len(V)))
    k = k[power[k] > _STRONG * power[k].max()]
    jw = 2j * np.pi * k[:, None] / (2 * (len(V) - 1))
    around = np.abs(k[:, None] - k) <= 2
    weight = 1.0 / np.sqrt(np.maximum(around @ np.abs(V[k]) ** 2, 1e-300))
    rows = weight[:, None] * np.hstack([V[k, None], -before[k, None], U[k], jw * U[k]])
    rows = np.vstack([rows.real, rows.imag])
    target, rows = rows[:, 0], rows[:, 1:]
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    theta = np.linalg.lstsq(rows / size, target, rcond=None)[0] / size
    left = np.sum((target - rows @ theta) ** 2)
    if len(k) < 2 * (1 + 2 * nu) or left > (1 - _FITTED) * np.sum(target**2):
        return False, False
    low = k <= k[0] + 3
    gain, lag = U[k[low]] @ theta[1 : 1 + nu], (jw * U[k])[low] @ theta[1 + nu :]
    share = np.sum(np.abs(gain) ** 2) / np.sum(np.abs(V[k[low]]) ** 2)
    return True, bool(
        abs(theta[0]) * 2 * (len(V) - 1) < _FORGETS
        and abs(share - 1) < _GAIN
        and np.sum(np.abs(lag) ** 2) < _LAG**2 * np.sum(np.abs(gain) ** 2)
    )


def _even(U: Complex, V: Complex, first: int) -> bool:
    """Tell if V follows U with a real gain that is the same in two bands."""
    middle = 2 * first + 2 * U.shape[1]
    if 3 * middle > len(V):
        return False
    sizes = []
    for band, coherent in (
        (slice(first, middle), _COHERENT),
        (slice(middle, 3 * middle), _UPPER),
    ):
        H = np.linalg.lstsq(U[band], V[band], rcond=None)[0]
        total = np.sum(np.abs(V[band]) ** 2)
        if np.sum(np.abs(V[band] - U[band] @ H) ** 2) > (1 - coherent) * total:
            return False
        turned = np.abs(H.imag) > np.tan(np.deg2rad(_REAL)) * np.abs(H.real)
        if total == 0 or (not sizes and turned.any()):
            return False
        sizes.append(total / np.sum(np.abs(U[band]) ** 2))
    return bool(_EVEN < np.sqrt(sizes[1] / sizes[0]) < 1 / _EVEN)
