"""Bands are those of the algebra, whatever start and coordinates, and hold what they should."""

from __future__ import annotations

import re
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, normal, output_jacobian, random_cell, random_model
from scipy import signal
from torch.nn.utils import parameters_to_vector, vector_to_parameters

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.analysis import uncertainty
from lfrtorch.analysis.confidence_bands import Uncertainty
from lfrtorch.data.records import Record, Start
from lfrtorch.engine import sensitivity
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


def noise(rng: np.random.Generator, T: int, ny: int, pole: float = 0.0) -> Array:
    """Of unit variance, the outputs correlated if there are two."""
    white = rng.standard_normal((T + 200, ny))
    white[:, 1:] = 0.6 * white[:, :1] + 0.8 * white[:, 1:]
    return np.asarray(signal.lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], white, axis=0))[200:]


def noisy(record: Record, level: float, *, seed: int = 0, pole: float = 0.0) -> Record:
    T, ny = record.y.shape
    e = noise(np.random.default_rng(seed), T, ny, pole)
    return replace(record, y=record.y + level * record.y.std(axis=0) * e)


def regression(T: int, *, pole: float = 0.0, seed: int = 0) -> tuple[Model, Record, Array]:
    """y = D u, fitted by least squares to inputs and noise of a colour; and the true D."""
    cell = lfrtorch.LFRCell(4, 1, 1, random=False).double()
    model = random_model(cell, seed=1)
    for name, p in cell.named_parameters():
        p.requires_grad_(name == "Dyu")
    rng = np.random.default_rng(seed)
    v = signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal((T, 4)), axis=0)
    D = np.array([[1.0, -1.0, 0.5, 2.0]])
    y = v @ D.T + noise(rng, T, 1, pole)
    with torch.no_grad():
        cell.Dyu.copy_(torch.as_tensor(np.linalg.lstsq(v, y, rcond=None)[0].T))
    s = model.scaler
    u, y = v * s.u_scale + s.u_offset, s.restore_y(y)
    return model, Record(u, y, model.fs, inputs=model.inputs, outputs=model.outputs), D


def fitted(model: Model, records: Sequence[Record], steps: int = 25) -> Model:
    trainer = lfrtorch.LevenbergMarquardt(max_iter=steps)
    return lfrtorch.fit(deepcopy(model), list(records), trainer=trainer).model


@pytest.fixture(scope="module")
def known() -> tuple[Model, Uncertainty]:
    """A model at the parameters that its data are of, so that no fit is needed."""
    model = random_model(random_cell(nu=2, ny=2, nz=2, nw=2, nn=2, feedback=0.3))
    return model, uncertainty(model, noisy(measure(model, 400), 0.05))


def along(model: Model, vector: Array) -> Model:
    """The model with its parameters moved."""
    moved = deepcopy(model)
    theta = parameters_to_vector(moved.lfr.parameters()).detach()
    vector_to_parameters(theta + torch.as_tensor(vector), moved.lfr.parameters())
    return moved


def directions(found: Uncertainty, far: float) -> Array:
    """Some columns of the factor as changes of all parameters, of length far."""
    wide = np.zeros((len(found.covariance), found.factor.shape[1]))
    wide[found.kept.numpy()] = found.factor.numpy()
    wide = wide[:, ::7]
    return (far * wide / np.linalg.norm(wide, axis=0)).T


def few(known: tuple[Model, Uncertainty]) -> tuple[Model, Uncertainty]:
    """The same with some of the factor's columns, for the sake of time."""
    model, found = known
    return model, replace(found, factor=found.factor[:, ::6])


def test_regression_has_the_covariance_of_the_textbook():
    model, record, _ = regression(400)
    found = uncertainty(model, record)
    s = model.scaler
    v = s.normalise_u(record.u)
    e = (record.y - model.simulate(record)) / s.y_scale
    expected = float((e**2).sum()) / (400 - 4) * np.linalg.inv(v.T @ v)
    assert found.colour.a[0].tolist() == [1.0]
    assert found.covariance == pytest.approx(expected, rel=0.03, abs=0.03 * expected.max())
    assert found.noise == pytest.approx(np.sqrt((e**2).sum() / 396) * s.y_scale)
    assert found.doubts == ()


@pytest.mark.parametrize("pole", [0.0, 0.8])
def test_bands_of_a_regression_cover(pole: float):
    """Pooled over 40 repeats of 20 samples; bands for white noise cover 65 % of the second."""
    inside = []
    for seed in range(40):
        model, record, D = regression(400, pole=pole, seed=seed)
        u, s = record.u[:20], model.scaler
        low, high = uncertainty(model, record).simulate(u).interval()
        y = s.restore_y(s.normalise_u(u) @ D.T)
        inside.append((low <= y) & (y <= high))
    assert 0.88 < np.mean(inside) < 0.99


