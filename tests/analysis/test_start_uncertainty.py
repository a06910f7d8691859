"""What an uncertain start state adds to errors, beside what it adds in many records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from experiments import cut_from, resonance

import lfrtorch
from lfrtorch import LinearModel
from lfrtorch.analysis import start_uncertainty
from lfrtorch.analysis.start_uncertainty import start_error
from lfrtorch.model.model import state_moment
from lfrtorch.reporting import scores
from lfrtorch.reporting.evaluation import Evaluation

pytestmark = pytest.mark.numeric


def known(model: LinearModel) -> LinearModel:
    """With the covariance of its states."""
    long = [cut_from(model, 4000, 0.0, seed)[0] for seed in (90, 91)]
    return replace(model, state_covariance=state_moment(model.to_model(), long).numpy())


@pytest.mark.parametrize(
    ("model", "T", "memory"),
    [
        (resonance(0.95, 0.1), 100, 0.0),
        (resonance(0.99, 0.3, ny=2), 100, 0.8),
        (resonance(0.999, 0.0), 150, 0.8),  # slower than the record
    ],
)
def test_what_the_start_adds_is_what_it_adds_in_many_records(
    model: LinearModel, T: int, memory: float
):
    """To a third: of 40 records the root of a mean square of few directions is known to a tenth."""
    linear = known(model)
    added, said = [], []
    for seed in range(40):
        record, e = cut_from(model, T, memory, seed)
        test = replace(record, skip=T // 5)
        y_hat = linear.simulate(test)
        added.append(np.mean((y_hat - (record.y - e))[test.skip :] ** 2))
        found = start_error(linear.to_model(), test, y_hat)
        assert found is not None
        said.append(found**2)
    assert np.sqrt(np.mean(said)) == pytest.approx(np.sqrt(np.mean(added)), rel=0.35)


def test_of_a_long_record_the_beginning_is_looked_at(monkeypatch: pytest.MonkeyPatch):
    """What has faded stays away, and what an integrator keeps stays."""
    integrator = replace(resonance(0.5, 1.0), A=np.array([[1.0, 0.3], [0.0, 0.6]]))
    for model in (resonance(0.95, 0.1), integrator):
        linear = known(model)
        record, _ = cut_from(model, 1500, 0.0, 0)
        test = replace(record, skip=50)
        given = linear.to_model(), test, linear.simulate(test)
        whole = start_error(*given)
        with monkeypatch.context() as shorter:
            shorter.setattr(start_uncertainty, "LONGEST", 400)
            assert start_error(*given) == pytest.approx(whole, rel=1e-3)


def test_other_starts_add_nothing():
    model = resonance(0.9, 0.2)
    record, _ = cut_from(model, 100, 0.0, 0)
    for test in (replace(record, start="zero", skip=20), record):
        assert start_error(model.to_model(), test, model.simulate(test)) is None
    diverging = np.full_like(record.y, np.nan)
    assert start_error(model.to_model(), replace(record, skip=20), diverging) is None


def test_a_sample_that_is_left_out_tells_no_start():
    model = resonance(0.95, 0.1)
    linear = known(model)
    record, _ = cut_from(model, 100, 0.0, 0)
    test = replace(record, skip=20)
    valid = np.arange(100) % 4 == 0
    found = []
    for each in (test, replace(test, valid=valid)):
        y_hat = linear.simulate(each)
        found.append(start_error(linear.to_model(), each, y_hat))
    assert found[1] > 1.3 * found[0]


def test_the_table_shows_what_the_start_adds_where_it_matters():
    model = resonance(0.97, 0.05)
    linear = known(model)
    records = {
        name: replace(cut_from(model, T, 0.5, 5)[0], name=name)
        for name, T in (("short", 50), ("long", 4000))
    }
    (train, _) = cut_from(model, 500, 0.0, 1)
    for name, shown in (("short", True), ("long", False)):
        data = lfrtorch.Dataset("d", [train], [], [records[name]]).with_windows()
        start = lfrtorch.initialise(linear, [train], nz=1, nw=1, nn=2)
        evaluation = Evaluation(dataset=data, linear=linear, model=start)
        found = scores.scored(evaluation)
        assert ("from the start" in scores.table(evaluation)) == shown
        assert found["scores"][name]["start_error"] > 0
