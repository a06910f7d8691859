"""Innovation form: predictions, and fits to them."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from reference import normal, random_cell, random_model

import lfrtorch
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Record
from lfrtorch.engine.innovation import predictor_cell, split_predictor
from lfrtorch.fitting.settings import Settings
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


def noisy(T: int, *, level: float = 0.1, seed: int = 0) -> tuple[Model, Record, np.ndarray]:
    """A random model with two outputs in innovation form, a record of it, and its innovations."""
    model = random_model(random_cell(2, 2, 3, 2, 1, 4, seed=3))
    model = replace(model, K=0.2 * normal(3, 2, seed=5))
    rng = np.random.default_rng(seed)
    u, e = rng.standard_normal((T, 2)), level * rng.standard_normal((T, 2))
    cell, s = model.lfr.cell, model.scaler
    x, y = torch.zeros(1, 3, dtype=torch.float64), np.zeros((T, 2))
    assert model.K is not None
    with torch.no_grad():
        for k in range(T):
            now = torch.as_tensor(s.normalise_u(u[k : k + 1]))
            y_hat, x = cell(now, x)
            y[k] = y_hat.numpy()[0] + e[k]
            x = x + torch.as_tensor(e[k]) @ model.K.mT
    channels: dict[str, Any] = {"inputs": model.inputs, "outputs": model.outputs}
    return model, Record(u, s.restore_y(y), model.fs, name="noisy", **channels), e * s.y_scale


def test_a_prediction_leaves_the_innovations():
    model, record, e = noisy(200)
    np.testing.assert_allclose(record.y - model.predict(record), e, atol=1e-10)


def test_predictions_far_ahead_know_no_output_since():
    model, record, _ = noisy(60)
    horizon = 7
    found = model.predict(record, horizon=horizon)
    for k in (0, 5, 20, 59):
        changed = record.y.copy()
        changed[max(0, k - horizon + 1) :] += 1.0  # what it may not know
        same = model.predict(replace(record, y=changed), horizon=horizon)
        np.testing.assert_allclose(same[k], found[k], rtol=1e-12)
    changed = record.y.copy()
    changed[59 - horizon] += 1.0  # what it knows
    assert (model.predict(replace(record, y=changed), horizon=horizon)[59] != found[59]).any()


def test_a_horizon_of_the_whole_record_is_a_simulation():
    model, record, _ = noisy(40)
    for horizon in (40, 400):
        found = model.predict(record, horizon=horizon)
        np.testing.assert_allclose(found, model.simulate(record), rtol=1e-12)


def test_the_two_forms_follow_from_each_other():
    cell, K = random_cell(2, 2, 3, 2, 1, 4), normal(3, 2)
    again, found = split_predictor(predictor_cell(cell, K))
    torch.testing.assert_close(found, K)
    for name, value in cell.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value)


def test_a_fit_finds_the_innovations_and_the_past_outputs_stay_out_of_z():
    truth, record, e = noisy(1500)
    start = random_model(random_cell(2, 2, 3, 2, 1, 4, seed=3))
    cell = start.lfr.cell
    with torch.no_grad():
        for parameter in cell.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.manual_seed(1)))
    start = replace(start, K=torch.zeros(3, 2, dtype=torch.float64), scaler=truth.scaler)
    train, test = record[:1000], replace(record[1000:], start="estimated", skip=100)
    seen: list[Model] = []
    trainer = lfrtorch.LevenbergMarquardt(max_iter=25)
    result = lfrtorch.fit(
        start, train, test, noise="innovation", trainer=trainer,
        monitors=[lambda model, _: seen.append(model)],
    )  # fmt: skip
    assert all(len(model.inputs) == 2 and model.K is not None for model in seen)
    model = result.model
    least = rms(e[1100:])
    assert lfrtorch.rmse(test, model.predict(test)) < 1.1 * least
    last = lfrtorch.rmse(train, seen[-1].predict(train))
    assert result.history[-1].train == pytest.approx(last, rel=1e-9)
    predictor = model.predictor().lfr.cell
    assert not predictor.Dzu[:, 2:].any()
    assert not predictor.Dyu[:, 2:].any()


def with_own_map(model: Model) -> Model:
    """The same model with a module that is not compiled."""
    cell = copy.deepcopy(model.lfr.cell)
    static = cell.static
    assert static is not None
    cell.static = torch.nn.Sequential(static)
    return replace(model, lfr=lfrtorch.LFR(cell))


@pytest.mark.parametrize("own", [False, True])
def test_an_observer_predicts_sample_by_sample(own: bool):
    model, record, e = noisy(80)
    model = with_own_map(model) if own else model
    observer = model.observer(after=record[:30])
    y_hat, errors = [], []
    for k in range(30, 80):
        observer.predict(record.u[k] + 1.0)  # what is asked in between changes nothing
        y_hat.append(observer.predict(record.u[k]))
        errors.append(observer.update(record.y[k]))
    np.testing.assert_allclose(y_hat, model.predict(record)[30:], atol=1e-10)
    np.testing.assert_allclose(errors, e[30:], atol=1e-10)


def test_an_observer_goes_on_without_outputs():
    model, record, _ = noisy(40)
    observer = model.observer()
    y_hat = []
    for u in record.u:
        y_hat.append(observer.predict(u))
        assert np.isnan(observer.update(None)).all()
    np.testing.assert_allclose(y_hat, model.simulate(record), atol=1e-12)
    again = model.observer(x0=observer.state)
    np.testing.assert_array_equal(again.state, observer.state)


@pytest.mark.parametrize(
    ("said", "act"),
    [
        ("call predict", lambda m, r: m.observer().update(r.y[0])),
        ("u has the shape", lambda m, r: m.observer().predict([1.0])),
        ("give finite numbers", lambda m, r: m.observer().predict([1.0, np.nan])),
        ("x0 has the shape", lambda m, r: m.observer(x0=[1.0])),
        ("give only one of them", lambda m, r: m.observer(after=r, x0=[0.0] * 3)),
        ("no innovation gain K", lambda m, r: replace(m, K=None).observer()),
    ],
)
def test_what_an_observer_cannot_follow_is_refused(said: str, act):
    model, record, _ = noisy(20)
    with pytest.raises(ValueError, match=said):
        act(model, record)


def test_a_gain_goes_with_its_model_or_not_at_all():
    model, record, _ = noisy(300)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=1)
    assert lfrtorch.fit(model, record, trainer=trainer).model.K is None  # of a simulation error
    assert lfrtorch.mean_model([model, model]).K is None
    same = lfrtorch.analysis.canonical(model, record).model
    np.testing.assert_allclose(same.predict(record), model.predict(record), atol=1e-8)


def test_a_checkpoint_keeps_the_gain(tmp_path: Path):
    model, record, _ = noisy(50)
    again = lfrtorch.load(model.save(tmp_path / "model"))
    assert np.array_equal(again.predict(record), model.predict(record))
    assert "innovation form" in str(again)


def test_a_run_predicts():
    rng = np.random.default_rng(0)
    u, e = rng.standard_normal(900), 0.1 * rng.standard_normal(900)
    y, x = np.zeros(900), 0.0
    for k in range(900):
        y[k] = x + e[k]
        x = 0.8 * x + np.tanh(3.0 * u[k]) + 0.6 * e[k]
    records = [
        Record(u[part], y[part], name=name, skip=20)
        for name, part in (("train", slice(0, 600)), ("test", slice(600, 900)))
    ]
    dataset = lfrtorch.Dataset("noisy", records[:1], [], records[1:])
    trainer = lfrtorch.LevenbergMarquardt(max_iter=25)
    settings = Settings(nx=1, nz=1, nn=3, noise="innovation", trainer=trainer)
    run = lfrtorch.identify(dataset, settings, observer=lfrtorch.Observer())
    test = records[1]
    own, linear = (lfrtorch.rmse(test, m.predict(test)) for m in (run.model, run.linear))
    assert own < 0.9 * linear
    assert own < 1.1 * rms(e[620:])
    assert "the errors 1, 10 and 100 samples ahead are" in run.verdict.text


@pytest.mark.parametrize(
    ("said", "act"),
    [
        ("has no innovation gain K", lambda m, r: replace(m, K=None).predict(r)),
        ("has no innovation gain K", lambda m, r: lfrtorch.fit(m, r, noise="innovation")),
        ("noise is 'white'", lambda m, r: lfrtorch.fit(m, r, noise=cast(Any, "white"))),
        ("noise is 'white'", lambda m, r: Settings(nx=1, noise=cast(Any, "white"))),
        ("horizon is 0", lambda m, r: m.predict(r, horizon=0)),
    ],
)
def test_what_cannot_be_predicted_is_refused(said: str, act):
    model, record, _ = noisy(50)
    if "has no" in said:
        model = replace(model, K=None)
    with pytest.raises(ValueError, match=said):
        act(model, record)
