"""Jacobian of the static nonlinearity at every sample, with respect to its inputs and weights."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call, jacrev, vjp, vmap

from lfrtorch.engine.nonlinearity import (
    ACTIVATIONS,
    Network,
    Polynomial,
    Stacked,
    inner_weights,
    is_network,
    is_polynomial,
)

Weights = dict[str, Tensor]


class StaticJacobian(Protocol):
    """dw = J dz + (∂w/∂φ) dφ; φ are all weights of the map in the order of its parameters.

    dφ has an axis R if every record has weights of its own.
    """

    @property
    def J(self) -> Float[Tensor, "R T nw nz"]:
        """∂w/∂z."""
        ...

    def part(self, records: slice, time: slice) -> StaticJacobian:
        """The same for some of the records and samples."""
        ...

    def by_weight(self) -> Float[Tensor, "R T nw weights"]:
        """∂w/∂φ."""
        ...

    def tangent(self, d_weights: Float[Tensor, "*records weights"]) -> Float[Tensor, "R T nw"]:
        """(∂w/∂φ) dφ."""
        ...

    def adjoint(self, d_w: Float[Tensor, "R T nw"]) -> Float[Tensor, "R weights"]:
        """Σ_k (∂w/∂φ)ᵀ d_w(k)."""
        ...


def linearise_static(
    static: nn.Module | None, z: Float[Tensor, "R T nz"], weights: Weights
) -> StaticJacobian:
    """The map linearised at z, with the given weights instead of its own."""
    if is_network(static):
        return NetworkJacobian(static, z, weights)
    if is_polynomial(static):
        return PolynomialJacobian(static, z, weights)
    return ModuleJacobian(static, z, weights)


_DERIVATIVES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "tanh": lambda v, h: torch.addcmul(h.new_ones(()), h, h, value=-1.0),
    "sigmoid": lambda v, h: h * (1.0 - h),
    "relu": lambda v, h: (v > 0).to(v.dtype),
    "rbf": lambda v, h: -2.0 * v * h,
    "softplus": lambda v, h: torch.sigmoid(v),
}
"""σ'(v) from v and h = σ(v)."""


