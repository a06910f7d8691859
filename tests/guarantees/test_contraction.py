"""Certificates that a model's trajectories come together."""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from reference import frf, measure, polynomial_cell, random_cell, random_model

from lfrtorch import Channel, analysis
from lfrtorch._support.types import Array
from lfrtorch.analysis import Contraction
from lfrtorch.data.records import Record
from lfrtorch.maps.network import Network
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


def scalar(A: float, *, bumps: float = 0.0, Ww: float = 1.0) -> Model:
    """x+ = A x + u + Ww (tanh(x - bumps) + tanh(x + bumps)) / 2, y = x, all in physical units."""
    model = random_model(random_cell(1, 1, 1, 1, 1, 2))
    cell, static = model.lfr.cell, model.lfr.cell.static
    assert isinstance(static, Network)
    with torch.no_grad():
        for p in cell.parameters():
            p.fill_(1.0)
        for p in (cell.Dyu, cell.Dyw, cell.Dzu, static.bw):
            p.zero_()
        cell.A.fill_(A)
        static.Ww.fill_(Ww / 2)
        static.bz.copy_(torch.tensor([-bumps, bumps]))
    s = model.scaler
    s.u_offset[:], s.u_scale[:], s.y_offset[:], s.y_scale[:] = 0.0, 1.0, 0.0, 1.0
    return model


def differences(
    model: Model, contraction: Contraction, size: float, *, start: float, T: int = 60
) -> Array:
    """|Δx|_P (pairs, T) of trajectories from other states under the same input."""
    rng, nx = np.random.default_rng(0), model.lfr.cell.nx
    found = []
    for _ in range(10):
        u = model.scaler.u_offset + size * rng.uniform(-1.0, 1.0, (T, len(model.inputs)))
        starts = [start * rng.normal(size=nx) for _ in range(2)]
        a, b = (model.signals(u, start="given", x0=x0).x[0].numpy() for x0 in starts)
        assert contraction.P is not None
        found.append(np.sqrt(np.einsum("ti,ij,tj->t", a - b, contraction.P, a - b)))
    return np.array(found)


@pytest.mark.parametrize(
    "sizes",
    [
        {"nx": 3},
        {"nx": 3, "nz": 2, "nw": 2, "nn": 5, "nu": 2, "ny": 2},
        {"nx": 2, "activation": "rbf"},
        {"nx": 2, "activation": "relu"},
        {"nx": 2, "nz": 3, "nw": 3, "nn": 2, "feedback": 0.3, "radius": 0.6},
    ],
)
def test_the_rate_and_the_gain_hold(sizes: dict[str, Any]):
    default: dict[str, Any] = {"feedback": 0.15}
    model = random_model(random_cell(**default | sizes))
    contraction = analysis.contraction(model)
    assert np.isinf(contraction.amplitude).all()
    assert contraction.rate < 1.0
    distance = differences(model, contraction, 3.0, start=3.0)
    bound = contraction.rate ** np.arange(distance.shape[1])
    large = distance > 1e-9 * distance[:, :1]
    assert (distance <= 1.000001 * bound * distance[:, :1])[large].all()
    rng = np.random.default_rng(1)
    for size in (0.01, 3.0):
        u = rng.normal(size=(200, len(model.inputs)))
        du = size * rng.normal(size=u.shape)
        dy = model.simulate(u + du) - model.simulate(u)
        assert np.linalg.norm(dy) <= contraction.gain * np.linalg.norm(du)


def test_a_linear_model_has_its_own_rate_and_gain():
    model = random_model(random_cell(2, 2, 3, 0, 0, radius=0.9))
    cell, s = model.lfr.cell, model.scaler
    A, Bu, Cy, Dyu = (m.detach().numpy() for m in (cell.A, cell.Bu, cell.Cy, cell.Dyu))
    system = A, Bu / s.u_scale, s.y_scale[:, None] * Cy, s.y_scale[:, None] * Dyu / s.u_scale
    peak = np.linalg.norm(frf(system, np.linspace(0.0, np.pi, 1000)), 2, axis=(1, 2)).max()
    contraction = analysis.contraction(model)
    assert 1 - contraction.rate == pytest.approx(1 - np.abs(np.linalg.eigvals(A)).max(), rel=0.02)
    assert contraction.gain == pytest.approx(peak, rel=0.01)


def test_one_slope_is_bounded_exactly():
    """x+ = 0.5 x + tanh(x) / 4: the slope is 0.75 at 0, and the gain 4."""
    contraction = analysis.contraction(scalar(0.5, Ww=0.25))
    assert contraction.rate == pytest.approx(0.75, abs=0.01)
    assert contraction.gain == pytest.approx(4.0, rel=0.01)


def test_what_is_printed_says_how_far_in_which_units():
    slow = analysis.contraction(scalar(0.0, Ww=0.99))
    said = str(slow).splitlines()
    assert "shrink to 0.99" in said[1]
    assert "of their size or less in every sample, to 1/e in 99." in said[1]
    assert said[2].endswith(" mm/N")
    assert "contraction(model, amplitude=...)" in said[3]
    assert "amplitude=" not in str(analysis.contraction(scalar(0.0, Ww=0.99), amplitude=0.5))
    assert "amplitude=" not in str(analysis.contraction(scalar(0.5, Ww=0.25)))
    model = random_model(random_cell(2, 2, 2, 1, 1, 3))
    assert str(analysis.contraction(model)).endswith(" mm/N, of all channels together")
    mixed = replace(model, outputs=(Channel("y1", "mm"), Channel("y2")))
    said = str(analysis.contraction(mixed))
    assert said.endswith(", of all outputs together (mm, 1) over all inputs (N)")


