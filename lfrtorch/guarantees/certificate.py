"""Certificate that all trajectories of a model converge: a linear matrix inequality.

The difference of two trajectories obeys a linear system with a few uncertain slopes::

    x+ = A x + B p + Bu u
    v  = C x + D u            |p_i| <= |v_i|, i = 1 .. q
    y  = Cy x + Dy p + Dyu u

Suppose that P > 0 and a diagonal T >= 0 satisfy, for u = 0 and all x and p that are not both 0::

    |x+|²_P - ρ²|x|²_P + |v|²_T - |p|²_T < 0.

The last two terms together are not negative, so |x|_P shrinks at least by the factor ρ in every
sample. Likewise, if for all x, p and u that are not all 0::

    |x+|²_P - |x|²_P + |v|²_T - |p|²_T + |y|² - γ²|u|² < 0,

the sum of |y|² is at most γ² times the sum of |u|². Both inequalities are linear in P, T and γ². An
interior-point method solves them. Afterwards eigenvalues of the matrices check the inequality, so
the method need not be trusted.

References:
    Boyd, El Ghaoui, Feron and Balakrishnan, "Linear Matrix Inequalities in System and Control
    Theory", SIAM 1994, chapters 5 and 8.
    Lohmiller and Slotine, "On contraction analysis for non-linear systems", Automatica 34, 1998.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.optional import imported
from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array
from lfrtorch.engine.cell import LFRCell
from lfrtorch.maps.enclosure import Enclosure, Interval

ACCURACY = 1e-9
"""Relative accuracy of the SDP solver."""

ROUNDING = 10 * np.finfo(np.float64).eps
"""Rounding error of a sum, relative to its length times the sum of moduli."""

SLOWEST = 1.0 - 1e-6
"""Largest rate that counts as contraction: differences take a million samples to shrink to 1/e."""

SHORTEST = 1e-9
"""Rows of C and columns of B that are shorter, relative to the longest, are scaled as if they had
this length."""

LARGEST = 64
"""Largest number of rows of the inequality: the solution time grows with their sixth power."""


@dataclass(frozen=True, eq=False)
class Differences:
    """The system of differences, whose slopes are those of neurons or entries of ∂w/∂z."""

    A: Float[Array, "nx nx"]
    B: Float[Array, "nx q"]
    C: Float[Array, "q nx"]
    Bu: Float[Array, "nx nu"]
    D: Float[Array, "q nu"]
    Cy: Float[Array, "ny nx"]
    Dy: Float[Array, "ny q"]
    Dyu: Float[Array, "ny nu"]
    neurons: bool = False

    @classmethod
    def free(cls, A: Float[Array, "nx nx"]) -> Differences:
        """x+ = A x alone."""
        n, none = len(A), np.zeros((0, 0))
        right, below = np.zeros((n, 0)), np.zeros((0, n))
        return cls(A, right, below, right, none, below, none, none)

    @classmethod
    def by_entry(cls, cell: LFRCell, J: Interval) -> Differences:
        """The system in which each entry of J = ∂w/∂z is anywhere in its interval."""
        i, j = np.nonzero(J.radius)
        radius = J.radius[i, j]
        return cls._about(
            cell, J.middle, np.eye(cell.nw)[:, i], radius[:, None] * np.eye(cell.nz)[j]
        )

    @classmethod
    def by_neuron(cls, cell: LFRCell, slopes: Interval, left: Tensor, right: Tensor) -> Differences:
        """The system for J = left diag(slopes) right, with each neuron's slope in its interval."""
        Ww, Wz = to_float64(left), to_float64(right)
        J = Ww * slopes.middle @ Wz
        return replace(cls._about(cell, J, Ww, slopes.radius[:, None] * Wz), neurons=True)

    @classmethod
    def _about(cls, cell: LFRCell, J: Array, left: Array, right: Array) -> Differences:
        """The system for ∂w/∂z = J + left diag(δ) right, |δ| <= 1."""
        A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw = cell.matrices()
        return cls(
            A=A + Bw @ J @ Cz,
            B=Bw @ left,
            C=right @ Cz,
            Bu=Bu + Bw @ J @ Dzu,
            D=right @ Dzu,
            Cy=Cy + Dyw @ J @ Cz,
            Dy=Dyw @ left,
            Dyu=Dyu + Dyw @ J @ Dzu,
        )

    @classmethod
    def of(cls, cell: LFRCell, slopes: Enclosure | None) -> list[Differences]:
        """The systems by entry and by neuron: the smaller, and the other if not too large."""
        if slopes is None:
            nothing = np.zeros((0, 0))
            return [cls.by_entry(cell, Interval(nothing, nothing))]
        systems = [cls.by_entry(cell, slopes.J)]
        if slopes.neurons:
            systems.append(cls.by_neuron(cell, *slopes.neurons))
        systems.sort(key=lambda system: system.size)
        return [systems[0], *(system for system in systems[1:] if system.size <= LARGEST)]

    @property
    def size(self) -> int:
        """Number of rows of the inequality."""
        return sum(self.B.shape)

    def moved(
        self, L: Float[Array, "nx nx"], s: Float[Array, " q"] | None = None
    ) -> tuple[Differences, Float[Array, " q"]]:
        """The system for L x and s v, s p, and s; default s: columns of B as long as rows of C."""
        back = np.linalg.inv(L)
        B, C = L @ self.B, self.C @ back
        lengths = np.array([np.linalg.norm(B, axis=0), np.linalg.norm(C, axis=1)])
        lengths = np.maximum(lengths, SHORTEST * lengths.max(initial=SHORTEST))
        by = np.sqrt(lengths[0] / lengths[1]) if s is None else s
        moved = Differences(
            A=L @ self.A @ back,
            B=B / by,
            C=by[:, None] * C,
            Bu=L @ self.Bu,
            D=by[:, None] * self.D,
            Cy=self.Cy @ back,
            Dy=self.Dy / by,
            Dyu=self.Dyu,
        )
        return moved, by


