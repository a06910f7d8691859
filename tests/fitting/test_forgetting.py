"""Models that forget where they began, and those that do not: rests planted, and seen or not."""

from typing import cast

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch.data.records import Record


def toggle(u: np.ndarray, x: float) -> np.ndarray:
    """x+ = x + 0.1 (x - x³ + u): two rests, at -1 and 1."""
    found = np.empty(len(u))
    for k, own in enumerate(u):
        found[k] = x
        x += 0.1 * (x - x**3 + own)
    return found


def of_toggle(record: Record) -> lfrtorch.Model:
    """The same system as a model with a polynomial, whose scales are 1."""
    bla = lfrtorch.LinearModel(
        *(np.array([[value]]) for value in (0.5, 0.1, 1.0, 0.0)),
        fs=1.0,
        u_offset=np.zeros(1),
        y_offset=np.zeros(1),
        inputs=record.inputs,
        outputs=record.outputs,
    )
    model = bla.to_model()
    cell = lfrtorch.LFRCell(1, 1, 1, 1, 1, lfrtorch.Polynomial(1, 1, 3), random=False).double()
    static = cast(lfrtorch.Polynomial, cell.static)
    with torch.no_grad():
        for weight, value in ((cell.A, 1.1), (cell.Bu, 0.1), (cell.Cy, 1.0), (cell.Bw, -0.1)):
            weight.fill_(value)
        cell.Cz.fill_(1.0)
        static.C.zero_()
        static.C[0, -1] = 1.0  # z³
    return lfrtorch.Model(lfrtorch.LFR(cell), model.scaler, 1.0, record.inputs, record.outputs)


def weak(seed: int, x: float) -> Record:
    """A record that stays beside the rest where it begins."""
    u = 0.2 * np.random.default_rng(seed).standard_normal(600)
    return Record(u, toggle(u, x), start="estimated")


def test_the_model_of_a_toggle_is_the_system():
    record = weak(0, 1.0)
    assert of_toggle(record).simulate(record) == pytest.approx(record.y, abs=1e-6)


def test_rests_that_the_records_visit_are_right_and_others_are_not():
    low, high = weak(0, -1.0), weak(1, 1.0)
    model = of_toggle(low)
    both = lfrtorch.forgets(model, [low, high])
    assert both.apart > 1.0
    assert (both.fades, both.visited, both.right) == (False, True, True)
    assert "several rests" in str(both)
    one = lfrtorch.forgets(model, low)
    assert one.apart > 1.0
    assert (one.visited, one.right) == (False, False)
    assert "does not forget where it began" in str(one)


def test_a_model_is_as_slow_as_the_linear_one():
    """A resonance that rings through the record, and an integrator."""
    u = np.random.default_rng(0).standard_normal((300, 1))
    for poles in ([0.999 * np.exp(0.3j), 0.999 * np.exp(-0.3j)], [1.0, 0.5]):
        A = np.diag(np.ones(1), 1)
        A[1] = -np.poly(poles).real[:0:-1]
        bla = lfrtorch.LinearModel(
            A, np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)),
            fs=1.0, u_offset=np.zeros(1), y_offset=np.zeros(1),
            inputs=(lfrtorch.Channel("u"),), outputs=(lfrtorch.Channel("y"),),
        )  # fmt: skip
        record = Record(u, bla.simulate(u))
        model = bla.to_model()
        alone = lfrtorch.forgets(model, record)
        assert not alone.fades
        beside = lfrtorch.forgets(model, record, bla)
        assert beside.fades
        assert "as slowly as the linear model" in str(beside)


def test_a_model_that_runs_away_from_a_start_among_its_data_is_not_right():
    record = weak(0, 1.0)
    model = of_toggle(record)
    with torch.no_grad():
        model.lfr.cell.Bw.mul_(-0.5)  # x + 0.1 (x + x³ / 2): unstable
    assert lfrtorch.forgets(model, record).apart == np.inf
    assert "runs away" in str(lfrtorch.forgets(model, record))


def test_of_starts_that_fit_alike_one_that_forgets_is_kept():
    """The start with two rests has the smaller error, and its other rest was never visited."""
    record = weak(0, 1.0)
    linear = lfrtorch.initialise(
        lfrtorch.estimate_bla(record, 1), record, nz=1, nw=1, static=lfrtorch.Polynomial(1, 1, 3)
    )
    two = of_toggle(record)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=0)
    found = lfrtorch.fit([linear, two], record, trainer=trainer, monitors=[[], []])
    assert found.starts[0].number == 0
    assert lfrtorch.rmse(record, two.simulate(record)) < 1e-3 * lfrtorch.rmse(
        record, linear.simulate(record)
    )
