"""A nonlinear model about a point is the linear one, up to the square of the deviations."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, random_cell, random_model

import lfrtorch
from lfrtorch.analysis import linearise
from lfrtorch.analysis.linearisation import linear_part, poles_at_rest
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.linearised import linearise as along
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

SIZES: dict[str, Any] = {"nu": 2, "ny": 2, "nx": 3, "nz": 2, "nw": 2}


def strong(**more: Any) -> Model:
    """A model that a loop of gain 1 makes clearly nonlinear, and that contracts all the same."""
    return random_model(random_cell(**SIZES | more, radius=0.5, feedback=0.4))


def test_error_of_small_deviations_is_quadratic():
    model = strong()
    u0 = model.scaler.u_offset + np.array([0.8, -0.5])
    local = linearise(model, u0)
    shape = np.random.default_rng(0).standard_normal((100, 2))
    rest = model.simulate(np.tile(u0, (300, 1)))[-1]
    np.testing.assert_allclose(local.y_offset, rest, rtol=0, atol=1e-9)
    x0 = model.signals(np.tile(u0, (300, 1))).x[0, -1].numpy()

    def error(amplitude: float) -> float:
        u = u0 + amplitude * shape
        y = model.simulate(u, start="given", x0=x0)
        return float(np.abs(local.simulate(u) - y).max())

    errors = [error(amplitude) for amplitude in (1e-1, 1e-2, 1e-3)]
    assert errors[0] > 1e-4  # it is nonlinear
    for large, small in pairwise(errors):
        assert 60 < large / small < 160  # 100 for an error that is quadratic


def test_it_is_the_linearisation_along_a_trajectory():
    """``u`` and ``x`` of any sample give F and H of that sample."""
    model = strong()
    record = measure(model, 40)
    trajectory = model.signals(record)
    F, H = along(model.lfr.cell, trajectory.z)
    for k in (0, 25):
        local = linearise(model, record.u[k], x=trajectory.x[0, k])
        np.testing.assert_allclose(local.A, F[0, k], rtol=0, atol=1e-12)
        scale = model.scaler.y_scale[:, None]
        np.testing.assert_allclose(local.C, scale * H[0, k].numpy(), rtol=0, atol=1e-12)
        np.testing.assert_allclose(local.y_offset, record.y[k], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(local.u_offset, record.u[k])


def test_it_goes_to_scipy_and_control_and_has_the_poles_at_rest():
    model = strong(ny=1, nu=1)
    local = linearise(model)
    assert np.sort_complex(local.poles) == pytest.approx(
        np.sort_complex(poles_at_rest(model)), abs=1e-9
    )
    system = local.to_scipy()
    assert system.dt == 1 / model.fs
    np.testing.assert_array_equal(system.A, local.A)
    control = pytest.importorskip("control", reason="python-control is not installed")
    gain = control.dcgain(local.to_control())
    assert np.allclose(gain, local.frf([0.0])[0, 0, 0].real)


def test_the_linear_part_is_the_model_with_a_silent_map():
    model = strong()
    cell = model.lfr.cell
    part = linear_part(model)
    with torch.no_grad():
        for weight in (cell.Bw, cell.Dyw):
            weight.zero_()
    record = measure(model, 50)
    np.testing.assert_allclose(part.simulate(record.u), record.y, rtol=0, atol=1e-12)


def test_single_precision_model_is_linearised_in_double_precision():
    model = strong()
    single = replace(model, lfr=lfrtorch.LFR(random_cell(**SIZES, dtype=torch.float32)))
    assert linearise(single).A.dtype == np.float64


def test_an_integrating_model_is_linearised_where_it_stands_still():
    model = random_model(random_cell(1, 1, 2, 1, 1, 3, radius=0.5))
    with torch.no_grad():
        cell = model.lfr.cell
        cell.A[:, 0], cell.Cz[:, 0] = torch.tensor([1.0, 0.0]), 0.0
    local = linearise(model)
    x = model.simulate(np.tile(local.u_offset, (300, 1)))
    np.testing.assert_allclose(x[-1], x[-2], atol=1e-9)  # under the offset it runs away
    assert abs(local.u_offset - model.scaler.u_offset) > 1e-3
    with pytest.raises(lfrtorch.InputError, match=r"integrates.\nGive no input to linearise at"):
        linearise(model, model.scaler.u_offset)


def test_points_that_do_not_exist_are_refused():
    cell = LFRCell(1, 1, 1, 1, 1, Polynomial(1, 1, 2), random=False).double()
    assert isinstance(cell.static, Polynomial)
    with torch.no_grad():  # x+ = x / 2 + u + x² / 4: no rest for u above 1/4
        for one in (cell.Bu, cell.Bw, cell.Cz, cell.Cy):
            one.fill_(1.0)
        cell.A.fill_(0.5)
        cell.static.C.copy_(torch.tensor([[0.0, 0.0, 0.25]]))
    model = random_model(cell)
    scale, offset = model.scaler.u_scale, model.scaler.u_offset
    root = (1 - np.sqrt(1 - 4 * 0.2)) * 1.0  # of x² / 4 - x / 2 + 0.2
    local = linearise(model, offset + 0.2 * scale)
    assert local.A[0, 0] == pytest.approx(0.5 + root / 2, abs=1e-8)
    with pytest.raises(lfrtorch.InputError, match="no state at rest was found under u1 = "):
        linearise(model, offset + 0.3 * scale)
    for given, words in (
        ({"u": [1.0, 2.0]}, r"the model has 1 input\(s\)"),
        ({"u": np.nan}, "give as many finite numbers"),
        ({"u": "fast"}, "u has type <U4; give real numbers"),
        ({"x": [1.0, 2.0]}, "the model has 1 states"),
    ):
        with pytest.raises(lfrtorch.InputError, match=words):
            linearise(model, **given)