class Certificate(NamedTuple):
    """P and T that satisfy the inequality, as its eigenvalues prove."""

    P: Float[Array, "nx nx"]
    T: Float[Array, " q"]


class Margin(NamedTuple):
    """The largest t with M(P, T) <= -t I in some coordinates, and trace P = nx.

    Z is the multiplier: to first order, a change dM of the matrix changes t by -trace(Z dM).
    """

    t: float
    P: Float[Array, "nx nx"]
    T: Float[Array, " q"]
    Z: Float[Array, "n n"]


def margin(system: Differences, rate: float) -> Margin | None:
    """The largest margin in the coordinates of the system; None if the solver fails."""
    nx, q = system.B.shape
    basis = _symmetric(nx)
    F = [inequality(system, E, np.zeros(q), rate) for E in basis]
    F += [inequality(system, np.zeros((nx, nx)), e, rate) for e in np.eye(q)]
    F.append(np.eye(nx + q))
    trace = np.array([*(np.trace(E) for E in basis), *np.zeros(q + 1)]) / nx
    solved = _solved([np.array(F)], [0.0 * F[-1]], len(F) - 1, -1.0, trace)
    if solved is None:
        return None
    found, Z = solved
    return Margin(float(found[-1]), *_unpacked(found, nx, q), Z)


def common_norm(A: Float[Array, "S nx nx"], rate: float) -> Float[Array, "nx nx"] | None:
    """P of a norm in which each of several A shrinks states to the rate or less; None if none.

    The solver's result is not verified here: the caller must check it.
    """
    nx = A.shape[-1]
    moved = prepared(Differences.free(A.mean(axis=0)), rate)
    if moved is None:
        return None
    L, basis, one = moved[1], _symmetric(nx), np.eye(nx)
    F = [
        np.array([*(M.T @ E @ M - rate**2 * E for E in basis), one])
        for M in L @ A @ np.linalg.inv(L)
    ]
    F.append(np.array([*(-E for E in basis), 1e-6 * one]))
    trace = np.array([*(np.trace(E) for E in basis), 0.0]) / nx
    solved = _solved(F, [np.zeros((nx, nx))] * len(F), len(basis), -1.0, trace)
    if solved is None or not solved[0][-1] > 0:
        return None
    return returned(np.einsum("k,kij->ij", solved[0][:-1], basis), np.empty(0), L, np.empty(0)).P


