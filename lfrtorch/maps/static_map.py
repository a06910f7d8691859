"""Static map of a model, w = f(z; φ), as the rest of the package uses it.

A new map is a class that defines ``equations``, from which value, slopes, machine code and exports
follow. ``Network`` and others override these with faster code. ``StaticMap()``, with nz = 0, stands
for no map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba.np.numpy_support import carray
from torch import Tensor
from torch.func import functional_call, jacrev, vmap
from torch.nn import Module

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.maps.formula_code import machine_code
from lfrtorch.maps.machine_code import NOTHING, SLOPE, Code, address, call_formula
from lfrtorch.maps.mean_slopes import Quadrature
from lfrtorch.maps.operations import Formula, Symbol
from lfrtorch.maps.written import Written

if TYPE_CHECKING:
    from lfrtorch.maps.enclosure import Enclosure, Interval
    from lfrtorch.maps.mean_slopes import Neurons


class Symmetry(NamedTuple):
    """Change of coordinates of some entries of z or w that the weights of a map absorb.

    Args:
        signal: ``z``, changed as z -> (I + εT) z, or ``w``, changed as w -> (I + εT)⁻¹ w.
        place: positions of the changed entries in z or w.
        changes: function of T (n, size, size) and the weights by name that returns the changes of
            the weights per ε, (n, *shape).
    """

    signal: Literal["z", "w"]
    place: slice
    changes: Callable[[Tensor, dict[str, Tensor]], dict[str, Tensor]]


class StaticMap(Module):
    """Static map with ``nz`` inputs and ``nw`` outputs; φ are its parameters in their order.

    A subclass defines ``equations``, and its parameters in ``__init__``.

    Args:
        nz, nw: sizes.

    Example:
        >>> class Drag(lfrtorch.StaticMap):
        ...     def __init__(self):
        ...         super().__init__(nz=1, nw=1)
        ...         self.a = torch.nn.Parameter(torch.ones(1))
        ...
        ...     def equations(self, z, phi):
        ...         return [phi[0] * z[0] * abs(z[0])]
        >>> Drag()(torch.tensor([[-2.0]])).tolist()
        [[-4.0]]
    """

    def __init__(self, nz: int = 0, nw: int = 0) -> None:
        super().__init__()
        self.nz, self.nw = nz, nw

    def equations(self, z: Sequence[Any], phi: Sequence[Any]) -> Sequence[Any]:
        """Output w from z and φ, sequences of numbers, by operators and torch's functions."""
        raise NotImplementedError(f"{type(self).__name__} has no equations.")

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """Output w of z."""
        if not self.nw:
            return z[..., :0]
        phi = [p.expand(z.shape[:-1]) for p in self.flat_weights().unbind()]
        found = self.equations(z.unbind(-1), phi)
        return torch.stack([torch.as_tensor(w).to(z).expand(z.shape[:-1]) for w in found], dim=-1)

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes beside nz and nw, by name."""
        return {"nn": 0}

    @property
    def maps(self) -> list[StaticMap]:
        """Maps of a direct sum, in the order of z and w; otherwise this map alone."""
        return [self]

    @property
    def known(self) -> Any:
        """Known equations, a ``KnownModel`` with the first z and w; None if there are none."""
        return None

    @property
    def learned(self) -> StaticMap:
        """Map beside the known model."""
        return self

    @property
    def title(self) -> str:
        """Name of the map in messages."""
        return type(self).__name__

    def describe(self) -> dict[str, Any] | None:
        """Describe the map for a checkpoint, without weights; see ``maps.descriptions``."""
        return _own(self) if self.nw else None

    def beside(self, others: Sequence[StaticMap]) -> StaticMap | None:
        """One map for this map and others, simpler than a ``DirectSum``; None if there is none."""
        return None

    def zero_output(self) -> None:
        """Set w to 0 by weights that a fit can improve. A map may ignore this call."""

    def redundant(self, fed: int, ny: int | None = None) -> int:
        """Number of directions of all weights that change no output, without those of x.

        Args:
            fed: number of signals (inputs and states) that enter z.
            ny: number of outputs, if the model has an affine map beside this one; otherwise None.
        """
        return sum((each.place.stop - each.place.start) ** 2 for each in self.symmetries)

    @property
    def code(self) -> Code | None:
        """The map in machine code; None if torch computes it."""
        return _formula_code(self) if self.nw else NOTHING

    @property
    def symmetries(self) -> list[Symmetry]:
        """Changes of coordinates that the weights absorb."""
        return []

    def across_branches(self) -> dict[str, Bool[Tensor, ...]]:
        """Entries of the weights that are zero where each w is a function of one z.

        Raises:
            ValueError: a map that no zeros turn into such functions.
        """
        raise InputError(
            "structure is 'parallel', but each w of the map depends on all z; give a network, or "
            "DirectSum(branches, [(1, 1)] * nz) of lfrtorch.maps.direct_sum."
        )

    @property
    def outputs_have_parameters(self) -> bool:
        """True if the map has an output equation with parameters of its own."""
        return False

    @property
    def weight_bounds(self) -> Float[Tensor, "P 2"]:
        """Least and largest value of each weight."""
        weights = self.flat_weights()
        return weights.new_tensor([-torch.inf, torch.inf]).repeat(len(weights), 1)

    def flat_weights(self) -> Float[Tensor, " P"]:
        """Weights φ in one vector."""
        own = [p.flatten() for p in self.parameters()]
        return torch.cat(own) if own else torch.zeros(0)

    def of_weights(self, z: Float[Tensor, "*axes nz"], phi: Float[Tensor, " P"]) -> Tensor:
        """Output w of z with the weights φ in place of the map's own."""
        return functional_call(self, self.named_weights(phi), (z,))

    def named_weights(self, phi: Float[Tensor, " P"]) -> dict[str, Tensor]:
        """Weights φ by the names of the parameters."""
        named = [(name, p.shape, p.numel()) for name, p in self.named_parameters()]
        parts = phi.split([count for _, _, count in named])
        return {n: p.view(shape) for (n, shape, _), p in zip(named, parts, strict=True)}

    def slope(
        self, z: Float[Tensor, "R T nz"], phi: Float[Tensor, " P"]
    ) -> Float[Tensor, "R T nw nz"]:
        """Slope ∂w/∂z at every sample, in torch."""
        if not self.nw:
            return z.new_zeros(*z.shape[:-1], 0, 0)
        of_z = jacrev(lambda z: self.of_weights(z, phi))
        return vmap(vmap(of_z))(z)

    def by_weight(
        self, z: Float[Tensor, "R T nz"], phi: Float[Tensor, " P"]
    ) -> Float[Tensor, "R T nw P"]:
        """Derivatives ∂w/∂φ at every sample, in torch."""
        if not len(phi):
            return z.new_zeros(*z.shape[:-1], self.nw, 0)
        of_phi = jacrev(lambda phi, z: self.of_weights(z, phi))
        return vmap(vmap(of_phi, in_dims=(None, 0)), in_dims=(None, 0))(phi, z)

    def enclosure(
        self, z: Interval, a: Interval | None = None, K: Float[Array, "nw nz"] | None = None
    ) -> Enclosure | None:
        """Bounds of w and its slopes over a box z (nz,); None if none are known.

        The interval ``a`` is a further bound of the neurons' ``right`` z. If ``K`` is given,
        w - K z is bounded instead of w.
        """
        return None

    def slopes_in(
        self, v: Interval, into: Float[Array, "nz nz"], middle: Float[Array, " nz"]
    ) -> Interval | None:
        """Bounds of ∂w/∂v (C, nw, nz) over cells of v (C, nz), z = into v + middle."""
        return None

    @property
    def quadrature(self) -> Quadrature:
        """Quadrature rule for means of ∂w/∂z between two z."""
        return Quadrature.gauss_legendre(32)

    @property
    def neurons(self) -> Neurons | None:
        """Scalar functions that the map is composed of, with exact mean slopes."""
        return None

    @property
    def meaning(self) -> str:
        """Equation of f(z), for the readers of an export."""
        return f"{type(self).__name__}(z)"

    @property
    def written(self) -> Written | None:
        """Form of the map for exports; None if only torch can compute it."""
        formula = self.formula
        if formula is None:
            return None
        return Written("formula", {}, lambda language, z: language.table(formula, z), formula)

    @property
    def formula(self) -> Formula | None:
        """Formula z -> w with the weights as numbers; None if no equations are known."""
        if not self.nw:
            return Formula(0, (), ())
        phi = self.flat_weights().detach().double().cpu().tolist()

        def of(*z: Symbol) -> Sequence[Any]:
            return self.equations(z, [z[0].constant(p) for p in phi])

        try:
            return Formula.traced(of, self.nz)
        except NotImplementedError:  # the map, or a part of it, has no equations
            return None