def test_the_region_of_the_data_has_a_proof_of_its_own():
    """x+ = 0.5 x + 0.8 tanh(x) + u has a slope of 1.3 at 0, and less than 1 from |x| = 0.71 on."""
    model = scalar(0.5, Ww=0.8)
    v = 3.0 + 0.2 * np.random.default_rng(0).normal(size=400)
    u = model.scaler.u_offset + model.scaler.u_scale * v[:, None]
    away = Record(
        u, model.simulate(u, start="given", x0=[6.0]), fs=model.fs,
        inputs=model.inputs, outputs=model.outputs, start="given", x0=np.array([6.0]),
    )  # fmt: skip
    z = model.signals(away).z[0].numpy()
    steepest = 0.5 + 0.8 / np.cosh(np.abs(z).min()) ** 2
    contraction = analysis.contraction(model, away)
    assert steepest <= contraction.rate <= steepest + 0.03 * (1 - steepest)
    assert "for z in the region of the data" in str(contraction)
    near = analysis.contraction(model, measure(model, 400))  # about 0
    assert not near.found
    assert "in the region of the data it has an eigenvalue of modulus 1.3" in near.reason
    # A model that knows its data says it beside the rate for all inputs, or beside none.
    known = analysis.contraction(model.reaching(away))
    assert not known.found
    assert known.data_rate == pytest.approx(contraction.rate)
    assert "As long as z is in the region of the data" in str(known)
    with pytest.raises(ValueError, match="records and amplitude are both given"):
        analysis.contraction(model, away, amplitude=0.1)


@pytest.mark.parametrize("sizes", [{}, {"nz": 2, "nw": 2, "nn": 6}, {"nx": 2, "nz": 3, "nw": 2}])
def test_differences_in_the_region_shrink_by_its_rate(sizes: dict[str, Any]):
    default: dict[str, Any] = {"feedback": 0.3, "radius": 0.65}
    model = random_model(random_cell(**default | sizes))
    record = measure(model, 300)
    contraction = analysis.contraction(model, record)
    everywhere = analysis.contraction(model).rate
    assert 1.0 - contraction.rate > 0.95 * (1.0 - everywhere)  # as far as it is looked for
    assert contraction.P is not None
    x = model.signals(record).x[0, :-1].double()
    v = torch.as_tensor(model.scaler.normalise_u(record.u))
    # Any two states of the record, under the input of the first: both z stay in its box.
    other = x[torch.randperm(len(x), generator=torch.Generator().manual_seed(0))]
    with torch.no_grad():
        z = [model.lfr.cell.internal(v, state)[0].numpy() for state in (x, other)]
        moved = [model.lfr.cell(v, state)[1] for state in (x, other)]
    reach = model.reaching(record).reach
    assert reach is not None
    white = [(each - reach.z.middle) @ reach.z.axes.T for each in z]
    low, high = reach.z.ends.T
    inside = np.all([((low <= w) & (w <= high)).all(axis=1) for w in white], axis=0)
    assert inside.sum() > 50
    L = torch.as_tensor(np.linalg.cholesky(contraction.P))
    before, after = (torch.linalg.norm((a - b) @ L, dim=1).numpy() for a, b in ((x, other), moved))
    assert (after <= contraction.rate * (1 + 1e-9) * before)[inside].all()


def test_two_rests_have_no_certificate():
    contraction = analysis.contraction(scalar(0.5, Ww=0.8))  # slope 1.3 at 0
    assert not contraction.found
    assert contraction.amplitude == 0.0
    assert "linearised at z = (" in contraction.reason
    assert "eigenvalue of modulus 1.3, so no norm shrinks there" in contraction.reason
    assert "no proof that the model contracts was found" in str(contraction)


def test_the_largest_amplitude_is_found_where_there_is_one():
    """The slope is 0.5 + sech² about ±2, and passes 1 at a z that a constant input leads to."""
    model = scalar(0.5, bumps=2.0)
    x = np.linspace(0.0, 2.0, 20001)
    slope = 0.5 + sum(1.0 / np.cosh(x + bump) ** 2 for bump in (-2.0, 2.0)) / 2
    last = x[np.argmax(slope >= 0.999)]
    leads = 0.5 * last - sum(np.tanh(last + bump) for bump in (-2.0, 2.0)) / 2
    contraction = analysis.contraction(model)
    assert 0.8 * leads < contraction.amplitude[0] < 1.01 * leads
    assert "for inputs within u1" in str(contraction)
    size = contraction.amplitude[0]
    distance = differences(model, contraction, size, start=0.01, T=30)
    bound = contraction.rate ** np.arange(distance.shape[1])
    assert (distance <= 1.000001 * bound * distance[:, :1] + 1e-12).all()
    assert analysis.contraction(model, amplitude=0.5 * size).rate < contraction.rate
    louder = analysis.contraction(model, amplitude=1.1 * leads)
    assert not louder.found
    assert "eigenvalue of modulus 1." in louder.reason


def test_without_a_bound_of_z_there_is_none_for_an_amplitude():
    contraction = analysis.contraction(scalar(1.1, Ww=-0.5))
    assert "eigenvalue of modulus 1.1, so no norm shrinks there" in contraction.reason
    assert "Nor is there one for an amplitude: A is not stable" in contraction.reason
    with pytest.raises(ValueError, match="A is not stable"):
        analysis.contraction(scalar(1.1, Ww=-0.5), amplitude=0.1)


def test_what_is_not_known_is_refused(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ValueError, match="Polynomial, whose slopes are not known to be bounded"):
        analysis.contraction(random_model(polynomial_cell(1, 1, 2)))
    monkeypatch.setitem(sys.modules, "clarabel", None)
    with pytest.raises(ValueError, match=r"pip install 'lfrtorch\[certificate\]'"):
        analysis.contraction(random_model(random_cell()))
