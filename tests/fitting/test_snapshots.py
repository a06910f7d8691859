"""A fit that was interrupted ends as if it had not been, to the last bit."""

import copy
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from reference import measure, random_cell, random_model
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from lfrtorch._support.atomic import TEMPORARY
from lfrtorch._support.reasons import Reason
from lfrtorch.data.records import Record, Start
from lfrtorch.distributed import Ranks, using
from lfrtorch.fitting import state_file, trainer
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.trainer import Fit, FitResult, Progress
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

STARTS: tuple[Start, ...] = ("zero", "given", "periodic", "estimated")


class Sine(torch.nn.Linear):
    """w = sin(W z + b), a map that is not compiled."""

    def forward(self, input: Tensor) -> Tensor:
        return torch.sin(super().forward(input))


def own_map() -> dict[str, Any]:
    torch.manual_seed(0)
    return {"static": Sine(2, 1, dtype=torch.float64), "nz": 2}


def measured(kind: Start, seed: int, **sizes: Any) -> Record:
    """A record of the true model whose start is of that kind."""
    truth = random_model(random_cell(**sizes, radius=0.7))
    if kind in ("zero", "periodic"):
        return measure(truth, 60, seed=seed, start=kind)
    late = measure(truth, 80, seed=seed)
    return replace(late[20:], start=kind, x0=[0.3, -0.2] if kind == "given" else None)


def records(
    kinds: Sequence[Start] = STARTS, validation: Start = "estimated", **sizes: Any
) -> tuple[list[Record], Record]:
    """One record of each kind of start, and one for validation."""
    train = [measured(kind, seed, **sizes) for seed, kind in enumerate(kinds)]
    return train, measured(validation, 9, **sizes)


def starts(count: int, **sizes: Any) -> list[Model]:
    return [random_model(random_cell(**sizes, radius=0.7, seed=10 + i)) for i in range(count)]


class Stop:
    """A monitor that interrupts after so many calls."""

    def __init__(self, after: int) -> None:
        self.left = after

    def __call__(self, model: Model, progress: Progress) -> None:
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt


def outcome(result: FitResult) -> tuple:
    """All of a result that is to be the same, durations left out."""
    weights = parameters_to_vector(result.model.lfr.parameters()).tolist()
    history = [asdict(p) | {"seconds": 0} for p in result.history]
    return weights, result.chosen_iteration, result.reason, result.starts, history


def run(
    models: Sequence[Model],
    data: tuple[list[Record], Record],
    folder: Path | None = None,
    stop: int = 0,
    own_stop: Callable[[], bool] | None = None,
    **options: Any,
) -> FitResult:
    options |= {"snapshots": Snapshots(folder, 0.0), "stop": own_stop}
    return fit(models, *data, monitors=[[Stop(stop)] if stop else [] for _ in models], **options)


# --- one start ------------------------------------------------------------------------------


def stand(fit: Fit) -> dict[str, Any]:
    """All that the next steps of a fit depend on, and all that its result is made of."""
    found, tensors = state_file.packed(fit.at)
    return copy.deepcopy({"at": found, **tensors, "problem": fit.problem.state_dict()})


def same(one: Any, other: Any) -> bool:
    """Whether two are alike in every bit; NaN is like NaN."""
    if type(one) is not type(other):
        return False
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other or (isinstance(one, float) and math.isnan(one) and math.isnan(other))


KINDS = {kind: (kind,) for kind in STARTS} | {"mixed": STARTS}


@pytest.mark.parametrize(
    "optimiser",
    [LevenbergMarquardt(max_iter=5), Adam(max_iter=5, learning_rate=1e-2)],
    ids=["levenberg_marquardt", "adam"],
)
@pytest.mark.parametrize(
    ("kinds", "sizes"),
    [*((KINDS[name], dict) for name in KINDS), (STARTS, own_map)],
    ids=[*KINDS, "mixed, own map"],
)
def test_all_of_a_fit_comes_back_from_its_file(
    tmp_path: Path, kinds: Sequence[Start], sizes: Any, optimiser: Any
):
    """A fit goes on from a file written midway, and from one written at a pause."""
    (train, _), validation = records(kinds, **sizes()), measured("zero", 9, **sizes())
    wanted: dict[Path, dict[str, Any]] = {}

    def keep(fit: Fit, paused: bool) -> None:
        if fit.state.iteration == (3 if paused else 2):
            file = tmp_path / ("paused" if paused else "killed")
            wanted[file] = stand(fit)
            fit.save(file)

    def begun(**options: Any) -> Fit:
        model, options = starts(1, **sizes())[0], options | {"ridge": 1e-3}
        return Fit(model, train, validation, trainer=optimiser, **options)

    whole = begun(keep=keep).advance(until=3).advance()
    assert len(wanted) == 2
    for file, state in wanted.items():
        again = begun()
        again.restore(file)
        found = stand(again)
        assert found.keys() == state.keys()
        assert not [name for name in state if not same(found[name], state[name])], file
        again.advance()
        assert outcome(again.result()) == outcome(whole.result()), file
        assert same(stand(again)["problem"], stand(whole)["problem"]), file


