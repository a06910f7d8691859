"""Measured starts: states that are outputs, unstable systems, errors over a horizon."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import lfrtorch
from lfrtorch import (
    Channel,
    Dataset,
    InputError,
    Known,
    LFRCell,
    Parameter,
    Record,
    Settings,
    initialise,
    load_records,
)
from lfrtorch.engine.initial_state import measured_start
from lfrtorch.fitting.from_outputs import with_measured_states
from lfrtorch.fitting.observer import Observer
from lfrtorch.fitting.windows import windows
from lfrtorch.linear.measured_states import measured_states_model

FS, GRAVITY, GAIN, DAMPING = 50.0, 20.0, 10.0, 0.5
HORIZON = 25
OUTPUTS = Channel("angle", "rad"), Channel("speed", "rad/s")


def inverted(x: Any, u: Any, p: Any) -> Any:
    return x.speed, p.gravity * torch.sin(x.angle) + p.gain * u[0] - p.damping * x.speed


def known(**options: Any) -> Known:
    begun = {"gravity": Parameter(10.0), "gain": Parameter(5.0), "damping": Parameter(1.0)}
    return Known(inverted, states=["angle", "speed"], parameters=begun, **options)


def flight(seed: int, samples: int = 1500) -> Record:
    """A pendulum that a controller holds upright, both states measured with a little noise."""
    rng = np.random.default_rng(seed)
    x, steps, u, y = np.array([0.1, 0.0]), 10, [], []
    wanted = np.repeat(0.6 * rng.standard_normal(samples // 25 + 1), 25)
    for k in range(samples):
        y.append(x)
        u.append(-4.0 * (x[0] - wanted[k]) - 1.0 * x[1])
        for _ in range(steps):
            rate = GRAVITY * np.sin(x[0]) + GAIN * u[-1] - DAMPING * x[1]
            x = x + np.array([x[1], rate]) / (steps * FS)
    noise = [1e-3, 5e-3] * rng.standard_normal((samples, 2))
    name = f"flight{seed}"
    return Record(np.array(u), np.array(y) + noise, FS, "measured", name=name, outputs=OUTPUTS)


@pytest.fixture(scope="module")
def flights() -> Dataset:
    one, two, three = flight(0), flight(1), flight(2, 500)

    def rates(y_hat: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.abs((y_hat - y)[..., 1])

    return Dataset("upright", [one], [two], [three], ahead={"rates": rates})


class Said(Observer):
    """Keeps what is said."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def say(self, text: str) -> None:
        self.texts.append(text)


@pytest.fixture(scope="module")
def said() -> Said:
    return Said()


@pytest.fixture(scope="module")
def with_equations(flights: Dataset, said: Said) -> lfrtorch.Run:
    settings = Settings(known=known(), nx=0, nn=0, horizon=HORIZON)
    return lfrtorch.identify(flights, settings, observer=said)


def test_windows_are_a_tenth_and_then_three_of_the_horizon(
    with_equations: lfrtorch.Run, said: Said
) -> None:
    found = [text.split(" samples")[0] for text in said.texts if text.startswith("windows of")]
    assert found == ["windows of 2", "windows of 8"]


def test_an_unstable_known_system_is_found(with_equations: lfrtorch.Run, flights: Dataset) -> None:
    found = with_equations.metrics["known"]["values"]
    values = {name: entry["value"] for name, entry in found.items()}
    assert values["gravity"] == pytest.approx(GRAVITY, rel=0.03)
    assert values["gain"] == pytest.approx(GAIN, rel=0.03)
    (score,) = with_equations.metrics["scores"].values()
    assert score["rates"] < 0.1 * score["hold_rates"]
    assert score["rates"] < score["lti_rates"]
    assert score["skip"] == HORIZON


