"""Proven bounds of states and outputs, for all inputs up to an amplitude.

x is the response of a stable linear system to u and w. Let δu and δw be the deviations of u and w
from the middles 0 and w̄ of their ranges, and A x̄ + Bw w̄ = x̄. Then::

    x(k) = x̄ + Aᵏ (x(0) - x̄) + Σ_j<k Aʲ (Bu δu(k-1-j) + Bw δw(k-1-j))

For |δu| <= r the input moves c x, for any row c, by at most Σ_j |c Aʲ Bu| r: the absolute sum of
the impulse response times r. The same holds for w, as the static map is bounded. That bounds z,
which bounds w more tightly, and so on. Once z is bounded, w = K z + δw and the loop is closed
through K: then only the small rest δw of the map adds to the bounds.

The sums are cut after N samples. Entry by entry, their rest is at most |M| (I - |M|)⁻¹ times the
sums of the states, where M = Aᴺ.

References:
    Dahleh and Diaz-Bobillo, "Control of Uncertain Systems: A Linear Programming Approach", Prentice
    Hall 1995 (norms of impulse responses as gains of amplitudes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import engineering, number, table
from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array
from lfrtorch.analysis.linearisation import levels_of, vector
from lfrtorch.data.records import Channel
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.operating_point import double
from lfrtorch.maps.activations import ACTIVATIONS, FAR
from lfrtorch.maps.enclosure import Enclosure, Interval, everywhere
from lfrtorch.model.model import Model

_LONGEST = 2**16
"""Largest number of samples of an impulse response that are summed; slower responses get a looser
bound."""

_REST = 1e-4
"""The sums end when their rest is below this part of the states' rms, or after ``_LONGEST``."""

_BLOCK = 256
"""Number of samples of impulse responses that are computed together."""


@dataclass(frozen=True, eq=False)
class Bound:
    """Proven bounds, up to rounding errors; ``print(bound)`` shows the bounds of the outputs.

    Args:
        amplitude: amplitude of the inputs, (nu,), physical units: the bound of |u - offset|.
        y: lowest and highest value of each output, (ny, 2), physical units.
        x, z, w: lowest and highest values of states and of the static map's signals, in the
            model's coordinates, as in ``model.signals(record)``.
        inputs, outputs: channel names and units.

    Example:
        >>> bound = lfrtorch.analysis.bound(model, 2.0)
        >>> low, high = bound.y[0]
        >>> u = np.random.default_rng(1).uniform(-2.0, 2.0, 1000)
        >>> bool(low <= model.simulate(u).min() and model.simulate(u).max() <= high)
        True
    """

    amplitude: Array
    y: Float[Array, "ny 2"]
    x: Float[Array, "nx 2"]
    z: Float[Array, "nz 2"]
    w: Float[Array, "nw 2"]
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]

    def __str__(self) -> str:
        rows = []
        for channel, sides in zip(self.outputs, self.y, strict=True):
            factor, unit = engineering(sides.tolist(), channel.unit)
            rows.append([channel.name, *(number(factor * side) for side in sides), unit])
        return (
            f"Inputs within {levels_of(self.inputs, self.amplitude)} of their offsets\n\n"
            + table(["output", "at least", "at most", "unit"], rows)
        )


@typed()
def bound(model: Model, amplitude: ArrayLike, *, x0: ArrayLike | None = None) -> Bound:
    """Bounds of the states and outputs of a model, for all inputs up to an amplitude.

    The worst input of a linear model reaches its bound; a nonlinear model may stay far within it.
    The docstring of ``lfrtorch/guarantees/bounds.py`` derives the bounds.

    Args:
        model: a model with a stable A: a linear one, or one with a tanh, sigmoid or rbf network.
        amplitude: largest |u - offset|, physical units; the offsets are those of the model.
        x0: initial state in the model's coordinates. Default: 0.

    Shape:
        amplitude: (nu,) or a number for all inputs, x0: (nx,).

    Raises:
        ValueError: A is not stable or the static map is not bounded, so the bound is infinite.

    Example:
        >>> bound = lfrtorch.analysis.bound(model, amplitude=0.5)
        >>> bound.y.shape, bound.x.shape
        ((1, 2), (1, 2))
        >>> louder = lfrtorch.analysis.bound(model, amplitude=1.0)
        >>> bool((louder.y[:, 1] > bound.y[:, 1]).all())
        True
    """
    cell, scaler = double(model.lfr.cell), model.scaler
    size = amplitudes(amplitude, len(model.inputs))
    start = (
        np.zeros(cell.nx) if x0 is None else vector("x0", x0, cell.nx, "the model has {} states")
    )
    reached = reach(cell, size / scaler.u_scale, start)
    y = np.stack([scaler.restore_y(side) for side in reached.y], axis=-1)
    x, z, w = (np.stack(signal, axis=-1) for signal in (reached.x, reached.z, reached.w))
    return Bound(size, y, x, z, w, model.inputs, model.outputs)