class NetworkJacobian:
    """A network in closed form: six times faster than ``torch.func``.

    With h0 = z and the layers v = W h_before + b, h = σ(v), w = Ww h + bw, every matrix but the
    last has a slope σ'(v) and an output h; ``W`` holds all matrices, the last is Ww.
    """

    def __init__(self, network: Network, z: Float[Tensor, "R T nz"], weights: Weights) -> None:
        inner = inner_weights(weights)
        self.W = [weights["Wz"], *(W for W, _ in inner), weights["Ww"]]
        self.h, self.slopes = [z], []
        for W, b in zip(self.W, [weights["bz"], *(b for _, b in inner)], strict=False):
            v = (self.h[-1] @ W.mT).add_(b)
            self.h.append(ACTIVATIONS[network.activation](v))
            self.slopes.append(_DERIVATIVES[network.activation](v, self.h[-1]))  # (R, T, nn)
        shapes = [W.shape[-2:] for W in self.W]
        self.sizes = [size for n, m in shapes for size in (n * m, n)]
        nw, nz = shapes[-1][0], shapes[0][1]
        if len(self.slopes) == 1:
            # J = Σ_n slope_n Ww[:, n] Wz[n, :] at every sample: one product with (nn, nw nz).
            rank_ones = self.W[-1].mT.unsqueeze(-1) * self.W[0].unsqueeze(-2)
            self.J = (self.slopes[0] @ rank_ones.flatten(-2)).unflatten(-1, (nw, nz))
        else:
            self.J = self._by_layer()[0] @ _over_time(self.W[0])

    def _by_layer(self) -> list[Float[Tensor, "R T nw nn"]]:
        """∂w/∂v of all layers, the first one first."""
        found = [self.slopes[-1].unsqueeze(-2) * _over_time(self.W[-1])]
        for slope, W in zip(self.slopes[-2::-1], self.W[-2:0:-1], strict=True):
            found.append((found[-1] @ _over_time(W)).mul_(slope.unsqueeze(-2)))
        return found[::-1]

    def part(self, records: slice, time: slice) -> StaticJacobian:
        """The same for some of the records and samples."""
        part = copy.copy(self)
        part.h, part.slopes = (
            [signal[records, time] for signal in signals] for signals in (self.h, self.slopes)
        )
        part.J = self.J[records, time]
        if self.W[0].ndim == 3:
            part.W = [W[records] for W in self.W]
        return part

    def by_weight(self) -> Float[Tensor, "R T nw weights"]:
        """∂w/∂φ."""
        R, T, nw = self.J.shape[:3]
        # With s = slope: ∂w_q/∂W[n, m] = ∂w_q/∂v_n h_m with the h before it, ∂w_q/∂b = ∂w_q/∂v,
        # ∂w_q/∂Ww[q, n] = h_n, ∂w_q/∂bw[q] = 1; the last two are 0 in the rows of other outputs.
        out = self.h[-1].new_zeros(R, T, nw, sum(self.sizes))
        *parts, Ww, bw = out.split(self.sizes, dim=-1)
        layers = zip(self.h, self._by_layer(), parts[::2], parts[1::2], strict=False)
        for h, by_v, W, b in layers:
            b.copy_(by_v)
            into = W.unflatten(-1, (b.shape[-1], h.shape[-1]))
            torch.mul(by_v.unsqueeze(-1), h[:, :, None, None], out=into)
        h = self.h[-1].unsqueeze(-1).expand(-1, -1, -1, nw)
        Ww.unflatten(-1, (nw, h.shape[2])).diagonal(dim1=2, dim2=3).copy_(h)
        bw.diagonal(dim1=2, dim2=3).fill_(1.0)
        return out

    def tangent(self, d_weights: Float[Tensor, "*records weights"]) -> Float[Tensor, "R T nw"]:
        """(∂w/∂φ) dφ."""
        parts, d_h = d_weights.split(self.sizes, dim=-1), None
        layers = zip(self.W, self.h, parts[::2], parts[1::2], [*self.slopes, None], strict=True)
        for W, h, d_W, d_b, slope in layers:
            d_v = h @ d_W.unflatten(-1, W.shape[-2:]).mT + d_b.unsqueeze(-2)
            if d_h is not None:
                d_v += d_h @ W.mT
            d_h = d_v if slope is None else slope * d_v
        assert d_h is not None
        return d_h

    def adjoint(self, d_w: Float[Tensor, "R T nw"]) -> Float[Tensor, "R weights"]:
        """Σ_k (∂w/∂φ)ᵀ d_w(k)."""
        d_v, parts = d_w, []
        for W, h, slope in zip(self.W[::-1], self.h[::-1], [*self.slopes[::-1], None], strict=True):
            parts = [(d_v.mT @ h).flatten(1), d_v.sum(-2), *parts]
            if slope is not None:
                d_v = (d_v @ W) * slope
        return torch.cat(parts, dim=-1)


def _over_time(W: Tensor) -> Tensor:
    """A matrix, or one a record, for all samples."""
    return W.unsqueeze(-3)


