"""Several starts of one fit: who goes on, and that each is what it is alone."""

import copy
import math
import threading
from dataclasses import replace
from itertools import pairwise
from typing import Any, cast

import pytest
import torch
from reference import measure, move, planted, random_cell, random_model, theta, unscaled
from torch import Tensor
from torch.nn.utils import vector_to_parameters

import lfrtorch
from lfrtorch._support.reasons import Reason
from lfrtorch._support.threads import worth_threads
from lfrtorch.data.metrics import rmse
from lfrtorch.data.records import Record
from lfrtorch.distributed import Ranks
from lfrtorch.engine.cell import LFRCell
from lfrtorch.fitting import side_by_side
from lfrtorch.fitting.means import mean_model
from lfrtorch.fitting.multistart import Round, fit, iterations_of, schedule
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.trainer import Progress
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


def several(count: int = 5, T: int = 60) -> tuple[list[Model], list[Record], Record]:
    """Models at growing distances from the true one, training and validation records."""
    _, train, validation = planted(T)
    models = []
    for i in range(count):
        model = random_model(random_cell(radius=0.7))
        move(model, 0.05 * (i + 1))
        models.append(model)
    return models, train, validation


def test_eight_starts_share_two_and_a_half_fits():
    planned = schedule(8, 200)
    assert planned == [(8, 13), (4, 25), (2, 200)]
    assert iterations_of(planned) == 8 * 13 + 4 * 12 + 2 * 175


def test_the_better_half_goes_on_round_by_round():
    models, train, validation = several()
    rounds: list[Round] = []
    optimiser = LevenbergMarquardt(max_iter=32, tolerance=0)
    result = fit(models, train, validation, trainer=optimiser, watch=rounds.append)
    assert [(r.number, r.count) for r in rounds] == [(1, 3), (2, 3), (3, 3)]
    assert [len(r.starts) for r in rounds] == [5, 3, 2]
    for one, following in pairwise(rounds):
        kept = {start.number for start in one.starts[: len(following.starts)]}
        assert {start.number for start in following.starts} == kept
    for one in rounds:
        errors = [start.validation for start in one.starts]
        assert errors == sorted(errors)
    ends = {start.number: start.iterations for start in result.starts}
    assert ends == {start.number: start.iterations for one in rounds for start in one.starts}
    assert sorted(ends.values())[:3] == [2, 2, 4]
    assert min(ends[start.number] for start in rounds[-1].starts) > 4
    assert [start.reason == Reason.OTHERS_BETTER for start in result.starts].count(True) == 3


def test_the_best_start_is_what_it_is_alone():
    models, train, validation = several()
    optimiser = LevenbergMarquardt(max_iter=8)
    result = fit(models, train, validation, trainer=optimiser)
    number = result.starts[0].number
    assert result.model is models[number]
    (alone,) = several()[0][number : number + 1]
    expected = fit(alone, train, validation, trainer=optimiser)
    assert torch.equal(theta(result.model), theta(alone))
    assert [p.train for p in result.history] == [p.train for p in expected.history]
    assert result.chosen_iteration == expected.chosen_iteration
    assert min(s.validation for s in result.starts) == result.starts[0].validation


def test_results_do_not_depend_on_threads():
    found = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        models, train, validation = several()
        found.append(fit(models, train, validation, trainer=LevenbergMarquardt(8)))
    expected, *others = (result.starts for result in found)
    for other in others:
        # The last start alone has its work spread over all threads, which sum in another order.
        for one, alike in zip(expected, other, strict=True):
            assert (one.number, one.iterations) == (alike.number, alike.iterations)
            assert one.validation == pytest.approx(alike.validation, rel=1e-6)


