"""The mean of several NL-LFR models, which is one, too: their blocks side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.nonlinearity import Network, is_network
from lfrtorch.model import Model


@typed()
def mean_model(models: Sequence[Model]) -> Model:
    """The model whose output is the mean of the outputs of several models.

    Models that fit alike from different random starts differ in what the data do not tell. There
    the squared error of their mean is at most the mean of theirs. It has the states, z, w and
    neurons of all: A, Bw, Cz, Wz and Ww are block diagonal.

    Args:
        models: of the same data, each with a network of the same activation; they are copied.

    Raises:
        ValueError: no model, or models of other channels, scales, rates or static maps.

    Example:
        >>> models = [lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4, seed=i) for i in range(3)]
        >>> lfrtorch.mean_model(models).sizes
        {'nx': 3, 'nz': 3, 'nw': 3, 'nn': 12}
    """
    if not models:
        raise InputError("there is no model to average; give one or more.")
    first = models[0]
    cells, networks = [], []
    for model in models:
        static = model.lfr.cell.static
        if not is_network(static):
            raise InputError(
                f"the mean is of models with a network, and one of these has {static!r} as its "
                "static nonlinearity; average the simulated outputs instead."
            )
        if networks and static.activation != networks[0].activation:
            raise InputError("the models have networks of different activations; give one kind.")
        if not _alike(model, first):
            raise InputError(
                "the models have other channels, scales or rates than each other; give models "
                "that start from the same linear model and data."
            )
        cells.append(model.lfr.cell)
        networks.append(static)
    count = len(cells)

    def blocks(of: Callable[[LFRCell], Tensor]) -> Tensor:
        return torch.block_diag(*map(of, cells))

    def stacked(of: Callable[[LFRCell], Tensor]) -> Tensor:
        return torch.cat([of(cell) for cell in cells])

    def beside(of: Callable[[LFRCell], Tensor]) -> Tensor:
        return torch.cat([of(cell) for cell in cells], dim=1) / count

    nx, nz, nw = (sum(getattr(cell, n) for cell in cells) for n in ("nx", "nz", "nw"))
    nn = sum(len(network.bz) for network in networks)
    like = {"device": cells[0].A.device, "dtype": cells[0].A.dtype}
    network = Network(nz, nw, nn, networks[0].activation, **like)
    cell = LFRCell(cells[0].nu, cells[0].ny, nx, nz, nw, network, **like, random=False)
    with torch.no_grad():
        cell.A.copy_(blocks(lambda c: c.A))
        cell.Bw.copy_(blocks(lambda c: c.Bw))
        cell.Cz.copy_(blocks(lambda c: c.Cz))
        cell.Bu.copy_(stacked(lambda c: c.Bu))
        cell.Dzu.copy_(stacked(lambda c: c.Dzu))
        cell.Cy.copy_(beside(lambda c: c.Cy))
        cell.Dyw.copy_(beside(lambda c: c.Dyw))
        cell.Dyu.copy_(torch.stack([c.Dyu for c in cells]).mean(dim=0))
        for name, weight in network.named_parameters():
            parts = [n.get_parameter(name) for n in networks]
            weight.copy_(torch.block_diag(*parts) if weight.ndim == 2 else torch.cat(parts))
    cell.free_feedthrough(
        z=any(c.Dzu.requires_grad for c in cells), y=any(c.Dyu.requires_grad for c in cells)
    )
    return replace(first, lfr=LFR(cell), K=None)  # gains of models do not make one of their mean


def _alike(one: Model, other: Model) -> bool:
    """Whether two models have the same channels, scales and rate."""
    scales = zip(vars(one.scaler).values(), vars(other.scaler).values(), strict=True)
    return (one.inputs, one.outputs, one.fs) == (other.inputs, other.outputs, other.fs) and all(
        np.array_equal(*pair) for pair in scales
    )
