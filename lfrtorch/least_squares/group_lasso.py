"""Group lasso: a penalty under which whole states, z, w or neurons of a model fade.

A group is everything that an internal signal needs: of a state its row and column of A, its rows
of Bu and Bw and its columns of Cz and Cy; of a z its rows of Cz and Dzu and
its column of Wz; of a w its columns of Bw and Dyw and its row of Ww and entry of bw; of a neuron
its row of Wz, entry of bz and column of Ww. If the group is 0, the signal is of no use.

Many sets of weights are one and the same model, so the norm of a group says little by itself. But
the penalty also chooses among these: the sum of the norms is least if z, w and x are turned such
that as few as possible carry all, and scaled such that what goes into each is as large as what
comes out of it. For z it is then the sum of the square roots of the singular values of Wz [Cz Dzu],
times √2: few of them, as the rank is what has to be small.

References:
    Yuan and Lin, "Model selection and estimation in regression with grouped variables", J. Royal
    Statistical Society B 68(1), 2006.
    Bemporad, "An L-BFGS-B approach for linear and nonlinear system identification under l1 and
    group-Lasso regularization", IEEE Trans. Automatic Control, 2025 (arXiv 2403.03827).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.least_squares.jacobian import Jacobian
from lfrtorch.least_squares.linear_systems import SVDSystem, System
from lfrtorch.least_squares.simulation_problem import SimulationProblem

EPSILON = 1e-3
"""Norm below which the penalty of a group is smooth."""

ENTRIES = {
    "nx": {"A": (0, 1), "Bu": (0,), "Bw": (0,), "Cz": (1,), "Cy": (1,)},
    "nz": {"Cz": (0,), "Dzu": (0,), "static.Wz": (1,)},
    "nw": {"Bw": (1,), "Dyw": (1,), "static.Ww": (0,), "static.bw": (0,)},
    "nn": {"static.Wz": (0,), "static.bz": (0,), "static.Ww": (1,)},
}
"""Along which axes of which parameters a size counts."""


class GroupLassoProblem(SimulationProblem):
    """Residual of the simulation, then √λ θ_g (|θ_g|² + ε²)^(-1/4) of each group g.

    The squares of the latter add up to λ Σ |θ_g| away from 0: a penalty on norms is a residual of
    least squares, and a Levenberg-Marquardt search takes it as it is.

    Args:
        lfr, records, y_scale, options: see ``SimulationProblem``; of one process.
        names: the sizes that shall become smaller, of nx, nz, nw and nn; the static map is a
            network, for nn of one layer.
        weight: λ; that of |y_hat - y|² is 1.
    """

    def __init__(
        self,
        lfr: LFR,
        records: Any,
        y_scale: Any = 1.0,
        *,
        names: Iterable[str],
        weight: float,
        **options: Any,
    ) -> None:
        super().__init__(lfr, records, y_scale, **options)
        self._lasso = {name: groups(lfr.cell, name) for name in names}
        self._weight = weight

    def norms(self) -> dict[str, Float[Tensor, " n"]]:
        """The norm of each group, of the weights in the module."""
        theta = self.theta
        return {
            name: torch.stack([theta[own].norm() for own in every])
            for name, every in self._lasso.items()
        }

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """r at θ: of the simulation, then of the groups."""
        return torch.cat([super().residual(theta), self._penalty(theta)[0]])

    def linearise(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, theta: Float[Tensor, " P"], *, reduce: bool = True
    ) -> _Penalised:
        """dr/dθ at θ."""
        simulated = super().linearise(theta, reduce=reduce, eliminate=False)
        return _Penalised(simulated, *self._penalty(theta))

    def _penalty(
        self, theta: Float[Tensor, " P"]
    ) -> tuple[Float[Tensor, " E"], Float[Tensor, "E P"]]:
        """The residual of the groups, and its derivative."""
        parts, rows = [], []
        for own in (own for every in self._lasso.values() for own in every):
            v = theta[own]
            s2 = v.square().sum() + EPSILON**2
            factor = self._weight**0.5 * s2**-0.25
            row = theta.new_zeros(len(v), len(theta))
            row[:, own] = factor * (torch.eye(len(v)).to(v) - torch.outer(v, v) / (2.0 * s2))
            parts.append(factor * v)
            rows.append(row)
        return torch.cat(parts), torch.cat(rows)


class _Penalised:
    """J with more rows.

    Args:
        simulated: J of the simulation.
        penalty: the residual of the other rows.
        rows: themselves.
    """

    def __init__(
        self, simulated: Jacobian, penalty: Float[Tensor, " E"], rows: Float[Tensor, "E P"]
    ) -> None:
        self._simulated, self._penalty, self._rows = simulated, penalty, rows

    def system(self, damping: float, truncation: float) -> tuple[System, Float[Tensor, " P"]]:
        """The system and the gradient."""
        R, gradient = self._simulated.factor()
        system = SVDSystem(torch.cat([R, self._rows]), truncation)
        return system, gradient + self._rows.mT @ self._penalty

    def tangent(self, d_theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """J dθ."""
        return torch.cat([self._simulated.tangent(d_theta), self._rows @ d_theta])

    def adjoint(self, residual: Float[Tensor, " M"]) -> Float[Tensor, " P"]:
        """Jᵀ residual."""
        own, other = residual.split([len(residual) - len(self._rows), len(self._rows)])
        return self._simulated.adjoint(own) + self._rows.mT @ other


def groups(cell: LFRCell, name: str) -> list[Int[Tensor, " n"]]:
    """Where the entries of each group stand among the free parameters."""
    found: list[list[Tensor]] = []
    first = 0
    for parameter, p in cell.named_parameters():
        if not p.requires_grad:
            continue
        places = torch.arange(first, first + p.numel(), device=p.device).view(p.shape)
        first += p.numel()
        for axis in ENTRIES[name].get(parameter, ()):
            lines = list(places.movedim(axis, 0))
            if parameter == "A" and axis == 1:  # its diagonal is in the row already
                lines = [torch.cat([line[:k], line[k + 1 :]]) for k, line in enumerate(lines)]
            found.append([line.flatten() for line in lines])
    return [torch.cat(of_one) for of_one in zip(*found, strict=True)]
