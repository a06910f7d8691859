"""Sizes and ridge by cross-validation, and what the choice is worth on data it has not seen."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch import Choice, LinearModel, Model, Record
from lfrtorch.distributed import using
from lfrtorch.fitting import choice as procedure
from lfrtorch.fitting.trainer import StoppedError


def measured(strength: float, samples: int = 400, seed: int = 0, noise: float = 0.05) -> Record:
    """A first-order system before a saturation of some strength, with noise."""
    rng = np.random.default_rng(seed)
    u, x = rng.standard_normal(samples), np.zeros(samples)
    for k in range(samples - 1):
        x[k + 1] = 0.8 * x[k] + 0.5 * u[k]
    y = np.tanh(strength * x) / strength if strength else x
    return Record(u, y + noise * rng.standard_normal(samples), skip=20)


def start(bla: LinearModel, train: Sequence[Record], sizes: dict[str, int], seed: int) -> Model:
    options: dict[str, Any] = dict(sizes)
    return lfrtorch.initialise(bla, train, seed=seed, **options)


def chosen(records: Record | list[Record], **options: Any) -> Choice:
    def linear(nx: int) -> LinearModel:
        return lfrtorch.estimate_bla(records, nx)

    given: dict[str, Any] = {"given": {"nz": 1, "nw": 1}, "orders": [1, 2]}
    given |= options
    return procedure.choose_sizes(records, given.pop("orders"), linear, start, **given)


@pytest.fixture(scope="module")
def saturating() -> Choice:
    return chosen(measured(2.0))


def nested(choice: Choice) -> float:
    """Error of the NL-LFR over the linear model's, in what had no part in the choice."""
    pairs = [(r.errors(y), r.errors(linear)) for r, linear, y in choice.left_out]
    own, linear = (np.concatenate(errors) for errors in zip(*pairs, strict=True))
    return float(np.sqrt(np.mean(own**2) / np.mean(linear**2)))


def test_a_saturation_is_found_with_few_parameters(saturating: Choice):
    sizes = saturating.chosen.sizes
    assert (saturating.nx, sizes["nx"], sizes["nz"], sizes["nw"]) == (1, 1, 1, 1)
    assert saturating.chosen.ratio < 0.5
    assert saturating.chosen.parameters_net < 40


def test_nested_errors_tell_new_data(saturating: Choice):
    new = measured(2.0, samples=4000, seed=9, noise=0.0)
    train = measured(2.0)
    bla = lfrtorch.estimate_bla(train, 1)
    sizes = {n: s for n, s in saturating.chosen.sizes.items() if n != "nx"}
    model = start(bla, [train], sizes, 0)
    lfrtorch.fit(model, train, ridge=saturating.chosen.ridge, monitors=[])
    noise = 0.05
    errors = [np.hypot(lfrtorch.rmse(new, m.simulate(new)), noise) for m in (model, bla)]
    assert nested(saturating) == pytest.approx(errors[0] / errors[1], rel=0.25)


@pytest.mark.usefixtures("short_paths")
def test_a_linear_system_is_not_called_nonlinear():
    found = chosen(measured(0.0))
    assert nested(found) > 0.98
    # Nothing is gained by the first sizes, so that no others are tried.
    assert len({tuple(c.sizes.values()) for c in found.candidates}) <= 4


def test_left_out_is_each_scored_sample_once(saturating: Choice):
    ((record, linear, y),) = saturating.left_out
    assert record.skip == 20
    assert not np.any(linear[20:] == record.y[20:])
    assert np.array_equal(y[:20], record.y[:20])
    assert saturating.counts.sum() == 380