@pytest.mark.parametrize("start", ["zero", "periodic", "given"])
def test_bands_are_those_of_all_columns(known: tuple[Model, Uncertainty], start: Start):
    model, found = known
    cell, scaler = model.lfr.cell, model.scaler
    record = measure(model, 60, seed=5)
    x0 = np.zeros(cell.nx)
    if start == "given":
        x0 = np.array([0.5, -1.0])
        record = replace(record, start=start, x0=x0)
    record = replace(record, start=start)
    band = found.simulate(record)
    periods = 4 if start == "periodic" else 1
    u = torch.as_tensor(scaler.normalise_u(record.u))[None]
    J = output_jacobian(cell, u, torch.as_tensor(x0)[None], periods)[0].numpy()
    variance = np.einsum("tip,pq,tiq->ti", J, found.covariance, J)
    assert band.y == pytest.approx(model.simulate(record))
    assert band.std == pytest.approx(np.sqrt(variance) * scaler.y_scale, rel=1e-5)


def test_an_estimated_start_moves_along(known: tuple[Model, Uncertainty]):
    """The record has no noise, so that the band of its own noise can be taken off."""
    model, found = few(known)
    record = replace(measure(model, 80, seed=6)[30:], start="estimated", skip=25)
    band, h = found.simulate(record), 1e-4
    variance = np.zeros(band.y.shape)
    wide = np.zeros((len(found.covariance), found.factor.shape[1]))
    wide[found.kept.numpy()] = found.factor.numpy()
    for column in wide.T:
        size = np.linalg.norm(column)
        ahead, back = (along(model, s * h * column / size).simulate(record) for s in (1, -1))
        variance += ((ahead - back) / (2 * h) * size) ** 2
    inside = band.std[25:] ** 2 / variance[25:]
    assert (inside > 0.98).all()
    assert np.median(band.std[25:] ** 2 / variance[25:]) < 100


def test_bands_do_not_depend_on_blocks(known: tuple[Model, Uncertainty], monkeypatch):
    model, found = known
    record = measure(model, 100, seed=7, start="periodic")
    whole = found.simulate(record)
    monkeypatch.setattr(sensitivity, "BLOCK", 13)
    assert found.simulate(record).std == pytest.approx(whole.std)


def test_bands_do_not_depend_on_coordinates():
    model = random_model(random_cell(ny=2, nx=3, nn=2, feedback=0.3))
    other = deepcopy(model)
    cell = other.lfr.cell
    T = normal(3, 3, seed=3) + 2 * torch.eye(3)
    with torch.no_grad():
        cell.A.copy_(T @ cell.A @ torch.linalg.inv(T))
        cell.Bu.copy_(T @ cell.Bu)
        cell.Bw.copy_(T @ cell.Bw)
        cell.Cz.copy_(cell.Cz @ torch.linalg.inv(T))
        cell.Cy.copy_(cell.Cy @ torch.linalg.inv(T))
    record, u = noisy(measure(model, 400), 0.05), measure(model, 50, seed=3).u
    one, two = (uncertainty(m, record) for m in (model, other))
    a, b = one.simulate(u), two.simulate(u)
    assert a.std == pytest.approx(b.std, rel=1e-5)
    assert a.surprises == pytest.approx(b.surprises, rel=1e-5)
    for linear in (lambda found: found.linear_part(), lambda found: found.linearise()):
        response = [lfrtorch.analysis.response_band(linear(f), [1.0, 20.0]) for f in (one, two)]
        assert response[0].covariance == pytest.approx(response[1].covariance, rel=1e-4)


@pytest.mark.parametrize("rest", [False, True])
def test_linear_models_move_with_the_parameters(known: tuple[Model, Uncertainty], rest: bool):
    model, found = few(known)
    u0 = model.scaler.u_offset + 0.3
    linear = found.linearise(u0) if rest else found.linear_part()
    f = np.array([0.5, 8.0])
    band, poles = lfrtorch.analysis.response_band(linear, f), lfrtorch.analysis.pole_bands(linear)
    assert band.std == pytest.approx(linear.frf_std(f))

    def of(moved: Model) -> Any:
        other = replace(found, model=moved)
        made = other.linearise(u0) if rest else other.linear_part()
        return made.frf(f), lfrtorch.analysis.pole_bands(made)

    wide = np.zeros((len(found.covariance), found.factor.shape[1]))
    wide[found.kept.numpy()] = found.factor.numpy()
    response, sizes, frequency = np.zeros((2, *band.response.shape)), 0.0, 0.0
    damping, h = 0.0, 1e-5
    for column in wide.T:
        size = np.linalg.norm(column)
        (ahead, up), (back, down) = (of(along(model, s * h * column / size)) for s in (1, -1))
        change = (ahead - back) / (2 * h) * size
        response += np.stack([change.real, change.imag]) ** 2
        sizes += ((np.abs(ahead) - np.abs(back)) / (2 * h) * size) ** 2
        frequency += ((up[0].frequency - down[0].frequency) / (2 * h) * size) ** 2
        damping += ((up[0].damping - down[0].damping) / (2 * h) * size) ** 2
    got = np.stack([band.covariance[..., 0, 0], band.covariance[..., 1, 1]])
    assert got == pytest.approx(response, rel=1e-3)
    assert band.magnitude_std**2 == pytest.approx(sizes, rel=1e-3)
    assert poles[0].frequency_std ** 2 == pytest.approx(frequency, rel=1e-3)
    assert poles[0].damping_std ** 2 == pytest.approx(damping, rel=1e-3)


