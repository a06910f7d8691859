"""Entries of a model that a fit holds, as masks with values.

Each function returns masks and values by the names of the parameters. ``LFRCell.hold`` writes the
values and unites the masks; two different values for one entry are an error.
Gauge, steps and the count of parameters read the united mask alone.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.weights import Held

STRUCTURES = ("free", "wiener", "hammerstein", "wiener_hammerstein", "parallel")
"""Block structures of a model."""

IN_SERIES = ("wiener_hammerstein", "parallel")
"""Structures whose states are divided into those before and those behind the static map."""

TIED = {"A": "Cy", "Bu": "Dyu", "Bw": "Dyw"}
"""Matrices of the state equation, and those that K multiplies in a predictor's."""


def structure(cell: LFRCell, kind: str, *, before: int | None = None) -> Held:
    """Zeros of a block structure.

    - ``"free"``: none;
    - ``"wiener"``: w acts on the output alone, Bw = 0;
    - ``"hammerstein"``: z depends on the inputs alone, Cz = 0;
    - ``"wiener_hammerstein"``: u drives the first states, on which z depends; w alone drives the
      other states. So w never acts on z;
    - ``"parallel"``: as ``"wiener_hammerstein"``, where each w is a function of the z of the same
      number, so that the branches share at most their poles. In a network weights between branches
      are held at zero; other maps have a map for each branch
      (:class:`lfrtorch.maps.direct_sum.DirectSum`).

    Args:
        cell: the model whose sizes are used.
        kind: one of these names.
        before: number of states that drive z. Default: half of them.

    Raises:
        ValueError: ``"parallel"`` with a map that is not a function for each z.
    """
    every, zero = torch.tensor(True), torch.tensor(0.0)
    after = torch.arange(cell.nx) >= (cell.nx // 2 if before is None else before)
    found: dict[str, Tensor] = {}
    if kind == "wiener":
        found = {"Bw": every}
    elif kind == "hammerstein":
        found = {"Cz": every}
    elif kind in IN_SERIES:
        found = {"A": after[:, None] != after, "Bu": after[:, None], "Bw": ~after[:, None]}
        found["Cz"] = after
    if kind == "parallel":
        found |= {f"static.{name}": mask for name, mask in cell.map.across_branches().items()}
    return {name: (mask, zero) for name, mask in found.items()}


def no_feedthrough(cell: LFRCell, *, z: bool, y: bool) -> Held:
    """Zeros of a model without feedthrough from the input to ``z``, or to ``y``.

    The input also reaches y through w. Without ``y`` that path is closed at Dzu, or else at Dyw.
    Known equations keep their own feedthrough.
    """
    known = cell.map.known
    first_z, first_w = (0, 0) if known is None else (known.nz, known.nw)
    zero, found = torch.tensor(0.0), dict[str, tuple[Tensor, Tensor]]()
    if not z:
        found["Dzu"] = (torch.arange(cell.nz) >= first_z)[:, None], zero
    if not y:
        found["Dyu"] = torch.tensor(True), zero
    if z and not y:
        found["Dyw"] = torch.arange(cell.nw) >= first_w, zero
    return found


def past_outputs(cell: LFRCell) -> Held:
    """Zeros of a predictor: no feedthrough from its last inputs, which are measured outputs."""
    last = torch.arange(cell.nu) >= cell.nu - cell.ny
    return {name: (last, torch.tensor(0.0)) for name in ("Dzu", "Dyu")}


def measured_states(cell: LFRCell) -> Held:
    """The output equation of a model whose states are its normalised outputs."""
    every, zero = torch.tensor(True), torch.tensor(0.0)
    return {"Cy": (every, torch.eye(cell.nx)), "Dyu": (every, zero), "Dyw": (every, zero)}


def integrators(cell: LFRCell) -> Held:
    """Columns of A and Cz of the exact integrators, at their present values."""
    states = integrating_states(cell)
    if not states.any():
        return {}
    return {"A": (states, cell.A.detach()), "Cz": (states, torch.tensor(0.0))}


def integrating_states(cell: LFRCell) -> Bool[Tensor, " nx"]:
    """States that are exact integrators.

    In such a state's column A is 0, but for a 1 on the diagonal and entries in rows of other
    integrators; Cz is 0 there. So this state acts on other integrators and the output alone. Then
    z = 1 is a pole of the model whatever its other parameters are, and a shift of the state shifts
    the output for ever. Two integrators in series are a double pole.
    """
    A = cell.A.detach()
    acts = A - torch.diag(A.diagonal()) != 0
    candidates = (A.diagonal() == 1) & ~cell.Cz.detach().any(dim=0)
    found = torch.zeros_like(candidates)
    for _ in range(cell.nx):  # the last integrator of a chain is found first
        found = candidates & ~acts[~found].any(dim=0)
    return found


def held_parameters(cell: LFRCell) -> Bool[Tensor, " free"]:
    """Entries of the free parameters, one after another, that a fit holds."""
    masks = [
        cell.held.get(name, torch.zeros(p.shape, dtype=torch.bool)).flatten()
        for name, p in cell.named_parameters()
        if p.requires_grad
    ]
    return torch.cat([torch.zeros(0, dtype=torch.bool), *masks]).to(cell.A.device)
