"""Best linear approximation -> weights of an NL-LFR model that starts exactly there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from lfrtorch.bla import LinearModel
from lfrtorch.cell import LFRCell
from lfrtorch.checks import integer
from lfrtorch.lfr import LFR
from lfrtorch.model import Model
from lfrtorch.nonlinearity import Network
from lfrtorch.records import Record, Scaler, as_records, rms_scale

OUTPUT_RANGE = 0.3
"""Bw, Dyw ~ U(-0.3, 0.3) of the ``"zero_output"`` start."""


def initialise(
    bla: LinearModel,
    records: Record | Sequence[Record],
    *,
    nz: int,
    nw: int,
    nn: int,
    activation: str = "tanh",
    method: Literal["zero_output", "paper"] = "zero_output",
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> Model:
    """NL-LFR model with one hidden layer whose output is that of the linear model.

    Signals and states are scaled to unit standard deviation over the records, and so is every z:
    C*, D* ~ U(-1, 1), then Cz, Dzu = C*, D* over the standard deviation of C* x + D* u. Wz and bz
    ~ U(-1, 1), bw = 0. The two methods differ in what keeps w out of the start:

    - ``"paper"``: Bw = Dyw = 0 and Ww ~ U(-1, 1) (Schoukens and Tóth 2020);
    - ``"zero_output"``: Ww = 0 and Bw, Dyw ~ U(-0.3, 0.3) (after Schoukens 2021). The more reliable
      one.

    Args:
        bla: stable linear model, best in balanced coordinates.
        records: the data that are to be fitted.
        nz, nw, nn: inputs, outputs and neurons of the static nonlinearity.
        activation: of the hidden layer.
        method: which of the two starts.
        seed: of the random weights.
        dtype: of the weights.

    Raises:
        ValueError: sizes below 1 or an unknown method.

    References:
        Schoukens and Tóth, IFAC-PapersOnLine 53(2), 2020, section 4.2.
        Schoukens, "Improved initialization of state-space artificial neural networks", ECC 2021.
    """
    for name, size in (("nz", nz), ("nw", nw), ("nn", nn)):
        integer(name, size, 1)
    integer("seed", seed, 0)
    if method not in ("zero_output", "paper"):
        raise ValueError(f"init method is {method!r}; use 'zero_output' or 'paper'.")
    data = as_records(records)
    scaler = Scaler(
        bla.u_offset,
        rms_scale([r.u for r in data], bla.u_offset),
        bla.y_offset,
        rms_scale([r.y for r in data], bla.y_offset),
    )
    static = Network(nz, nw, nn, activation, dtype=dtype)
    cell = LFRCell(len(bla.inputs), len(bla.outputs), len(bla.A), nz, nw, static, dtype=dtype)
    model = Model(LFR(cell), scaler, bla.fs, bla.inputs, bla.outputs)
    generator = torch.Generator().manual_seed(seed)

    def uniform(parameter: Tensor, limit: float = 1.0) -> None:
        parameter.uniform_(-limit, limit, generator=generator)

    with torch.no_grad():
        write_bla(cell, bla, scaler)
        static.reset_parameters(generator)
        for weight in (cell.Bw, cell.Dyw):
            weight.zero_()
        x = torch.cat([model.signals(record).x[0, :-1] for record in data])
        u = torch.cat([torch.as_tensor(scaler.normalise_u(r.u)).to(x) for r in data])
        std = _deviation(x)
        cell.A.copy_(cell.A * std / std[:, None])
        cell.Bu.div_(std[:, None])
        cell.Cy.mul_(std)
        uniform(cell.Cz)
        uniform(cell.Dzu)
        z = (x / std) @ cell.Cz.mT + u @ cell.Dzu.mT
        spread = _deviation(z)[:, None]
        cell.Cz.div_(spread)
        cell.Dzu.div_(spread)
        if method == "zero_output":
            static.Ww.zero_()
            uniform(cell.Bw, OUTPUT_RANGE)
            uniform(cell.Dyw, OUTPUT_RANGE)
    return model


def write_bla(cell: LFRCell, bla: LinearModel, scaler: Scaler) -> None:
    """A, Bu, Cy and Dyu of the cell from the linear model, in the scaler's normalised units."""
    with torch.no_grad():
        for weight, value in (
            (cell.A, bla.A),
            (cell.Bu, bla.B * scaler.u_scale),
            (cell.Cy, bla.C / scaler.y_scale[:, None]),
            (cell.Dyu, bla.D * scaler.u_scale / scaler.y_scale[:, None]),
        ):
            weight.copy_(torch.as_tensor(np.ascontiguousarray(value)))


def _deviation(signal: Tensor) -> Tensor:
    std = signal.std(dim=0, correction=0)
    return torch.where(std > 0, std, torch.ones_like(std))
