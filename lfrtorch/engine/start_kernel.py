"""Estimation of initial states from outputs, record by record in machine code.

``estimated_start`` in ``initial_state`` defines the estimate. Gauss-Newton steps begin at a
trajectory and overwrite it with better ones. ``step_of`` is one step, for any model.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lfrtorch.engine.simulation_kernel import affine, matrices, simulate_record
from lfrtorch.engine.small_matrices import reflect, svd
from lfrtorch.maps.machine_code import call_slope, prepared

ITERATIONS = 20
"""Largest number of Gauss-Newton steps of a search."""

HALVINGS = 6
"""Largest number of trials in a Gauss-Newton step."""

TOLERANCE = 1e-8
"""Relative decrease of the cost that ends a search."""

SEEN = 1e-9
"""Smallest effect on the weighted output for a direction of the initial state to be estimated."""

FADED = 1e-12
"""Part of an initial state that cannot be seen in the output: far below ``SEEN``."""

PASSES = 8
"""Number of passes that estimate the prior's weight."""

_MET = 4.0 * np.finfo(np.float64).eps
_BLOCK = 256  # number of samples whose rows are added at once


@njit(cache=True, nogil=True, error_model="numpy")
def step_of(L, squares, x0, white, spread, variance, counted, passes, seen):
    """Gauss-Newton step from x0, its predicted decrease of the cost, and the prior's weight.

    L = [rows left]ᵀ: the squared errors at x0 + d are |rows d + left|² plus a constant; ``squares``
    is their sum at d = 0. The prior adds v |white x0|²; spread is the inverse of white. The error
    variance v is ``variance`` in the first pass. Each later pass takes it from the errors of the
    linearised model at the last v. Without ``passes`` there is no prior.

    Shape:
        L: (nx + 1, nx + 1), x0: (nx,), white, spread: (nx, nx).
    """
    nx, v = len(x0), variance if passes else 0.0
    R, errors = np.empty((nx + 1, nx)), np.empty(nx + 1)
    for i in range(nx + 1):
        errors[i] = L[nx, i]
        for j in range(nx):
            R[i, j] = L[j, i]
            errors[i] -= R[i, j] * x0[j]
    if passes > 1:
        U, s, _ = svd(_product(R, spread))
        along, left = _product_with(U.T, errors), _norm(L[nx])
        beside = max(squares - left, 0.0) + max(_norm(errors) - _norm(along), 0.0)
        for _ in range(passes - 1):
            total = beside
            for i in range(nx):
                if v > 0.0:
                    total += (along[i] * v / (s[i] * s[i] + v)) ** 2
            v = total / max(counted, 1)
    whole, root, weighted = np.zeros((nx + 1, 2 * nx + 1)), math.sqrt(v), _product_with(white, x0)
    for i in range(nx + 1):
        for j in range(nx + 1):
            whole[i, j] = L[i, j]
        for j in range(nx):
            whole[i, nx + 1 + j] = root * (white[j, i] if i < nx else weighted[j])
    reflect(whole, nx)
    # A direction that is invisible in the output keeps its value.
    square = np.empty((nx, nx))
    for i in range(nx):
        for j in range(nx):
            square[i, j] = whole[j, i]
    U, s, V = svd(square)
    along, most, promised = _product_with(U.T, whole[nx, :nx]), _largest(s), 0.0
    for i in range(nx):
        shown = s[i] > max(seen, SEEN * most)
        along[i] = -along[i] / s[i] if shown else 0.0
        promised += (s[i] * along[i]) ** 2
    return _product_with(V, along), promised, v