def test_lines_of_equal_weight_are_white_noise():
    model = random_model(random_cell(nn=2, feedback=0.3))
    record = noisy(measure(model, 400, start="periodic"), 0.05)
    lines = replace(record, line_weight=np.ones(201))
    u = measure(model, 50, seed=3).u
    a, b = (uncertainty(model, each).simulate(u) for each in (record, lines))
    assert b.std == pytest.approx(a.std, rel=0.15)


def test_surprise_is_one_on_data_like_the_training_and_more_elsewhere():
    model = random_model(random_cell(nn=2, feedback=0.3))
    s, rng = model.scaler, np.random.default_rng(0)
    slow = signal.butter(4, 0.2)

    def driven(T: int, size: float = 1.0) -> Array:
        v = signal.lfilter(*slow, rng.standard_normal((T, 1)), axis=0)
        return size * v / v.std() * s.u_scale + s.u_offset

    u = driven(1000)
    train = Record(u, model.simulate(u), model.fs, inputs=model.inputs, outputs=model.outputs)
    found = uncertainty(model, noisy(train, 0.02))
    assert 0.8 < found.simulate(driven(1000)).surprise < 1.3
    assert found.simulate(driven(1000, 2.0)).surprise > 1.6
    fast = rng.standard_normal((1000, 1)) * s.u_scale + s.u_offset
    assert found.simulate(fast).surprise > 1.6
    assert found.simulate(driven(1000, 0.1)).surprise < 0.5


def test_a_model_that_is_too_small_is_doubted():
    truth = random_model(random_cell(nn=2, feedback=0.3))
    with torch.no_grad():
        truth.lfr.cell.Bw.mul_(3.0)
    record = noisy(measure(truth, 600), 0.01)
    linear = lfrtorch.estimate_bla(record, nx=2).to_model()
    (doubt,) = uncertainty(linear, record).doubts
    assert "depend on" in doubt
    assert str(uncertainty(linear, record)).startswith(doubt[:60])
    assert not any("depend" in d for d in uncertainty(truth, record).doubts)


def test_noise_of_a_loud_record_is_no_fault_of_a_model_in_a_quiet_one():
    """A linear model is doubted there all the same: see the test above."""
    truth = random_model(random_cell(nn=2, feedback=0.3))
    with torch.no_grad():
        truth.lfr.cell.Bw.mul_(3.0)
    quiet, loud = noisy(measure(truth, 600), 0.01), noisy(measure(truth, 600, seed=2), 0.2, seed=2)
    found = uncertainty(fitted(truth, [quiet, loud], 8), [quiet, loud])
    assert not any("depend" in doubt for doubt in found.doubts)
    linear = lfrtorch.estimate_bla([quiet, loud], nx=2).to_model()
    assert any("depend" in doubt for doubt in uncertainty(linear, [quiet, loud]).doubts)


def clipped(T: int, level: float) -> tuple[Uncertainty, Array]:
    """A fit of a regression whose output ends at 1 and -2 deviations, and by how much D is off."""
    model, record, D = regression(T)
    s = model.scaler
    e = level * np.random.default_rng(1).standard_normal((T, 1))
    y = s.restore_y(s.normalise_u(record.u) @ D.T + e)
    limits = s.restore_y(np.array([[-12.0], [6.0]]))
    clipped = replace(record, y=np.clip(y, *limits), limits=limits)
    found = uncertainty(fitted(model, [clipped], 10), clipped)
    return found, found.model.lfr.cell.Dyu.detach().numpy()[0] - D[0]


@pytest.mark.parametrize("level", [0.02, 1.0])
def test_noise_is_that_of_the_samples_that_count(level: float):
    """The model goes on beyond the limits of a sensor, by far more than the noise."""
    found, _ = clipped(2000, level)
    assert found.noise == pytest.approx(level * found.model.scaler.y_scale, rel=0.15)


