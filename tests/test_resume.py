"""A fit that was interrupted ends as if it had not been, to the last bit."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
from reference import measure, random_cell, random_model
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from lfrtorch import snapshot, trainer
from lfrtorch.adam import Adam
from lfrtorch.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.model import Model
from lfrtorch.multistart import fit_starts
from lfrtorch.ranks import Ranks
from lfrtorch.records import Record
from lfrtorch.resume import Snapshots
from lfrtorch.trainer import INTERRUPTED, Fit, FitResult, Progress


class Sine(torch.nn.Linear):
    """w = sin(W z + b), a map that is not compiled."""

    def forward(self, input: Tensor) -> Tensor:
        return torch.sin(super().forward(input))


def own_map() -> dict[str, Any]:
    torch.manual_seed(0)
    return {"static": Sine(2, 1, dtype=torch.float64), "nz": 2}


def records(**sizes: Any) -> tuple[list[Record], Record]:
    """One record of each kind of start, and one for validation."""
    truth = random_model(random_cell(**sizes, radius=0.7))
    train = [measure(truth, 150), measure(truth, 100, seed=1, start="periodic")]
    unknown = measure(truth, 120, seed=3)[20:]
    return [*train, Record(unknown.u, unknown.y, fs=unknown.fs, start="estimated")], measure(
        truth, 150, seed=2
    )


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
    **options: Any,
) -> FitResult:
    monitors = [[Stop(stop)] if stop else [] for _ in models]
    return fit_starts(models, *data, monitors=monitors, snapshots=Snapshots(folder, 0.0), **options)


@pytest.mark.parametrize(
    ("optimiser", "sizes"),
    [
        (LevenbergMarquardt(max_iter=12), dict),
        (LevenbergMarquardt(max_iter=7), own_map),
        (Adam(epochs=12, learning_rate=1e-2), dict),
    ],
    ids=["compiled", "own map", "adam"],
)
def test_ends_as_without_interruption(tmp_path: Path, optimiser: Any, sizes: Any):
    data = records(**sizes())
    whole = run(starts(1, **sizes()), data, optimiser=optimiser, ridge=1e-3)
    for iterations in (2, 5):  # interrupted twice
        cut = run(starts(1, **sizes()), data, tmp_path, 3, optimiser=optimiser, ridge=1e-3)
        assert (cut.reason, cut.iterations) == (INTERRUPTED, iterations)
    resumed = run(starts(1, **sizes()), data, tmp_path, optimiser=optimiser, ridge=1e-3)
    assert outcome(resumed) == outcome(whole)


@pytest.mark.parametrize("stop", [2, 7])
def test_several_starts_end_as_without_interruption(tmp_path: Path, stop: int):
    data, optimiser = records(), LevenbergMarquardt(max_iter=16)
    whole = run(starts(5), data, optimiser=optimiser)
    assert run(starts(5), data, tmp_path, stop, optimiser=optimiser).reason == INTERRUPTED
    resumed = run(starts(5), data, tmp_path, optimiser=optimiser)
    assert outcome(resumed) == outcome(whole)


def test_a_run_that_is_killed_loses_what_came_after_the_last_file(tmp_path: Path):
    """A file of an earlier iteration leads to the same end."""
    (train, validation), optimiser = records(), LevenbergMarquardt(max_iter=6)
    file = tmp_path / "0.safetensors"

    def keep(fit: Fit, paused: bool) -> None:
        if fit.history and fit.state.iteration == 3 and not paused:
            fit.save(file)

    fit = Fit(starts(1)[0], train, validation, optimiser=optimiser, keep=keep).advance()
    again = Fit(starts(1)[0], train, validation, optimiser=optimiser)
    again.restore(file)
    assert again.state.iteration == 3
    assert outcome(again.advance().result()) == outcome(fit.result())


def test_more_iterations_than_were_asked_for(tmp_path: Path):
    data = records()
    for limit in (3, 9):
        optimiser = LevenbergMarquardt(max_iter=limit)
        assert run(starts(1), data, tmp_path, optimiser=optimiser).iterations == limit
    whole = run(starts(1), data, optimiser=LevenbergMarquardt(max_iter=9))
    resumed = run(starts(1), data, tmp_path, optimiser=LevenbergMarquardt(max_iter=9))
    assert outcome(resumed)[0] == outcome(whole)[0]


def test_a_step_that_was_taken_back_is_taken_back_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The state after a refusal is not that of the last iterate."""
    monkeypatch.setattr(trainer, "EXPLOSION", 0.0)
    train, validation = records()
    far = Record(validation.u, -validation.y, fs=validation.fs)  # the better the fit, the worse
    optimiser, refusals = LevenbergMarquardt(max_iter=12), []

    def keep(fit: Fit, paused: bool) -> None:
        if not paused and fit.history[-1].score != fit._score:
            refusals.append(tmp_path / str(fit.state.iteration))
            fit.save(refusals[-1])

    whole = Fit(starts(1)[0], train, far, optimiser=optimiser, keep=keep).advance().result()
    assert refusals
    for file in refusals[:2]:
        again = Fit(starts(1)[0], train, far, optimiser=optimiser)
        again.restore(file)
        assert outcome(again.advance().result()) == outcome(whole)


