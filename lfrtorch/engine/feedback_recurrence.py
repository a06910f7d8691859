"""Recurrences of the linearised model without forming F(k) = A + Bw J(k) Cz.

J(k) has nw nz entries, and F(k) has nx². A step of one column takes nx (nx + nz + nw) products.
On the CPU compiled code is used; other devices form F and use ``scan``.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from lfrtorch._support.threads import has_kernels, spread, spread_loop, to_numpy
from lfrtorch.engine.blocked_kernel import add_feedback
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.jacobian_kernel import copy_to
from lfrtorch.engine.linear_recurrence import flush, linear_recurrence, scan
from lfrtorch.engine.linearised import PASS, linearise_at, static_slope
from lfrtorch.engine.weights import Weights


def states(
    W: Weights,
    J: Float[Tensor, "R T nw nz"],
    g: Float[Tensor, "R T nx"],
    known: Float[Tensor, "R nx"],
    *,
    backwards: bool = False,
) -> Float[Tensor, "R T+1 nx"]:
    """States of s(k+1) = F(k) s(k) + g(k) from the known s(0).

    If ``backwards``: costates of s(k) = F(k)ᵀ s(k+1) + g(k) from the known s(T).
    """
    if has_kernels(J):
        s = g.new_empty(len(g), g.shape[1] + 1, g.shape[2])
        s[:, -1 if backwards else 0] = known
        kernel = _backwards if backwards else _forwards
        spread_loop(kernel, len(g), *_matrices(W), to_numpy(J), to_numpy(g), s.numpy())
        return s
    F, g, known = linearise_at(W, J).F, g.unsqueeze(-1), known.unsqueeze(-1)
    if backwards:
        return scan(F.mT.flip(1), g.flip(1), known).squeeze(-1).flip(1)
    return scan(F, g, known).squeeze(-1)


def transition(
    W: Weights, J: Float[Tensor, "R T nw nz"], Phi: Float[Tensor, "R nx m"]
) -> Float[Tensor, "R nx m"]:
    """Product F(T-1) ... F(0) Φ: the transition matrix applied to Φ."""
    if not has_kernels(J):
        F = linearise_at(W, J).F
        return linear_recurrence(F, torch.zeros_like(F), Phi)[:, -1]
    Phi = Phi.clone(memory_format=torch.contiguous_format)
    spread(_transition, len(Phi), *_matrices(W), to_numpy(J), Phi.numpy())
    return Phi


@torch.no_grad()
def monodromy(model: LFRCell | Weights, z: Float[Tensor, "R T nz"]) -> Float[Tensor, "R nx nx"]:
    """Transition matrix over a whole record: the product of all F(k)."""
    W = model.weights()
    Phi = torch.eye(W.nx).to(z).expand(len(z), W.nx, W.nx)
    for part in z.split(max(1, PASS // len(z)), dim=1):
        Phi = transition(W, static_slope(W, part), Phi)
    return Phi


def _matrices(W: Weights) -> list[NDArray]:
    return [to_numpy(part) for part in (W.A, W.Bw, W.Cz)]


@njit(cache=True, nogil=True, error_model="numpy")
def _forwards(first, jobs, step, A, Bw, Cz, J, g, s):
    for r in range(first, jobs, step):
        _forwards_of(r, A, Bw, Cz, J, g, s)


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def _forwards_of(r, A, Bw, Cz, J, g, s):
    # Transposed, so that inner loops run over contiguous memory and become vector instructions.
    AT, BwT, J, g, s = A.T.copy(), Bw.T.copy(), J[r], g[r], s[r]
    nw, nx = BwT.shape
    for k in range(len(g)):
        now, after = s[k], s[k + 1]
        for i in range(nx):
            after[i] = g[k, i]
        for j in range(nx):
            for i in range(nx):
                after[i] += AT[j, i] * now[j]
        for j in range(len(Cz)):
            z = s.dtype.type(0)
            for i in range(nx):
                z += Cz[j, i] * now[i]
            for q in range(nw):
                w = J[k, q, j] * z
                for i in range(nx):
                    after[i] += BwT[q, i] * w
        if k % 256 == 255:
            flush(s[k + 1 : k + 2])


@njit(cache=True, nogil=True, error_model="numpy")
def _backwards(first, jobs, step, A, Bw, Cz, J, g, s):
    for r in range(first, jobs, step):
        _backwards_of(r, A, Bw, Cz, J, g, s)


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def _backwards_of(r, A, Bw, Cz, J, g, s):
    BwT, J, g, s = Bw.T.copy(), J[r], g[r], s[r]
    nw, nx = BwT.shape
    for k in range(len(g) - 1, -1, -1):
        now, before = s[k + 1], s[k]
        for i in range(nx):
            before[i] = g[k, i]
        for j in range(nx):
            for i in range(nx):
                before[i] += A[j, i] * now[j]
        for q in range(nw):
            w = s.dtype.type(0)
            for i in range(nx):
                w += BwT[q, i] * now[i]
            for j in range(len(Cz)):
                z = J[k, q, j] * w
                for i in range(nx):
                    before[i] += Cz[j, i] * z
        if k % 256 == 255:
            flush(s[k : k + 1])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _transition(r, A, Bw, Cz, J, Phi):
    BwT, J, Phi = Bw.T.copy(), J[r], Phi[r]
    F, X = np.empty_like(A), Phi.T.copy()
    X_next = np.empty_like(X)
    for k in range(len(J)):
        copy_to(A.T, F, 0)
        add_feedback(BwT, J[k], Cz, F)
        np.dot(X, F, X_next)  # all three are transposed
        X, X_next = X_next, X
        if k % 256 == 255:
            flush(X)
            if not X.any():  # the transition has decayed to 0
                break
    copy_to(X.T, Phi, 0)