class OwnModule(StaticMap):
    """Map of a user's module, which torch computes."""

    def __init__(self, module: Module, nz: int, nw: int) -> None:
        super().__init__(nz, nw)
        self.module = module

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """Output w of z."""
        return self.module(z)

    @property
    def title(self) -> str:
        """The class of the module."""
        return type(self.module).__name__

    def describe(self) -> dict[str, Any] | None:
        """The class of the module."""
        return _own(self.module)

    def __repr__(self) -> str:
        return repr(self.module)

    @property
    def code(self) -> Code | None:
        """None, as there is no machine code."""
        return None

    @property
    def meaning(self) -> str:
        """Name the user's class."""
        return f"{type(self.module).__name__}(z)"


def as_map(static: Module | None, nz: int, nw: int) -> StaticMap:
    """Return a module as a static map: itself, or an ``OwnModule``."""
    if static is None:
        return StaticMap()
    if isinstance(static, StaticMap) and not _is_changed(type(static)):
        return static
    return OwnModule(static, nz, nw)


def _own(module: Module) -> dict[str, Any]:
    return {"type": "own", "class": type(module).__qualname__}


def _is_changed(kind: type) -> bool:
    """Tell if a class overrides the forward pass of its equations or code."""
    order = [each.__dict__ for each in kind.__mro__]

    def defined(name: str) -> int:
        return next(i for i, each in enumerate(order) if name in each)

    return defined("forward") < min(defined("code"), defined("equations"))


