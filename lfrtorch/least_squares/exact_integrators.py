"""Exact integrators of a model: which of its parameters a fit must leave alone.

A state i integrates if column i of A is 0 but for a 1 on the diagonal and entries in rows of other
integrators, and column i of Cz is 0: nothing but integrators and the output sees it. Then z = 1 is
a pole of the model, whatever its other parameters are, and a shift of that state shifts the output
for good. Two in a row are a double pole. Such columns of A and Cz are constants of a fit.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from lfrtorch.engine.block_form import fixed_entries
from lfrtorch.engine.cell import LFRCell


def integrating_states(cell: LFRCell) -> Bool[Tensor, " nx"]:
    """Which states are exact integrators."""
    A = cell.A.detach()
    acts = A - torch.diag(A.diagonal()) != 0
    candidates = (A.diagonal() == 1) & ~cell.Cz.detach().any(dim=0)
    found = torch.zeros_like(candidates)
    for _ in range(cell.nx):  # the last of a chain comes first
        found = candidates & ~acts[~found].any(dim=0)
    return found


def fixed_parameters(cell: LFRCell) -> Bool[Tensor, " free"]:
    """Which entries of the free parameters a fit must not change."""
    # Columns of exact integrators, those of past outputs in a predictor (``engine.innovation``),
    # and the entries that are given (``engine.block_form``).
    states, fixed = integrating_states(cell), fixed_entries(cell)
    inputs = torch.arange(cell.nu, device=states.device) >= cell.nu - cell.past_outputs
    columns = {"A": states, "Cz": states, "Dzu": inputs, "Dyu": inputs}
    none = states.new_zeros(())
    masks = [
        (columns.get(name, none) | fixed.get(name, none)).expand(p.shape)
        for name, p in cell.named_parameters()
        if p.requires_grad
    ]
    return torch.cat([states[:0], *(mask.flatten() for mask in masks)])
