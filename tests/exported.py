"""Models to export, and the model's own numbers that an export must have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from reference import measure, normal, polynomial_cell, random_cell, random_model
from torch.func import jacrev

from lfrtorch import Known, LFRCell, Network, NoiseCovariance
from lfrtorch._support.types import Array
from lfrtorch.analysis import canonical
from lfrtorch.engine.cell import Matrices
from lfrtorch.maps.activations import ACTIVATIONS
from lfrtorch.maps.direct_sum import DirectSum
from lfrtorch.maps.static_map import StaticMap
from lfrtorch.model.model import Model

Step = Callable[[Array, Array], tuple[Array, Array]]
"""(x, u) -> (x_next, y), physical units."""


def in_canonical_form(model: Model) -> Model:
    """The same model, the linear part of its map in the linear block."""
    return canonical(model, measure(model, 60, seed=1)).model


class Drag(StaticMap):
    """Equations of one's own, and nothing else: a result of each z, and a constant."""

    def __init__(self) -> None:
        super().__init__(nz=2, nw=3)
        self.a = torch.nn.Parameter(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64))

    def equations(self, z: Sequence[Any], phi: Sequence[Any]) -> Sequence[Any]:
        """w of z."""
        return [phi[0] * z[0] * abs(z[0]), torch.tanh(z[1]) * phi[1], 2.0 * phi[2]]


def known_model(beside: StaticMap) -> Model:
    """Two tanks with an overflow by many operations, and a map beside them."""

    def rates(x, u, p):
        def drain(level):
            return p.out * torch.sqrt((level + 1.0).clamp(min=1e-2))

        over = torch.nn.functional.softplus(x.h1 - 1.5) + torch.relu(x.h1 - x.h2)
        pump = torch.where(u[0] > u[1], torch.sin(u[0]) ** 2, torch.sigmoid(u[1]))
        lost = torch.minimum(x.h2, p.edge) * torch.exp(-torch.abs(x.h2))
        return pump - drain(x.h1) - 0.1 * over, drain(x.h1) - p.out * lost - 0.1 * x.h2

    def outputs(x, u, p):
        return x.h2 + 0.1 * torch.tanh(u[0]), torch.cos(x.h1) - p.edge, u[1] * 0.5

    known = Known(
        rates, states=["h1", "h2"], parameters={"out": 0.4, "edge": 0.7}, outputs=outputs,
        substeps=2, intersample="bl",
    )  # fmt: skip
    own = known.map(2, ["y1", "y2", "y3"], 4.0)
    static = DirectSum([own, beside], [(own.nz, own.nw), (beside.nz, beside.nw)])
    cell = LFRCell(2, 3, 3, static.nz, static.nw, static, dtype=torch.float64, random=False)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in beside.parameters():
            p.uniform_(-1.0, 1.0, generator=generator)
        for name in Matrices._fields:
            cell.get_parameter(name).uniform_(-0.1, 0.1, generator=generator)
        cell.Cz[:2, :2], cell.Dzu[2:4] = torch.eye(2), torch.eye(2)
        cell.Bw[:2, :2], cell.Dyw[:, 2:5] = 0.8 * torch.eye(2), torch.eye(3)
    return random_model(cell)


MODELS: dict[str, Model] = {
    **{name: random_model(random_cell(2, 3, 4, 2, 3, 5, activation=name)) for name in ACTIVATIONS},
    "polynomial": random_model(polynomial_cell(2, 2, 3)),
    "affine": random_model(polynomial_cell(1, 1, 1)),
    "linear": random_model(random_cell(2, 2, 3, 0, 0)),
    "known": known_model(Network(2, 1, 4, "softplus", dtype=torch.float64)),
    "drag": random_model(random_cell(2, 1, 3, 2, 3, static=Drag(), radius=0.5)),
    "smallest": random_model(random_cell(1, 1, 1, 1, 1, 1), fs=750.0),
}
"""Every activation, polynomials, no static map, a known model, own equations, one of all."""