def test_ends_as_without_interruption(tmp_path: Path):
    data, optimiser = records(), LevenbergMarquardt(max_iter=6)
    whole = run(starts(1), data, trainer=optimiser, ridge=1e-3)
    for iterations in (2, 5):  # interrupted twice
        cut = run(starts(1), data, tmp_path, 3, trainer=optimiser, ridge=1e-3)
        assert (cut.reason, cut.iterations) == (Reason.INTERRUPTED, iterations)
    resumed = run(starts(1), data, tmp_path, trainer=optimiser, ridge=1e-3)
    assert outcome(resumed) == outcome(whole)


def test_minibatches_end_as_without_interruption(tmp_path: Path):
    """And their steps are more than the one of an epoch over all records."""
    (train, unused), validation = records(("zero", "estimated"))
    data, optimiser = ([train, unused] * 32, validation), Adam(max_iter=4, learning_rate=1e-2)
    whole = run(starts(1), data, trainer=optimiser)
    cut = run(starts(1), data, tmp_path, 3, trainer=optimiser)
    assert (cut.reason, cut.iterations) == (Reason.INTERRUPTED, 2)
    assert outcome(run(starts(1), data, tmp_path, trainer=optimiser)) == outcome(whole)
    few = run(starts(1), ([train, unused], validation), trainer=optimiser)
    assert whole.history[-1].train < few.history[-1].train < few.history[0].train


def test_seconds_before_an_interruption_count(tmp_path: Path):
    data, optimiser = records(["zero"], "zero"), LevenbergMarquardt(max_iter=6)
    first = run(starts(1), data, tmp_path, stop=4, trainer=optimiser)
    last = run(starts(1), data, tmp_path, trainer=optimiser)
    assert last.iterations > first.iterations
    assert last.seconds > last.history[-1].seconds - last.history[0].seconds


def test_several_starts_end_as_without_interruption(tmp_path: Path):
    data, optimiser = records(["zero", "periodic"]), LevenbergMarquardt(max_iter=8)
    whole = run(starts(3), data, trainer=optimiser)
    for stop in (2, 5):  # in the first round, and in the last
        folder = tmp_path / str(stop)
        folder.mkdir()
        cut = run(starts(3), data, folder, stop, trainer=optimiser)
        assert cut.reason == Reason.INTERRUPTED
        assert len(Snapshots(folder).rounds) == (stop == 5)
        resumed = run(starts(3), data, folder, trainer=optimiser)
        assert outcome(resumed) == outcome(whole)


def stop_after(count: int) -> Callable[[], bool]:
    """Asks to stop from the call of that number on."""
    calls = itertools.count()
    return lambda: next(calls) >= count


def test_a_start_that_had_not_begun_takes_part_after_that(tmp_path: Path):
    data, optimiser = records(["zero"], "zero"), LevenbergMarquardt(max_iter=8)
    whole = run(starts(3), data, trainer=optimiser)
    for after in range(2, 9):
        folder = tmp_path / str(after)
        folder.mkdir()
        cut = run(starts(3), data, folder, trainer=optimiser, own_stop=stop_after(after))
        assert cut.reason == Reason.INTERRUPTED
        assert outcome(run(starts(3), data, folder, trainer=optimiser)) == outcome(whole)


def test_a_fit_is_cut_short_if_a_start_beside_the_best_is(tmp_path: Path):
    data, optimiser = records(["zero"], "zero"), LevenbergMarquardt(max_iter=4)
    whole = run(starts(3), data, trainer=optimiser)
    ends = 0
    for after in range(9, 16):
        folder = tmp_path / str(after)
        folder.mkdir()
        cut = run(starts(3), data, folder, trainer=optimiser, own_stop=stop_after(after))
        if cut.reason != Reason.INTERRUPTED:
            assert outcome(cut) == outcome(whole)
            break
        ends += any(start.reason == Reason.ALL_ITERATIONS for start in cut.starts)
        assert outcome(run(starts(3), data, folder, trainer=optimiser)) == outcome(whole)
    assert ends


def test_more_iterations_than_were_asked_for(tmp_path: Path):
    data = records()
    for limit in (3, 9):
        optimiser = LevenbergMarquardt(max_iter=limit)
        assert run(starts(1), data, tmp_path, trainer=optimiser).iterations == limit
    whole = run(starts(1), data, trainer=LevenbergMarquardt(max_iter=9))
    resumed = run(starts(1), data, tmp_path, trainer=LevenbergMarquardt(max_iter=9))
    assert outcome(resumed)[0] == outcome(whole)[0]


def test_a_step_that_was_taken_back_is_taken_back_again(tmp_path, monkeypatch):
    """The state after a refusal is not that of the last iterate."""
    monkeypatch.setattr(trainer, "EXPLOSION", 0.0)
    train, validation = records()
    far = Record(validation.u, -validation.y, fs=validation.fs)  # the better the fit, the worse
    optimiser, refusals = LevenbergMarquardt(max_iter=12), []

    def keep(fit: Fit, paused: bool) -> None:
        assert fit.at is not None
        if not paused and fit.history[-1].score != fit.at.score:
            refusals.append(tmp_path / str(fit.state.iteration))
            fit.save(refusals[-1])

    whole = Fit(starts(1)[0], train, far, trainer=optimiser, keep=keep).advance().result()
    assert refusals
    for file in refusals[:2]:
        again = Fit(starts(1)[0], train, far, trainer=optimiser)
        again.restore(file)
        assert outcome(again.advance().result()) == outcome(whole)


