"""Models whose inputs act later: each door has the model whose states are its delays."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, normal, random_cell, random_model

from lfrtorch import (
    InputError,
    LevenbergMarquardt,
    LinearModel,
    Model,
    NoiseCovariance,
    Record,
    estimate_bla,
    export,
    fit,
    initialise,
    load,
    simulate_blocks,
    update,
)
from lfrtorch.analysis import linearise, uncertainty
from lfrtorch.data.delayed_records import delayed_records
from lfrtorch.data.records import with_past_outputs
from lfrtorch.engine.record_starts import STARTS
from lfrtorch.export.targets import TARGETS

DELAYS = (2, 0, 5)


def close(a: object, b: object, within: float = 1e-9) -> None:
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=within, atol=within)


@pytest.fixture(scope="module")
def model() -> Model:
    plain = random_model(random_cell(3, 2, 3, 2, 2, 4, radius=0.6))
    return replace(plain, K=0.1 * normal(3, 2, seed=5)).delayed(DELAYS)


@pytest.fixture(scope="module")
def record(model: Model) -> Record:
    found = measure(model.delayed(0), 150, seed=3)
    noise = 0.1 * model.scaler.y_scale * np.random.default_rng(4).standard_normal(found.y.shape)
    return replace(found, start="zero", y=model.simulate(found.u) + noise)


def test_inputs_act_later(model: Model, record: Record):
    later = np.stack([np.roll(v, d) for v, d in zip(record.u.T, DELAYS, strict=True)], axis=1)
    for j, d in enumerate(DELAYS):
        later[:d, j] = model.scaler.u_offset[j]
    close(model.simulate(record), model.delayed(0).simulate(later))


@pytest.mark.parametrize("start", ["zero", "periodic"])
def test_states_are_delays(model: Model, record: Record, start: str):
    of = replace(record, start=start)
    whole = model.with_delay_line()
    assert whole.lfr.cell.nx == 3 + sum(DELAYS)
    close(whole.simulate(of), model.simulate(of))


def test_both_forms_have_the_same_free_parameters(model: Model):
    whole = model.with_delay_line()
    assert whole.parameter_count == model.parameter_count
    assert whole.net_parameter_count == model.net_parameter_count


def test_an_unknown_past_is_not_blamed_on_the_model(model: Model, record: Record):
    late = replace(record[60:], start="estimated", skip=40)  # its first inputs act from before
    exact = model.simulate(record)[60:]
    np.testing.assert_allclose(
        model.simulate(late)[40:], exact[40:], atol=0.1 * model.scaler.y_scale.min()
    )


def test_every_kind_of_start_simulates(model: Model, record: Record):
    for start in STARTS:
        of = replace(record, start=start, x0=np.zeros(3) if start == "given" else None)
        assert np.isfinite(model.simulate(of)).all()


def test_blocks_are_one_simulation(model: Model, record: Record):
    u, x0 = record.u, np.full(3, 0.2)
    cuts = [u[:1], u[1:3], u[3:4], u[4:90], u[90:]]  # some shorter than the delays
    close(np.concatenate(list(simulate_blocks(model, cuts))), model.simulate(u))
    given = np.concatenate(list(simulate_blocks(model, cuts, x0=x0)))
    close(given, model.simulate(u, start="given", x0=x0))


def test_predictions_are_those_of_the_states(model: Model, record: Record):
    for horizon in (1, 4):
        whole = model.with_delay_line().predict(record, horizon=horizon)
        close(model.predict(record, horizon=horizon), whole)
    assert model.predictor().delay == (*DELAYS, 0, 0)
    close(model.predictor().innovation_form().simulate(record), model.simulate(record))


def test_observers_know_the_inputs_under_way(model: Model, record: Record):
    noise = NoiseCovariance(Q=1e-3 * np.eye(3), R=1e-2, S=np.zeros((3, 2)))
    for observer in (model.observer(), model.observer(noise=noise, P0=1e-6, x0=np.zeros(3))):
        for u, y in zip(record.u[:50], record.y[:50], strict=True):
            assert np.isfinite(observer.predict(u)).all()
            observer.update(y)
        assert len(observer.state) == 3 + sum(DELAYS)
    steady = model.observer(after=record[:50])
    close(steady.predict(record.u[50]), model.predict(record[:51])[50], 1e-6)
    disturbed = model.observer(noise=noise, disturbance="output", after=record[:50])
    assert len(disturbed.state) == 3 + sum(DELAYS)


def test_a_checkpoint_keeps_delays(model: Model, record: Record, tmp_path: Path):
    again = load(model.save(tmp_path / "model"))
    assert again.delay == DELAYS
    assert np.array_equal(again.simulate(record), model.simulate(record))
    linear = linearise(model)
    assert LinearModel.load(linear.save(tmp_path / "linear")).delay == DELAYS


def test_linear_models_turn_their_response(model: Model, record: Record):
    linear, f = linearise(model), np.linspace(0.0, model.fs / 2, 9)
    close(linear.frf(f), linear.with_delay_line().frf(f))
    close(linear.simulate(record), linear.with_delay_line().simulate(record))
    assert len(linear.to_scipy().A) == 3 + sum(DELAYS)
    bla = replace(estimate_bla(record[:100], 1), delay=DELAYS)
    turned, plain = (m.frf_covariance(f) for m in (bla, replace(bla, delay=())))
    close(np.trace(turned, axis1=-2, axis2=-1), np.trace(plain, axis1=-2, axis2=-1))
    # The variance along the response is that of its magnitude, which a delay leaves.
    along = [np.stack([G.real, G.imag], -1) for G in (bla.frf(f), replace(bla, delay=()).frf(f))]
    of = [
        np.einsum("...i,...ij,...j", a, C, a) for a, C in zip(along, (turned, plain), strict=True)
    ]
    close(*of)


@pytest.mark.parametrize("to", [to for to in TARGETS if not to.startswith(("fmu", "torch"))])
def test_exports_are_those_of_the_states(model: Model, to: str, tmp_path: Path):
    pytest.importorskip({"casadi": "casadi", "onnx": "onnx"}.get(to, "numpy"))
    noise = NoiseCovariance(Q=np.diag([1e-3, 1e-3, 2e-3]), R=1e-2)
    of_line = NoiseCovariance(Q=np.diag([1e-3, 1e-3, 2e-3, *[0.0] * sum(DELAYS)]), R=1e-2)
    follows = bool(TARGETS[to].follow)
    texts = []
    for name, one, own in (("a", model, noise), ("b", model.with_delay_line(), of_line)):
        more: dict[str, Any] = {"observer": own} if follows else {}
        texts.append([p.read_bytes() for p in export.write(one, to, tmp_path / name, **more)])
    assert [len(text) for text in texts[0]] == [len(text) for text in texts[1]]
    if to not in ("matlab",):  # its numbers carry the time of writing
        assert texts[0] == texts[1]


@pytest.mark.parametrize("language", ["python", "torch"])
def test_an_exported_step_simulates(model: Model, record: Record, language: str):
    made: dict[str, Any] = {}
    exec(export.python_source(model), made)
    step, number = made["step"], np.asarray
    if language == "torch":
        step, number = export.torch_modules(model)[0], torch.as_tensor
    x, found = number(np.zeros((1, 3 + sum(DELAYS)), np.float32)), []
    for u in record.u[:60].astype(np.float32):
        x, y = step(x, number(u[None])) if language == "torch" else step(x[0], u)
        x, y = (x, y[0]) if language == "torch" else (x[None], y)
        found.append(number(y))
    close(np.stack(found), model.simulate(record.u[:60].astype(np.float32)), 1e-4)


def test_another_rate_has_other_delays(model: Model):
    slow = random_model(random_cell(1, 1, 2, 1, 1, 3, radius=0.6)).delayed(3)
    slow.lfr.cell.A.data = torch.diag(torch.tensor([0.9, 0.7], dtype=torch.float64))
    faster, _ = slow.resample(4 * slow.fs)
    assert faster.delay == (12,)
    assert model.delay == DELAYS


def test_a_fit_recovers_a_delayed_model(model: Model, record: Record):
    quiet = replace(model, K=None)
    exact = replace(record, y=quiet.simulate(record))
    parts = [replace(exact, start="zero"), replace(exact[40:], start="estimated")]
    begun = deepcopy(quiet)
    with torch.no_grad():
        for p in begun.lfr.parameters():
            p.mul_(1.02)
    result = fit(begun, parts, trainer=LevenbergMarquardt(max_iter=60), monitors=[])
    assert result.model.delay == DELAYS
    error = np.std(exact.y - result.model.simulate(exact)) / exact.y.std()
    assert error < 1e-3


def test_windows_know_the_inputs_before_them(model: Model, record: Record):
    quiet = replace(model, K=None)
    exact = replace(record, y=quiet.simulate(record), start="estimated")
    shifted = delayed_records([exact], DELAYS, quiet.scaler.u_offset)
    each = [
        fit(deepcopy(one), of, horizon=30, trainer=LevenbergMarquardt(max_iter=1), monitors=[])
        for one, of in ((quiet, [exact]), (quiet.delayed(0), shifted))
    ]
    assert each[0].history[0].train == pytest.approx(each[1].history[0].train, rel=1e-9)
    assert each[0].history[0].train < 1e-6 * exact.y.std()


def test_an_update_keeps_the_delay(model: Model, record: Record):
    quiet = replace(model, K=None)
    found = update(
        quiet, record[80:], prior=record[:80], weight=1.0, trainer=LevenbergMarquardt(max_iter=3)
    )
    assert found.model.delay == DELAYS
    assert (found.after <= found.before).all()


def test_bands_are_those_of_the_inputs_as_they_act(model: Model, record: Record):
    quiet = replace(model, K=None)
    shifted = delayed_records([record], DELAYS, quiet.scaler.u_offset)[0]
    late, plain = uncertainty(quiet, record), uncertainty(quiet.delayed(0), shifted)
    close(late.simulate(record).std, plain.simulate(shifted).std)


def test_past_outputs_are_not_delayed(model: Model, record: Record):
    predictor = model.predictor()
    of = with_past_outputs(replace(record, start="estimated"))
    normalised = predictor.scaler.normalise(of)
    close(normalised.u[:, 3:], model.scaler.normalise_y(record.y))


@pytest.mark.parametrize("delay", [(1, 2), -1, 1.5, (1, 2, -3)])
def test_delays_that_cannot_be_are_refused(model: Model, delay: object):
    with pytest.raises(InputError, match="delay"):
        model.delayed(delay)  # type: ignore[arg-type]


@pytest.mark.parametrize("method", ["zero_output", "random_states", "paper"])
def test_a_start_takes_the_delay_of_its_linear_model(record: Record, method: Any):
    (shifted,) = delayed_records([record], DELAYS, np.zeros(3))
    linear = replace(estimate_bla(shifted, 3), delay=DELAYS)
    begun = initialise(linear, record, nz=1, nw=1, nn=3, method=method)
    assert begun.delay == DELAYS
    close(linear.simulate(record), linear.to_model().simulate(record))
    if method == "zero_output":
        close(begun.simulate(record), linear.simulate(record))