@njit(cache=True, nogil=True, error_model="numpy")
def fit_starts(
    first, jobs, step, sizes, weights, code, u, y, weight, white, spread, variance, counted, passes,
    x, z, w, y_hat,
):  # fmt: skip
    """Search the initial states of these jobs' records; results overwrite the first trajectories.

    A step that does not lower the cost is quartered. The number of passes of the prior doubles from
    step to step up to ``PASSES``; 0 passes mean no prior.

    Shape:
        u: (R, T, nu), y, weight: (R, T, ny), white, spread: (R, nx, nx), variance, counted: (R,).
        x: (R, T + 1, nx), z: (R, T, nz), w: (R, T, nw), y_hat: (R, T, ny).
    """
    nx, _, ny, nz, nw = sizes
    T = u.shape[1]
    trial = np.empty((T + 1, nx)), np.empty((T, nz)), np.empty((T, nw)), np.empty((T, ny))
    for r in range(first, jobs, step):
        best, own, largest = (x[r], z[r], w[r], y_hat[r]), passes, 0.0
        for k in range(T):
            largest = max(largest, _largest(weight[r, k]))
        seen, squares = SEEN * largest, _squares(y_hat[r], y[r], weight[r])
        for _ in range(ITERATIONS):
            usable, L = _factor(sizes, weights, code, y[r], weight[r], best)
            if not (usable and np.isfinite(squares)):
                break
            x0 = best[0][0].copy()
            d, promised, v = step_of(
                L, squares, x0, white[r], spread[r], variance[r], counted[r], own, seen
            )
            before = cost = squares + v * _norm(_product_with(white[r], x0))
            # A step with too small a predicted decrease of the cost is not tried.
            for _ in range(HALVINGS if promised > TOLERANCE * cost else 0):
                _copy(best, trial)
                for i in range(nx):
                    trial[0][0, i] = x0[i] + d[i]
                simulate_record(
                    sizes, weights, code, u[r], _MET, trial[0], trial[1], trial[2], trial[3]
                )
                reached = _squares(trial[3], y[r], weight[r])
                total = reached + v * _norm(_product_with(white[r], trial[0][0]))
                if total < cost:  # False for NaN
                    _copy(trial, best)
                    squares, cost = reached, total
                    break
                for i in range(nx):
                    d[i] /= 4.0
            if (own in (0, PASSES)) and not cost < (1.0 - TOLERANCE) * before:
                break
            own = min(2 * own, PASSES)


@njit(nogil=True, error_model="numpy")
def _factor(sizes, weights, code, y, weight, at):
    """Tell if M = [∂y/∂x0 | errors], weighted, is finite, and compute L with L Lᵀ = Mᵀ M."""
    A, _, Bw, Cz, _, Cy, _, Dyw, phi = matrices(sizes, weights)
    (nx, nw), nz, (T, ny) = Bw.shape, len(Cz), y.shape
    slope, ints, constants, room = code[2], code[3], code[4], prepared(code, phi)
    S, L, J = np.eye(nx), np.zeros((nx + 1, nx + 1)), np.zeros((nw, nz))  # S[j] is ∂x/∂x0[j]
    none, nothing = np.empty(0), np.empty((max(nw, nz), 0))
    dx, dz, dw, dy = np.empty(nx), np.empty(nz), np.empty(nw), np.empty(ny)
    for t0 in range(0, T, _BLOCK):
        B = min(_BLOCK, T - t0)
        stacked, finite = np.zeros((nx + 1, nx + 1 + B * ny)), True
        _into(L, stacked)
        for k in range(t0, t0 + B):
            if nw:
                call_slope(slope, ints, constants, phi, at[1][k], J, none, 0, room)
            first = nx + 1 + (k - t0) * ny
            for j in range(nx):
                affine(Cz, S[j], nothing, none, dz)
                affine(J, dz, nothing, none, dw)
                affine(Cy, S[j], Dyw, dw, dy)
                affine(A, S[j], Bw, dw, dx)
                for i in range(nx):
                    S[j, i] = dx[i]
                for i in range(ny):
                    stacked[j, first + i] = weight[k, i] * dy[i]
                    finite = finite and math.isfinite(stacked[j, first + i])
            for i in range(ny):
                stacked[nx, first + i] = weight[k, i] * (at[3][k, i] - y[k, i])
                finite = finite and math.isfinite(stacked[nx, first + i])
        if not finite:
            return False, L
        reflect(stacked, nx + 1)
        _into(stacked, L)
        faded = True
        for j in range(nx):
            for i in range(nx):
                faded = faded and abs(S[j, i]) < FADED  # False for NaN
        if faded:
            break
    return True, L


# Loops are used instead of slices and array expressions, which numba takes seconds to compile.


@njit(nogil=True)
def _into(source, target):
    """Copy the columns that both arrays have."""
    for i in range(len(source)):
        for j in range(min(source.shape[1], target.shape[1])):
            target[i, j] = source[i, j]


@njit(nogil=True)
def _copy(source, target):
    """Write the signals of a trajectory over those of another."""
    for n in range(4):
        _into(source[n], target[n])


@njit(nogil=True)
def _largest(v):
    most = 0.0
    for i in range(len(v)):
        most = max(most, abs(v[i]))
    return most


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
def _product_with(M, v):
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