def test_noise_that_limits_cut_off_is_doubted_by_how_far_it_shifts_the_fit():
    found, off = clipped(8000, 1.0)
    (doubt,) = [each for each in found.doubts if "limits" in each]
    told = float(re.findall(r"shifts the fit by some ([0-9.]+)", doubt)[0])
    shift = np.linalg.solve(np.linalg.cholesky(found.covariance), off)
    assert told == pytest.approx(np.sqrt(np.mean(shift**2)), rel=0.3)
    assert not any("limits" in each for each in clipped(2000, 0.02)[0].doubts)


def test_a_model_off_its_minimum_is_doubted(known: tuple[Model, Uncertainty]):
    model, found = known
    record = noisy(measure(model, 400), 0.05)
    moved = along(model, directions(found, 0.02)[-1])
    assert any("minimum" in doubt for doubt in uncertainty(moved, record).doubts)


def test_directions_without_data_surprise():
    """The second input is silent in the data."""
    model = random_model(random_cell(nu=2, nn=2, feedback=0.3))
    offset = model.scaler.u_offset
    u = measure(model, 400).u.copy()
    u[:, 1] = offset[1]
    silent = Record(u, model.simulate(u), model.fs, inputs=model.inputs, outputs=model.outputs)
    found = uncertainty(model, noisy(silent, 0.02))
    assert found.rank < len(found.kept)
    assert found.simulate(u).surprise < 1.2
    u[:, 1] += 0.1
    assert found.simulate(u).surprise > 100


def test_spread_of_models(known: tuple[Model, Uncertainty]):
    model, found = known
    models = [along(model, step) for step in directions(found, 0.01)[:3]]
    u = measure(model, 30).u
    band = lfrtorch.analysis.spread(models, u)
    outputs = [m.simulate(u) for m in models]
    assert band.y == pytest.approx(np.mean(outputs, axis=0))
    assert band.std == pytest.approx(np.std(outputs, axis=0, ddof=1))


def test_what_cannot_be_done_is_said(known: tuple[Model, Uncertainty]):
    model, found = known
    record = noisy(measure(model, 400), 0.05)
    with pytest.raises(lfrtorch.InputError, match="more samples than parameters"):
        uncertainty(model, record[:10])
    with pytest.raises(lfrtorch.InputError, match="a Model"):
        uncertainty(lfrtorch.estimate_bla(record, nx=2), record)  # pyright: ignore[reportArgumentType]
    with pytest.raises(lfrtorch.InputError, match="predictions"):
        uncertainty(replace(model, K=torch.zeros(2, 2)), record)
    with pytest.raises(lfrtorch.InputError, match="level"):
        found.simulate(record).interval(95)
    with pytest.raises(lfrtorch.InputError, match="two models"):
        lfrtorch.analysis.spread([model], record)
    with pytest.raises(lfrtorch.InputError, match="covariance"):
        lfrtorch.analysis.pole_bands(lfrtorch.analysis.linearise(model))


PLANTED: list[tuple[dict[str, Any], int, float, float]] = [
    ({"nx": 2, "nn": 2}, 500, 0.02, 0.8),
    ({"nx": 3, "nn": 3, "ny": 2, "seed": 3}, 500, 0.02, 0.8),
    ({"nx": 3, "nn": 2, "ny": 2, "seed": 1}, 500, 0.02, 0.0),
    ({"nx": 2, "nn": 2}, 500, 0.05, 0.0),
]
"""Sizes, samples, noise over the output's deviation, and the pole of the noise."""


def coverage(case: int, repeats: int) -> tuple[float, float]:
    """Part of the true outputs of a new input that are in bands of 95 %, and mean surprise."""
    sizes, T, level, pole = PLANTED[case]
    truth = random_model(random_cell(**sizes, feedback=0.3))
    new = measure(truth, 300, seed=99)
    inside, surprise = [], []
    for seed in range(repeats):
        record = noisy(measure(truth, T, seed=1000 + seed), level, seed=seed, pole=pole)
        band = uncertainty(fitted(truth, [record]), record).simulate(new.u)
        low, high = band.interval()
        inside.append((low <= new.y) & (new.y <= high))
        surprise.append(band.surprise)
    return float(np.mean(inside)), float(np.mean(surprise))


def test_bands_of_a_planted_model_cover():
    covered, _ = coverage(0, 4)
    assert 0.8 < covered <= 1


@pytest.mark.slow
def test_bands_are_calibrated():
    """200 repeats in all: white and coloured noise, one and two outputs, 16 to 28 parameters."""
    found = np.array([coverage(case, 50) for case in range(len(PLANTED))])
    assert ((found[:, 0] > 0.91) & (found[:, 0] < 0.98)).all(), found
    assert 0.93 <= found[:, 0].mean() <= 0.97, found
    assert ((found[:, 1] > 0.8) & (found[:, 1] < 1.4)).all(), found
