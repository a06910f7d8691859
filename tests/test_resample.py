"""Tests of models at another sampling rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from exported import MODELS, in_canonical_form
from reference import measure, random_cell, random_model
from scipy.signal import cont2discrete

from lfrtorch import LinearModel
from lfrtorch.analysis import linearise
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


def oscillator(fs: float, stiff: float) -> Model:
    """x'' + 0.6 x' + x + stiff (tanh(x) - x) = u, of which the last term is held over a sample."""
    model = random_model(random_cell(1, 1, 2, 1, 1, 1), fs=fs)
    A, B = np.array([[0.0, 1.0], [-1.0, -0.6]]), np.array([[0.0], [1.0]])
    system = cont2discrete((A + B @ [[stiff, 0.0]], B, np.eye(2), np.zeros((2, 1))), 1.0 / fs)
    made = {
        "A": system[0], "Bu": system[1], "Bw": -stiff * system[1], "Cz": [[1.0, 0.0]],
        "Cy": [[1.0, 0.0]], "Dzu": 0.0, "Dyu": 0.0, "Dyw": 0.0,
    }  # fmt: skip
    cell = model.lfr.cell
    with torch.no_grad():
        for name, value in made.items():
            getattr(cell, name).copy_(torch.as_tensor(np.asarray(value)))
        for name, value in {"Wz": 1.0, "Ww": 1.0, "bz": 0.0, "bw": 0.0}.items():
            getattr(cell.static, name).fill_(value)
    s = model.scaler
    s.u_offset[:], s.u_scale[:], s.y_offset[:], s.y_scale[:] = 0.0, 1.0, 0.0, 1.0
    return model


@pytest.mark.parametrize("times", [4.0, 2.5, 0.5, 1 / 30])
def test_linear_parts_are_exact(times: float):
    A = np.array([[-0.1, 1.0, 0.0], [-1.0, -0.1, 0.0], [0.0, 0.3, -0.5]])
    B, C = np.ones((3, 1)), np.array([[1.0, 0.5, 0.0]])
    old, new = (cont2discrete((A, B, C, np.zeros((1, 1))), 1.0 / fs) for fs in (10.0, 10.0 * times))
    made = replace(lti(old, 10.0), y_offset=np.array([3.0]))
    found, error = made.to_model().resample(10.0 * times)
    cell = found.lfr.cell
    for weight, expected in zip((cell.A, cell.Bu, cell.Cy), new, strict=False):
        np.testing.assert_allclose(weight.detach().numpy(), expected, rtol=0, atol=1e-9)
    assert error[0] < 1e-9
    again = found.resample(10.0).model
    np.testing.assert_allclose(again.lfr.cell.A.detach().numpy(), old[0], rtol=0, atol=1e-6)


def lti(system: tuple, fs: float) -> LinearModel:
    A, B, C, D, _ = system
    zero = np.zeros(1)
    channels = MODELS["smallest"]
    return LinearModel(
        A, B, C, D, u_offset=zero, y_offset=zero, fs=fs,
        inputs=channels.inputs, outputs=channels.outputs,
    )  # fmt: skip


def test_a_nonlinear_one_is_that_of_the_other_rate_within_its_error():
    coarse = oscillator(10.0, 0.8)
    faster, error = coarse.resample(40.0)
    u = np.repeat(np.random.default_rng(3).uniform(-1.5, 1.5, 40), 20)
    old, new = coarse.simulate(u)[:, 0], faster.simulate(np.repeat(u, 4))[::4, 0]
    assert 0.0 < np.sqrt(np.mean((old - new) ** 2)) < 1.5 * error[0]
    assert error[0] < 0.06 * old.std()


@pytest.mark.parametrize("name", ["tanh", "canonical"])
def test_at_rest_it_is_exact(name: str):
    cell = random_cell(2, 2, 3, 2, 2, 5, feedback=0.2)
    with torch.no_grad():
        cell.A.copy_(0.6 * torch.eye(3) + 0.1 * cell.A)  # away from the negative axis
    model = random_model(cell)
    model = in_canonical_form(model) if name == "canonical" else model
    local, other = linearise(model), linearise(model.resample(3.0 * model.fs).model)
    third = np.eye(len(local.A) + local.B.shape[1])
    third[: len(other.A)] = np.hstack([other.A, other.B])
    cubed = np.linalg.matrix_power(third, 3)[: len(other.A)]
    np.testing.assert_allclose(cubed, np.hstack([local.A, local.B]), rtol=0, atol=1e-6)


def test_channels_and_reach_stay_and_the_gain_does_not():
    model = MODELS["smallest"]
    with torch.no_grad():
        model = model.reaching(measure(model, 100, seed=1))
    known = replace(model, K=torch.zeros(1, 1, dtype=torch.float64))
    found = known.resample(1500.0).model
    assert (found.K, found.reach, found.outputs) == (None, model.reach, model.outputs)


def test_poles_of_no_continuous_system_are_refused():
    for pole in (-0.5, 0.0):
        made = lti((np.array([[pole]]), *np.ones((3, 1, 1)), 0.1), 10.0)
        with pytest.raises(
            ValueError, match=rf"has a pole at {pole:.3g}, which no continuous system has"
        ):
            made.to_model().resample(20.0)
    with pytest.raises(ValueError, match="fs"):
        MODELS["smallest"].resample(-1.0)