class PolynomialJacobian:
    """w = C m(z), in closed form: every ∂w/∂z is a polynomial in the same monomials."""

    def __init__(
        self, polynomial: Polynomial, z: Float[Tensor, "R T nz"], weights: Weights
    ) -> None:
        C, nz = weights["C"], polynomial.nz
        self.m, (nw, count) = polynomial.monomials(z), C.shape[-2:]
        n, j, e, lower = torch.tensor(polynomial.slopes, device=C.device).mT
        # Its coefficients: D[.., lower, q, j] = e C[q, n].
        D = C.new_zeros(*C.shape[:-2], count, nw, nz)
        D[..., lower, :, j] = (e * C[..., n]).movedim(-1, 0)
        self.J = (self.m @ D.flatten(-2)).unflatten(-1, (nw, nz))

    def part(self, records: slice, time: slice) -> StaticJacobian:
        """The same for some of the records and samples."""
        part = copy.copy(self)
        part.m, part.J = self.m[records, time], self.J[records, time]
        return part

    def by_weight(self) -> Float[Tensor, "R T nw weights"]:
        """∂w/∂φ: the monomials, in the rows of one output each."""
        nw = self.J.shape[2]
        if nw == 1:
            return self.m.unsqueeze(2)
        return torch.einsum("rtm,qp->rtqpm", self.m, torch.eye(nw).to(self.m)).flatten(-2)

    def tangent(self, d_weights: Float[Tensor, "*records weights"]) -> Float[Tensor, "R T nw"]:
        """(∂w/∂φ) dφ."""
        return self.m @ d_weights.unflatten(-1, (self.J.shape[2], -1)).mT

    def adjoint(self, d_w: Float[Tensor, "R T nw"]) -> Float[Tensor, "R weights"]:
        """Σ_k (∂w/∂φ)ᵀ d_w(k)."""
        return (d_w.mT @ self.m).flatten(1)


class ModuleJacobian:
    """Any module, by ``torch.func``; ``None`` is a map without inputs, outputs and weights."""

    def __init__(
        self, static: nn.Module | None, z: Float[Tensor, "R T nz"], weights: Weights
    ) -> None:
        self.z, self.static, self.weights = z, static, weights
        self.by_record = None  # axis of the weights that counts the records, for vmap
        if isinstance(static, Stacked):
            self.static, self.by_record = static.base, 0
            self.weights = dict(zip(static.names, weights.values(), strict=True))
        if self.static is None:
            self.J = z.new_zeros(*z.shape, 0)
        else:
            self.J = self._at_every_sample(jacrev(self._map, argnums=1))

    def _map(self, weights: Weights, z: Tensor) -> Tensor:
        return z if self.static is None else functional_call(self.static, weights, (z,))

    def _at_every_sample(self, function: Callable[[Weights, Tensor], Any]) -> Any:
        over_time = vmap(function, in_dims=(None, 0))
        return vmap(over_time, in_dims=(self.by_record, 0))(self.weights, self.z)

    def part(self, records: slice, time: slice) -> StaticJacobian:
        """The same for some of the records and samples."""
        part = copy.copy(self)
        part.z, part.J = self.z[records, time], self.J[records, time]
        if self.by_record is not None:
            part.weights = {name: p[records] for name, p in self.weights.items()}
        return part

    def by_weight(self) -> Float[Tensor, "R T nw weights"]:
        """∂w/∂φ."""
        parts = self._at_every_sample(jacrev(self._map)) if self.weights else {}
        return torch.cat(
            [self.J[..., :0], *(part.reshape(*self.J.shape[:3], -1) for part in parts.values())],
            dim=-1,
        )

    def tangent(self, d_weights: Float[Tensor, "*records weights"]) -> Float[Tensor, "R T nw"]:
        """(∂w/∂φ) dφ."""
        return (self.by_weight() @ d_weights[..., None, :, None]).squeeze(-1)

    def adjoint(self, d_w: Float[Tensor, "R T nw"]) -> Float[Tensor, "R weights"]:
        """Σ_k (∂w/∂φ)ᵀ d_w(k)."""

        def one(weights: Weights, z: Tensor, d_w: Tensor) -> Weights:
            return vjp(lambda weights: self._map(weights, z), weights)[1](d_w)[0]

        parts = vmap(one, in_dims=(self.by_record, 0, 0))(self.weights, self.z, d_w)
        return torch.cat(
            [d_w[:, 0, :0], *(part.reshape(len(d_w), -1) for part in parts.values())], dim=-1
        )