def certificate(system: Differences, rate: float) -> Certificate | None:
    """P and T that prove that all differences shrink at the rate; None if none are found."""
    moved = prepared(system, rate)
    if moved is None:
        return None
    x, L, s = moved
    found = margin(x, rate)
    if found is None or not found.t > 0:
        return None
    back = returned(found.P, found.T, L, s)
    return back if holds(system, back, rate) else None


def gain(system: Differences) -> float | None:
    """Smallest γ with a proof of |Δy| <= γ |Δu|, for root sums of squares over all time."""
    sizes = [np.abs(M).max(initial=0.0) for M in (system.Cy, system.Dy, system.Bu, system.D)]
    y, u = max(sizes[:2]) or 1.0, max(sizes[2:]) or 1.0
    unit = replace(
        system,
        Cy=system.Cy / y, Dy=system.Dy / y, Dyu=system.Dyu / (y * u),
        Bu=system.Bu / u, D=system.D / u,
    )  # fmt: skip
    moved = prepared(unit, 1.0)
    if moved is None:
        return None
    x, L, s = moved
    nx, q = x.B.shape
    zero, none = np.zeros((nx, nx)), np.zeros(q)
    constant = inequality(x, zero, none, gain=0.0)
    basis = _symmetric(nx)
    F = [inequality(x, E, none, gain=0.0) - constant for E in basis]
    F += [inequality(x, zero, e, gain=0.0) - constant for e in np.eye(q)]
    F.append(inequality(x, zero, none, gain=1.0) - constant)
    for slack in (1e-6, 1e-4, 1e-2):
        shifted = constant + slack * np.eye(len(constant))
        solved = _solved([np.array(F)], [shifted], len(F) - 1, 1.0)
        if solved is not None and solved[0][-1] > 0:
            value = float(np.sqrt(solved[0][-1]))
            found = returned(*_unpacked(solved[0], nx, q), L, s)
            if holds(unit, found, 1.0, value):
                return value * y * u
    return None


def inequality(
    system: Differences,
    P: Float[Array, "nx nx"],
    T: Float[Array, " q"],
    rate: float = 1.0,
    gain: float | None = None,
) -> Array:
    """The matrix that must be negative definite, for x and p, or with a gain for x, p and u."""
    return sum(S.T @ Q @ S for S, Q in _terms(system, P, T, rate, gain))  # pyright: ignore[reportReturnType]


def _terms(
    system: Differences, P: Array, T: Array, rate: float, gain: float | None
) -> list[tuple[Array, Array]]:
    """Pairs S, Q of the inequality's parts Sᵀ Q S."""
    (nx, q), nu = system.B.shape, system.Bu.shape[1] if gain is not None else 0
    one = np.eye(nx + q + nu)
    V = np.hstack([system.C, np.zeros((q, q)), system.D[:, :nu]])
    terms = [
        (np.hstack([system.A, system.B, system.Bu[:, :nu]]), P),
        (one[:nx], -(rate**2) * P),
        (V, np.diag(T)),
        (one[nx : nx + q], -np.diag(T)),
    ]
    if gain is not None:
        Y = np.hstack([system.Cy, system.Dy, system.Dyu])
        terms += [(Y, np.eye(len(Y))), (one[nx + q :], -(gain**2) * np.eye(nu))]
    return terms


def prepared(system: Differences, rate: float) -> tuple[Differences, Array, Array] | None:
    """The system for L x and s v, where A alone shrinks x, and L and s; None if A is unstable."""
    A = system.A / rate
    finite = np.isfinite(A).all()  # products of finite weights may be infinite
    if not finite or np.abs(np.linalg.eigvals(A)).max() >= 1.0 - ROUNDING:
        return None
    P, power = np.eye(len(A)), A
    for _ in range(60):  # Σ (Aᵏ)ᵀ Aᵏ, by doubling
        P, power = P + power.T @ P @ power, power @ power
        if np.abs(power).max() < ACCURACY:
            break
    try:
        L = np.linalg.cholesky(P / np.trace(P) * len(A)).T
    except np.linalg.LinAlgError:
        return None
    moved, s = system.moved(L)
    return moved, L, s