def test_sums_are_those_of_simulations_from_each_sample(
    with_equations: lfrtorch.Run, flights: Dataset
) -> None:
    model, (test,) = with_equations.model, flights.tests
    total = []
    for first in range(0, test.samples - HORIZON):
        y_hat = model.simulate(test[first : first + HORIZON + 1])
        total.append(np.abs(y_hat - test.y[first : first + HORIZON + 1])[1:, 1])
    expected = np.mean(total, axis=0).sum()
    assert with_equations.metrics["scores"][test.name]["rates"] == pytest.approx(expected)


def test_predictions_without_noise_model_begin_at_outputs(
    with_equations: lfrtorch.Run, flights: Dataset
) -> None:
    model, (test,) = with_equations.model, flights.tests
    y_hat = model.predict(test, horizon=5)
    for sample in (5, 40, test.samples - 1):
        own = model.simulate(test[sample - 5 : sample + 1])
        np.testing.assert_allclose(y_hat[sample], own[-1], rtol=1e-9)
    np.testing.assert_allclose(y_hat[:5], model.simulate(test[:5]), rtol=1e-6, atol=1e-9)
    with pytest.raises(InputError, match="has 20 samples and horizon is 20"):
        model.ahead(test[:20], 20)


def test_a_checkpoint_predicts_the_same(with_equations: lfrtorch.Run, flights: Dataset, tmp_path):
    with_equations.model.save(tmp_path / "model")
    loaded = lfrtorch.load(tmp_path / "model")
    (test,) = flights.tests
    expected = with_equations.model.ahead(test, 7)
    np.testing.assert_allclose(loaded.ahead(test, 7), expected, rtol=1e-9)


@pytest.mark.usefixtures("short_paths")
def test_sizes_are_searched_where_outputs_are_states(flights: Dataset) -> None:
    """The system is unstable in itself: no simulation through what is left out is near it."""
    data = replace(flights, train=[flights.train[0][:600]], validation=[])
    searched: dict[str, Any] = {"nx": "auto", "nz": 1, "nw": 1, "nn": "auto"}
    run = lfrtorch.identify(data, Settings(**searched, horizon=HORIZON))
    assert run.choice is not None
    assert run.choice.chosen.ratio < 0.8  # errors where each stretch was left out
    assert torch.equal(run.model.lfr.cell.Cy, torch.eye(2, dtype=torch.float64))
    ((record, linear, y_hat),) = run.choice.left_out
    errors = [np.abs(record.errors(signal)).mean() for signal in (y_hat, linear)]
    assert errors[0] < errors[1] < np.inf


@pytest.mark.usefixtures("short_paths")
def test_sizes_without_a_horizon_are_judged_by_simulations_from_an_output() -> None:
    """Each stretch begins at its first output."""
    u = np.random.default_rng(3).standard_normal(400)
    y = np.zeros(401)
    for k in range(400):
        y[k + 1] = 0.6 * y[k] + np.tanh(2.0 * u[k])
    record = Record(u, y[:400], start="measured")
    settings = Settings(nx=1, nz=1, nw=1, nn="auto")
    run = lfrtorch.identify(Dataset("steps", [record], [], []), settings)
    assert run.choice is not None
    assert run.choice.chosen.ratio < 0.1


def test_no_other_states_than_the_outputs_are_advised() -> None:
    """A hidden state is missing, and nx can be nothing but the number of outputs."""
    u = np.random.default_rng(5).standard_normal(600)
    y = lfilter([0.0, 1.0], [1.0, -1.5, 0.7], u)
    record = Record(u, y, start="measured")
    run = lfrtorch.identify(record, Settings(nx=1, nz=1, nw=1, nn=2, horizon=10, starts=1))
    assert run.advice
    assert not any("nx" in (each.change or {}) for each in run.advice)


