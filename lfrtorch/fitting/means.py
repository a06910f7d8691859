"""The mean of several NL-LFR models: an NL-LFR with their blocks side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import Module

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch.engine.cell import LFRCell, Matrices
from lfrtorch.engine.lfr import LFR
from lfrtorch.maps.direct_sum import DirectSum
from lfrtorch.model.model import Model


@typed()
def mean_model(models: Sequence[Model]) -> Model:
    """The model whose output is the mean of the outputs of several models.

    Models that fit alike from different random starts differ where the data do not determine them.
    The squared error of the mean model is at most the mean of the models' squared errors. The mean
    model has the states, z and w of all models, and their static maps side by side. Networks of
    the same activation become one network.

    Args:
        models: models of the same data; they are copied.

    Raises:
        ValueError: no model; models whose channels, scales or rates differ; or a known model.

    Example:
        >>> models = [lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4, seed=i) for i in range(3)]
        >>> lfrtorch.mean_model(models).sizes
        {'nx': 3, 'nz': 3, 'nw': 3, 'nn': 12}
    """
    if not models:
        raise InputError("there is no model to average; give one or more.")
    first = models[0]
    if not all(_alike(model, first) for model in models):
        raise InputError(
            "the models differ in channels, scales or rates; give models that start from the same "
            "linear model and data."
        )
    if any(model.known_states for model in models):
        raise InputError(
            "a mean of known models has no parameters of its own; average the simulated outputs."
        )
    cells = [model.lfr.cell for model in models]
    count = len(cells)

    def blocks(of: Callable[[LFRCell], Tensor]) -> Tensor:
        return torch.block_diag(*map(of, cells))

    def stacked(of: Callable[[LFRCell], Tensor]) -> Tensor:
        return torch.cat([of(cell) for cell in cells])

    def beside(of: Callable[[LFRCell], Tensor]) -> Tensor:
        return torch.cat([of(cell) for cell in cells], dim=1) / count

    nx, nz, nw = (sum(getattr(cell, n) for cell in cells) for n in ("nx", "nz", "nw"))
    like = {"device": cells[0].A.device, "dtype": cells[0].A.dtype}
    cell = LFRCell(cells[0].nu, cells[0].ny, nx, nz, nw, _beside(cells), **like, random=False)
    with torch.no_grad():
        cell.A.copy_(blocks(lambda c: c.A))
        cell.Bw.copy_(blocks(lambda c: c.Bw))
        cell.Cz.copy_(blocks(lambda c: c.Cz))
        cell.Bu.copy_(stacked(lambda c: c.Bu))
        cell.Dzu.copy_(stacked(lambda c: c.Dzu))
        cell.Cy.copy_(beside(lambda c: c.Cy))
        cell.Dyw.copy_(beside(lambda c: c.Dyw))
        cell.Dyu.copy_(torch.stack([c.Dyu for c in cells]).mean(dim=0))
    for name in Matrices._fields:  # matrices that are frozen in all models stay frozen
        frozen = not any(c.get_parameter(name).requires_grad for c in cells)
        cell.get_parameter(name).requires_grad_(not frozen)
    cell.held = _held_beside(cells, dict(cell.named_parameters()))
    return replace(first, lfr=LFR(cell), K=None)  # the mean of models has no gain of its own


def _beside(cells: Sequence[LFRCell]) -> Module | None:
    """The static maps of all cells as one."""
    cells = [cell for cell in cells if cell.nw]
    if not cells:
        return None
    first, *others = (cell.map for cell in cells)
    parts = [deepcopy(cell.static) for cell in cells if cell.static is not None]
    return first.beside(others) or DirectSum(parts, [(cell.nz, cell.nw) for cell in cells])


def _held_beside(cells: Sequence[LFRCell], whole: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Masks of held entries of the mean; zeros between blocks are held if a block has held entries.

    Otherwise a fit of the mean could connect w of one model to z of another, against a structure.
    """
    found = {}
    for name in {name for cell in cells for name in cell.held if name in whole}:
        masks = [
            cell.held.get(name, torch.zeros(cell.get_parameter(name).shape, dtype=torch.bool))
            for cell in cells
        ]
        if name == "Dyu":
            found[name] = torch.stack(masks).all(dim=0)
        elif name in ("Bu", "Dzu", "Cy", "Dyw"):
            found[name] = torch.cat(masks, dim=int(name in ("Cy", "Dyw")))
        else:
            found[name] = ~torch.block_diag(*(~mask for mask in masks))
    return {name: mask for name, mask in found.items() if mask.shape == whole[name].shape}


def _alike(one: Model, other: Model) -> bool:
    """Tell if two models have the same channels, scales and rate."""
    scales = zip(vars(one.scaler).values(), vars(other.scaler).values(), strict=True)
    return (one.inputs, one.outputs, one.fs) == (other.inputs, other.outputs, other.fs) and all(
        np.array_equal(*pair) for pair in scales
    )
