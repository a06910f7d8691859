"""Known equations as a static map: w = [x(k+1); y(k)] of z = [x(k); u(k)], with parameters.

An LFR with fixed matrices makes this map a model; a learned map may stand beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Parameter

from lfrtorch._support.errors import InputError
from lfrtorch._support.threads import to_float64
from lfrtorch.maps.formula_code import machine_code
from lfrtorch.maps.known_code import DISCRETE, EULER, RK4, known_slope, known_value
from lfrtorch.maps.machine_code import SLOPE, Code, address
from lfrtorch.maps.operations import Formula
from lfrtorch.maps.static_map import StaticMap

METHODS = {"discrete": DISCRETE, "euler": EULER, "rk4": RK4}
"""Methods for one sample: f returns the next state, or rates that are integrated."""


class KnownEquations(NamedTuple):
    """Equations x(k+1) or dx/dt = f(x, u; p), y = h(x, u; p), in physical units.

    Args:
        f, h: functions of [x; u; p].
        states, parameters: names of x and p.
        units: units of the parameters.
        inputs: number of inputs u.
        method: one of ``METHODS``.
        substeps: steps of the integration in a sample, or in half a sample with ``centred``.
        centred: True if inputs are held from half a sample before to half a sample after their
            sample; x is then the state half a sample before.
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
        """The equations as plain values for JSON."""
        return {**self._asdict(), "f": self.f.described(), "h": self.h.described()}

    @classmethod
    def of(cls, description: Any) -> KnownEquations:
        """The equations of a description; an invalid description raises a ValueError."""
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


class KnownModel(StaticMap):
    """Map of known equations, for normalised signals and parameters.

    Args:
        equations: the equations in physical units.
        sample_time: sampling time in seconds.
        device, dtype: as in any torch module, for the weights.

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
        nx, count = len(equations.states), len(equations.parameters)
        nz, nw = nx + equations.inputs, nx + len(equations.h.results)
        super().__init__(nz, nw)
        self.nx, self.physics, self.sample_time = nx, equations, sample_time
        like: dict[str, Any] = {"device": device, "dtype": dtype}
        self.p = Parameter(torch.ones(count, **like))
        for name, size in (("of_z", nz), ("of_w", nw)):
            self.register_buffer(name, torch.tensor([0.0, 1.0], **like).repeat(size, 1))
        self.register_buffer("p_scale", torch.ones(count, **like))
        ends = torch.tensor([-torch.inf, torch.inf], **like)
        self.register_buffer("bounds", ends.repeat(count, 1))

    def weight_shapes(self, nz: int, nw: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights and buffers; nz and nw follow from the equations."""
        count = len(self.physics.parameters)
        scaling = {"of_z": (self.nz, 2), "of_w": (self.nw, 2), "bounds": (count, 2)}
        return {"p": (count,), "p_scale": (count,), **scaling}

    @property
    def known(self) -> KnownModel:
        """Known model: this map itself."""
        return self

    @property
    def learned(self) -> StaticMap:
        """Parts beside the known model: none."""
        return StaticMap()

    def describe(self) -> dict[str, Any]:
        """Describe the equations."""
        equations = self.physics.described()
        return {"type": "Known", "equations": equations, "sample_time": self.sample_time}

    @property
    def physical(self) -> dict[str, float]:
        """Parameters in their units, by name."""
        values = (self.p * self.p_scale).detach().double().cpu().tolist()
        return dict(zip(self.physics.parameters, values, strict=True))

    @property
    def outputs_have_parameters(self) -> bool:
        """True if y depends on parameters directly, not only through the states."""
        return max(self.physics.h.used, default=0) >= self.nz

    @property
    def steps(self) -> tuple[float, int, int]:
        """Length of an integration step in seconds, number of steps, steps before the output."""
        e = self.physics
        number = e.substeps * (1 + e.centred)
        return self.sample_time / number, number, e.substeps * e.centred

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """Output w of z."""
        v = (self.of_z[:, 0] + self.of_z[:, 1] * z).unbind(-1)
        p = [each.expand(z.shape[:-1]) for each in (self.p * self.p_scale).unbind(-1)]
        w = self._stepped(v, p, lambda formula, values: formula(*values))
        return (torch.stack(w, -1) - self.of_w[:, 0]) / self.of_w[:, 1]

    def equations(self, z: Sequence[Any], phi: Sequence[Any]) -> Sequence[Any]:
        """Output w from z and φ, which are sequences of numbers."""
        ends = (self.of_z, self.of_w)
        of_z, of_w = (each.detach().double().cpu().tolist() for each in ends)
        v = [offset + scale * each for each, (offset, scale) in zip(z, of_z, strict=True)]
        p_scale = self.p_scale.detach().double().cpu().tolist()
        p = [scale * each for each, scale in zip(phi, p_scale, strict=True)]
        w = self._stepped(v, p, lambda formula, values: formula.of_symbols(values))
        return [(each - offset) / scale for each, (offset, scale) in zip(w, of_w, strict=True)]

    def _stepped(
        self, v: Sequence[Any], p: Sequence[Any], of: Callable[[Formula, Sequence[Any]], list[Any]]
    ) -> list[Any]:
        """Compute [x+; y] of v = [x; u] and p in physical units; ``of`` evaluates a formula."""
        x, u = [*v[: self.nx]], [*v[self.nx :]]
        f, h, (step, number, before) = self.physics.f, self.physics.h, self.steps
        if self.physics.method == "discrete":
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
            if self.physics.method == "euler":
                x = moved((step, k1))
                continue
            k2 = rates((0.5 * step, k1))
            k3 = rates((0.5 * step, k2))
            k4 = rates((step, k3))
            x = moved((step / 6.0, k1), (step / 3.0, k2), (step / 3.0, k3), (step / 6.0, k4))
        return [*x, *y]

    @property
    def weight_bounds(self) -> Float[Tensor, "P 2"]:
        """Least and largest value of each parameter, normalised."""
        return self.bounds / self.p_scale.unsqueeze(-1)

    @property
    def code(self) -> Code:
        """Map in machine code, with exact derivatives through the integration."""
        e, (step, number, before) = self.physics, self.steps
        made = [
            machine_code(each, slopes=slopes) for slopes in (False, True) for each in (e.f, e.h)
        ]
        nx, nz, nw, count = self.nx, self.nz, self.nw, len(e.parameters)
        addresses = [each.address for each in made]
        sizes = nx, nz, nw, count, METHODS[e.method], number, before
        scaling = (self.of_z.flatten(), self.of_w.flatten(), self.p_scale)
        constants = np.concatenate([[step], *(to_float64(each) for each in scaling)])
        q = nz + count
        room = q + 2 * nx + nw * (1 + q) + (nw - nx) * q + 4 * nx * q
        ints = np.array([*addresses, *sizes])
        code = address(known_value), address(known_slope, SLOPE)
        return Code(0, *code, ints, constants, max(room, q + 3 * nx + nw), made)

    @property
    def meaning(self) -> str:
        """Meaning of f(z) in words."""
        return "a step of the known model"

    def extra_repr(self) -> str:
        """States and parameters, for ``print(module)``."""
        values = ", ".join(f"{name}={value:.6g}" for name, value in self.physical.items())
        return f"{', '.join(self.physics.states)}; {values}"
