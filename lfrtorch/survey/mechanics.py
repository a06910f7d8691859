"""Detection of feedback around a system, and of dry friction in it."""

from __future__ import annotations

import numpy as np

from lfrtorch._support.types import Array

_LAGS = 20  # past samples that predict the next one; fewer in short records
_MOST, _FEWEST = 20_000, 300  # samples that are used, the first ones of a long record

# The input reacts if past surprises of the output explain REACTS of the input's own surprises, and
# CHANCE times what they would by chance, and in either half of the record HALF of it. A controller
# acts all the time; a frozen sensor or samples out of order do not. An input whose surprises are
# below FORESEEN of its rms is planned.
_REACTS, _CHANCE, _HALF, _FORESEEN = 0.03, 5.0, 0.5, 1e-3
_WINDOWS, _SPAN = (1, 3, 10, 30, 100), 40  # samples of a moving mean; SPAN of them in a record

# Friction is dry if position, speed and acceleration with the direction of motion explain EXPLAINED
# of the force, and leave at most LEFT of what they leave without the direction.
_EXPLAINED, _LEFT = 0.9, 0.6
_LEVELS = 16  # an input of so few values turns the motion by its steps: not a sign of friction


def reacting(u: Array, y: Array, *, feedthrough: bool = True) -> Array:
    """Return the part of each input's surprises that the outputs' past surprises explain.

    A surprise is what a prediction from past samples leaves. Inputs of an experiment without
    feedback do not depend on the noise of the outputs; what chance explains counts as 0. A
    controller that acts only in the same sample is found only if ``feedthrough`` is False, which
    says that the input does not act on the output at once: a system with feedthrough looks alike.

    Shape:
        u: (T, nu), y: (T, ny) -> (nu,).
    """
    u, y = (s[:_MOST, np.ptp(s, axis=0) > 0] for s in (u, y))
    if len(u) < _FEWEST:
        return np.zeros(u.shape[1])
    part, least = _explained(u, y, feedthrough)
    part = np.where(part < least, 0.0, part)
    for half in (slice(0, len(u) // 2), slice(len(u) // 2, None)) if part.any() else ():
        again, least = _explained(u[half], y[half], feedthrough)
        part = np.where(again < _HALF * least, 0.0, part)
    return part


def _explained(u: Array, y: Array, feedthrough: bool) -> tuple[Array, float]:
    """Part (nu,) of each input's surprises that the outputs explain, and the least that counts."""
    T, nu, ny = len(u), u.shape[1], y.shape[1]
    n = min(_LAGS, T // (10 * max(1, nu + ny)))
    none = np.zeros(nu)
    if n < 1 or T < _FEWEST // 2 or not nu * ny:
        return none, 1.0
    u, y = ((s - s.mean(axis=0)) / np.maximum(s.std(axis=0), 1e-300) for s in (u, y))
    e = _left(y[n:], u[n:, : nu * feedthrough], _past(u, n), _past(y, n))
    e = e[:, e.std(axis=0) > 1e-7]  # smaller ones are rounding
    if not e.size:
        return none, 1.0
    e = e / e.std(axis=0)
    before, own = _past(e, n), _past(u[n:], n)
    if not feedthrough:
        before = np.hstack([before, e[n:]])
    alone, both = (_left(u[2 * n :], own, *more) for more in ((), (before,)))
    power = np.maximum(np.sum(alone**2, axis=0), 1e-300)
    part = 1.0 - np.sum(both**2, axis=0) / power
    foreseen = np.sqrt(power / len(alone)) < _FORESEEN
    return np.where(foreseen, 0.0, part), max(_REACTS, _CHANCE * n * ny / len(alone))


def rubs(u: Array, y: Array) -> bool:
    """Return whether a force (T,) that moves a position (T,) changes with the direction."""
    # The signals are averaged over windows of several lengths, as differences enlarge noise.
    T = len(u)
    if len(np.unique(u)) <= _LEVELS or np.ptp(y) == 0:
        return False
    for window in _WINDOWS:
        if _SPAN * window > T:
            break
        mean = np.ones(window) / window
        f, x = (np.convolve(s, mean, "valid")[:: max(1, window // 2)] for s in (u, y))
        v, a, x, f = (x[2:] - x[:-2]) / 2, np.diff(x, 2), x[1:-1], f[1:-1]
        total = np.sum((f - f.mean()) ** 2)
        smooth = [s[:, None] for s in (x, v, a)]
        without, along = (
            np.sum(_left(f[:, None], *smooth, *more) ** 2) for more in ((), (np.sign(v)[:, None],))
        )
        if along < (1 - _EXPLAINED) * total and along < _LEFT * without:
            return bool(without > 1e-9 * total)
    return False


def _past(signals: Array, n: int) -> Array:
    """Samples k - 1 .. k - n of signals (T, m) for k = n .. T - 1: (T - n, n m)."""
    return np.hstack([signals[n - j : len(signals) - j] for j in range(1, n + 1)])


def _left(target: Array, *columns: Array) -> Array:
    """Residuals of the regression of a target (T, m) on columns and a constant."""
    rows = np.hstack([np.ones((len(target), 1)), *columns])
    rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    return target - rows @ np.linalg.lstsq(rows, target, rcond=1e-12)[0]
