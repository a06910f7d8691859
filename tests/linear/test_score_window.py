"""How many samples a score of an estimated start leaves out, and what the scores are then."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import lfrtorch
from lfrtorch import Dataset, LinearModel, Record
from lfrtorch._support.types import Array
from lfrtorch.linear import score_window
from lfrtorch.linear.score_window import determining_samples, with_score_windows

pytestmark = pytest.mark.numeric


def second_order(radius: float, angle: float, ny: int = 1) -> LinearModel:
    """A pole pair, seen in ``ny`` outputs."""
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    C = np.array([[1.0, 0.0], [0.5, 1.0]])[:ny]
    names = [tuple(lfrtorch.Channel(f"{s}{i}") for i in range(n)) for s, n in (("u", 1), ("y", ny))]
    return LinearModel(
        A, np.array([[1.0], [0.3]]), C, np.zeros((ny, 1)), fs=1.0,
        u_offset=np.zeros(1), y_offset=np.zeros(ny), inputs=names[0], outputs=names[1],
    )  # fmt: skip


INTEGRATOR = replace(second_order(0.5, 1.0), A=np.array([[1.0, 0.3], [0.0, 0.6]]))


def noise(T: int, memory: float, seed: int, ny: int = 1) -> Array:
    """Of unit variance, with a first-order spectrum."""
    e = np.sqrt(1 - memory**2) * np.random.default_rng([3, seed]).standard_normal((T, ny))
    for k in range(1, T):
        e[k] += memory * e[k - 1]
    return e


def measured(model: LinearModel, T: int, memory: float, seed: int) -> tuple[Record, Array]:
    """A part of a long measurement, and its errors."""
    u = np.random.default_rng([1, seed]).standard_normal(T + 500)
    e = noise(T, memory, seed, len(model.outputs))
    y = model.simulate(u)[500:] + e
    record = Record(u[500:], y, start="estimated", inputs=model.inputs, outputs=model.outputs)
    return record, e


@pytest.mark.parametrize("memory", [0.0, 0.8])
@pytest.mark.parametrize(
    ("model", "T"),
    [
        (second_order(0.7, 0.5), 60),
        (second_order(0.99, 0.3), 300),  # lightly damped: memory of 100 samples
        (second_order(0.97, 0.1, ny=2), 200),
        (INTEGRATOR, 600),
    ],
)
def test_scores_are_the_errors_of_the_model(model: LinearModel, T: int, memory: float):
    """The mean square over some records, to a quarter: what the start state may add, and chance."""
    _, known = measured(model, 4000, memory, seed=99)
    found: list[float] = []
    true: list[float] = []
    for seed in range(6):
        record, e = measured(model, T, memory, seed)
        skip = determining_samples(model.to_model(), record, [known])
        assert skip is not None
        assert skip < 0.6 * T
        error = (record.y - model.simulate(replace(record, skip=skip)))[skip:]
        found.append(float(np.mean(error**2)))
        true.append(float(np.mean(e[skip:] ** 2)))
    assert np.mean(found) < 1.25 * np.mean(true)


def test_slow_errors_and_slow_systems_need_more_samples():
    def samples(model: LinearModel, memory: float) -> int:
        record, _ = measured(model, 400, memory, seed=0)
        found = determining_samples(model.to_model(), record, [noise(4000, memory, 99)])
        assert found is not None
        return found

    fast, slow = second_order(0.7, 0.2), second_order(0.97, 0.05)
    assert samples(fast, 0.0) < samples(slow, 0.0) < samples(slow, 0.9)


def test_the_window_does_not_depend_on_units():
    model = second_order(0.95, 0.2, ny=2)
    record, _ = measured(model, 300, 0.5, 0)
    units = np.array([1.0, 1e6])
    scaled = replace(model, C=model.C * units[:, None])
    in_units = replace(record, y=record.y * units)
    windows, outputs = [], []
    for each, data in ((model, record), (scaled, in_units)):
        train = replace(data, start="zero", skip=0)
        dataset = with_score_windows(Dataset("d", [train], [], [data]), each.to_model())
        windows.append(dataset.tests[0].skip)
        outputs.append(each.simulate(dataset.tests[0]))
    assert windows[0] == windows[1] > 0
    assert np.allclose(outputs[0] * units, outputs[1], rtol=1e-6, atol=1e-6)


def uses(dataset: Dataset) -> Sequence[Sequence[Record]]:
    return dataset.validation, dataset.selection, dataset.tests


def test_windows_that_are_given_stay_and_others_are_at_least_skip():
    model = second_order(0.9, 0.2)
    record, _ = measured(model, 300, 0.0, 0)
    given = replace(record, skip=3), replace(record, start="zero"), replace(record[:200], skip=7)
    least = replace(record, skip=150, skip_more=True)
    dataset = Dataset("d", [record], [given[0], least], [given[1]], selection=[given[2], record])
    found = with_score_windows(dataset, model.to_model())
    assert found.validation[0] is given[0]
    assert found.tests[0] is given[1]
    assert found.selection[0] is given[2]
    assert found.validation[1].skip == 150
    assert 2 <= found.selection[1].skip < 60
    assert found.train == [record]
    assert (found.unscored, found.notes) == ((), ())
    again = with_score_windows(found, model.to_model())
    assert uses(again) == uses(found)  # the same objects


def test_records_that_are_too_short_are_not_scored_and_a_note_says_so():
    model = second_order(0.99, 0.02)
    record, _ = measured(model, 1000, 0.9, 0)
    short = [replace(record[:n], start="estimated", name=f"short_{n}") for n in (40, 8)]
    data = with_score_windows(Dataset("d", [record], short[:1], short[1:]), model.to_model())
    assert (data.validation, data.tests) == ([], [])
    assert [(use, r.name) for use, r in data.unscored] == [
        ("validation", "short_40"), ("test", "short_8"),
    ]  # fmt: skip
    assert data.notes == (
        "record 'short_40' (validation): 40 samples are too few to determine the start state and "
        "score the rest: not scored",
        "record 'short_8' (test): 8 samples are too few to determine the start state and score "
        "the rest: not scored",
        "no validation record can be scored, so the training error chooses",
    )


def test_an_exact_model_without_errors_and_one_without_states_to_see_are_scored():
    model = second_order(0.9, 0.2)
    record, e = measured(model, 100, 0.0, 0)
    clean = replace(record, y=record.y - e)
    assert determining_samples(model.to_model(), clean, [0.0 * e]) is not None
    blind = replace(model, C=np.zeros((1, 2)))
    assert determining_samples(blind.to_model(), record) == 1


def test_of_long_records_the_beginning_is_looked_at(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(score_window, "LONGEST", 100)
    model = second_order(0.9, 0.2)
    record, e = measured(model, 300, 0.0, 0)
    assert determining_samples(model.to_model(), replace(record, skip=200), [e]) == 200
    found = determining_samples(model.to_model(), record, [e])
    assert found == determining_samples(
        model.to_model(), replace(record[:100], start="estimated"), [e]
    )


def test_a_model_that_diverges_is_scored():
    record, _ = measured(second_order(0.9, 0.2), 300, 0.0, 0)
    unstable = replace(second_order(0.9, 0.2), A=np.diag([40.0, 0.5])).to_model()
    data = with_score_windows(Dataset("d", [record], [], [record]), unstable)
    assert len(data.tests) == 1
    assert not np.isfinite(lfrtorch.rmse(data.tests[0], unstable.simulate(data.tests[0])))


def test_a_fit_chooses_on_samples_that_its_start_is_not_fitted_to():
    model = second_order(0.9, 0.2)
    (train, _), (judge, _) = (measured(model, 200, 0.0, seed) for seed in (0, 1))
    start = lfrtorch.initialise(model, [train], nz=1, nw=1, nn=2)
    skip = determining_samples(start, judge, [train.y - start.simulate(train)])
    trainer = lfrtorch.LevenbergMarquardt(max_iter=1)
    result = lfrtorch.fit(start, train, judge, trainer=trainer)
    expected = lfrtorch.rmse(
        replace(judge, skip=skip), result.model.simulate(replace(judge, skip=skip))
    )
    kept = result.history[result.chosen_iteration]
    assert kept.validation == pytest.approx(expected, rel=1e-6)
    short = replace(judge[:9], start="estimated")
    with pytest.raises(lfrtorch.InputError, match="9 samples, too few to determine the start"):
        lfrtorch.fit(start, train, short, trainer=trainer)
