"""A static map linearised at every sample: dw = J dz + (∂w/∂φ) dφ."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor
from torch.func import vjp, vmap

from lfrtorch._support.threads import has_kernels, spread_loop, to_float64
from lfrtorch._support.types import Array
from lfrtorch.maps.machine_code import Code, call_slope, prepared
from lfrtorch.maps.static_map import StaticMap


def linearise_map(
    static: StaticMap, z: Float[Tensor, "R T nz"], phi: Float[Tensor, " P"], code: Code | None
) -> LinearisedMap:
    """Linearise a map at z with the weights φ; ``code`` is its machine code, or None for torch."""
    if code is not None and static.nw and has_kernels(z):
        return CompiledMap(z, phi, static.nw, code)
    return TorchMap(static, z, phi)


class TorchMap:
    """Linearisation by torch, on any device."""

    def __init__(
        self, static: StaticMap, z: Float[Tensor, "R T nz"], phi: Float[Tensor, " P"]
    ) -> None:
        self._static, self._z, self._phi = static, z, phi
        self.J = static.slope(z, phi)

    def by_weight(self) -> Float[Tensor, "R T nw P"]:
        """Derivatives ∂w/∂φ."""
        return self._static.by_weight(self._z, self._phi)

    def tangent(self, d_phi: Float[Tensor, " P"]) -> Float[Tensor, "R T nw"]:
        """Product (∂w/∂φ) dφ."""
        return self.by_weight() @ d_phi

    def adjoint(self, d_w: Float[Tensor, "R T nw"]) -> Float[Tensor, "R P"]:
        """Product Σ_k (∂w/∂φ)ᵀ d_w(k)."""
        if not len(self._phi):
            return d_w[:, 0, :0]

        def one(z: Tensor, d_w: Tensor) -> Tensor:
            return vjp(lambda phi: self._static.of_weights(z, phi), self._phi)[1](d_w)[0]

        return vmap(one)(self._z, d_w)


class CompiledMap:
    """Linearisation in machine code: each use computes derivatives anew and stores none."""

    def __init__(
        self, z: Float[Tensor, "R T nz"], phi: Float[Tensor, " P"], nw: int, code: Code
    ) -> None:
        self._z, self._phi, self._code, self._dtype = to_float64(z), to_float64(phi), code, z.dtype
        self._shape = (*z.shape[:2], nw)
        self.J = self._run(_slopes, np.empty((*self._shape, z.shape[2])), 0)

    def by_weight(self) -> Float[Tensor, "R T nw P"]:
        """∂w/∂φ."""
        return self._run(_slopes, np.empty((*self._shape, len(self._phi))), 1)

    def tangent(self, d_phi: Float[Tensor, " P"]) -> Float[Tensor, "R T nw"]:
        """(∂w/∂φ) dφ."""
        return self._run(_tangent, np.empty(self._shape), to_float64(d_phi))

    def adjoint(self, d_w: Float[Tensor, "R T nw"]) -> Float[Tensor, "R P"]:
        """Product Σ_k (∂w/∂φ)ᵀ d_w(k)."""
        out = np.zeros((len(d_w), len(self._phi)))
        return self._run(_adjoint, out, to_float64(d_w.contiguous()))

    def _run(self, kernel: Callable[..., None], out: Array, given: Any) -> Tensor:
        """Run a loop over the records, and return the array that it writes."""
        spread_loop(kernel, len(out), self._code.arguments, self._phi, self._z, given, out)
        return torch.from_numpy(out).to(self._dtype)


LinearisedMap = TorchMap | CompiledMap
"""A linearised map: ∂w/∂z, ∂w/∂φ and products with ∂w/∂φ at every sample, for all weights φ."""


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(first, jobs, step, code, phi, z, which, out):
    """Write ∂w/∂z (``which`` = 0) or ∂w/∂φ (1) at all samples of the records of these jobs."""
    slope, ints, constants, room = code[2], code[3], code[4], prepared(code, phi)
    nw, P = out.shape[2], len(phi)
    J, none = np.empty(nw * z.shape[2]), np.empty(0)
    for r in range(first, jobs, step):
        for k in range(z.shape[1]):
            if which == 0:
                call_slope(slope, ints, constants, phi, z[r, k], out[r, k], none, 0, room)
            else:
                call_slope(slope, ints, constants, phi, z[r, k], J, out[r, k], P, room)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _tangent(first, jobs, step, code, phi, z, d_phi, out):
    slope, ints, constants, room = code[2], code[3], code[4], prepared(code, phi)
    nw, P = out.shape[2], len(phi)
    J, by = np.empty(nw * z.shape[2]), np.empty((nw, P))
    for r in range(first, jobs, step):
        for k in range(z.shape[1]):
            call_slope(slope, ints, constants, phi, z[r, k], J, by, P, room)
            for q in range(nw):
                a = 0.0
                for n in range(P):
                    a += by[q, n] * d_phi[n]
                out[r, k, q] = a


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _adjoint(first, jobs, step, code, phi, z, d_w, out):
    slope, ints, constants, room = code[2], code[3], code[4], prepared(code, phi)
    nw, P = d_w.shape[2], len(phi)
    J, by = np.empty(nw * z.shape[2]), np.empty((nw, P))
    for r in range(first, jobs, step):
        for k in range(z.shape[1]):
            call_slope(slope, ints, constants, phi, z[r, k], J, by, P, room)
            for q in range(nw):
                for n in range(P):
                    out[r, n] += by[q, n] * d_w[r, k, q]