def amplitudes(given: ArrayLike, nu: int) -> Array:
    """An amplitude for each input."""
    found = np.atleast_1d(reals("amplitude", given))
    if found.shape not in ((1,), (nu,)) or not (np.isfinite(found) & (found >= 0)).all():
        raise InputError(
            f"amplitude is {given!r}; give one number for all {nu} input(s) or a number for each, "
            "in physical units, finite and not negative."
        )
    return np.broadcast_to(found, nu).copy()


@dataclass(frozen=True, eq=False)
class _Reach:
    """Bounds of all signals, normalised, and the enclosure of the static map within them."""

    x: Interval
    y: Interval
    z: Interval
    w: Interval
    map: Enclosure | None


def reach(cell: LFRCell, amplitude: Float[Array, " nu"], x0: Float[Array, " nx"]) -> _Reach:
    """Bounds of all signals for |u| <= amplitude, normalised; the cell is in float64 on the CPU."""
    anywhere = cell.map.enclosure(everywhere(cell.nz))
    _check(cell, anywhere)
    loop = _Loop(cell, anywhere, amplitude, x0)
    K = np.zeros((cell.nw, cell.nz))
    if anywhere is None:
        nothing = Interval(np.empty(0), np.empty(0))
        return _Reach(*loop.signals(loop.bounds(K, nothing))[:3], nothing, None)

    def inside(rows: Interval, K: Array | None = None) -> Enclosure:
        found = cell.map.enclosure(*loop.signals(rows)[2:], K)
        assert found is not None
        return found

    found = loop.bounds(K, anywhere.w)
    closed = False
    for _ in range(50):
        there = inside(found)
        if closed:
            K = there.J.middle
            if not _is_stable(loop.closed(K)):
                break
            there = inside(found, K)
        before, found = found, found.within(loop.bounds(K, there.w))
        if (found.radius >= 0.99 * before.radius).all():  # this round has tightened no bound
            if closed:
                break
            closed = True
    x, y, z, _ = loop.signals(found)
    there = inside(found)
    return _Reach(x, y, z, there.w, there)


class _Loop:
    """The linear part of a model, with rows for the signals to be bounded.

    The signals are x, y, z and, if nz > 1, the inputs of neurons.
    """

    def __init__(
        self,
        cell: LFRCell,
        anywhere: Enclosure | None,
        amplitude: Float[Array, " nu"],
        x0: Float[Array, " nx"],
    ) -> None:
        A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw = cell.matrices()
        self.A, self.Bu, self.Bw, self.Cz, self.Dzu = A, Bu, Bw, Cz, Dzu
        self._amplitude, self._x0 = amplitude, x0
        Wz = np.zeros((0, cell.nz))
        if anywhere is not None and anywhere.neurons and cell.nz > 1:  # a single z bounds them
            Wz = to_float64(anywhere.neurons[2])
        self.C = np.concatenate([np.eye(cell.nx), Cy, Cz, Wz @ Cz])
        self.Du = np.concatenate([np.zeros((cell.nx, cell.nu)), Dyu, Dzu, Wz @ Dzu])
        self.Dw = np.zeros((len(self.C), cell.nw))
        self.Dw[cell.nx : cell.nx + cell.ny] = Dyw
        self._ends = np.cumsum([cell.nx, cell.ny, cell.nz])

    def signals(self, rows: Interval) -> tuple[Interval, Interval, Interval, Interval | None]:
        """Bounds of x, y, z and inputs of neurons; None in place of the last if there are none."""
        low, high = (np.split(side, self._ends) for side in rows)
        x, y, z, a = (Interval(*pair) for pair in zip(low, high, strict=True))
        return x, y, z, (a if len(a.low) else None)

    def closed(self, K: Float[Array, "nw nz"]) -> Float[Array, "nx nx"]:
        """A with the loop closed through K."""
        return self.A + self.Bw @ K @ self.Cz

    def bounds(self, K: Float[Array, "nw nz"], w: Interval) -> Interval:
        """Bounds of the rows if w - K z stays in an interval."""
        A, Bu = self.closed(K), self.Bu + self.Bw @ K @ self.Dzu
        C, Du = self.C + self.Dw @ K @ self.Cz, self.Du + self.Dw @ K @ self.Dzu
        rest = np.linalg.solve(np.eye(len(A)) - A, self.Bw @ w.middle)
        radius = np.concatenate([self._amplitude, w.radius])
        moved = _moved(A, np.hstack([Bu, self.Bw]), C, radius, self._x0 - rest)
        middle = C @ rest + self.Dw @ w.middle
        direct = np.abs(np.hstack([Du, self.Dw])) @ radius
        return Interval(middle + moved.low - direct, middle + moved.high + direct).wider()


