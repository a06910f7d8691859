"""The exact LPV form: the model as one that is linear in x and u, with varying parameters.

Let ζ = z - z0. The static map is f(z) = f(z0) + Δ(ζ) ζ with Δ = ∫ f'(z0 + t ζ) dt, t from 0 to 1. A
network has Δ = Ww diag(s) Wz, where s = (σ(v0 + d) - σ(v0)) / d are the mean slopes of its neurons
between v0 and v0 + d, d = Wz ζ. A mean slope lies between the smallest and the largest slope, so
the parameters of the form are bounded.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.analysis.linearisation import about
from lfrtorch.data.records import Record, as_records
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.linearised import static_slope
from lfrtorch.engine.operating_point import equilibrium
from lfrtorch.maps.mean_slopes import Neurons
from lfrtorch.model.model import Model

_ROUNDING = 1e-14
"""Errors of f(z) - f(z0) below this part of both are rounding errors."""

Slopes = Callable[[Float[Array, "S nz"]], Float[Array, "S P"]]


@dataclass(frozen=True, eq=False)
class LPV:
    """A model in LPV form, physical units::

        x+ = x_next0 + A(p) (x - x0) + B(p) (u - u0)
        y  = y0      + C(p) (x - x0) + D(p) (u - u0)

    A(p) = A[0] + p_1 A[1] + p_2 A[2] + .., and likewise B, C and D. For p = scheduling(x, u) the
    form is the model itself, not an approximation. At rest x_next0 = x0.

    Args:
        A, B, C, D: matrices; the first axis counts the parameters from 1.
        bounds: smallest and largest value of each p for all x and u; infinite if not known.
        schedule: kind of p: ``"neurons"`` or ``"map"``.
        x0, u0, x_next0, y0: the point from which deviations count, with the next state and the
            output at that point.
        Cz, Dzu: z - z0 = Cz (x - x0) + Dzu (u - u0).
        slopes: function from z - z0 to p.
        model: the model in LPV form.

    Example:
        >>> form = lfrtorch.analysis.lpv(model)
        >>> form.A.shape, form.bounds.tolist()[0]
        ((5, 1, 1), [0.0, 1.0])
    """

    A: Float[Array, "Q nx nx"]
    B: Float[Array, "Q nx nu"]
    C: Float[Array, "Q ny nx"]
    D: Float[Array, "Q ny nu"]
    bounds: Float[Array, "P 2"]
    schedule: str
    x0: Float[Array, " nx"]
    u0: Float[Array, " nu"]
    x_next0: Float[Array, " nx"]
    y0: Float[Array, " ny"]
    Cz: Float[Array, "nz nx"]
    Dzu: Float[Array, "nz nu"]
    slopes: Slopes
    model: Model

    def scheduling(
        self, x: Float[Array, "*axes nx"], u: Float[Array, "*axes nu"]
    ) -> Float[Array, "*axes P"]:
        """Compute p for states and inputs."""
        zeta = (x - self.x0) @ self.Cz.T + (u - self.u0) @ self.Dzu.T
        points = zeta.reshape(int(np.prod(zeta.shape[:-1])), len(self.Cz))
        return self.slopes(points).reshape(*zeta.shape[:-1], len(self.bounds))

    def seen(self, records: Record | Sequence[Record]) -> Float[Array, "V P"]:
        """Corners of a box that holds all p of the model's simulations of records.

        The box lies along the axes of p or along the principal axes of their cloud, whichever box
        is smaller. The matrices at its corners, ``form.at(p)``, are the vertices of a polytope for
        controllers and proofs in the region of the data. Directions in which p does not move have
        no corners.

        Example:
            >>> form = lfrtorch.analysis.lpv(model, schedule="map")
            >>> corners = form.seen(record)
            >>> p = form.scheduling(model.signals(record).x[0, :-1].numpy(), record.u)
            >>> corners.shape, bool((p >= corners.min(axis=0) - 1e-9).all())
            ((2, 1), True)
        """
        p = np.concatenate([
            self.scheduling(self.model.signals(one).x[0, :-1].double().numpy(), one.u)
            for one in as_records(records)
        ])  # fmt: skip
        middle = p.mean(axis=0)
        principal = np.linalg.svd(p - middle, full_matrices=False)[2]
        boxes = []
        for axes in (np.eye(p.shape[1]), principal):
            along = (p - middle) @ axes.T
            ends = np.stack([along.min(axis=0), along.max(axis=0)])
            width = ends[1] - ends[0]
            moves = width > 1e-9 * width.max(initial=0.0)
            corners = np.array(list(itertools.product(*ends[:, moves].T)))
            boxes.append((moves.sum(), np.log(width[moves]).sum(), middle + corners @ axes[moves]))
        return min(boxes, key=lambda box: box[:2])[2]

    def at(self, p: Float[Array, " P"]) -> tuple[Array, Array, Array, Array]:
        """A(p), B(p), C(p) and D(p)."""
        A, B, C, D = (M[0] + np.tensordot(p, M[1:], 1) for M in (self.A, self.B, self.C, self.D))
        return A, B, C, D

    def step(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"]
    ) -> tuple[Float[Array, " nx"], Float[Array, " ny"]]:
        """Next state and output."""
        A, B, C, D = self.at(self.scheduling(x, u))
        dx, du = x - self.x0, u - self.u0
        return self.x_next0 + A @ dx + B @ du, self.y0 + C @ dx + D @ du

    def simulate(self, u: ArrayLike, x0: Float[Array, " nx"] | None = None) -> Float[Array, "T ny"]:
        """Simulate the output for an input.

        Args:
            u: the input, physical units.
            x0: initial state in the model's coordinates. Default: 0, as ``model.simulate``.

        Shape:
            u: (T, nu), or (T,) for one input.

        Raises:
            ValueError: an input of another shape.

        Example:
            >>> form = lfrtorch.analysis.lpv(model)
            >>> np.allclose(form.simulate(record.u), model.simulate(record.u))
            True
        """
        signal = reals("u", u)
        signal = signal[:, None] if signal.ndim == 1 else signal
        if signal.ndim != 2 or signal.shape[1] != len(self.u0):
            raise InputError(
                f"the input has the shape {np.shape(u)}; give (samples, {len(self.u0)})."
            )
        x = np.zeros_like(self.x0) if x0 is None else x0
        y = np.empty((len(signal), len(self.y0)))
        for k, u_k in enumerate(signal):
            x, y[k] = self.step(x, u_k)
        return y


@typed()
def lpv(
    model: Model,
    u: ArrayLike | None = None,
    *,
    x: ArrayLike | None = None,
    schedule: str | None = None,
) -> LPV:
    """The exact LPV form of a model about an operating point, in physical units.

    Args:
        model: nonlinear or linear (then there is no p).
        u: constant input u0. Default: the inputs' offsets in the data.
        x: state x0 in the model's coordinates. Default: the state at rest under u0, so that the
            form has no constant terms; 0 if there is none.
        schedule: kind of p. ``"neurons"``: the mean slope of each neuron of a network.
            ``"map"``: the entries of Δ by rows (w1 z1, w1 z2, .., w2 z1, ..), for any static map;
            better for a network that has fewer such entries than neurons. Default: ``"neurons"``
            for a network, ``"map"`` for other maps.

    A map other than a network or a polynomial is integrated by a Gauss-Legendre rule with 32 nodes.
    The rule's error is added to Δ along ζ, so that f(z0) + Δ ζ is exact.

    Shape:
        u: (nu,) or a number for one input, x: (nx,).

    Raises:
        ValueError: an unknown schedule, the neurons of another map, or wrong shapes.

    References:
        Tóth, "Modeling and Identification of Linear Parameter-Varying Systems", Springer, 2010.

    Example:
        >>> form = lfrtorch.analysis.lpv(model, schedule="map")
        >>> form.A.shape, bool(np.isfinite(form.bounds).all())
        ((2, 1, 1), True)
    """
    model = model.with_delay_line()
    (cell, u0, v0, x0), s = about(model, u, x), model.scaler
    neurons = cell.map.neurons
    if schedule not in (None, "neurons", "map"):
        raise InputError(f"schedule is {schedule!r}; give 'neurons' or 'map'.")
    if schedule == "neurons" and neurons is None:
        raise InputError(
            "schedule is 'neurons', but the static map is not a network; give schedule='map'."
        )
    schedule = schedule or ("map" if neurons is None else "neurons")
    if x0 is None and (x0 := equilibrium(cell, v0)) is None:
        x0 = v0.new_zeros(cell.nx)
    with torch.no_grad():
        y0, x_next0 = (each.numpy() for each in cell(v0, x0))
        z0 = cell.internal(v0, x0)[0].numpy()
    left, right, bounds, slopes = _slopes(cell, z0, neurons if schedule == "neurons" else None)
    A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw = cell.matrices()

    def affine(M: Array, into: Array, of: Array) -> Array:
        """M, and what each p multiplies: a column of ``left`` times a row of ``right``."""
        return np.concatenate([M[None], np.einsum("ip,pj->pij", into @ left, right @ of)])

    scale = s.y_scale[:, None]
    Dzu = Dzu / s.u_scale
    return LPV(
        affine(A, Bw, Cz),
        affine(Bu / s.u_scale, Bw, Dzu),
        affine(scale * Cy, scale * Dyw, Cz),
        affine(scale * Dyu / s.u_scale, scale * Dyw, Dzu),
        bounds, schedule, x0.numpy(), np.array(u0), x_next0, s.restore_y(y0), Cz, Dzu, slopes,
        model,
    )  # fmt: skip


def _slopes(
    cell: LFRCell, z0: Float[Array, " nz"], neurons: Neurons | None
) -> tuple[Array, Array, Float[Array, "P 2"], Slopes]:
    """L (nw, P), R (P, nz), bounds and p(ζ) of Δ = L diag(p) R; without neurons p is Δ by rows."""
    if neurons is not None:
        return *neurons[:3], lambda zeta: neurons.mean_slopes(z0, zeta)
    nw, nz, found = cell.nw, cell.nz, cell.map.neurons
    left, right = np.repeat(np.eye(nw), nz, axis=1), np.tile(np.eye(nz), (nw, 1))
    bounds = np.array([-np.inf, np.inf]) if found is None else found.delta_bounds
    bounds = np.broadcast_to(bounds, (nw, nz, 2)).reshape(nw * nz, 2)
    return left, right, bounds, lambda zeta: _delta(cell, z0, zeta).reshape(len(zeta), nw * nz)


def _delta(
    cell: LFRCell, z0: Float[Array, " nz"], zeta: Float[Array, "S nz"]
) -> Float[Array, "S nw nz"]:
    """Δ(ζ)."""
    if (neurons := cell.map.neurons) is not None:
        return neurons.delta(z0, zeta)
    t, weight, exact = cell.map.quadrature
    points = torch.as_tensor(z0 + t[:, None, None] * zeta)
    delta = np.tensordot(weight, static_slope(cell, points).numpy(), 1)
    return delta if exact else delta + _left_over(cell, z0, zeta, delta)


@torch.no_grad()
def _left_over(
    cell: LFRCell,
    z0: Float[Array, " nz"],
    zeta: Float[Array, "S nz"],
    delta: Float[Array, "S nw nz"],
) -> Float[Array, "S nw nz"]:
    """Smallest change of Δ that makes f(z0) + Δ ζ exact."""
    f = cell.map(torch.as_tensor(np.concatenate([z0[None], z0 + zeta]))).numpy()
    error = f[1:] - f[0] - np.einsum("swz,sz->sw", delta, zeta)
    error[np.abs(error) <= _ROUNDING * (np.abs(f[1:]) + np.abs(f[0]))] = 0.0
    power = np.sum(zeta**2, axis=1, keepdims=True)
    along = np.divide(zeta, power, out=np.zeros_like(zeta), where=power > 0)
    return error[:, :, None] * along[:, None, :]