def test_samples_that_are_not_valid_tell_no_linear_model(flights: Dataset) -> None:
    (one,) = flights.train
    valid = np.ones(one.y.shape, dtype=bool)
    valid[200:210] = False
    y = np.where(valid, one.y, 50.0)
    found = measured_states_model([replace(one, y=y, valid=valid)])
    expected = measured_states_model([one[:200], one[210:]])
    np.testing.assert_allclose(found.A, expected.A, rtol=1e-2, atol=1e-3)


def test_a_black_box_has_the_outputs_as_states(flights: Dataset) -> None:
    settings = Settings(nx="auto", nz=1, nw=1, nn=6, horizon=HORIZON, starts=1)
    run = lfrtorch.identify(flights, settings)
    cell = run.model.lfr.cell
    assert torch.equal(cell.Cy, torch.eye(2, dtype=torch.float64))
    assert not cell.Dyu.any()
    assert not cell.Dyw.any()
    (score,) = run.metrics["scores"].values()
    assert score["rates"] < 0.7 * score["lti_rates"]


def test_hidden_states_begin_at_rest() -> None:
    cell = LFRCell(nu=1, ny=2, nx=3, dtype=torch.float64, random=False)
    with torch.no_grad():
        cell.Cy[:, :2], cell.Dyu[0] = 2.0 * torch.eye(2), 1.0
    u, y = torch.tensor([[3.0], [0.0]]).double(), torch.tensor([[5.0, 4.0], [1.0, 0.0]]).double()
    expected = torch.tensor([[1.0, 2.0, 0.0], [0.5, 0.0, 0.0]]).double()
    assert torch.allclose(measured_start(cell, u, y), expected)


def test_the_linear_model_is_that_of_the_next_sample() -> None:
    rng = np.random.default_rng(0)
    A, B = np.array([[1.0, 0.02], [0.3, 1.1]]), np.array([[0.0], [0.5]])
    u, y = rng.standard_normal((60, 1)), np.zeros((60, 2))
    for k in range(59):
        y[k + 1] = A @ y[k] + B @ u[k] + [0.1, 0.0]
    found = measured_states_model([Record(u, y, start="measured")])
    np.testing.assert_allclose(found.A, A, atol=1e-3)
    np.testing.assert_allclose(found.B, B, atol=1e-3)


def test_windows_weigh_outputs_of_one_unit_alike() -> None:
    y = np.cumsum(np.random.default_rng(0).standard_normal((101, 3)) * [1.0, 3.0, 50.0], axis=0)
    outputs = Channel("x", "m"), Channel("y", "m"), Channel("speed", "m/s")
    record = Record(np.zeros(101), y, 1.0, "measured", outputs=outputs)
    cut = windows([record], 10, 3, y_scale=np.ones(3))
    assert len(cut) == 10
    assert {(part.samples, part.skip, part.start) for part in cut} == {(11, 1, "measured")}
    weights = np.array([part.weight for part in cut])
    assert (weights[:, 0] == weights[:, 1]).all()
    assert (weights[:, 0] > 100 * weights[:, 2]).all()
    squares = np.mean([((y[h:] - y[:-h]) ** 2).mean(axis=0) for h in range(1, 11)], axis=0)
    assert weights[:, 0].mean() == pytest.approx(1 / squares[:2].mean())
    relative = [((part.y[1:] - part.y[0]) ** 2 * weights[0]).mean() for part in cut]
    assert np.argmax(relative) == np.argmin(weights[:, 0])  # what moves most weighs least


