"""The initial state that an output tells, record by record in machine code.

``estimated_start`` in ``initial_state`` says what is computed. Gauss-Newton steps begin at a
trajectory and write the better ones over it. ``step_of`` is one of them, for any model.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lfrtorch.engine.jacobian_kernel import record_rows
from lfrtorch.engine.simulation_kernel import simulate_record
from lfrtorch.engine.small_matrices import reflect, svd

ITERATIONS, HALVINGS, TOLERANCE = 20, 6, 1e-8
"""Most Gauss-Newton steps, trials in a step, and the relative decrease that ends the search."""

SEEN = 1e-9
"""A direction of the initial state is estimated if it moves the weighted output by this much."""

FADED = 1e-12
"""Part of an initial state that the output cannot tell: far below ``SEEN``."""

PASSES = 8
"""Passes that estimate the prior's weight."""

_MET = 4.0 * np.finfo(np.float64).eps
_BLOCK = 256  # samples whose rows are folded at once
_NO_ENTRIES, _NO_WEIGHTS = np.zeros((0, 3), np.int64), np.zeros(0, np.int64)


@njit(cache=True, nogil=True, error_model="numpy")
def step_of(L, squares, x0, white, spread, variance, counted, passes, seen):
    """A Gauss-Newton step from x0, the cost that it promises to take off, and the prior's weight.

    L = [rows left]ᵀ: the squared errors at x0 + d are |rows d + left|² and what no d changes;
    ``squares`` are all of them at d = 0. The prior adds v |white x0|²; spread is the inverse of
    white. v, the variance of the errors, is ``variance`` in the first pass; in each later one it is
    that of the errors which the linear model has at the last v. Without ``passes`` there is none.

    Shape:
        L: (nx + 1, nx + 1), x0: (nx,), white, spread: (nx, nx).
    """
    nx, v = len(x0), variance if passes else 0.0
    if passes > 1:
        scaled, errors = _product(L[:nx].T, spread), L[nx] - _dot(L[:nx].T, x0)
        U, s, _ = svd(scaled)
        along = _dot(U.T, errors)
        beside = max(squares - _norm(L[nx]), 0.0) + max(_norm(errors) - _norm(along), 0.0)
        for _ in range(passes - 1):
            total = beside
            for i in range(nx):
                if v > 0.0:
                    total += (along[i] * v / (s[i] * s[i] + v)) ** 2
            v = total / max(counted, 1)
    whole = np.zeros((nx + 1, 2 * nx + 1))
    prior, weighted = np.sqrt(v) * white, np.sqrt(v) * _dot(white, x0)
    for i in range(nx + 1):
        for j in range(nx + 1):
            whole[i, j] = L[i, j]
        for j in range(nx):
            whole[i, nx + 1 + j] = prior[j, i] if i < nx else weighted[j]
    reflect(whole, nx)
    # A state that the output does not show stays where it is.
    U, s, V = svd(np.ascontiguousarray(whole[:nx, :nx].T))
    along, most = -_dot(U.T, whole[nx, :nx]), s.max()
    for i in range(nx):
        along[i] = along[i] / s[i] if s[i] > max(seen, SEEN * most) else 0.0
    return _dot(V, along), _norm(s * along), v