@pytest.mark.usefixtures("short_paths")
def test_a_fold_sees_nothing_of_what_is_left_out():
    """Other outputs in a stretch change nothing of what simulates it but the choice."""
    train = measured(1.0, samples=240)
    y = train.y.copy()
    y[20:75] += 5.0
    given = {"nx": 1, "nz": 1, "nw": 1, "nn": 2}
    spoilt = Record(train.u, y, skip=20)
    bla = lfrtorch.estimate_bla(train, 1)
    first, other = (
        procedure.choose_sizes(r, [1], lambda nx: bla, start, given=given) for r in (train, spoilt)
    )
    pairs = zip(first.candidates, other.candidates, strict=True)
    for one, two in pairs:
        assert np.allclose(one.outputs[0], two.outputs[0], rtol=1e-3, atol=1e-3)


def test_orders_go_two_beyond_that_of_the_scan(monkeypatch):
    seen = list[int]()

    def choose(records: Sequence[Record], orders: Sequence[int], *_: Any, **__: Any) -> Choice:
        seen.extend(orders)
        raise StoppedError("these are enough")

    monkeypatch.setattr("lfrtorch.fitting.sizes.choose_sizes", choose)
    dataset = lfrtorch.Dataset("one", [measured(0.0)], [measured(0.0, seed=1)], [])
    settings = lfrtorch.Settings(nx="auto", nz=1, nw=1, nn="auto")
    with pytest.raises(StoppedError):
        lfrtorch.identify(dataset, settings, observer=lfrtorch.Observer())
    assert seen == [1, 2, 3]


@pytest.mark.usefixtures("short_paths")
def test_a_pole_slower_than_the_record_has_to_pay():
    """It follows the drift of this record; of the system it says nothing."""
    rng = np.random.default_rng(4)
    u, y = rng.standard_normal(200), np.zeros(200)
    for k in range(199):
        y[k + 1] = 0.6 * y[k] + u[k]
    record = Record(u, y + 0.06 * np.cumsum(rng.standard_normal(200)))
    given = {"nx": 1, "nz": 1, "nw": 1, "nn": 1}
    assert chosen(record, orders=[1, 2, 3], given=given, ridge=10.0).nx == 1


@pytest.mark.usefixtures("short_paths")
def test_sizes_given_are_kept():
    found = chosen(measured(1.0), given={"nx": 2, "nz": 2, "nw": 1, "nn": 3}, orders=[2])
    assert {tuple(c.sizes.items()) for c in found.candidates} == {
        (("nx", 2), ("nz", 2), ("nw", 1), ("nn", 3))
    }
    ridges = [c.ridge for c in found.candidates if isinstance(c.ridge, float)]
    assert len(ridges) == len(found.candidates)
    assert ridges == sorted(ridges, reverse=True)


def test_smaller_ridges_are_not_tried_after_two_that_are_worse(monkeypatch):
    monkeypatch.setattr(procedure, "_RIDGES", [(10.0**-k, 2) for k in range(5)])
    monkeypatch.setattr(procedure, "_WORSE", 0.0)  # all after the first are
    found = chosen(measured(1.0, 200), given={"nx": 1, "nz": 1, "nw": 1, "nn": 2}, orders=[1])
    assert [c.ridge for c in found.candidates] == [1.0, 0.1, 0.01]


def test_a_ridge_that_is_given_is_that_of_all_fits():
    given = {"nx": 2, "nz": 1, "nw": 1}
    found = chosen(measured(1.0), given=given, orders=[2], ridge={"static": 0.1})
    assert all(c.ridge == {"static": 0.1} for c in found.candidates)
    assert "{'static': 0.1}" in found.table()


@pytest.mark.usefixtures("short_paths")
def test_several_records_and_periodic_ones_are_cut():
    rng = np.random.default_rng(3)
    u = np.tile(rng.standard_normal(60), 4)
    x = np.zeros(240)
    for k in range(239):
        x[k + 1] = 0.8 * x[k] + 0.5 * u[k]
    steady = Record(u[60:], np.tanh(x[60:]), start="periodic", period=60)
    found = chosen([measured(1.0, 150), steady], given={"nz": 1, "nw": 1, "nn": 3}, orders=[1])
    assert [record.samples for record, *_ in found.left_out] == [150, 180]
    assert np.isfinite(found.chosen.ratio)


