"""Steps that keep held entries: steps are projected, and θ is corrected afterwards.

A held entry is usually an entry of θ that does not change. A predictor also has held equations: its
matrices are A - K C, Bu - K Dyu and Bw - K Dyw. So a held entry a of the system's A, Bu or Bw is an
equation c(θ) = a, which is linear in each factor. Steps are tangent to it, {d: ∂c/∂θ d = 0}. Then
the entries of A - K C, Bu - K Dyu and Bw - K Dyw are corrected so that the equation holds exactly.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.held import TIED, held_parameters
from lfrtorch.engine.weights import Held
from lfrtorch.least_squares.linear_systems import System
from lfrtorch.least_squares.simulation_errors import Parameters


class Projection:
    """Projection onto the directions that keep held entries, at one θ."""

    def __init__(
        self, entries: Bool[Tensor, " P"], normals: Float[Tensor, "P n"] | None = None
    ) -> None:
        self.entries = entries
        self._any = bool(entries.any())
        self._normals = None if normals is None else torch.linalg.qr(normals)[0]

    @property
    def held(self) -> bool:
        """True if an entry or an equation is held."""
        return self._any or self.tied

    @property
    def tied(self) -> bool:
        """True if equations between entries are held."""
        return self._normals is not None

    def __call__(self, columns: Float[Tensor, "*rows K"]) -> Float[Tensor, "*rows K"]:
        """Rows of gradients or directions of the first K entries of θ, projected."""
        if self._any:
            columns = columns.masked_fill(self.entries[: columns.shape[-1]], 0.0)
        if self._normals is not None:
            own = self._normals[: columns.shape[-1]].to(columns)
            columns = columns - (columns @ own) @ own.mT
        return columns


class ProjectedSystem:
    """A system whose steps keep held entries."""

    def __init__(self, system: System, project: Projection) -> None:
        self._system, self._project = system, project
        self.size, self.rank = system.size, system.rank

    @property
    def scale(self) -> float:
        """Largest eigenvalue of JᵀJ."""
        return self._system.scale

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient."""
        return self._project(self._system.solve(self._project(gradient), damping))


class HeldSteps:
    """Constraints of a search over θ: held entries, and a predictor's equations.

    Args:
        cell: cell of the start.
        parameters: θ.
        size: P.
    """

    def __init__(self, cell: LFRCell, parameters: Parameters, size: int) -> None:
        own = held_parameters(cell)
        self.entries = torch.cat([own, own.new_zeros(size - len(own))])
        """Entries of θ that do not move."""
        self._entries_alone = Projection(self.entries)
        self._parameters, self._nu = parameters, cell.nu - cell.ny
        self._tied: Held = cell.of_system or {}

    def projection(self, theta: Float[Tensor, " P"]) -> Projection:
        """The projection onto the directions that are free at θ."""
        if not self._tied:
            return self._entries_alone
        W, nu = self._parameters.weights(theta), self._nu
        layout, K, rows = W.layout, W.Bu[:, nu:], []
        for name, (mask, _) in self._tied.items():
            for i, j in mask.nonzero().tolist():
                row = {n: torch.zeros_like(getattr(W, n)) for n in (name, "Bu", TIED[name])}
                row[name][i, j] += 1.0
                row["Bu"][i, nu:] += getattr(W, TIED[name])[:, j]
                row[TIED[name]][:, j] += K[i]
                whole = torch.zeros_like(W.flat)
                for n, part in row.items():
                    whole[layout.place(n)] = part.flatten()
                rows.append(whole[torch.from_numpy(layout.free)])
        normals = W.flat.new_zeros(len(self.entries), len(rows))
        normals[: len(layout.free)] = torch.stack(rows, dim=1)
        return Projection(self.entries, normals.masked_fill(self.entries[:, None], 0.0))

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ, corrected so that the held equations of a predictor hold."""
        if not self._tied or not torch.isfinite(theta).all():
            return theta
        W = self._parameters.weights(theta)
        flat, K = W.flat.clone(), W.Bu[:, self._nu :]
        for name, (mask, values) in self._tied.items():
            columns = mask.shape[1]
            found = getattr(W, name).clone()
            wanted = values.to(found) - K @ getattr(W, TIED[name])[:, :columns]
            found[:, :columns] = torch.where(mask.to(found.device), wanted, found[:, :columns])
            flat[W.layout.place(name)] = found.flatten()
        own = flat[torch.from_numpy(W.layout.free)]
        return torch.cat([own, theta[len(own) :]])
