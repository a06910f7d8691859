"""A known model as a static map: w = [x(k+1); y(k)] of z = [x(k); u(k)], with its parameters.

In an LFR with fixed matrices this is the known model itself; beside it, the LFR learns.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Module, Parameter

from lfrtorch._support.errors import InputError
from lfrtorch._support.threads import has_kernels, spread, to_float64, workers
from lfrtorch.engine.formula_code import machine_code
from lfrtorch.engine.known_kernel import DISCRETE, EULER, RK4, known_slopes
from lfrtorch.engine.operations import Formula, Symbol
from lfrtorch.engine.static_jacobian import ModuleJacobian, StaticJacobian, Weights

METHODS = {"discrete": DISCRETE, "euler": EULER, "rk4": RK4}
"""How a sample is made of f: its result is the next state, or its rates are integrated."""


class KnownEquations(NamedTuple):
    """x(k+1) or dx/dt = f(x, u; p), y = h(x, u; p), in physical units.

    Args:
        f, h: functions of [x; u; p].
        states, parameters: their names.
        units: of the parameters.
        inputs: number of u.
        method: one of ``METHODS``.
        substeps: steps of the integration in a sample, or in half a one with ``centred``.
        centred: whether inputs are held from half a sample before to half a sample after their
            own; x is then the state half a sample before.
    """

    f: Formula
    h: Formula
    states: tuple[str, ...]
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    inputs: int
    method: str
    substeps: int
    centred: bool = False

    def described(self) -> dict[str, Any]:
        """The equations for JSON."""
        return {**self._asdict(), "f": self.f.described(), "h": self.h.described()}

    @classmethod
    def of(cls, description: Any) -> KnownEquations:
        """The equations of a description; anything else is a ValueError."""
        f, h = (Formula.of(description[name]) for name in ("f", "h"))
        states, names, units = (
            tuple(map(str, description[name])) for name in ("states", "parameters", "units")
        )
        inputs, substeps = int(description["inputs"]), int(description["substeps"])
        size = len(states) + inputs + len(names)
        fits = f.inputs == h.inputs == size and len(f.results) == len(states) and substeps > 0
        if not fits or description["method"] not in METHODS:
            raise InputError("its known equations do not fit each other")
        how = description["method"], substeps, bool(description["centred"])
        return cls(f, h, states, names, units, inputs, *how)


class KnownMap(Module):
    """The map of known equations, of normalised signals and parameters.

    Args:
        equations: in physical units.
        sample_time: in seconds.
        device, dtype: of the weights, as in any torch module.

    Shape:
        p: (parameters,), in units of ``p_scale``. z: (..., nx + nu), w: (..., nx + ny). Offsets and
        scales of z, w and p, and ``bounds``, (parameters, 2), are buffers.
    """

    of_z: Tensor
    of_w: Tensor
    p_scale: Tensor
    bounds: Tensor

    def __init__(
        self,
        equations: KnownEquations,
        sample_time: float,
        *,
        device: torch.device | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.equations, self.sample_time = equations, sample_time
        nx, count = len(equations.states), len(equations.parameters)
        nz, nw = nx + equations.inputs, nx + len(equations.h.results)
        self.nx, self.nz, self.nw = nx, nz, nw
        like: dict[str, Any] = {"device": device, "dtype": dtype}
        self.p = Parameter(torch.ones(count, **like))
        for name, size in (("of_z", nz), ("of_w", nw)):
            self.register_buffer(name, torch.tensor([0.0, 1.0], **like).repeat(size, 1))
        self.register_buffer("p_scale", torch.ones(count, **like))
        ends = torch.tensor([-torch.inf, torch.inf], **like)
        self.register_buffer("bounds", ends.repeat(count, 1))

    def weight_shapes(self, nz: int, nw: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights and buffers; nz and nw follow from the equations."""
        count = len(self.equations.parameters)
        scaling = {"of_z": (self.nz, 2), "of_w": (self.nw, 2), "bounds": (count, 2)}
        return {"p": (count,), "p_scale": (count,), **scaling}

    @property
    def physical(self) -> dict[str, float]:
        """The parameters in their units, by name."""
        values = (self.p * self.p_scale).detach().double().cpu().tolist()
        return dict(zip(self.equations.parameters, values, strict=True))

    @property
    def outputs_have_parameters(self) -> bool:
        """Whether y depends on parameters of its own, and not through the states alone."""
        return max(self.equations.h.used, default=0) >= self.nz

    @property
    def steps(self) -> tuple[float, int, int]:
        """Seconds of one step of the integration, their number, and those before the output."""
        e = self.equations
        number = e.substeps * (1 + e.centred)
        return self.sample_time / number, number, e.substeps * e.centred

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """w of z."""
        v = (self.of_z[:, 0] + self.of_z[:, 1] * z).unbind(-1)
        p = [each.expand(z.shape[:-1]) for each in (self.p * self.p_scale).unbind(-1)]
        w = self._stepped(v, p, lambda formula, values: formula(*values))
        return (torch.stack(w, -1) - self.of_w[:, 0]) / self.of_w[:, 1]

    def of_symbols(self, z: Sequence[Symbol]) -> list[Any]:
        """w of z for a table of operations, with the parameters as numbers."""
        ends = (self.of_z, self.of_w)
        of_z, of_w = (each.detach().double().cpu().tolist() for each in ends)
        v = [offset + scale * each for each, (offset, scale) in zip(z, of_z, strict=True)]
        p = [z[0].constant(value) for value in self.physical.values()]
        w = self._stepped(v, p, lambda formula, values: formula.of_symbols(values))
        return [(each - offset) / scale for each, (offset, scale) in zip(w, of_w, strict=True)]

    def _stepped(
        self, v: Sequence[Any], p: Sequence[Any], of: Callable[[Formula, Sequence[Any]], list[Any]]
    ) -> list[Any]:
        """[x+; y] of v = [x; u] and p in physical units; ``of`` evaluates a formula."""
        x, u = [*v[: self.nx]], [*v[self.nx :]]
        f, h, (step, number, before) = self.equations.f, self.equations.h, self.steps
        if self.equations.method == "discrete":
            return [*of(f, [*x, *u, *p]), *of(h, [*x, *u, *p])]

        def rates(*terms: tuple[float, list[Any]]) -> list[Any]:
            return of(f, [*moved(*terms), *u, *p])

        def moved(*terms: tuple[float, list[Any]]) -> list[Any]:
            found = x
            for part, k in terms:
                found = [a + part * b for a, b in zip(found, k, strict=True)]
            return found

        y: list[Any] = []
        for n in range(number):
            y = of(h, [*x, *u, *p]) if n == before else y
            k1 = rates()
            if self.equations.method == "euler":
                x = moved((step, k1))
                continue
            k2 = rates((0.5 * step, k1))
            k3 = rates((0.5 * step, k2))
            k4 = rates((step, k3))
            x = moved((step / 6.0, k1), (step / 3.0, k2), (step / 3.0, k3), (step / 6.0, k4))
        return [*x, *y]

    def kernel(self, *, slopes: bool = False) -> list[Any]:
        """The map as ``known_kernel`` takes it, between p and w; ``slopes``: with derivatives."""
        e = self.equations
        f, h = (machine_code(each, slopes=slopes) for each in (e.f, e.h))
        return [f, h, self.nx, METHODS[e.method], *self.steps]

    def arguments(self, p: Tensor | None = None) -> list[Any]:
        """Scaling and physical parameters as ``known_kernel`` takes them."""
        own = self.p if p is None else p
        return [to_float64(each) for each in (self.of_z, self.of_w, own * self.p_scale)]

    def linearised(self, z: Float[Tensor, "R T nz"], weights: Weights) -> StaticJacobian:
        """The map linearised at z, with the given weights."""
        if not has_kernels(z):
            return ModuleJacobian(self, z, weights)
        return KnownJacobian(self, z, weights["p"])

    def extra_repr(self) -> str:
        """States and parameters, for ``print(module)``."""
        values = ", ".join(f"{name}={value:.6g}" for name, value in self.physical.items())
        return f"{', '.join(self.equations.states)}; {values}"