def _moved(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx n"],
    C: Float[Array, "rows nx"],
    radius: Float[Array, " n"],
    d: Float[Array, " nx"],
) -> Interval:
    """Bounds of C x over all time for x+ = A x + B v, |v| <= radius, x(0) = d; C begins with I."""
    nx = len(A)
    samples = _samples(A, B * radius)
    powers = [C]
    for _ in range(_BLOCK - 1):
        powers.append(powers[-1] @ A)
    H, over_block = np.stack(powers), np.linalg.matrix_power(A, _BLOCK)
    X = np.column_stack([B * radius, d])
    spread, farthest = np.zeros(len(C)), np.zeros(nx)
    low, high = np.full(len(C), np.inf), np.full(len(C), -np.inf)
    for _ in range(samples // _BLOCK):
        G = H @ X
        free, more = G[..., -1], np.abs(G[..., :-1]).sum(axis=-1)
        after = spread + np.cumsum(more, axis=0)
        before = after - more
        low = np.minimum(low, (free - before).min(axis=0))
        high = np.maximum(high, (free + before).max(axis=0))
        spread, X = after[-1], over_block @ X
        farthest = np.maximum(farthest, np.abs(free[:, :nx]).max(axis=0))
    # Bounds on the samples after the last summed one, entry by entry.
    M = np.abs(np.linalg.matrix_power(A, samples))
    power, states, later = np.linalg.matrix_power(A, samples), spread[:nx], np.zeros(nx)
    while (rest := _rest(M)) is None:
        states = states + M @ states
        later = np.maximum(later, M @ farthest)
        farthest = np.maximum(farthest, later)
        power = power @ power
        M = np.abs(power)
    states = states + rest @ states
    later = np.maximum(later, rest @ farthest)
    end = spread + np.abs(C) @ (states - spread[:nx] + later)
    return Interval(np.minimum(low, -end), np.maximum(high, end))


def _samples(A: Float[Array, "nx nx"], B: Float[Array, "nx n"]) -> int:
    """Number of samples, a power of 2, after which impulse responses have nearly decayed."""
    samples, power, gramian = 1, A, B @ B.T
    while samples < _LONGEST:
        rms = np.sqrt(gramian.diagonal())
        rest = _rest(np.abs(power)) if samples >= _BLOCK else None
        if rest is not None and (rest @ rms <= _REST * (rms + _REST * rms.max())).all():
            break
        gramian = gramian + power @ gramian @ power.T
        samples, power = 2 * samples, power @ power
    return samples


def _rest(M: Float[Array, "nx nx"]) -> Float[Array, "nx nx"] | None:
    """M + M² + .. = M (I - M)⁻¹ for M >= 0, proven by a q > 0 with M q < q; None without proof."""
    if not (M.sum(axis=1) < np.inf).all():
        return None
    try:
        total = np.linalg.inv(np.eye(len(M)) - M)
    except np.linalg.LinAlgError:
        return None
    q = total.sum(axis=1)
    return M @ total if (q > 0).all() and (M @ q < q).all() and (total >= 0).all() else None


def _is_stable(A: Float[Array, "nx nx"]) -> bool:
    return np.abs(np.linalg.eigvals(A)).max() < 1.0


def _check(cell: LFRCell, anywhere: Enclosure | None) -> None:
    """Refuse a model whose bound would be infinite."""
    if cell.nw and (anywhere is None or not (anywhere.w.radius < math.sqrt(FAR)).all()):
        *names, last = (name for name, sigma in ACTIVATIONS.items() if sigma.bounded)
        raise InputError(
            f"the static map is a {cell.map.title}, which is not known to be bounded; a proven "
            f"bound needs a network of {', '.join(names)} or {last}."
        )
    largest = float(np.abs(np.linalg.eigvals(cell.A.detach().numpy())).max())
    if largest >= 1.0:
        raise InputError(
            f"A is not stable, with an eigenvalue of modulus {largest:.6g}: a small input may make "
            "states grow without bound.\nA fit with trainer.guarantee=stable keeps the modulus < 1."
        )