@pytest.mark.parametrize("average", [1, 3])
def test_a_start_that_diverges_at_once_leaves_the_others_as_they_are(average: int, tmp_path):
    found = []
    for spoilt in (False, True):
        models, train, validation = several(3)
        if spoilt:
            with torch.no_grad():
                models[0].lfr.cell.A.mul_(50.0)
        optimiser = LevenbergMarquardt(max_iter=8)
        options: dict[str, Any] = {"trainer": optimiser, "average": average}
        options["snapshots"] = Snapshots(tmp_path / str(spoilt), every=0.0)
        own = models if spoilt else models[1:]
        found.append(fit(own, train, validation, **options))
    alone, beside = found
    assert torch.equal(theta(alone.model), theta(beside.model))
    lost = beside.starts[-1]
    assert (lost.number, lost.iterations, lost.reason) == (0, 0, Reason.START_DIVERGES)
    assert math.isinf(lost.train)


def test_one_start_is_a_fit():
    models, train, validation = several(1)
    result = fit(models, train, validation, trainer=LevenbergMarquardt(max_iter=6))
    (alone,) = several(1)[0]
    expected = fit(alone, train, validation, trainer=LevenbergMarquardt(max_iter=6))
    assert torch.equal(theta(result.model), theta(alone))
    assert result.reason == expected.reason
    assert len(result.starts) == 1


class Slow(LevenbergMarquardt):
    """8 s an iteration, by a clock of its own."""

    now = 1000.0

    def step(self, problem, state):
        Slow.now += 8.0
        return super().step(problem, state)


def test_a_fit_takes_as_long_as_its_rounds(monkeypatch):
    monkeypatch.setattr("time.perf_counter", lambda: Slow.now)
    models, train, validation = several(1, T=20)
    rounds: list[Round] = []
    result = fit(models, train, validation, trainer=Slow(max_iter=3), watch=rounds.append)
    assert [r.seconds for r in rounds] == [24.0]
    assert (result.seconds, result.seconds_per_iteration) == (24.0, 8.0)


def test_starts_without_validation_are_judged_on_training():
    models, train, _ = several(3)
    result = fit(models, train, trainer=LevenbergMarquardt(max_iter=1))
    assert all(math.isnan(start.validation) for start in result.starts)
    errors = [start.train for start in result.starts]
    assert errors == sorted(errors)


def test_selection_chooses_among_starts_and_not_among_iterates():
    models, train, validation = several(4)
    odd = random_model(random_cell(radius=0.7))
    vector_to_parameters(theta(models[2]), odd.lfr.parameters())
    # A record of the third start as it is: at the start it is the best there.
    selection = measure(odd, 60, seed=9)
    options: Any = {"trainer": LevenbergMarquardt(max_iter=3, tolerance=0)}
    result = fit(models, train, validation, selection, **options)
    for start in result.starts:
        (alone,) = several(4)[0][start.number : start.number + 1]
        until = LevenbergMarquardt(max_iter=start.iterations, tolerance=0)
        expected = fit(alone, train, validation, trainer=until)
        kept = expected.history[expected.chosen_iteration]
        assert start.validation == pytest.approx(kept.validation, rel=1e-9)
        errors = [rmse(record, alone.simulate(record)) for record in (validation, selection)]
        pooled = math.sqrt((errors[0] ** 2 + errors[1] ** 2) / 2)
        assert start.selection == pytest.approx(pooled, rel=1e-6)
    errors = [start.selection for start in result.starts]
    assert errors == sorted(errors)
    alone = fit(several(4)[0], train, selection=selection, **options)
    error = rmse(selection, alone.model.simulate(selection))
    assert alone.starts[0].selection == pytest.approx(error, rel=1e-6)
    by_validation = fit(several(4)[0], train, validation, **options)
    assert all(math.isnan(start.selection) for start in by_validation.starts)


class Sharing(Ranks):
    """Claims to be one of three processes, which have the same records."""

    world = 3

    def share(self, items: list) -> list:
        return items


def test_processes_that_share_records_fit_one_start_after_another():
    torch.set_num_threads(2)
    models, train, validation = several(2)
    train.append(validation)
    assert len(train) >= Sharing.world
    threads = set()
    monitors: Any = [[lambda *_: threads.add(threading.get_ident())]] * 2
    options: Any = {"trainer": LevenbergMarquardt(max_iter=2), "monitors": monitors}
    fit(models, train, validation, ranks=Sharing(), **options)
    assert threads == {threading.get_ident()}


