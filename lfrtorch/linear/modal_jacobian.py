"""Jacobian of a response by its modes: for many states, inputs and outputs.

Let A = V Λ V⁻¹, b = V⁻¹ B and c = C V. The response is a sum over modes,
G(z) = Σ cᵢ bᵢ / (z - λᵢ) + D. All derivatives with λ, b, c and D are 1, 1 / (z - λᵢ) or
1 / (z - λᵢ)², times constants. So JᴴJ needs the products of 2 nx + 1 functions summed over the
lines, and constants: no J. The first-order change of λ, b and c with A, B, C is known; its rows
span all directions in θ but those of a change of state coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
import torch
from jaxtyping import Complex128, Float
from torch import Tensor

from lfrtorch._support.types import Array, Booleans, Complex
from lfrtorch.linear.pole_limits import Excess
from lfrtorch.linear.spectral_data import SpectralData


class Modes(NamedTuple):
    """Linear model by its modes."""

    poles: Complex128[Complex, " nx"]
    V: Complex128[Complex, "nx nx"]  # eigenvectors as columns
    W: Complex128[Complex, "nx nx"]  # V⁻¹
    b: Complex128[Complex, "nx nu"]  # W B
    c: Complex128[Complex, "ny nx"]  # C V
    D: Float[Array, "ny nu"]

    @classmethod
    def of(cls, A: Array, B: Array, C: Array, D: Array) -> Modes | None:
        """Return the modes of a system, or ``None`` if they cannot be told apart."""
        poles, V = (np.asarray(part, dtype=np.complex128) for part in np.linalg.eig(A))
        try:
            W = np.asarray(np.linalg.inv(V), dtype=np.complex128)
        except np.linalg.LinAlgError:
            return None
        # The derivatives of modes grow with sᵢ sⱼ / |λᵢ - λⱼ|, s being how far a pole moves with A,
        # and cancel in those of the response: at 1e6 JᵀJ has four digits left.
        with np.errstate(over="ignore"):
            s = np.linalg.norm(V, axis=0) * np.linalg.norm(W, axis=1)
            apart = np.abs(poles - poles[:, None]) + np.diag(np.full(len(poles), np.inf))
            if not (np.outer(s, s) < 1e6 * apart).all():
                return None
        return cls(poles, V, W, W @ B, C @ V, D)

    def response(self, z: Complex128[Complex, " F"]) -> Complex128[Complex, "F ny nu"]:
        """G at some points."""
        products = self.c.T[:, :, None] * self.b[:, None, :]
        return _gains(1.0 / (z[:, None] - self.poles), products) + self.D


class ModalJacobian:
    """Jacobian of the errors √weight (G U - Y), and of the excess of poles, with A, B, C, D."""

    def __init__(
        self,
        modes: Modes,
        data: SpectralData,
        errors: Complex128[Complex, "F ny m"],
        *,
        free: Booleans,
        excess: tuple[Float[Array, " nx"], Float[Array, "nx P"]],
    ) -> None:
        self._modes, self._data, self._errors = modes, data, errors
        r = 1.0 / (data.z[:, None] - modes.poles)
        self._functions = np.hstack([r * r, r])
        self._change = _change(modes, free)
        self._free = free
        self._gradient_of_errors = self._gradient(errors)
        size = float(np.linalg.norm(errors))
        self._excess = Excess(*excess, size, self._gradient_of_errors)

    def system(self, damping: float, truncation: float) -> tuple[_GramSystem, Tensor]:
        """Return the system and the gradient, see ``levenberg_marquardt.Jacobian``."""
        del damping, truncation
        Q = np.linalg.qr(_without_scaling(self._modes, self._change).T)[0]
        Z = self._change @ Q
        G = (Z.conj().T @ (self._products() @ Z)).real
        gradient = self._gradient_of_errors
        if self._excess.active:
            T = self._excess.jacobian
            TQ = T @ Q
            G = G + TQ.T @ TQ
            gradient = gradient + T.T @ self._excess.residual
        return _GramSystem(G, Q), torch.as_tensor(gradient)

    def tangent(self, d_theta: Tensor) -> Tensor:
        """J dθ."""
        d = d_theta.numpy()
        response = self._data.weighted(self._tangent(self._change @ d) @ self._data.U)
        return stacked(response, self._excess.jacobian @ d)

    def adjoint(self, residual: Tensor) -> Tensor:
        """Jᵀ residual (P,)."""
        nx = len(self._modes.poles)
        real, imaginary = residual[:-nx].numpy().reshape(2, *self._errors.shape)
        of_errors = self._gradient(real + 1j * imaginary)
        return torch.as_tensor(of_errors + self._excess.jacobian.T @ residual[-nx:].numpy())

    def _products(self) -> Complex:
        """JᴴJ with λ, b, c and the free entries of D, (Kc, Kc)."""
        functions = _with_one(self._functions)
        left, right = _constants(self._modes, self._data.U.shape[1])
        free = np.concatenate([np.ones(left.shape[1] - self._free.size, bool), self._free.ravel()])
        return _products(functions, self._data, left[:, free], right[:, free])

    def _tangent(self, change: Complex) -> Complex:
        """Return the change of G (F, ny, nu) with a change of λ, b, c and D."""
        m = self._modes
        d_poles, db, dc, dD = self._parts(change)
        squares = d_poles[:, None, None] * (m.c.T[:, :, None] * m.b[:, None, :])
        singles = m.c.T[:, :, None] * db[:, None, :] + dc[:, :, None] * m.b[:, None, :]
        return _gains(self._functions, np.concatenate([squares, singles])) + dD

    def _gradient(self, r: Complex) -> Array:
        """Jᵀ r (P,) of errors (F, ny, m)."""
        m, n = self._modes, len(self._modes.poles)
        H = self._data.weighted(r) @ self._data.U.conj().swapaxes(1, 2)
        sums = self._functions.conj().T @ H.reshape(len(H), -1)
        squares, singles = sums.reshape(2, n, len(m.c), -1)
        c, b = m.c.T.conj(), m.b.conj()
        g = np.concatenate(
            [
                np.einsum("iok,io,ik->i", squares, c, b),
                np.einsum("iok,io->ik", singles, c).ravel(),
                np.einsum("iok,ik->io", singles, b).ravel(),
                H.sum(axis=0)[self._free],
            ]
        )
        return (self._change.conj().T @ g).real

    def _parts(self, change: Complex) -> tuple[Complex, Complex, Complex, Complex]:
        (ny, n), nu = self._modes.c.shape, self._data.U.shape[1]
        poles, b, c, free = np.split(change, np.cumsum([n, n * nu, n * ny]))
        D = np.zeros((ny, nu), dtype=complex)
        D[self._free] = free
        return poles, b.reshape(n, nu), c.reshape(n, ny), D


class _GramSystem:
    """Normal equations JᵀJ = G in a basis Q of the directions that change the response."""

    def __init__(self, G: Float[Array, "K K"], Q: Float[Array, "P K"]) -> None:
        self.scale = self.size = float("nan")
        self.rank = 0
        if np.isfinite(G).all():
            squares, axes = np.linalg.eigh(G)
            kept = squares > 1e-14 * squares[-1]  # the others are rounding errors
            self._squares, self._axes = squares[kept], Q @ axes[:, kept]
            self.scale = self.size = float(squares[-1])
            self.rank = int(kept.sum())

    def solve(self, gradient: Tensor, damping: float) -> Tensor:
        """-(JᵀJ + λI)⁻¹ gradient."""
        along = self._axes.T @ gradient.numpy()
        return torch.as_tensor(-self._axes @ (along / (self._squares + damping)))


def _gains(functions: Complex, products: Complex) -> Complex:
    """Σ function (F, k) times product (k, ny, nu): (F, ny, nu)."""
    k, ny, nu = products.shape
    return (functions @ products.reshape(k, -1)).reshape(-1, ny, nu)


def _with_one(functions: Complex) -> Complex:
    return np.hstack([functions, np.ones((len(functions), 1), dtype=complex)])


def _products(functions: Complex, data: SpectralData, left: Complex, right: Complex) -> Complex:
    """Inner products (K, K) of columns that are a function (F, a) of z times constants of the
    outputs, ``left`` (ny, K), and of the inputs, ``right`` (a nu, K)."""
    U, a = data.U, functions.shape[1]
    nu, every = U.shape[1], slice(None)
    weights = [(every, 1.0)]
    if data.weight is not None:
        weights = [([o], data.weight[:, [o]]) for o in range(len(left))]
    found = np.zeros((left.shape[1], left.shape[1]), dtype=complex)
    for outputs, weight in weights:
        power = (weight * U) @ U.conj().swapaxes(1, 2)  # (F, nu, nu), of j and the conjugate of k
        sums = np.zeros((a, nu, a, nu), dtype=complex)
        for j in range(nu):
            for k in range(j + 1):
                if power[:, j, k].any():
                    part = functions.conj().T @ (power[:, j, k, None] * functions)
                    sums[:, k, :, j] = part
                    sums[:, j, :, k] = part.conj().T
        own = left[outputs]
        found += (own.conj().T @ own) * (right.conj().T @ (sums.reshape(a * nu, -1) @ right))
    return found


def with_best_inputs(
    A: Array, C: Array, data: SpectralData, free: Booleans
) -> tuple[Array, Array] | None:
    """Return B and D of least errors for A and C, ``None`` if modes cannot be told apart."""
    z, U, n, nu, ny = data.z, data.U, len(A), data.U.shape[1], len(C)
    B, D = np.zeros((n, nu)), np.zeros((ny, nu))
    m = Modes.of(A, B, C, D)
    if m is None:
        return None
    left, right = _constants(m, nu)
    columns = np.concatenate([n + np.arange(n * nu), n * (1 + nu + ny) + np.flatnonzero(free)])
    right = right.reshape(-1, nu, right.shape[1])[n:, :, columns].reshape(-1, len(columns))
    functions = _with_one(1.0 / (z[:, None] - m.poles))
    Z = scipy.linalg.block_diag(np.kron(m.W, np.eye(nu)), np.eye(int(free.sum())))
    G = (Z.conj().T @ _products(functions, data, left[:, columns], right) @ Z).real
    size = np.sqrt(np.maximum(np.diagonal(G), 1e-300))
    system = _GramSystem(G / np.outer(size, size), np.eye(len(G)))
    if not system.rank:
        return None
    for _ in range(2):  # solving again for what is left is as precise as a solution by J
        errors = data.Y - Modes(*m[:3], m.W @ B, m.c, D).response(z) @ U
        H = data.weighted(data.weighted(errors)) @ U.conj().swapaxes(1, 2)
        sums = (functions.conj().T @ H.reshape(len(H), -1)).reshape(-1, ny, nu)
        of_b = np.einsum("iok,oi->ik", sums[:n], m.c.conj())
        gradient = (Z.conj().T @ np.concatenate([of_b.ravel(), sums[n][free]])).real / size
        step = -system.solve(torch.as_tensor(gradient), 0.0).numpy() / size
        B += step[: n * nu].reshape(n, nu)
        D[free] += step[n * nu :]
    return B, D


def _constants(m: Modes, nu: int) -> tuple[Complex, Complex]:
    """Constants of the columns for λ, b, c, D: of the outputs (ny, Kc), and of each function and
    input ((2 nx + 1) nu, Kc)."""
    ny, n = m.c.shape
    outputs, inputs, states = np.eye(ny), np.eye(nu), np.eye(2 * n + 1)
    squares, singles, one = states[:, :n], states[:, n : 2 * n], states[:, 2 * n :]
    left = [m.c, np.repeat(m.c, nu, axis=1), np.tile(outputs, n), np.repeat(outputs, nu, axis=1)]
    of_b = np.einsum("ai,jk->ajik", singles, inputs)
    driven = [np.einsum("ai,ij->aji", part, m.b) for part in (squares, singles)]
    right = [
        driven[0],
        of_b.reshape(2 * n + 1, nu, n * nu),
        np.repeat(driven[1], ny, axis=2),
        np.tile(np.einsum("ai,jk->ajk", one, inputs), (1, 1, ny)),
    ]
    return np.hstack(left), np.concatenate(right, axis=2).reshape((2 * n + 1) * nu, -1)


def _change(m: Modes, free: Booleans) -> Complex:
    """Derivative of λ, b (by modes), c (by modes) and the free D with A, B, C, D, (Kc, P)."""
    n, nu, ny = len(m.poles), m.b.shape[1], len(m.c)
    apart = m.poles - m.poles[:, None]
    np.fill_diagonal(apart, 1.0)
    near = (1.0 - np.eye(n)) / apart  # 1 / (λⱼ - λᵢ)
    Vt = m.V.T
    sizes = n * n, n * nu, ny * n, ny * nu
    of_poles = (m.W[:, :, None] * Vt[:, None, :]).reshape(n, -1)
    mixed = -np.einsum("qj,jk,ij->ikq", m.V, m.b, near, optimize=True)
    b_A = (m.W[:, None, :, None] * mixed[:, :, None, :]).reshape(n * nu, -1)
    mixed = np.einsum("oj,jp,ji->iop", m.c, m.W, near, optimize=True)
    c_A = (mixed[:, :, :, None] * Vt[:, None, None, :]).reshape(n * ny, -1)
    b_B = np.einsum("ip,jk->ijpk", m.W, np.eye(nu)).reshape(n * nu, -1)
    c_C = np.einsum("iq,ou->iouq", Vt, np.eye(ny)).reshape(n * ny, -1)
    change = np.zeros((n * (1 + nu + ny) + int(free.sum()), sum(sizes)), dtype=complex)
    rows = np.cumsum([0, n, n * nu, n * ny])
    columns = np.cumsum([0, *sizes])
    change[: rows[1], : columns[1]] = of_poles
    change[rows[1] : rows[2], : columns[1]] = b_A
    change[rows[2] : rows[3], : columns[1]] = c_A
    change[rows[1] : rows[2], columns[1] : columns[2]] = b_B
    change[rows[2] : rows[3], columns[2] : columns[3]] = c_C
    change[rows[3] + np.arange(int(free.sum())), columns[3] + np.flatnonzero(free)] = 1.0
    return change


def _without_scaling(m: Modes, change: Complex) -> Float[Array, "K P"]:
    """Return real rows that span the same directions: one pole of each pair, and the largest entry
    of each bᵢ and cᵢ held constant, as bᵢ and cᵢ share a factor."""
    (ny, n), nu = m.c.shape, m.b.shape[1]
    poles, b, c, D = np.split(change, np.cumsum([n, n * nu, n * ny]))
    both = np.concatenate([b.reshape(n, nu, -1), c.reshape(n, ny, -1)], axis=1)
    # Multiplying bᵢ and dividing cᵢ by a factor moves both along these directions.
    along = np.concatenate([m.b, -m.c.T], axis=1)
    largest, at = np.abs(along).argmax(axis=1), np.arange(n)
    size = along[at, largest]  # 0 of a mode that no input moves and no output shows
    factor = both[at, largest] / np.where(size == 0, 1.0, size)[:, None]  # (n, P)
    both = both - along[:, :, None] * factor[:, None]
    both = both[np.arange(nu + ny) != largest[:, None]].reshape(n, -1, change.shape[1])
    whole = np.concatenate([poles[:, None], both], axis=1)
    upper, pair = whole[m.poles.imag >= 0], whole[m.poles.imag > 0]
    parts = [part.reshape(-1, change.shape[1]) for part in (upper.real, pair.imag)]
    return np.concatenate([*parts, D.real])


def stacked(errors: Complex, more: Array) -> Tensor:
    """Real parts, then imaginary parts, then more."""
    flat = errors.ravel()
    return torch.as_tensor(np.concatenate([flat.real, flat.imag, more]))
