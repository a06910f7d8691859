"""Linear recurrences s(k+1) = F(k) s(k) + g(k), for many columns at once.

Newton steps over a trajectory, start states and periodic boundaries lead to such recurrences. On
the CPU compiled code is used; other devices use ``scan``, which is parallel in time.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from lfrtorch._support.threads import has_kernels, spread, to_numpy

NOTHING = 1e-30
"""Magnitude below which entries are set to 0; states are of unit size."""


def linear_recurrence(
    F: Float[Tensor, "R T n n"], g: Float[Tensor, "R T n m"], s0: Float[Tensor, "R n m"]
) -> Float[Tensor, "R T+1 n m"]:
    """States of s(k+1) = F(k) s(k) + g(k), s(0) = s0."""
    if not has_kernels(F):
        return scan(F, g, s0)
    R, T, n, m = g.shape
    s = g.new_empty(R, T + 1, n, m)
    s[:, 0] = s0
    spread(_recur, R, to_numpy(F), to_numpy(g), s.detach().numpy())
    return s


@njit(cache=True, nogil=True, fastmath={"contract"})
def _recur(r, F, g, s):
    _, T, n, m = g.shape
    for k in range(T):
        for i in range(n):
            for c in range(m):
                a = g[r, k, i, c]
                for j in range(n):
                    a += F[r, k, i, j] * s[r, k, j, c]
                s[r, k + 1, i, c] = a
        if k % 256 == 255:
            flush(s[r, k + 1])


@njit(nogil=True)
def flush(s):
    """Set decayed entries to 0: with denormal numbers a recurrence is a hundred times slower."""
    for i in range(s.shape[0]):
        for c in range(s.shape[1]):
            if abs(s[i, c]) < NOTHING:
                s[i, c] = 0.0


def scan(
    F: Float[Tensor, "R T n n"], g: Float[Tensor, "R T n m"], s0: Float[Tensor, "R n m"]
) -> Float[Tensor, "R T+1 n m"]:
    """The recurrence in about 3 √T batched products: chunks of √T steps next to each other.

    Every chunk is computed from a zero state, together with its transition matrices. One loop over
    the chunks then computes their initial states, and the response to these is added.
    """
    R, T, n, m = g.shape
    steps = max(1, math.isqrt(T))
    chunks = -(-T // steps)
    pad = chunks * steps - T
    eye = torch.eye(n, dtype=F.dtype, device=F.device)
    F = torch.cat([F, eye.expand(R, pad, n, n)], dim=1).reshape(R, chunks, steps, n, n)
    g = torch.cat([g, g.new_zeros(R, pad, n, m)], dim=1).reshape(R, chunks, steps, n, m)

    local = torch.cat([g.new_zeros(R, chunks, n, m), eye.expand(R, chunks, n, n)], dim=-1)
    inside = []
    for k in range(steps):
        local = F[:, :, k] @ local
        local[..., :m] += g[:, :, k]
        inside.append(local)
    particular, transition = torch.stack(inside, dim=2).split([m, n], dim=-1)

    initial = [s0]
    for c in range(chunks - 1):
        initial.append(transition[:, c, -1] @ initial[-1] + particular[:, c, -1])
    s = particular + transition @ torch.stack(initial, dim=1).unsqueeze(2)
    return torch.cat([s0.unsqueeze(1), s.reshape(R, chunks * steps, n, m)[:, :T]], dim=1)