class KnownJacobian:
    """A known model in machine code: derivatives of one step, exact through the integration."""

    # The code is that of float64, for float32 as well.

    def __init__(self, of: KnownMap, z: Float[Tensor, "R T nz"], p: Float[Tensor, " p"]) -> None:
        R, T = z.shape[:2]
        J, by_p = np.empty((R, T, of.nw, of.nz)), np.empty((R, T, of.nw, len(p)))
        scaling = [*of.arguments(p), to_float64(of.p_scale)]
        parts = min(R, workers())
        formulas = of.kernel(slopes=True)
        states = np.ascontiguousarray(to_float64(z))
        spread(known_slopes, parts, parts, states, *scaling, *formulas, J, by_p)
        self.J, self._by_p = (torch.from_numpy(each).to(z.dtype) for each in (J, by_p))

    def part(self, records: slice, time: slice) -> StaticJacobian:
        """The same for some of the records and samples."""
        part = copy.copy(self)
        part.J, part._by_p = self.J[records, time], self._by_p[records, time]
        return part

    def by_weight(self) -> Float[Tensor, "R T nw weights"]:
        """∂w/∂φ."""
        return self._by_p

    def tangent(self, d_weights: Float[Tensor, " weights"]) -> Float[Tensor, "R T nw"]:
        """(∂w/∂φ) dφ."""
        return (self._by_p @ d_weights[..., None, :, None]).squeeze(-1)

    def adjoint(self, d_w: Float[Tensor, "R T nw"]) -> Float[Tensor, "R weights"]:
        """Σ_k (∂w/∂φ)ᵀ d_w(k)."""
        return torch.einsum("rtqp,rtq->rp", self._by_p, d_w)