def test_parts_of_a_file_begin_at_their_own_outputs(tmp_path) -> None:
    one = flight(0, 100)
    np.savetxt(tmp_path / "x.csv", np.hstack([one.u, one.y]), delimiter=",", header="u,y1,y2")
    data = load_records(tmp_path / "x.csv", fs=FS, start="measured", validation=0.2, test=0.2)
    assert [r.samples for r in (*data.train, *data.validation, *data.tests)] == [60, 20, 20]
    assert {r.start for r in (*data.train, *data.validation, *data.tests)} == {"measured"}
    np.testing.assert_allclose(data.tests[0].y[0], one.y[80])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"nx": 3, "nn": 2}, "the 2 outputs are the states; give nx=2"),
        ({"nx": 2, "nn": 2, "nz": 1, "structure": "parallel"}, "4 states that its 2 outputs"),
        ({"nx": 2, "nn": 2, "relaxations": 1}, "outputs do not determine; give nx=2"),
    ],
)
def test_what_cannot_be_is_refused(flights: Dataset, settings: dict[str, Any], message: str):
    short = Dataset("short", [flights.train[0][:200]], [], [])
    with pytest.raises(InputError, match=message):
        lfrtorch.identify(short, Settings(**settings, horizon=HORIZON))


def test_outputs_that_are_fitted_tell_no_states(flights: Dataset) -> None:
    linear = measured_states_model(flights.train)
    cut = windows(flights.train, HORIZON, 2)
    model = lfrtorch.initialise(linear, cut, nz=1, nw=1, nn=2)
    with pytest.raises(InputError, match="start='measured' computes states from outputs"):
        lfrtorch.fit(model, flights.train)
    scaled = known(outputs=lambda x, u, p: (p.gain * x.angle, x.speed))
    with pytest.raises(InputError, match="start='measured' computes states from outputs"):
        lfrtorch.identify(flights, Settings(known=scaled, horizon=HORIZON))


def test_a_record_within_the_horizon_is_refused_before_the_fit(flights: Dataset) -> None:
    short = replace(flights, tests=[flights.tests[0][:HORIZON]])
    with pytest.raises(InputError, match=f"has {HORIZON} samples and horizon is {HORIZON}"):
        lfrtorch.identify(short, Settings(known=known(), horizon=HORIZON))


def test_no_window_begins_at_an_output_that_is_not_valid(flights: Dataset) -> None:
    (one,) = flights.train
    gap = replace(one, valid=np.arange(one.samples) != 100)
    with pytest.raises(InputError, match="a fit from measured outputs needs all of them"):
        lfrtorch.identify(replace(flights, train=[gap]), Settings(known=known(), horizon=HORIZON))


def test_other_starts_beside_measured_ones_are_refused(flights: Dataset) -> None:
    (one,) = flights.train
    mixed = Dataset("mixed", [one, replace(one, start="zero", name="rest")], [], [])
    with pytest.raises(InputError, match="some records have start 'measured' and others not"):
        lfrtorch.identify(mixed, Settings(known=known(), horizon=HORIZON))


K = np.arange(300.0)


@pytest.mark.parametrize(
    ("beside", "pole"),
    [
        (1.5 + 0 * K, 1.0),
        (1.5e-9 + 0 * K, 1.0),
        (0.01 * K, 1.0),
        (np.exp(0.01 * K), np.exp(0.01)),
        (0.99**K, 0.99),
    ],
)
def test_an_output_that_the_input_does_not_move_keeps_its_pole(beside, pole: float) -> None:
    rng = np.random.default_rng(0)
    u = rng.standard_normal(300)
    moved = lfilter([0.0, 1.0], [1.0, -0.8], u) + 1e-3 * rng.standard_normal(300)
    record = Record(u, np.column_stack([moved, beside]), start="measured")
    model = initialise(measured_states_model([record]), record, nz=1, nw=1, nn=2)
    A = with_measured_states(model).lfr.cell.A.detach().numpy()
    np.testing.assert_allclose(np.linalg.eigvals(A).max(), pole, rtol=1e-3)


def test_a_linear_model_that_runs_away_asks_for_a_horizon() -> None:
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(1500), np.zeros(1500)
    for k in range(1499):
        u[k] -= 1.5 * y[k]
        y[k + 1] = 1.8 * y[k] + u[k]
    record = Record(u, y, start="measured")
    with pytest.raises(ValueError, match=r"unstable.* give a horizon"):
        initialise(measured_states_model([record]), record, nz=1, nw=1, nn=2)
