"""Bounds that no input of an amplitude passes."""

from typing import Any

import numpy as np
import pytest
import scipy.signal
import torch
from reference import measure, polynomial_cell, random_cell, random_model

from lfrtorch import analysis
from lfrtorch.maps.network import Network
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


def worst(model: Model, amplitude: float, output: int, side: int, T: int = 150) -> float:
    """The farthest last output that a search among inputs at their limits comes to."""
    s = model.scaler
    limit = torch.as_tensor(amplitude / s.u_scale)
    u = limit * torch.ones(1, T, len(limit), dtype=torch.float64)
    for _ in range(8):
        u = u.detach().requires_grad_()
        y = model.lfr(u)[0, -1, output]
        (slope,) = torch.autograd.grad(side * y, u)
        u = limit * torch.where(slope < 0, -1.0, 1.0)
    return float(s.restore_y(model.lfr(u).detach()[0, -1].numpy())[output])


def test_a_linear_model_reaches_its_bound():
    model = random_model(random_cell(2, 2, 5, 0, 0, radius=0.97))
    bound = analysis.bound(model, [0.7, 0.7])
    for output, sides in enumerate(bound.y):
        reached = [worst(model, 0.7, output, side, T=600) for side in (-1, 1)]
        middle = model.scaler.y_offset[output]
        assert reached - middle == pytest.approx(sides - middle, rel=0.01)
        assert sides[0] <= reached[0]
        assert reached[1] <= sides[1]


@pytest.mark.parametrize("activation", ["tanh", "sigmoid", "rbf"])
@pytest.mark.parametrize("sizes", [{"nx": 2}, {"nu": 2, "ny": 2, "nx": 4, "nz": 2, "nw": 2}])
def test_no_input_passes_the_bound(activation: str, sizes: dict[str, Any]):
    model = random_model(random_cell(**sizes, nn=6, feedback=0.4, activation=activation))
    bound = analysis.bound(model, 1.5)
    for output, (low, high) in enumerate(bound.y):
        reached = [worst(model, 1.5, output, side) for side in (-1, 1)]
        assert low <= reached[0] < reached[1] <= high
        assert high - low < 1.3 * (reached[1] - reached[0])
    offset, scale = model.scaler.u_offset, model.scaler.u_scale
    u = offset + 1.5 * np.random.default_rng(0).choice([-1.0, 1.0], (2000, len(scale)))
    trajectory = model.signals(u)
    for name in ("x", "z", "w"):
        low, high = getattr(bound, name).T
        signal = getattr(trajectory, name)[0].numpy()
        assert (low <= signal.min(axis=0)).all()
        assert (signal.max(axis=0) <= high).all()


def test_a_canonical_form_has_the_bound_of_its_model():
    model = random_model(random_cell(nu=2, ny=2, nx=4, nz=2, nw=2, nn=6, feedback=0.4))
    same = analysis.canonical(model, measure(model, 60)).model
    bound, before = analysis.bound(same, 1.5), analysis.bound(model, 1.5)
    for name in ("y", "z", "w"):
        np.testing.assert_allclose(getattr(bound, name), getattr(before, name), rtol=1e-3)
    u = model.scaler.u_offset + np.random.default_rng(0).choice([-1.5, 1.5], (500, 2))
    x, (low, high) = same.signals(u).x[0].numpy(), bound.x.T
    assert (low <= x.min(axis=0)).all()
    assert (x.max(axis=0) <= high).all()


def test_a_map_that_is_nearly_linear_costs_little():
    """Neurons of huge weights that cancel, and a loop that the linear part does not show."""
    cell = random_cell(1, 1, 2, 1, 1, 4, feedback=0.5)
    static = cell.static
    assert isinstance(static, Network)
    with torch.no_grad():
        static.Wz.copy_(torch.tensor([[0.01], [0.01], [0.02], [0.01]]))
        static.Ww.copy_(torch.tensor([[400.0, -300.0, -20.0, 10.0]]))
        static.bz.zero_()
        static.bw.zero_()
    model = random_model(cell)
    bound = analysis.bound(model, 0.1)
    reached = [worst(model, 0.1, 0, side) for side in (-1, 1)]
    offset = model.scaler.y_offset[0]
    assert bound.y[0] - offset == pytest.approx(np.array(reached) - offset, rel=0.05)


def test_the_start_state_is_part_of_it():
    model = random_model(random_cell(nx=3, radius=0.95))
    x0 = np.array([20.0, -10.0, 5.0])
    u = model.scaler.u_offset + np.zeros((300, 1))
    y = model.simulate(u, x0=x0, start="given")
    low, high = analysis.bound(model, 0.0, x0=x0).y[0]
    assert low <= y.min() < y.max() <= high
    assert high - low == pytest.approx(np.ptp(y), rel=0.05)
    assert np.ptp(analysis.bound(model, 0.0).y) < 0.2 * np.ptp(y)


@pytest.mark.parametrize("distance", [1e-3, 1e-6, 1e-9])
def test_slow_states_have_a_bound(distance: float):
    """Two poles 1 - d turned by an angle: far more samples than are summed."""
    model = random_model(random_cell(1, 1, 2, 0, 0))
    cell, angle = model.lfr.cell, 0.3
    turn = torch.tensor([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    with torch.no_grad():
        cell.A.copy_((1 - distance) * turn)
    size = np.diff(analysis.bound(model, 1.0).y[0])[0] / 2
    system = [m.detach().numpy() for m in (cell.A, cell.Bu, cell.Cy, cell.Dyu)]
    y = scipy.signal.dimpulse((*system, 1.0), n=4000)[1][0]
    per_sample = np.abs(y[-63:]).mean() / (1 - distance) ** 3970  # three turns, all angles
    least = model.scaler.y_scale[0] / model.scaler.u_scale[0] * per_sample / distance
    assert 0.9 * least < size < 100.0 * least  # what is not summed is bounded entry by entry


def test_what_has_no_bound_is_refused():
    unstable = random_model(random_cell(radius=1.3, nx=1))
    with pytest.raises(ValueError, match=r"A is not stable, .* modulus 1\.3: a small input"):
        analysis.bound(unstable, 1.0)
    with pytest.raises(ValueError, match="network of relu, which is not known to be bounded"):
        analysis.bound(random_model(random_cell(activation="relu")), 1.0)
    with pytest.raises(ValueError, match="Polynomial, which is not known to be bounded"):
        analysis.bound(random_model(polynomial_cell(1, 1, 2)), 1.0)
    model = random_model(random_cell())
    for amplitude in (-1.0, np.nan, [1.0, 2.0]):
        with pytest.raises(ValueError, match=r"amplitude is .*; give one number for all 1 input"):
            analysis.bound(model, amplitude)
    with pytest.raises(ValueError, match="the model has 2 states"):
        analysis.bound(model, 1.0, x0=[1.0])


def test_it_prints_its_outputs_with_their_units():
    text = str(analysis.bound(random_model(random_cell(ny=2)), 1.0))
    assert "Inputs within u1 1.00 N of their offsets" in text
    assert text.count(" mm") == 2