def test_monitors_are_called_one_at_a_time():
    models, train, validation = several(4)
    busy = threading.Lock()

    def watch(model: Model, progress: Progress):
        assert busy.acquire(blocking=False)
        busy.release()

    def weights(model: Model, progress: Progress):
        own = theta(model)
        assert own.isfinite().all()

    optimiser = LevenbergMarquardt(max_iter=4)
    fit(models, train, validation, trainer=optimiser, monitors=[[watch, weights]] * 4)


@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_keeps_the_best_of_all(threads: int):
    models, train, validation = several(3)
    best: dict[int, tuple[float, Tensor]] = {}

    def watch(model: Model, progress: Progress):
        if progress.best:
            best[id(model)] = progress.score, unscaled(model)
        if progress.iteration == 3:
            raise KeyboardInterrupt

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        result = fit(models, train, validation, monitors=[[watch]] * 3)
    finally:
        torch.set_num_threads(before)
    assert result.reason == Reason.INTERRUPTED
    score, weights = min(best.values(), key=lambda each: each[0])
    assert torch.equal(unscaled(result.model), weights)
    assert result.history[result.chosen_iteration].score == score


def test_ctrl_c_in_one_of_small_fits_ends_those_that_wait():
    models, train, validation = several(3)
    begun = []

    def watch(model: Model, progress: Progress):
        begun.append(id(model))
        if progress.iteration == 1:
            raise KeyboardInterrupt

    result = fit(models, train, validation, monitors=[[watch]] * 3)
    assert result.reason == Reason.INTERRUPTED
    assert set(begun) == {id(models[0])}


def test_small_fits_do_not_wait_for_each_other_on_threads(monkeypatch: pytest.MonkeyPatch):
    models, train, validation = several(3)
    seen = set()

    def watch(model: Model, progress: Progress):
        seen.add(threading.get_ident())

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        for worth in (False, True):
            monkeypatch.setattr(side_by_side, "worth_threads", lambda *_, worth=worth: worth)
            seen.clear()
            fit(models, train, validation, monitors=[[watch]] * 3)
            assert (threading.get_ident() in seen) == (not worth)
    finally:
        torch.set_num_threads(before)
    assert not worth_threads(240, 90)
    assert worth_threads(100_000, 90)


def test_a_stop_after_some_have_come_to_the_end_of_their_round():
    models, train, validation = several(3)

    def stop(model: Model, progress: Progress):
        if model is models[2]:
            raise KeyboardInterrupt

    result = fit(models, train, validation, monitors=[[stop]] * 3)
    assert result.reason == Reason.INTERRUPTED
    assert {start.reason for start in result.starts} == {Reason.INTERRUPTED}


def test_a_failure_ends_all():
    models, train, validation = several(3)

    def fail(model: Model, progress: Progress):
        raise RuntimeError("no room on the disk")

    with pytest.raises(RuntimeError, match="no room"):
        fit(models, train, validation, monitors=[[fail]] * 3)


def test_mean_is_of_the_starts_that_there_are():
    models, train, _ = several(2)
    optimiser = LevenbergMarquardt(max_iter=1)
    assert fit(models, train, average=8, trainer=optimiser).averaged == 2
    assert fit(models[:1], train, average=8, trainer=optimiser).model is models[0]