def returned(P: Array, T: Array, L: Array, s: Array) -> Certificate:
    """P and T of a system, from the P and T of the system for L x and s v."""
    P = L.T @ P @ L
    return Certificate((P + P.T) / 2, T * s**2)


def _unpacked(found: Array, nx: int, q: int) -> tuple[Array, Array]:
    """P and T from the solver's unknowns."""
    return np.einsum("k,kij->ij", found[: -q - 1], _symmetric(nx)), found[-q - 1 : -1]


def holds(system: Differences, found: Certificate, rate: float, gain: float | None = None) -> bool:
    """Tell if P and T satisfy the inequality by more than rounding errors."""
    P, T = found
    if P.shape != system.A.shape or len(T) != len(system.C) or not (T >= 0).all():
        return False
    return _is_negative([(np.eye(len(P)), -P)]) and _is_negative(_terms(system, P, T, rate, gain))


def _is_negative(terms: Sequence[tuple[Array, Array]]) -> bool:
    """Tell if Σ Sᵀ Q S is negative definite by more than rounding errors."""
    M = sum(S.T @ Q @ S for S, Q in terms)
    size = sum(np.abs(S).T @ np.abs(Q) @ np.abs(S) for S, Q in terms)
    assert isinstance(M, np.ndarray)
    assert isinstance(size, np.ndarray)
    scale = 1.0 / np.sqrt(np.maximum(size.diagonal(), 1e-300))
    M, size = (scale[:, None] * N * scale for N in (M, size))
    if not np.isfinite(M).all():
        return False
    error = ROUNDING * len(M) * np.linalg.norm(size, np.inf)
    return bool(np.linalg.eigvalsh((M + M.T) / 2)[-1] < -error)


def _symmetric(n: int) -> Float[Array, "k n n"]:
    """A basis of symmetric matrices."""
    i, j = np.triu_indices(n)
    basis = np.zeros((len(i), n, n))
    basis[range(len(i)), i, j] = basis[range(len(i)), j, i] = 1.0
    return basis


def _solved(
    F: Sequence[Float[Array, "k n n"]],
    constants: Sequence[Float[Array, "n n"]],
    objective: int,
    weight: float,
    trace: Array | None = None,  # trace · ξ = 1
) -> tuple[Array, Array] | None:
    """ξ that minimises weight ξ_objective, and the multiplier of the last inequality.

    The inequalities are constant + Σ ξ_k F_k <= 0, one for each item of ``F`` and ``constants``.
    """
    clarabel: Any = imported("clarabel", "certificate")
    n, count = F[0].shape[-1], len(F[0])
    j, i = np.tril_indices(n)  # gives the upper triangle column by column
    weights = np.where(i == j, 1.0, np.sqrt(2.0))
    rows = np.vstack([(each[:, i, j] * weights).T for each in F])
    right = np.concatenate([-constant[i, j] * weights for constant in constants])
    cones = [clarabel.PSDTriangleConeT(n)] * len(F)
    if trace is not None:
        rows, right = np.vstack([trace, rows]), np.concatenate([[1.0], right])
        cones.insert(0, clarabel.ZeroConeT(1))
    cost = np.zeros(count)
    cost[objective] = weight
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    nothing = scipy.sparse.csc_matrix((count, count))
    sparse = scipy.sparse.csc_matrix(rows)
    answer = clarabel.DefaultSolver(nothing, cost, sparse, right, cones, settings).solve()
    found, dual = np.array(answer.x), np.array(answer.z)
    if len(found) != count or not np.isfinite(found).all():
        return None
    Z = np.zeros((n, n))
    Z[i, j] = Z[j, i] = dual[len(dual) - len(i) :] / weights
    return found, Z
