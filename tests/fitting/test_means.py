"""The mean of models is one model: its output is the mean of theirs."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from reference import random_cell, random_model

import lfrtorch
from lfrtorch.data.records import Start
from lfrtorch.engine.cell import LFRCell
from lfrtorch.fitting.means import mean_model
from lfrtorch.fitting.state_scaling import scale_states
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


class Sine(torch.nn.Linear):
    """w = sin(W z + b), a module of the user's own."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        return torch.sin(super().forward(input))


def models(*maps: torch.nn.Module) -> list[Model]:
    """Three of one data set, whose starts were drawn from three seeds."""
    maps = maps or tuple(Network(2, 1, 4) for _ in range(3))
    first, *others = (
        random_model(random_cell(2, 2, 3, 2, 1, seed=seed, static=static))
        for seed, static in enumerate(maps, start=1)
    )
    return [first, *(replace(other, scaler=first.scaler) for other in others)]


@pytest.mark.parametrize("start", ["zero", "periodic"])
def test_mean_of_models_simulates_the_mean(start: Start):
    several = models()
    u = np.random.default_rng(0).normal(size=(200, 2))
    mean = mean_model(several)
    expected = np.mean([model.simulate(u, start=start) for model in several], axis=0)
    np.testing.assert_allclose(mean.simulate(u, start=start), expected, rtol=0, atol=1e-9)
    assert mean.sizes == {"nx": 9, "nz": 6, "nw": 3, "nn": 12}
    assert repr(mean.lfr.cell.static) == "Network(nz=6, nw=3, nn=12, activation='tanh')"


@pytest.mark.parametrize(
    ("maps", "last"),
    [
        ([Network(2, 1, 4), Network(2, 1, 3, "relu"), Network(2, 1, 2)], {"nn": 9}),
        ([Polynomial(2, 1, 2) for _ in range(3)], {"degree": 2}),
        ([Sine(2, 1) for _ in range(3)], {"nn": 0}),
    ],
)
def test_maps_that_are_no_network_together_stand_beside_each_other(
    maps: list[torch.nn.Module], last: dict[str, int], tmp_path: Path
):
    several = models(*maps)
    u = 0.3 * np.random.default_rng(0).normal(size=(200, 2))
    mean = mean_model(several)
    expected = np.mean([model.simulate(u) for model in several], axis=0)
    np.testing.assert_allclose(mean.simulate(u), expected, rtol=0, atol=1e-9)
    assert mean.sizes == {"nx": 9, "nz": 6, "nw": 3, **last}
    folder = mean.save(tmp_path / "model")
    if isinstance(maps[0], Sine):
        with pytest.raises(ValueError, match="class Sine, which is not part of this package"):
            lfrtorch.load(folder)
    again = lfrtorch.load(folder, static=Sine(2, 1))
    np.testing.assert_array_equal(again.simulate(u), mean.simulate(u))


def test_mean_of_linear_models_is_linear():
    several = [random_model(random_cell(nz=0, nw=0, seed=seed)) for seed in range(2)]
    assert mean_model(several).lfr.cell.static is None
    several[1] = replace(random_model(random_cell(seed=1)), scaler=several[0].scaler)
    u = np.random.default_rng(0).normal(size=(50, 1))
    expected = np.mean([model.simulate(u) for model in several], axis=0)
    np.testing.assert_allclose(mean_model(several).simulate(u), expected, rtol=0, atol=1e-9)


def test_mean_of_one_is_itself():
    (model,) = models()[:1]
    u = np.random.default_rng(0).normal(size=(50, 2))
    np.testing.assert_array_equal(mean_model([model]).simulate(u), model.simulate(u))


def test_mean_is_a_copy(tmp_path: Path):
    several = models()
    mean = mean_model(several)
    u = np.random.default_rng(0).normal(size=(50, 2))
    before = mean.simulate(u)
    with torch.no_grad():
        several[0].lfr.cell.A.zero_()
    np.testing.assert_array_equal(mean.simulate(u), before)
    mean.save(tmp_path / "model")
    np.testing.assert_array_equal(lfrtorch.load(tmp_path / "model").simulate(u), before)