def test_bad_calls_are_refused():
    models, train, _ = several(2)
    with pytest.raises(ValueError, match="no model to start from"):
        fit([], train)
    with pytest.raises(ValueError, match=r"models\[1\] is a str"):
        fit(cast(Any, [models[0], "model"]), train)
    twice = [*models, replace(models[0], fitted_to="again")]
    with pytest.raises(ValueError, match=r"models\[2\] shares its weights with models\[0\]"):
        fit(twice, train)
    with pytest.raises(ValueError, match=r"2 models and 1 lists"):
        fit(models, train, monitors=[[]])
    with pytest.raises(ValueError, match="average is 0"):
        fit(models, train, average=0)
    known = lfrtorch.Known(lambda x, u, p: (0.5 * x.h + u[0],), states=["h"], method="discrete")
    cell = LFRCell(1, 1, 1, 2, 2, known.map(1, ["h"], 1.0), dtype=torch.float64)
    with pytest.raises(ValueError, match="a mean of models has no parameters of its own"):
        fit([random_model(cell)], train, average=2, trainer=Adam(max_iter=10**9))


@pytest.mark.parametrize("judged_on", ["validation", "selection"])
def test_mean_of_as_many_starts_as_are_best_is_taken(judged_on: str):
    """Two on either side of the truth, and one that is farther away."""
    models, train, validation = several(3)
    for model, step in zip(models, (-0.03, -0.12, 0.0), strict=True):
        move(model, step)  # to 0.02, -0.02 and 0.15
    stay = LevenbergMarquardt(max_iter=0)
    options: Any = {judged_on: validation, "trainer": stay, "average": 3}
    result = fit(models, train, **options)
    assert all(start.reason != Reason.OTHERS_BETTER for start in result.starts)
    best = [models[start.number] for start in result.starts]
    means = [mean_model(best[:count]) for count in (1, 2, 3)]
    errors = [rmse(validation, mean.simulate(validation)) for mean in means]
    assert errors.index(min(errors)) == 1
    assert result.averaged == 2
    assert rmse(validation, result.model.simulate(validation)) == pytest.approx(errors[1])


def test_mean_of_more_starts_is_taken_if_it_is_as_good():
    """The best one is by some luck: here by less than 1 %."""
    models, train, validation = several(3)
    for i, model in enumerate(models):
        move(model, 0.1 + 3e-4 * i - 0.05 * (i + 1))  # to 0.1, 0.1003 and 0.1006
    stay = LevenbergMarquardt(max_iter=0)
    result = fit(models, train, validation, trainer=stay, average=3)
    assert result.averaged == 3
    best = min(start.validation for start in result.starts)
    assert rmse(validation, result.model.simulate(validation)) > best


def test_mean_of_starts_is_not_taken_if_one_is_better():
    models, train, validation = several(2)
    move(models[0], -0.05)  # the one that made the data
    optimiser = LevenbergMarquardt(max_iter=1)
    result = fit(models, train, validation, trainer=optimiser, average=2)
    assert result.averaged == 1
    assert result.model is models[0]


def noisy(record: Record) -> Record:
    noise = 0.1 * torch.randn(record.y.shape, generator=torch.manual_seed(0)).numpy()
    return replace(record, y=record.y + noise)


def test_means_have_the_error_of_starts_whose_fit_is_over_windows():
    models, train, validation = several(1)
    same = [models[0], copy.deepcopy(models[0])]
    options: Any = {"trainer": LevenbergMarquardt(max_iter=0), "average": 2}
    assert fit(same, train, noisy(validation), horizon=8, **options).averaged == 2


def test_means_have_the_error_of_starts_whose_predictions_count():
    models, train, validation = several(2)
    move(models[0], -0.05)  # the one that made the data
    move(models[1], 0.1)
    K = torch.zeros(models[0].lfr.cell.nx, 1, dtype=torch.float64)
    models = [replace(model, K=K) for model in models]
    options: Any = {"trainer": LevenbergMarquardt(max_iter=0), "average": 2}
    train, validation = [noisy(each) for each in train], noisy(validation)
    assert fit(models, train, validation, noise="innovation", **options).averaged == 1


def test_mean_of_starts_is_taken_where_nothing_tells():
    models, train, _ = several(3)
    optimiser = LevenbergMarquardt(max_iter=2)
    result = fit(models, train, trainer=optimiser, average=3)
    assert result.averaged == 3
    assert result.model.lfr.cell.nx == 3 * models[0].lfr.cell.nx