def test_records_too_short_say_so():
    with pytest.raises(ValueError, match=r"scored samples, of which 4 stretches"):
        chosen(measured(1.0, samples=50))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seed": "one"}, "seed is 'one'"),
        ({"last": "neurons"}, "last is 'neurons'; give one of nz, nw, nn, degree"),
        ({"linear": lambda nx: nx}, "linear returned 2; it is to return a LinearModel"),
        ({"start": lambda *_: None}, "start returned None; it is to return a Model"),
    ],
)
def test_what_is_not_to_be_used_is_named(change: dict[str, Any], said: str):
    record = measured(1.0)
    given: dict[str, Any] = {
        "linear": lambda nx: lfrtorch.estimate_bla(record, nx),
        "start": start,
        **change,
    }
    with pytest.raises(lfrtorch.LfrtorchError, match=said):
        procedure.choose_sizes(record, [2], **given)


def test_a_stop_before_the_first_sizes_ends_the_choice():
    with pytest.raises(StoppedError, match="while sizes were chosen"):
        chosen(measured(1.0), stop=lambda: True)


@pytest.mark.usefixtures("short_paths")
def test_a_stop_later_keeps_the_best_sizes_so_far():
    said = list[str]()

    def stop() -> bool:
        return any(text.startswith("sizes:") for text in said)

    found = chosen(measured(2.0), stop=stop, watch=said.append)
    assert len({tuple(c.sizes.values()) for c in found.candidates}) == 1
    assert found.chosen in found.candidates
    assert "note: stopped while sizes were chosen: the best so far go on" in said


@pytest.mark.usefixtures("short_paths")
def test_sizes_that_do_not_forget_where_they_began_are_refused(monkeypatch):
    def memory(model: Model, *_: Any, **__: Any) -> lfrtorch.Memory:
        return lfrtorch.Memory(1.0 if model.sizes["nn"] == 8 else 0.0)

    monkeypatch.setattr(procedure, "forgets", memory)
    said = list[str]()
    found = chosen(measured(2.0), watch=said.append)
    remember = [c for c in found.candidates if c.sizes["nn"] == 8]
    assert remember
    assert all(c.remembers and c.ratio == np.inf for c in remember)
    assert found.chosen.sizes["nn"] != 8
    assert any(f"note: {len(remember)} of {len(found.candidates)} candidates" in t for t in said)


@pytest.mark.usefixtures("short_paths")
def test_where_all_sizes_run_away_the_smallest_is_chosen_and_has_no_error(monkeypatch):
    monkeypatch.setattr(procedure, "forgets", lambda *_, **__: lfrtorch.Memory(np.inf))
    said = list[str]()
    found = chosen(measured(2.0), watch=said.append)
    assert any("note: all sizes run away" in text and "has radius 0." in text for text in said)
    assert found.chosen.parameters_net == min(c.parameters_net for c in found.candidates)
    assert not np.isfinite(nested(found))


def test_table_has_a_line_for_each_size_and_marks_the_chosen(saturating: Choice):
    lines = saturating.table().splitlines()
    sizes = {tuple(c.sizes.values()) for c in saturating.candidates}
    assert sum("chosen" in line for line in lines[: len(sizes) + 2]) == 1
    assert len(lines) == len(sizes) + 2 + len(procedure.LEGEND.splitlines())
    entries = saturating.entries()
    assert sum(entry["chosen"] for entry in entries) == 1


@pytest.mark.usefixtures("short_paths")
def test_all_processes_take_the_choice_of_the_first():
    class Other(lfrtorch.distributed.Ranks):
        """A process that is told the numbers of the first."""

        def first(self, part: torch.Tensor) -> torch.Tensor:
            squares = torch.full_like(part, 4.0)
            squares[-1] = 1.0
            return squares

    with using(Other()):
        found = chosen(measured(2.0))
    assert found.chosen is found.candidates[-1]