def test_the_best_score_of_all(tmp_path: Path):
    assert Snapshots(tmp_path).least == Snapshots().least == float("inf")
    result = run(starts(3), records(), tmp_path, optimiser=LevenbergMarquardt(max_iter=2))
    assert Snapshots(tmp_path).least == min(p.score for p in result.history)


def test_processes_take_their_own_residuals(tmp_path: Path):
    """The residual on disk is the first one's alone."""

    class Two(Ranks):
        world = 2

    data, optimiser = records()[0], LevenbergMarquardt(max_iter=3)
    ranks = Ranks()
    fit = Fit(starts(1)[0], data, optimiser=optimiser, ranks=ranks).advance(until=2)
    fit.save(tmp_path / "fit")
    again = Fit(starts(1)[0], data, optimiser=optimiser, ranks=ranks)
    again.ranks = Two()
    again.restore(tmp_path / "fit")
    assert torch.equal(again.state.residual, again.problem.residual(again.state.theta))


# --- what cannot go on ----------------------------------------------------------------------


def test_another_number_of_starts(tmp_path: Path):
    run(starts(2), records(), tmp_path, optimiser=LevenbergMarquardt(max_iter=1))
    with pytest.raises(ValueError, match=r"has 2 start\(s\), and now there are 3"):
        run(starts(3), records(), tmp_path)


def test_another_start(tmp_path: Path):
    run(starts(1), records(), tmp_path, optimiser=LevenbergMarquardt(max_iter=1))
    with pytest.raises(ValueError, match="began elsewhere"):
        run(starts(2)[1:], records(), tmp_path)


def test_fewer_iterations_than_it_has_had(tmp_path: Path):
    run(starts(1), records(), tmp_path, optimiser=LevenbergMarquardt(max_iter=3))
    with pytest.raises(ValueError, match="has had 3 iterations, more than the 2 asked for"):
        run(starts(1), records(), tmp_path, optimiser=LevenbergMarquardt(max_iter=2))


def test_another_optimiser(tmp_path: Path):
    run(starts(1), records(), tmp_path, optimiser=LevenbergMarquardt(max_iter=1))
    with pytest.raises(ValueError, match="another optimiser than Adam"):
        run(starts(1), records(), tmp_path, optimiser=Adam(epochs=3))


@pytest.mark.parametrize("name", ["0.safetensors", "rounds.json"])
def test_a_damaged_file(tmp_path: Path, name: str):
    run(starts(2), records(), tmp_path, optimiser=LevenbergMarquardt(max_iter=1))
    path = tmp_path / name
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(ValueError, match=r"damaged .*init_from=DIR"):
        run(starts(2), records(), tmp_path)


def test_a_file_of_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as changed:
        changed.setattr(snapshot, "FORMAT", "lfrtorch snapshot 2")
        run(starts(1), records(), tmp_path, optimiser=LevenbergMarquardt(max_iter=1))
    with pytest.raises(ValueError, match="another version"):
        run(starts(1), records(), tmp_path)
