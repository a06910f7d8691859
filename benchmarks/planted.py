"""Two hundred planted systems: a noisy record of each, and new data without noise.

    planted(3).u, planted(3).y, planted(3).new_u, planted(3).new_y
    louder(3).at[2.0]                                      # an input and its output, twice as loud

Seven of each twenty are linear. Time is counted in samples: ``pace`` is the time constant of a
system, 3 to 200 samples and at most a twelfth of its record. ``strength`` of a nonlinearity is
log-uniform, and signals inside a system are near 1, so that it means about the same for each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.signal import butter, lfilter

from lfrtorch._support.types import Array

COUNT = 260
"""Systems there are."""

CYCLE = (
    *("linear", "wiener", "dead zone", "linear", "duffing", "tank", "linear", "friction"),
    *("cubic", "linear", "hysteresis", "weak", "bilinear", "linear", "two tanks", "saturation"),
    *("linear", "wiener", "weak", "linear"),
)
"""Kinds of system, in turn."""

STRENGTHS = {
    "wiener": (0.2, 2.0),
    "dead zone": (0.1, 0.8),
    "cubic": (0.02, 0.5),
    "saturation": (0.2, 2.0),
    "weak": (0.005, 0.1),
    "duffing": (0.02, 1.0),
    "tank": (0.1, 0.5),
    "two tanks": (0.1, 0.5),
    "friction": (0.05, 0.6),
    "hysteresis": (0.1, 0.8),
    "bilinear": (0.05, 0.5),
}
"""From nearly linear to strongly nonlinear."""

STEPS = 8
"""Of Runge and Kutta in each sample."""

EQUATIONS = ("duffing", "friction", "hysteresis", "bilinear", "tank", "two tanks")
DUFFING, FRICTION, HYSTERESIS, BILINEAR, TANK, TWO_TANKS = range(6)
"""Kinds that are simulated as differential equations."""

NEW = 2000
"""Samples of new data that are scored."""

LOUDER = "friction", "saturation", "duffing", "hysteresis"
"""Kinds with louder new data than the estimation record, in turn; a Duffing spring stiffens."""

AMPLITUDES = 1.0, 2.0, 3.0
"""Of these new data, over that of the estimation record."""

Response = Callable[[Array], Array]


@dataclass(frozen=True)
class Planted:
    """A system's measurement, and new data to judge its models.

    Args:
        linear: whether the system is.
        in_motion: whether the record begins so; otherwise at rest.
        u, y: record for estimation, with noise at the output.
        new_u, new_y: input of the same class and output without noise; it continues the record,
            or begins at rest.
        skip: first samples of the new data that no score counts.
        snr: signal over noise in dB.

    Shape:
        u (T, nu), y (T, 1), new_u (skip + 2000, nu), new_y (skip + 2000, 1).
    """

    name: str
    kind: str
    linear: bool
    in_motion: bool
    u: Array
    y: Array
    new_u: Array
    new_y: Array
    skip: int
    fs: float
    snr: float


class Louder(NamedTuple):
    """A measurement (T, 1) of a system at rest, and inputs and outputs at several amplitudes."""

    kind: str
    u: Array
    y: Array
    at: dict[float, tuple[Array, Array]]
    skip: int


def louder(number: int) -> Louder:
    """System ``number`` of 0, 1, ...: 400 to 2000 samples with noise of 20 to 40 dB below them."""
    rng = np.random.default_rng([77, number])
    kind = LOUDER[number % len(LOUDER)]
    T, pace = round(_log_uniform(rng, 400, 2000)), _log_uniform(rng, 3, 30)
    skip, excite = round(8 * pace), _excitation(rng, pace, T, 1)
    u, new = excite(T), excite(skip + NEW)
    respond = _system(kind, rng, pace, u)
    y = respond(u)
    y = y + 10 ** (-rng.uniform(20, 40) / 20) * y.std() * rng.standard_normal(T)
    at = {gain: (gain * new, respond(gain * new)[:, None]) for gain in AMPLITUDES}
    return Louder(kind, u, y[:, None], at, skip)


def planted(number: int) -> Planted:
    """System ``number`` of 0 .. 199; the same number gives the same data."""
    if not 0 <= number < COUNT:
        raise ValueError(f"number is {number}; give one of 0 .. {COUNT - 1}.")
    rng = np.random.default_rng([2026, number])
    kind = CYCLE[number % len(CYCLE)]
    T = round(_log_uniform(rng, 150, 5000))
    pace = _log_uniform(rng, 3, min(200, T / 12))
    nu = 2 if kind in ("linear", "wiener", "cubic") and rng.random() < 0.25 else 1
    skip = round(8 * pace)
    in_motion, continues, coloured = rng.random(3) < (0.4, 0.5, 1 / 3)
    before = skip if in_motion else 0
    excite = _excitation(rng, pace, T, nu)
    u, new_u = excite(before + T), excite(skip + NEW)
    respond = _system(kind, rng, pace, u)
    y = respond(u)
    new_y = respond(np.vstack([u, new_u]))[len(u) :] if continues else respond(new_u)
    u, y = u[before:], y[before:]
    snr = rng.uniform(10, 40)
    noise = rng.standard_normal(T + 200)
    if coloured:
        noise = lfilter([1.0], [1.0, -rng.uniform(0.7, 0.95)], noise)
    noise = noise[200:] * y.std() / noise[200:].std() * 10 ** (-snr / 20)
    (u_gain, y_gain), (u0, y0) = 10 ** rng.uniform(-2, 2, 2), rng.uniform(-3, 3, 2)
    return Planted(
        f"{number:03d} {kind}",
        kind,
        kind == "linear",
        bool(in_motion),
        u_gain * (u0 + u),
        y_gain * (y0 + y + noise)[:, None],
        u_gain * (u0 + new_u),
        y_gain * (y0 + new_y)[:, None],
        skip,
        float(rng.choice([1.0, 10.0, 100.0, 1000.0])),
        snr,
    )


def _excitation(rng: np.random.Generator, pace: float, T: int, nu: int) -> Callable[[int], Array]:
    """An input of a class and band, drawn anew at each call, with unit root mean square."""
    band = min(_log_uniform(rng, 2, 10) / (2 * np.pi * pace), 0.4)  # cycles a sample
    N = T // int(rng.integers(1, 3))  # a period of the multisine
    period = int(min(16 / band, T / 2))

    def noise(count: int) -> Array:
        b, a = butter(2, 2 * band)
        return lfilter(b, a, rng.standard_normal(count + period))[period:]

    def multisine(count: int) -> Array:
        lines = max(8, round(band * N))
        spectrum = np.zeros(N // 2 + 1, complex)
        spectrum[1 : lines + 1] = np.exp(2j * np.pi * rng.random(lines))
        return np.resize(np.fft.irfft(spectrum, N), count)

    def staircase(count: int) -> Array:
        hold = max(2, round(0.3 / band))
        holds = 1 + rng.integers(hold, 3 * hold, count)
        return np.repeat(rng.uniform(-1, 1, count), holds)[:count]

    def sweep(count: int) -> Array:
        there_and_back = np.abs((np.arange(count) / period + rng.random()) % 1 * 2 - 1)
        phase = np.cumsum(2 * np.pi * band * 0.1 ** (1 - there_and_back))
        return np.sin(phase + 2 * np.pi * rng.random())

    shape = (noise, multisine, staircase, sweep)[rng.integers(4)]

    def excite(count: int) -> Array:
        signals = np.column_stack([shape(count) for _ in range(nu)])
        return signals / np.sqrt(np.mean(signals**2, axis=0))

    return excite


def _system(kind: str, rng: np.random.Generator, pace: float, u: Array) -> Response:
    """The output (T,) of a system at rest, whose signals are near 1 with the input ``u``."""
    s = 0.0 if kind == "linear" else _log_uniform(rng, *STRENGTHS[kind])
    if kind in EQUATIONS[BILINEAR:]:
        p = np.array([1 / pace, rng.uniform(1, 3) / pace, s])
        return lambda u: _integrate(kind, u[:, 0], p)
    if kind in EQUATIONS:
        damping = _log_uniform(rng, 0.1, 0.7)
        rate = min(1 / (damping * pace), 0.7)
        scale = 1 / _integrate(kind, u[:, 0], np.array([rate, damping, 0.0])).std()
        return lambda u: _integrate(kind, scale * u[:, 0], np.array([rate, damping, s]))
    modes = _modes(rng, pace, u.shape[1])
    scale = 1 / modes(u).std()
    bends: dict[str, Response] = {
        "linear": lambda x: x,
        "wiener": lambda x: np.tanh(s * (x + 0.3)) / s,
        "dead zone": lambda x: x - np.clip(x, -s, s),
        "cubic": lambda x: x + s * x**3,
        "saturation": lambda x: np.tanh(s * x) / s,
        "weak": lambda x: x + s * x**2,
    }
    bend, after = bends[kind], kind in ("linear", "wiener", "weak")
    return lambda u: bend(scale * modes(u)) if after else modes(bend(u)) * scale


def _modes(rng: np.random.Generator, pace: float, nu: int) -> Response:
    """A linear system of one to four states: its modes side by side, at rest."""
    order = int(rng.integers(1, 5))
    poles: list[complex] = []
    while order:
        near = pace * _log_uniform(rng, 0.3, 1.5)
        resonant = order > 1 and rng.random() < 0.4
        turn = min(rng.uniform(2, 15) / near, 1.0) if resonant else 0.0
        poles.append(np.exp(-1 / near + 1j * turn))
        order -= 2 if resonant else 1
    gains = rng.uniform(0.3, 1.0, (len(poles), nu)) * rng.choice([-1.0, 1.0], (len(poles), nu))

    def respond(u: Array) -> Array:
        outputs = [
            lfilter([0.0, 1 - p], [1.0, -p], u @ gain) for p, gain in zip(poles, gains, strict=True)
        ]
        return np.real(np.sum(outputs, axis=0))

    return respond


def _integrate(kind: str, u: Array, p: Array) -> Array:
    """The output of a differential equation from its rest, with the input held in each sample."""
    return _runge_kutta(EQUATIONS.index(kind), np.ascontiguousarray(u), p)


@njit(cache=True)
def _runge_kutta(kind: int, u: Array, p: Array) -> Array:
    y, h = np.zeros(len(u)), 1.0 / STEPS
    a = b = c = 1.0 if kind >= TANK else 0.0  # the state; scalars, since arrays here cost time
    for k in range(len(u)):
        y[k] = b if kind in (BILINEAR, TWO_TANKS) else a
        for _ in range(STEPS):
            a1, b1, c1 = _derivative(kind, a, b, c, u[k], p)
            a2, b2, c2 = _derivative(kind, a + h / 2 * a1, b + h / 2 * b1, c + h / 2 * c1, u[k], p)
            a3, b3, c3 = _derivative(kind, a + h / 2 * a2, b + h / 2 * b2, c + h / 2 * c2, u[k], p)
            a4, b4, c4 = _derivative(kind, a + h * a3, b + h * b3, c + h * c3, u[k], p)
            a += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            b += h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
            c += h / 6 * (c1 + 2 * c2 + 2 * c3 + c4)
    return y


@njit(cache=True)
def _derivative(
    kind: int, a: float, b: float, c: float, u: float, p: Array
) -> tuple[float, float, float]:
    """Of the state, in samples: ``p`` is a rate, a damping or a second rate, and ``s``."""
    rate, d, s = p
    if kind >= TANK:  # levels; the pump does not run backwards
        out = np.sqrt(max(a, 0.0))
        return rate * (max(1.0 + s * u, 0.0) - out), d * (out - np.sqrt(max(b, 0.0))), 0.0
    if kind == BILINEAR:
        return rate * (u - a + min(max(s * u, -0.8), 0.8) * a), d * (a - b), 0.0
    force = u - 2.0 * d * b - a  # on a mass at a spring: position a, velocity b over the rate
    if kind == DUFFING:
        force -= s * a**3
    elif kind == FRICTION:
        force -= s * np.tanh(b / 0.1)
    else:  # the part s of the spring has the hysteresis of Bouc and Wen
        force += s * (a - c)
    return rate * b, rate * force, rate * (b - abs(b) * c - 0.5 * b * abs(c))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