OBSERVED: dict[str, Model] = {
    name: replace(
        MODELS[name], K=0.1 * normal(MODELS[name].lfr.cell.nx, len(MODELS[name].outputs), seed=2)
    )
    for name in ("softplus", "polynomial", "linear", "drag", "smallest")
}
"""Models with a gain K."""


def some_noise(model: Model, seed: int = 0) -> NoiseCovariance:
    """Correlated noise on all states and outputs."""
    nx, ny = model.lfr.cell.nx, len(model.outputs)
    root = 0.2 * np.random.default_rng(seed).normal(size=(nx + ny, nx + ny + 1))
    joint, scale = root @ root.T, model.scaler.y_scale
    R = joint[nx:, nx:] * scale[:, None] * scale
    return NoiseCovariance(joint[:nx, :nx], R, joint[:nx, nx:] * scale)


def measured_with_gaps(model: Model, T: int) -> tuple[Array, Array]:
    """An input, and an output with errors in which some samples are missing (NaN)."""
    u, rng = inputs(model, T), np.random.default_rng(1)
    y = model.simulate(u)
    y += 0.3 * model.scaler.y_scale * rng.normal(size=y.shape)
    y[4, 0] = y[7] = np.nan
    return u, y


def inputs(model: Model, T: int) -> Array:
    """White noise about the operating point, (T, nu)."""
    noise = np.random.default_rng(7).normal(size=(T, len(model.inputs)))
    return model.scaler.u_offset + model.scaler.u_scale * noise


def cell_step(model: Model, x: torch.Tensor, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """One sample by the cell of the model, physical units."""
    s = {name: torch.tensor(value) for name, value in vars(model.scaler).items()}
    y, x_next = model.lfr.cell((u - s["u_offset"]) / s["u_scale"], x)
    return x_next, y * s["y_scale"] + s["y_offset"]


def check_step(step: Step, model: Model) -> None:
    """One sample from several states is that of the model to 1e-12."""
    generator = np.random.default_rng(3)
    for u in inputs(model, 5):
        x = generator.normal(size=model.lfr.cell.nx)
        with torch.no_grad():
            expected = cell_step(model, torch.tensor(x), torch.tensor(u))
        for found, one in zip(step(x, u), expected, strict=True):
            assert found.shape == one.shape
            assert np.abs(found - one.numpy()).max() <= 1e-12 * np.abs(one.numpy()).max()


def check_rest(x_rest: Array, model: Model) -> None:
    """The state stays where it is with the inputs at their operating point."""
    with torch.no_grad():
        u = torch.tensor(model.scaler.u_offset)
        after = cell_step(model, torch.tensor(x_rest), u)[0].numpy()
    assert np.abs(after - x_rest).max() <= 1e-9


def check_run(step: Step, model: Model) -> None:
    """A thousand samples from rest are those of the model to 1e-10 of the output's rms."""
    u, x, y = inputs(model, 1000), np.zeros(model.lfr.cell.nx), []
    for u_k in u:
        x, y_k = step(x, u_k)
        y.append(y_k)
    check_output(np.array(y), model, u)


def check_output(y: Array, model: Model, u: Array) -> None:
    """An output from rest is that of the model to 1e-10 of its rms."""
    expected = model.simulate(u)
    assert y.shape == expected.shape
    assert (np.abs(y - expected).max(axis=0) <= 1e-10 * expected.std(axis=0)).all()


def jacobians(model: Model, x: Array, u: Array) -> list[Array]:
    """dx+/dx, dx+/du, dy/dx and dy/du by torch."""
    by = jacrev(lambda x, u: cell_step(model, x, u), argnums=(0, 1))
    return [one.detach().numpy() for each in by(torch.tensor(x), torch.tensor(u)) for one in each]


def step(model: Model, x: Array, u: Array) -> tuple[Array, Array]:
    """x+ and y, physical units."""
    with torch.no_grad():
        x_next, y = cell_step(model, torch.tensor(x), torch.tensor(u))
    return x_next.numpy(), y.numpy()
