"""What closes a loop, and what rubs: feedback around a system, and dry friction in it."""

from __future__ import annotations

import numpy as np

from lfrtorch._support.types import Array

LAGS, MOST, FEWEST = 20, 20_000, 300
"""Past samples that predict the next one, fewer in short records; samples that are looked at, the
first ones of a long record; and the fewest."""

REACTS, CHANCE = 0.03, 5.0
"""The input reacts if past surprises of the output explain REACTS of the input's own, and CHANCE
times what they would by chance."""

FORESEEN = 1e-3
"""An input whose surprises are below this part of it is planned: no controller makes it."""

WINDOWS, SPAN = (1, 3, 10, 30, 100), 40
"""Samples of a moving mean, in a record of SPAN times as many or more."""

EXPLAINED, LEFT = 0.9, 0.6
"""Friction is dry if the direction of motion, beside position, speed and acceleration, leaves at
most LEFT of what they leave of the force, and EXPLAINED or more is explained."""

LEVELS = 16
"""Steps of an input that has at most this number of values turn the motion: no sign of friction."""


def reacting(u: Array, y: Array, *, feedthrough: bool = True) -> Array:
    """Part of each input's surprises that the outputs' past surprises explain; 0 if by chance.

    The surprise is what is left of a prediction from past samples. Inputs of an experiment without
    feedback do not depend on the noise of the outputs. A controller that acts in the same sample
    alone is seen only if ``feedthrough`` is False, so that the input does not act on the output at
    once: a system where it does looks like it.

    Shape:
        u: (T, nu), y: (T, ny) -> (nu,).

    Example:
        >>> from lfrtorch.survey.mechanics import reacting
        >>> u, e = np.random.default_rng(0).standard_normal((2, 1000, 1))
        >>> reacting(u, e), reacting(u + np.roll(e, 1), e).round(1)
        (array([0.]), array([0.5]))
    """
    u, y = (s[:MOST, np.ptp(s, axis=0) > 0] for s in (u, y))
    T, nu, ny = len(u), u.shape[1], y.shape[1]
    n = min(LAGS, T // (10 * max(1, nu + ny)))
    if n < 1 or T < FEWEST or not nu * ny:
        return np.zeros(nu)
    u, y = ((s - s.mean(axis=0)) / s.std(axis=0) for s in (u, y))
    e = _left(y[n:], u[n:, : nu * feedthrough], _past(u, n), _past(y, n))
    e = e[:, e.std(axis=0) > 1e-7]  # rounding
    if not e.size:
        return np.zeros(nu)
    e = e / e.std(axis=0)
    before, own = _past(e, n), _past(u[n:], n)
    if not feedthrough:
        before = np.hstack([before, e[n:]])
    alone, both = (_left(u[2 * n :], own, *more) for more in ((), (before,)))
    power = np.maximum(np.sum(alone**2, axis=0), 1e-300)
    part = 1.0 - np.sum(both**2, axis=0) / power
    foreseen = np.sqrt(power / len(alone)) < FORESEEN
    by_chance = part < max(REACTS, CHANCE * n * ny / len(alone))
    return np.where(foreseen | by_chance, 0.0, part)


def rubs(u: Array, y: Array) -> bool:
    """Whether a force (T,) that moves a position (T,) changes with the direction of the motion.

    The signals are averaged over windows of several lengths, as differences enlarge noise.

    Example:
        >>> from lfrtorch.survey.mechanics import rubs
        >>> v = np.convolve(np.random.default_rng(0).standard_normal(1000), np.ones(9) / 9)
        >>> rubs(v, np.cumsum(v)), rubs(v + np.sign(v), np.cumsum(v))
        (False, True)
    """
    T = len(u)
    if len(np.unique(u)) <= LEVELS or np.ptp(y) == 0:
        return False
    for window in WINDOWS:
        if SPAN * window > T:
            break
        mean = np.ones(window) / window
        f, x = (np.convolve(s, mean, "valid")[:: max(1, window // 2)] for s in (u, y))
        v, a, x, f = (x[2:] - x[:-2]) / 2, np.diff(x, 2), x[1:-1], f[1:-1]
        total = np.sum((f - f.mean()) ** 2)
        smooth = [s[:, None] for s in (x, v, a)]
        without, along = (
            np.sum(_left(f[:, None], *smooth, *more) ** 2) for more in ((), (np.sign(v)[:, None],))
        )
        if along < (1 - EXPLAINED) * total and along < LEFT * without:
            return bool(without > 1e-9 * total)
    return False


def _past(signals: Array, n: int) -> Array:
    """Samples k - 1 .. k - n of signals (T, m) for k = n .. T - 1: (T - n, n m)."""
    return np.hstack([signals[n - j : len(signals) - j] for j in range(1, n + 1)])


def _left(target: Array, *columns: Array) -> Array:
    """What columns and a constant leave of a target (T, m)."""
    rows = np.hstack([np.ones((len(target), 1)), *columns])
    rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    return target - rows @ np.linalg.lstsq(rows, target, rcond=1e-12)[0]