@pytest.mark.parametrize(("every", "files"), [(0.0, 4), (1e9, 1)])
def test_files_are_written_when_it_is_time_and_at_the_end(
    tmp_path: Path, every: float, files: int, monkeypatch: pytest.MonkeyPatch
):
    written, save = [], Fit.save
    monkeypatch.setattr(Fit, "save", lambda fit, path: (written.append(path), save(fit, path)))
    options: Any = {"trainer": LevenbergMarquardt(max_iter=3)}
    fit(starts(1), *records(["zero"]), snapshots=Snapshots(tmp_path, every), **options)
    assert written == files * [tmp_path / "0.safetensors"]


def test_the_best_score_of_all(tmp_path: Path):
    assert Snapshots(tmp_path).least == Snapshots().least == float("inf")
    result = run(starts(3), records(), tmp_path, trainer=LevenbergMarquardt(max_iter=2))
    assert Snapshots(tmp_path).least == min(p.score for p in result.history)
    # What a kill left half written is no start.
    (tmp_path / f"{TEMPORARY}0.safetensors").write_bytes(b"half")
    (tmp_path / ".0-half.safetensors").write_bytes(b"as an older version named it")
    assert Snapshots(tmp_path).least == min(p.score for p in result.history)


def test_processes_forget_the_periodic_orbits_of_the_first(tmp_path: Path):
    """The guesses on disk are those of the first process's records."""

    class Second(Ranks):
        rank, world = 1, 2

    model = random_model(random_cell(radius=0.7))
    data = [measure(model, 50, seed=i, start="periodic") for i in range(3)]  # two are the first's
    fit = Fit(starts(1)[0], data[::2], trainer=LevenbergMarquardt(max_iter=3))
    fit.advance(until=2).save(tmp_path / "fit")
    with using(Second()):
        again = Fit(starts(1)[0], data, trainer=LevenbergMarquardt(max_iter=3))
    again.restore(tmp_path / "fit")
    alone = Fit(again.model, data[1::2]).problem
    # Of one point to the tolerance of the steady state, 1e-10, times the gain.
    torch.testing.assert_close(
        again.state.residual, alone.residual(again.state.theta), rtol=0, atol=1e-8
    )


def test_the_first_process_alone_writes_files(tmp_path: Path):
    snapshots = Snapshots(tmp_path, 0.0, writes=False)
    options: Any = {"trainer": LevenbergMarquardt(max_iter=2), "snapshots": snapshots}
    assert fit(starts(3), *records(), **options).iterations == 2
    assert list(tmp_path.iterdir()) == []


# --- what cannot go on ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "now", "trainer", "message"),
    [
        (starts(2), starts(3), LevenbergMarquardt(), r"has 2 start\(s\), but 3 are given"),
        (starts(1), starts(2)[1:], LevenbergMarquardt(), "had another start"),
        (starts(1), starts(1), LevenbergMarquardt(max_iter=1), "has had 2 iterations, more than "),
        (starts(1), starts(1), Adam(max_iter=3), "another trainer than Adam"),
    ],
)
def test_another_fit_does_not_go_on(tmp_path: Path, before, now, trainer: Any, message: str):
    data = records(["zero"], "zero")
    run(before, data, tmp_path, trainer=LevenbergMarquardt(max_iter=2))
    with pytest.raises(ValueError, match=message):
        run(now, data, tmp_path, trainer=trainer)


@pytest.mark.parametrize("name", ["0.safetensors", "rounds.json"])
def test_a_damaged_file(tmp_path: Path, name: str):
    run(starts(2), records(), tmp_path, trainer=LevenbergMarquardt(max_iter=1))
    path = tmp_path / name
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(ValueError, match=r"damaged .*init_from=DIR"):
        run(starts(2), records(), tmp_path)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("0.safetensors", b'"iteration\\": 1', b'"iteration\\": 9'),
        ("rounds.json", b'"starts": 1', b'"starts": "x"'),
        ("rounds.json", b"[]", b"[1]"),
        ("rounds.json", b"[]", b'[["x"]]'),
        ("rounds.json", b"[]", b"9" * 5000),
    ],
)
def test_numbers_that_were_not_written(tmp_path: Path, name: str, old: bytes, new: bytes):
    run(starts(1), records(), tmp_path, trainer=LevenbergMarquardt(max_iter=1))
    path = tmp_path / name
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(ValueError, match=r"damaged .*init_from=DIR"):
        run(starts(1), records(), tmp_path)


def test_a_file_of_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as changed:
        changed.setattr(state_file, "_FORMAT", "lfrtorch snapshot 0")
        run(starts(1), records(), tmp_path, trainer=LevenbergMarquardt(max_iter=1))
    with pytest.raises(ValueError, match="another version"):
        run(starts(1), records(), tmp_path)