@njit(cache=True, nogil=True, error_model="numpy")
def fit_starts(
    first, jobs, step, sizes, weights, code, u, y, weight, white, spread, variance, counted, passes,
    x, z, w, y_hat,
):  # fmt: skip
    """Search the initial states of the records of these jobs, from trajectories and over them.

    A step that does not lower the cost is quartered. Passes of the prior double from step to step
    up to ``PASSES``; of 0 there is no prior.

    Shape:
        u: (R, T, nu), y, weight: (R, T, ny), white, spread: (R, nx, nx), variance, counted: (R,).
        x: (R, T + 1, nx), z: (R, T, nz), w: (R, T, nw), y_hat: (R, T, ny).
    """
    trial = np.empty_like(x[0]), np.empty_like(z[0]), np.empty_like(w[0]), np.empty_like(y_hat[0])
    for r in range(first, jobs, step):
        best, own = (x[r], z[r], w[r], y_hat[r]), passes
        seen, squares = SEEN * np.abs(weight[r]).max(), _squares(y_hat[r], y[r], weight[r])
        for _ in range(ITERATIONS):
            usable, L = _factor(sizes, weights, code, u[r], y[r], weight[r], best)
            if not (usable and np.isfinite(squares)):
                break
            x0 = best[0][0].copy()
            d, promised, v = step_of(
                L, squares, x0, white[r], spread[r], variance[r], counted[r], own, seen
            )
            before = cost = squares + v * _norm(_dot(white[r], x0))
            # A step that should hardly lower the cost is not worth a trial.
            for _ in range(HALVINGS if promised > TOLERANCE * cost else 0):
                for n in range(4):
                    trial[n][:] = best[n]
                trial[0][0] = x0 + d
                simulate_record(
                    sizes, weights, code, u[r], _MET, trial[0], trial[1], trial[2], trial[3]
                )
                reached = _squares(trial[3], y[r], weight[r])
                total = reached + v * _norm(_dot(white[r], trial[0][0]))
                if total < cost:  # False for NaN
                    for n in range(4):
                        best[n][:] = trial[n]
                    squares, cost = reached, total
                    break
                d = d / 4.0
            if (own in (0, PASSES)) and not cost < (1.0 - TOLERANCE) * before:
                break
            own = min(2 * own, PASSES)


@njit(nogil=True, error_model="numpy")
def _factor(sizes, weights, code, u, y, weight, at):
    """Whether M = [derivative by x0 | errors], weighted, is finite, and L with L Lᵀ = Mᵀ M."""
    (T, ny), nx = y.shape, sizes[0]
    x, z, w, y_hat = at
    S, L = np.eye(nx), np.zeros((nx + 1, nx + 1))
    for t0 in range(0, T, _BLOCK):
        B = min(_BLOCK, T - t0)
        rows, stacked = np.empty((B, ny, nx)), np.zeros((nx + 1, nx + 1 + B * ny))
        record_rows(
            sizes, weights, code, u, x, z, w, t0, _NO_ENTRIES, _NO_ENTRIES, _NO_ENTRIES,
            _NO_WEIGHTS, 0, nx, S, rows,
        )  # fmt: skip
        stacked[:, : nx + 1] = L
        for k in range(B):
            for i in range(ny):
                column = nx + 1 + k * ny + i
                for j in range(nx):
                    stacked[j, column] = weight[t0 + k, i] * rows[k, i, j]
                stacked[nx, column] = weight[t0 + k, i] * (y_hat[t0 + k, i] - y[t0 + k, i])
        if not np.isfinite(stacked).all():
            return False, L
        reflect(stacked, nx + 1)
        L = stacked[:, : nx + 1].copy()
        if np.abs(S).max() < FADED:
            break
    return True, L


@njit(nogil=True, error_model="numpy")
def _squares(y_hat, y, weight):
    total = 0.0
    for k in range(len(y)):
        for i in range(y.shape[1]):
            total += (weight[k, i] * (y_hat[k, i] - y[k, i])) ** 2
    return total


@njit(nogil=True, error_model="numpy")
def _norm(v):
    total = 0.0
    for i in range(len(v)):
        total += v[i] * v[i]
    return total


@njit(nogil=True, error_model="numpy")
def _dot(M, v):
    out = np.zeros(len(M))
    for i in range(len(M)):
        for j in range(len(v)):
            out[i] += M[i, j] * v[j]
    return out


@njit(nogil=True, error_model="numpy")
def _product(M, N):
    out = np.zeros((len(M), N.shape[1]))
    for i in range(len(M)):
        for j in range(len(N)):
            for c in range(N.shape[1]):
                out[i, c] += M[i, j] * N[j, c]
    return out