def test_start_of_a_mean_is_most_probable():
    """From 20 noisy samples, 12 slow states: least squares alone would follow the noise."""
    several = []
    for seed in range(4):
        model = random_model(random_cell(1, 1, 3, 2, 1, 4, seed=1, radius=0.97, feedback=0.02))
        with torch.no_grad():
            poles = torch.diag(torch.tensor([0.97, 0.95, 0.9])) + 0.002 * seed * torch.eye(3)
            model.lfr.cell.A.copy_(poles)
            model.lfr.cell.Dyu.zero_()
        several.append(model)
    worst = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=(300, 1))
        past = rng.normal(size=(100, 1))
        clean = np.mean([m.simulate(np.vstack([past, u]))[100:] for m in several], axis=0)
        noise = 0.03 * clean.std()
        record = lfrtorch.Record(
            u, clean + noise * rng.normal(size=clean.shape), fs=several[0].fs,
            inputs=several[0].inputs, outputs=several[0].outputs, start="estimated", skip=20,
        )  # fmt: skip
        error = (mean_model(several).simulate(record) - clean)[20:60]
        worst.append(np.sqrt(np.mean(error**2)) / noise)
    assert max(worst) < 1.0  # of least squares: 87 to 13000


def arm(detuned: float, seed: int) -> Model:
    """Two lightly damped modes in coordinates of their own."""
    A = np.zeros((4, 4))
    for i, (radius, angle) in enumerate(((0.998, 0.11 + detuned), (0.99, 0.5 - 2.0 * detuned))):
        pole = radius * np.exp(1j * angle)
        A[2 * i :][:2, 2 * i :][:, :2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
    T = np.linalg.qr(np.random.default_rng(seed).normal(size=(4, 4)))[0]
    B, C = np.array([[1.0], [0.0], [0.5], [0.2]]), np.array([[1.0, 0.3, 0.8, -0.2]])
    rest: Any = np.zeros((1, 1)), 1.0, np.zeros(1), np.zeros(1), ("u",), ("y",)
    return lfrtorch.LinearModel(T @ A @ T.T, T @ B, C @ T.T, *rest).to_model()


def test_start_of_a_mean_is_not_fitted_to_few_samples_beyond_what_is_probable():
    """Sixteen states meet 36 outputs far better than a probable start, and fail after them."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=(800, 1))
    y = arm(0.0, 0).simulate(lfrtorch.Record(u, np.zeros((800, 1)), fs=1.0))
    several = [arm(d, seed) for seed, d in enumerate((3e-4, -3e-4, 6e-4, -5e-4), start=1)]
    mean = mean_model(several)
    for model in (mean, *several):
        scale_states(model, lfrtorch.Record(u, y, fs=1.0))
    later, known = y[300:], np.arange(500)[:, None] < 36
    record = lfrtorch.Record(
        u[300:], np.where(known, later, 0.0), fs=1.0, start="estimated", skip=36
    )

    def error(model: Model) -> float:
        return float(np.sqrt(np.mean((model.simulate(record) - later)[36:] ** 2)))

    assert error(mean) < min(map(error, several))  # of least squares: 3.5 times


def test_mean_refuses_models_that_are_not_alike():
    with pytest.raises(ValueError, match="no model to average"):
        mean_model([])
    several = models()
    with pytest.raises(ValueError, match="differ in channels, scales or rates"):
        mean_model([several[0], replace(several[1], fs=7.0)])
    known = lfrtorch.Known(lambda x, u, p: (0.5 * x.h + u[0],), states=["h"], method="discrete")
    cell = LFRCell(1, 1, 1, 2, 2, known.map(1, ["h"], 1.0), dtype=torch.float64)
    with pytest.raises(ValueError, match="average the simulated outputs"):
        mean_model([random_model(cell)])
