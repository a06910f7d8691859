"""Cell of the NL-LFR model: one step of an LTI block in feedback with a static nonlinearity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array
from lfrtorch.engine.weights import Held, Layout, Weights
from lfrtorch.maps.static_map import StaticMap, as_map


def check_dtype(dtype: torch.dtype) -> None:
    """Refuse any dtype but float32 and float64 with a ValueError."""
    if dtype not in (torch.float32, torch.float64):
        raise InputError(f"dtype is {dtype!r}; give torch.float64 or torch.float32.")


_DECAY = 0.9
"""Magnitude of all eigenvalues of a random A."""

_SAME = 1e-6
"""Relative difference below which two values of an entry are equal, also in single precision."""


class Matrices(NamedTuple):
    """The linear block of a cell as arrays of float64."""

    A: Array
    Bu: Array
    Bw: Array
    Cz: Array
    Dzu: Array
    Cy: Array
    Dyu: Array
    Dyw: Array


class LFRCell(nn.Module):
    """Time step (u, x) -> (y, x+) of the NL-LFR state-space model::

        x+ = A  x + Bu  u + Bw  w
        z  = Cz x + Dzu u              (no Dzw: no algebraic loop)
        w  = static(z)
        y  = Cy x + Dyu u + Dyw w

    The matrices start at random, see ``reset_parameters``; ``lfrtorch.initialise`` writes the best
    linear approximation, from which a fit takes far fewer iterations.

    Args:
        nu, ny, nx, nz, nw: sizes; ``nz = nw = 0`` without ``static`` is a linear model.
        static: the map z -> w: any module from (..., nz) to (..., nw).
        random: False leaves all matrices at zero, for a caller that fills them.
        device, dtype: as in any torch module, for the matrices.

    Shape:
        A: (nx, nx), Bu: (nx, nu), Bw: (nx, nw), Cz: (nz, nx), Dzu: (nz, nu), Cy: (ny, nx),
        Dyu: (ny, nu), Dyw: (ny, nw).

    References:
        Schoukens and Tóth, "On the Initialization of Nonlinear LFR Model Identification with the
        Best Linear Approximation", IFAC-PapersOnLine 53(2), 2020, equations (1) and (2).

    Example:
        >>> cell = lfrtorch.LFRCell(nu=1, ny=1, nx=2, nz=1, nw=1, static=lfrtorch.Network(1, 1, 5))
        >>> y, x = cell(torch.ones(1), torch.zeros(2))
        >>> y.shape, x.shape
        (torch.Size([1]), torch.Size([2]))
    """

    def __init__(
        self,
        nu: int,
        ny: int,
        nx: int,
        nz: int = 0,
        nw: int = 0,
        static: nn.Module | None = None,
        *,
        random: bool = True,
        device: torch.device | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        for name, size in (("nu", nu), ("ny", ny), ("nx", nx)):
            integer(name, size, 1)
        for name, size in (("nz", nz), ("nw", nw)):
            integer(name, size, 0)
        if (static is None) != (nw == 0) or (nz == 0) != (nw == 0):
            raise InputError(
                f"nz={nz}, nw={nw} with static={static}: a static nonlinearity needs nz >= 1 and "
                "nw >= 1, and a linear model has neither."
            )
        self.nu, self.ny, self.nx, self.nz, self.nw = nu, ny, nx, nz, nw

        def matrix(rows: int, columns: int) -> nn.Parameter:
            return nn.Parameter(torch.zeros(rows, columns, device=device, dtype=dtype))

        self.A, self.Bu, self.Bw = matrix(nx, nx), matrix(nx, nu), matrix(nx, nw)
        self.Cz, self.Dzu = matrix(nz, nx), matrix(nz, nu)
        self.Cy, self.Dyu, self.Dyw = matrix(ny, nx), matrix(ny, nu), matrix(ny, nw)
        self.static = static
        self.state_covariance: Tensor
        """E x xᵀ (nx, nx) over the training data, about 0; the identity before a fit."""
        # On the device "meta" torch.eye would import torch's compiler, which takes a second.
        identity = torch.zeros(nx, nx, device=device, dtype=dtype).fill_diagonal_(1.0)
        self.register_buffer("state_covariance", identity)
        self.held: dict[str, Tensor] = {}
        """Masks of the entries that a fit holds, by the names of the parameters; see ``hold``."""
        self.of_system: Held | None = None
        """For a predictor, held entries of A, Bu and Bw of its system; otherwise None."""
        self._check_shapes()
        if not isinstance(random, bool):
            raise InputError(f"random is {random!r}; give True or False.")
        if random and not self.A.is_meta:
            self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw random matrices of a stable model by torch's generator; the map does not change.

        A is 0.9 times a random orthogonal matrix. White inputs of unit variance give states, z and
        outputs of about unit variance. Bw is 0, so the model is stable whatever the map is. Dyw is
        not 0, so the weights of the map have a gradient from the beginning.
        """
        for p in self.parameters(recurse=False):
            p.zero_()
        torch.nn.init.orthogonal_(self.A, gain=_DECAY)
        for p, variance in (
            (self.Bu, (1.0 - _DECAY**2) / self.nu),
            (self.Cz, 1.0 / self.nx),
            (self.Cy, 1.0 / self.nx),
            (self.Dyw, 1.0 / max(1, self.nw)),
        ):
            p.normal_(std=math.sqrt(variance))

    @torch.no_grad()
    def hold(self, given: Held) -> None:
        """Hold entries at given values: every fit keeps them.

        Args:
            given: masks and values by the names of the parameters, as ``engine.held`` makes them.

        Raises:
            ValueError: an entry is already held at another value.
        """
        for name, (entries, values) in given.items():
            p = self.get_parameter(name)
            mask = entries.expand(p.shape).clone().cpu()
            wanted, own = values.to(p).expand(p.shape), p.detach()
            before = self.held.get(name, torch.zeros_like(mask))
            apart = before & mask & ((own - wanted).abs() > _SAME * own.abs()).cpu()
            if apart.any():
                at = tuple(apart.nonzero()[0].tolist())
                raise InputError(
                    f"{name}{list(at)} is held at {float(own[at]):.6g} by one setting and at "
                    f"{float(wanted[at]):.6g} by another (normalised); leave out one of them."
                )
            p[mask] = wanted[mask]
            if mask.any():
                self.held[name] = before | mask

    def forward(
        self, u: Float[Tensor, "*axes nu"], x: Float[Tensor, "*axes nx"]
    ) -> tuple[Float[Tensor, "*axes ny"], Float[Tensor, "*axes nx"]]:
        """Output and next state.

        Raises:
            ValueError: signals of other sizes, dtype or device than the weights.
        """
        if self.autocast:
            with torch.autocast(self.A.device.type, enabled=False):
                return self(*self.uncast(u, x))
        axes = u.shape[:-1] if isinstance(u, Tensor) else ()
        self._check("u", u, (*axes, self.nu))
        self._check("x", x, (*axes, self.nx))
        w = self.internal(u, x)[1]
        y = x @ self.Cy.mT + u @ self.Dyu.mT + w @ self.Dyw.mT
        return y, x @ self.A.mT + u @ self.Bu.mT + w @ self.Bw.mT

    @property
    def autocast(self) -> bool:
        """Tell whether ``torch.autocast`` is on; the layer computes in its weights' dtype."""
        device = self.A.device.type
        return device != "meta" and torch.is_autocast_enabled(device)

    def uncast(self, *signals: Any) -> list[Any]:
        """Signals, cast to the dtype of the weights if they have that of ``torch.autocast``."""
        chosen = torch.get_autocast_dtype(self.A.device.type)
        own = [isinstance(each, Tensor) and each.dtype == chosen for each in signals]
        pairs = zip(signals, own, strict=True)
        return [each.to(self.A.dtype) if cast else each for each, cast in pairs]

    def internal(
        self, u: Float[Tensor, "*axes nu"], x: Float[Tensor, "*axes nx"]
    ) -> tuple[Float[Tensor, "*axes nz"], Float[Tensor, "*axes nw"]]:
        """Input z and output w of the static nonlinearity."""
        z = x @ self.Cz.mT + u @ self.Dzu.mT
        return z, (z if self.static is None else self.static(z))

    @property
    def map(self) -> StaticMap:
        """The static map as a ``StaticMap``."""
        return as_map(self.static, self.nz, self.nw)

    def weights(self, given: Sequence[Tensor] | None = None) -> Weights:
        """Vector of all numbers of the cell: its present parameters, or the given ones."""
        named = list(self.named_parameters())
        parameters = [(name, p.numel(), p.requires_grad) for name, p in named]
        sizes = self.nx, self.nu, self.ny, self.nz, self.nw
        layout = Layout(sizes, self.map, parameters, self.state_covariance)
        numbers = [p for _, p in named] if given is None else given
        return Weights(layout, torch.cat([p.detach().flatten() for p in numbers]))

    def matrices(self) -> Matrices:
        """The linear block as arrays."""
        return Matrices(*(to_float64(self.get_parameter(name)) for name in Matrices._fields))

    def check(self) -> None:
        """Refuse weights of inconsistent shapes, which machine code would not notice.

        A map whose class has no ``weight_shapes`` is checked by torch alone.

        Raises:
            ValueError: a weight of another shape, dtype or device.
        """
        check_dtype(self.A.dtype)
        for name, weight in self._check_shapes().items():
            self._check_kind(name, weight)

    def _check_shapes(self) -> dict[str, Tensor]:
        """The weights whose shapes are known, by name."""
        nu, ny, nx, nz, nw = self.nu, self.ny, self.nx, self.nz, self.nw
        shapes = {"A": (nx, nx), "Bu": (nx, nu), "Bw": (nx, nw), "Cz": (nz, nx), "Dzu": (nz, nu)}
        shapes |= {"Cy": (ny, nx), "Dyu": (ny, nu), "Dyw": (ny, nw)}
        of_static = getattr(self.static, "weight_shapes", None)
        if of_static is not None:
            shapes |= {f"static.{name}": shape for name, shape in of_static(nz, nw).items()}
        weights = {**dict(self.named_parameters()), **dict(self.named_buffers())}
        for name, shape in shapes.items():
            if name not in weights:
                raise InputError(
                    f"{name} is not a parameter any more, as after a parametrisation or a pruning; "
                    "the equations need it.\nOnly the layers of a static map of torch's modules "
                    "may be changed so: static=torch.nn.Sequential(...)."
                )
            found = tuple(weights[name].shape)
            if found != shape:
                raise InputError(
                    f"{name} has the shape {found}; with nu={nu}, ny={ny}, nx={nx}, nz={nz} and "
                    f"nw={nw} it must be {shape}: give a matrix or a static map of these sizes."
                )
        return {name: weights[name] for name in shapes}

    def check_signals(
        self, u: Tensor, x0: Tensor | None = None, guess: Tensor | None = None
    ) -> None:
        """Refuse signals (R, T, nu), (R, nx) and (R, any, nx) that are not the model's.

        Raises:
            ValueError: other shapes, no record or sample, or another dtype or device.
        """
        R, T = u.shape[:2] if isinstance(u, Tensor) and u.ndim == 3 else ("R", "T")
        self._check("u", u, (R, T, self.nu), "records, samples and inputs")
        if not u.numel():
            raise InputError(
                f"u has the shape {tuple(u.shape)}; give at least one record of one sample."
            )
        if x0 is not None:
            self._check("x0", x0, (R, self.nx), "records and states")
        if guess is not None:
            samples = guess.shape[1] if isinstance(guess, Tensor) and guess.ndim == 3 else "T"
            self._check("guess", guess, (R, samples or "T", self.nx), "records, samples, states")

    def _check(
        self, name: str, signal: Tensor, shape: tuple[int | str, ...], axes: str = ""
    ) -> None:
        if not isinstance(signal, Tensor):
            raise InputError(f"{name} is of type {type(signal).__name__}; give a torch tensor.")
        if signal.shape != shape:
            raise InputError(
                f"{name} has the shape {tuple(signal.shape)}; give ({', '.join(map(str, shape))})"
                f"{f': {axes}' if axes else ''}."
            )
        self._check_kind(name, signal)

    def _check_kind(self, name: str, tensor: Tensor) -> None:
        """Refuse a tensor of another dtype or device than A."""
        if tensor.dtype != self.A.dtype or tensor.device != self.A.device:
            raise InputError(
                f"{name} is {tensor.dtype} on {tensor.device}, but the model is {self.A.dtype} on "
                f"{self.A.device}; convert {name} or the model, so that both are alike."
            )

    def extra_repr(self) -> str:
        """Sizes, for ``print(module)``."""
        return f"nu={self.nu}, ny={self.ny}, nx={self.nx}, nz={self.nz}, nw={self.nw}"