def combined(weights: Sequence[Any], signals: Sequence[Any], constant: Any) -> Any:
    """A sum of weighted signals and a constant."""
    total = constant
    for weight, signal in zip(weights, signals, strict=True):
        total = total + weight * signal
    return total


def _formula_code(static: StaticMap) -> Code:
    """The code of a map that has equations."""
    nz, nw, count = static.nz, static.nw, len(static.flat_weights())
    formula = Formula.traced(lambda *v: static.equations(v[:nz], v[nz:]), nz + count)
    value, slope = machine_code(formula), machine_code(formula, slopes=True)
    ints = np.array([value.address, slope.address, nz, nw, count])
    room = (nz + count) * (1 + nw) + nw
    code = address(_formula_value), address(_formula_slope, SLOPE)
    return Code(0, *code, ints, np.zeros(0), room, (value, slope))


def _formula_value(ints, constants, weights, z, w, room):
    v = carray(room, (ints[2] + ints[4],))
    for i in range(ints[2]):
        v[i] = z[i]
    for i in range(ints[4]):
        v[ints[2] + i] = weights[i]
    call_formula(ints[0], v, carray(w, (ints[3],)))


def _formula_slope(ints, constants, weights, z, J, by_weight, stride, room):
    nz, nw, P = ints[2], ints[3], ints[4]
    inside = carray(room, ((nz + P) * (1 + nw) + nw,))
    v, out = inside[: nz + P], inside[nz + P :]
    for i in range(nz):
        v[i] = z[i]
    for i in range(P):
        v[nz + i] = weights[i]
    call_formula(ints[1], v, out)
    for q in range(nw):
        row = nw + q * (nz + P)
        for j in range(nz):
            J[q * nz + j] = out[row + j]
        for j in range(P if stride else 0):
            by_weight[q * stride + j] = out[row + nz + j]
