"""Which parameters of a model a fit leaves as they are: zeros of its blocks, and what is given.

``LFRCell.structure`` says of which:

- ``"free"``: none is;
- ``"wiener"``: w acts on the output alone, Bw = 0;
- ``"hammerstein"``: z is of the inputs alone, Cz = 0;
- ``"wiener_hammerstein"``: the first half of the states, which u drives, makes z; the second half,
  which w alone drives, sees nothing of the first. So w never comes back to z;
- ``"parallel"``: the same with a network in which each neuron sees one z and acts on the w of the
  same number: branches that share their poles at most.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lfrtorch.engine.cell import LFRCell

STRUCTURES = ("free", "wiener", "hammerstein", "wiener_hammerstein", "parallel")
"""Values of ``LFRCell.structure``."""

IN_SERIES = ("wiener_hammerstein", "parallel")
"""Structures with as many states before the static map as after it."""


def fixed_entries(cell: LFRCell) -> dict[str, Tensor]:
    """Entries that a fit leaves as they are: zeros of the structure, and what is given."""
    zeros = zeros_of(cell)
    both = {name: mask | zeros.get(name, mask) for name, mask in cell.fixed.items()}
    return zeros | both


def zeros_of(cell: LFRCell) -> dict[str, Tensor]:
    """Entries of the parameters that are 0 for good, by the names of those that have any."""
    after = torch.arange(cell.nx, device=cell.A.device) >= cell.nx // 2
    match cell.structure:
        case "wiener":
            found = {"Bw": torch.ones_like(cell.Bw, dtype=torch.bool)}
        case "hammerstein":
            found = {"Cz": torch.ones_like(cell.Cz, dtype=torch.bool)}
        case "wiener_hammerstein" | "parallel":
            found = {
                "A": after[:, None] != after,
                "Bu": after[:, None].expand(cell.Bu.shape),
                "Bw": ~after[:, None].expand(cell.Bw.shape),
                "Cz": after.expand(cell.Cz.shape),
            }
        case _:
            found = {}
    if cell.structure == "parallel":
        assert cell.static is not None
        neurons = cell.static.get_parameter("Wz")
        own = torch.arange(len(neurons), device=neurons.device) * cell.nz // len(neurons)
        apart = own[:, None] != torch.arange(cell.nz, device=neurons.device)
        found |= {"static.Wz": apart, "static.Ww": apart.mT}
    return found
