"""Processes that share a fit, its records or starts: that of one, and what is left of a loss."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, normal, random_cell, random_model, unscaled
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from lfrtorch._support.reasons import Reason
from lfrtorch.cli.command import start as start_command
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.distributed import ProcessLostError, Ranks, connect, using
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.trainer import FitResult, Progress
from lfrtorch.least_squares import jacobian
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt, LMState
from lfrtorch.least_squares.shared_problem import problem_of
from lfrtorch.model.loading import load
from lfrtorch.model.model import Model
from lfrtorch.reporting.monitor import Checkpoint

ROOT = Path(__file__).resolve().parents[1]
TESTS = Path(__file__).resolve().parent


def case() -> tuple[Model, list[Record], Record]:
    """A model some way off, records of three lengths and starts of the true one, and another."""
    truth, model = (random_model(random_cell(1, 1, 2, 1, 1, 3, radius=0.7)) for _ in range(2))
    late = measure(truth, 120, seed=2)
    train = [
        measure(truth, 80),
        measure(truth, 60, seed=1, start="periodic"),
        Record(late.u[20:], late.y[20:], late.fs, "estimated", inputs=late.inputs,
               outputs=late.outputs),
    ]  # fmt: skip
    vector = theta(model)
    vector = vector + 0.05 * normal(len(vector), seed=9)
    vector_to_parameters(vector, model.lfr.parameters())
    return model, train, measure(truth, 50, seed=3)


def dataset() -> Dataset:
    """The same for train.py."""
    _, train, other = case()
    return Dataset("several", train, [other], [other])


def theta(model: Model) -> Tensor:
    return parameters_to_vector(model.lfr.parameters()).detach().clone()


@dataclass(frozen=True)
class Dying(LevenbergMarquardt):
    """Levenberg-Marquardt, killed or stopped on one of the processes."""

    rank: int = 1
    at: int = 3
    by: str = "SIGKILL"

    def step(self, problem: Any, state: LMState) -> LMState:
        spared = "SPARED" in os.environ
        if not spared and state.iteration == self.at and os.environ.get("RANK") == str(self.rank):
            os.kill(os.getpid(), signal.Signals[self.by])
        return super().step(problem, state)


# --- processes ------------------------------------------------------------------------------


def start(task: Callable[[Ranks], Any], folder: Path, train: bool = False) -> list[Any]:
    """What each of two processes saved of a task, one file each.

    Args:
        task: done by both of them.
        folder: where they work, and leave what else they write.
        train: have them run train.py before.
    """
    ports = []
    with ExitStack() as taken:
        for _ in range(2):
            free = taken.enter_context(socket.socket())
            free.bind(("127.0.0.1", 0))
            ports.append(free.getsockname()[1])
    server = multiprocessing.get_context("forkserver")  # what both need is imported once
    server.set_forkserver_preload(["lfrtorch._public", "hydra.main", "torch.utils.tensorboard"])
    processes = [
        server.Process(target=_work, args=(task, folder, rank, ports, train)) for rank in range(2)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(300)  # a hang, not a slow machine
        assert process.exitcode is not None
    files = [folder / f"{rank}.pt" for rank in range(2)]
    return [torch.load(file, weights_only=False) for file in files]


def _work(
    task: Callable[[Ranks], Any], folder: Path, rank: int, ports: list[int], train: bool
) -> None:
    torch.set_num_threads(1)
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1"}
    if train:
        os.environ["MASTER_PORT"] = str(ports[0])
        _train(folder / "train", rank)
    os.environ["MASTER_PORT"] = str(ports[1])
    warnings.simplefilter("error")
    os.chdir(folder)
    with connect(timeout=30) as ranks:
        task(ranks)


def _train(folder: Path, rank: int) -> None:
    """train.py as torchrun starts it; what it prints is in a file beside the folder."""
    folder.mkdir(exist_ok=True)
    os.chdir(folder)
    sys.argv = ["train.py", *SETTINGS, "trainer.max_iter=3"]
    with (folder.parent / f"{rank}.out").open("w") as out, redirect_stdout(out):
        start_command("fit")


# --- the same fit ---------------------------------------------------------------------------

FITS: dict[str, tuple[Any, float, float]] = {  # optimiser, ridge, NORMAL of the Jacobian
    "normal equations": (LevenbergMarquardt(max_iter=6), 0.0, 0.0),
    "orthogonal": (LevenbergMarquardt(max_iter=6), 0.0, math.inf),
    "normal equations, ridge": (LevenbergMarquardt(max_iter=6), 1e-2, 0.0),
    "orthogonal, ridge": (LevenbergMarquardt(max_iter=6), 1e-2, math.inf),
}
ADAM = {"adam": (Adam(max_iter=20, learning_rate=1e-2), 1e-2, jacobian.NORMAL)}


def fitted(name: str, ranks: Ranks) -> tuple[Tensor, FitResult]:
    optimiser, ridge, regime = (FITS | ADAM)[name]
    usual, jacobian.NORMAL = jacobian.NORMAL, regime
    try:
        model, train, validation = case()
        if ranks.rank == 1:  # starts from what the first process has all the same
            vector_to_parameters(2.0 * theta(model), model.lfr.parameters())
        result = fit(model, train, validation, trainer=optimiser, ridge=ridge, ranks=ranks)
        return theta(model), result
    finally:
        jacobian.NORMAL = usual


def slope(ranks: Ranks) -> dict[str, Any]:
    """Cost, gradients and error of the start."""
    model, train, _ = case()
    with using(ranks):
        problem = problem_of(model, train, ridge=1e-2)
    at = problem.theta + 0.01
    point, gradient = problem.gradient(at)
    system, product = problem.linearise(at).system(0.0, 1e-12)
    found = {"cost": torch.tensor(point.cost), "rmse": torch.tensor(problem.rmse_at(point))}
    found |= {"gradient": gradient, "product": product, "scale": torch.tensor(system.scale)}
    return found | {"step": system.solve(product, 0.1), "start": problem.theta}


def averaged(ranks: Ranks) -> tuple[Tensor, int]:
    """Weights of a mean of starts, without validation, and of how many."""
    models, (_, train, _) = [case()[0], case()[0]], case()
    optimiser = LevenbergMarquardt(max_iter=2)
    result = fit(models, train, trainer=optimiser, average=2, ranks=ranks)
    return theta(result.model), result.averaged


def starts() -> tuple[list[Model], list[Record], Record]:
    """Five starts, and one record, which two processes cannot share."""
    truth = random_model(random_cell(1, 1, 2, 1, 1, 3, radius=0.7))
    train = measure(truth, 120)
    models = [random_model(random_cell(1, 1, 2, 1, 1, 3, radius=0.6)) for _ in range(5)]
    for number, model in enumerate(models):
        vector = theta(model) * (1 + 0.2 * normal(len(theta(model)), seed=number))
        vector_to_parameters(vector, model.lfr.parameters())
    return models, [train], measure(truth, 60, seed=3)


def spread(ranks: Ranks, folder: Path | None = None) -> FitResult:
    """The fit from these starts, which two processes share."""
    models, train, validation = starts()
    trainer = LevenbergMarquardt(max_iter=12)
    latest = [0] * len(models)

    def watch(number: int) -> Callable[[Model, Progress], None]:
        return lambda model, progress: latest.__setitem__(number, progress.iteration)

    watching = [[watch(number)] for number in range(len(models))]
    snapshots = Snapshots(folder, every=0.0, writes=ranks.rank == 0)
    result = fit(
        models, train, validation, validation[:50], trainer=trainer, average=2, ranks=ranks,
        monitors=watching, snapshots=snapshots,
    )  # fmt: skip
    assert latest == [s.iterations for s in sorted(result.starts, key=lambda s: s.number)]
    return result


def everything(ranks: Ranks) -> None:
    """All that two processes do together, and at last one of them is lost."""
    found: dict[str, Any] = {name: fitted(name, ranks) for name in FITS}
    found["averaged"] = averaged(ranks)
    found["spread"] = spread(ranks, Path("starts"))
    found["stopped"] = stopped(ranks)
    found["slope"] = slope(ranks)
    rows = normal(2 * ranks.rank, 3, seed=ranks.rank)
    found["stacked"] = ranks.stack(rows), ranks.first(normal(3 - ranks.rank, 2))
    model, train, _ = case()
    try:
        fit(model, train[:1], ranks=ranks)
    except ValueError as error:
        found["refusal"] = str(error)
    torch.save(found, f"{ranks.rank}.pt")
    torch.save(losing(ranks), "left.pt")


def stopped(ranks: Ranks) -> tuple[str, int]:
    """How it ends if the second process alone is asked to stop."""
    calls: list[int] = []

    def stop() -> bool:
        calls.append(0)
        return ranks.rank == ranks.world - 1 and len(calls) > 20

    models, train, validation = starts()
    result = fit(models, train, validation, stop=stop, ranks=ranks, monitors=[[]] * 5)
    return result.reason, len(result.starts)


def losing(ranks: Ranks) -> Any:
    model, train, validation = case()
    monitors = [Checkpoint("model", every=0.0)] if ranks.rank == 0 else []
    begin = time.monotonic()
    options: Any = {"trainer": Dying(max_iter=50), "monitors": monitors, "ranks": ranks}
    result = fit(model, train, validation, **options)
    seconds = time.monotonic() - begin
    try:
        ranks.sum(torch.ones(1))
    except ProcessLostError as error:
        return unscaled(model), result, seconds, str(error)


def adam(ranks: Ranks) -> None:
    torch.save({"adam": fitted("adam", ranks)}, f"{ranks.rank}.pt")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ranks")


@pytest.fixture(scope="module")
def both(folder: Path) -> list[dict[str, Any]]:
    return start(everything, folder, train=True)


@pytest.mark.numeric
def test_two_processes_take_one_mean(both: list[dict[str, Any]]):
    (first, count), (second, other) = (found["averaged"] for found in both)
    assert count == other == averaged(Ranks())[1] == 2
    assert torch.equal(first, second)


@pytest.mark.numeric
def test_starts_that_processes_share_end_as_on_one(both: list[dict[str, Any]], folder: Path):
    alone = spread(Ranks())
    for result in (found["spread"] for found in both):
        np.testing.assert_allclose(theta(result.model), theta(alone.model), rtol=1e-9, atol=1e-12)
        assert result.averaged == alone.averaged
        for mine, theirs in zip(result.starts, alone.starts, strict=True):
            assert (mine.number, mine.iterations, mine.reason) == (
                theirs.number, theirs.iterations, theirs.reason
            )  # fmt: skip
            assert mine.selection == pytest.approx(theirs.selection, rel=1e-9)
        assert len(result.history) == len(alone.history)
    assert len(list((folder / "starts").glob("[0-9].safetensors"))) == len(alone.starts)


@pytest.mark.numeric
def test_a_longer_fit_of_shared_starts_goes_on_on_one(both: list[dict[str, Any]], folder: Path):
    models, train, validation = starts()
    result = fit(
        models, train, validation, validation[:50], trainer=LevenbergMarquardt(max_iter=12),
        average=2, snapshots=Snapshots(folder / "starts", writes=False),
    )  # fmt: skip
    before = both[0]["spread"]
    np.testing.assert_allclose(theta(result.model), theta(before.model), rtol=1e-9, atol=1e-12)
    assert [s.number for s in result.starts] == [s.number for s in before.starts]


def test_one_process_that_stops_ends_all_starts(both: list[dict[str, Any]]):
    (reason, count), other = (found["stopped"] for found in both)
    assert other == (reason, count)
    assert reason == Reason.INTERRUPTED
    assert count == 5


@pytest.mark.numeric
@pytest.mark.parametrize("name", FITS)
def test_two_processes_fit_as_one(name: str, both: list[dict[str, Any]]):
    agree(name, both)


@pytest.mark.slow
def test_two_processes_fit_as_one_by_adam(tmp_path: Path):
    agree("adam", start(adam, tmp_path))


def agree(name: str, both: list[dict[str, Any]]):
    """The fit of two processes is the same on both, and that of one."""
    expected, alone = fitted(name, Ranks())
    (first, result), (second, other) = (found[name] for found in both)
    assert torch.equal(first, second)
    assert result.iterations == other.iterations == alone.iterations == result.history[0].limit
    assert result.chosen_iteration == other.chosen_iteration == alone.chosen_iteration
    # Sums in another order are other in the last digit, 1e-16. A problem that is as badly
    # conditioned as 1e6 makes 1e-10 of it, and more iterations would make more.
    np.testing.assert_allclose(first, expected, rtol=1e-9, atol=1e-9)
    for mine, theirs in zip(result.history, alone.history, strict=True):
        assert mine.train == pytest.approx(theirs.train, rel=1e-8)
        assert mine.validation == pytest.approx(theirs.validation, rel=1e-8)


@pytest.mark.numeric
def test_cost_and_gradient_are_those_of_all_records(both: list[dict[str, Any]]):
    expected = slope(Ranks())
    for name, value in expected.items():
        first, second = (found["slope"][name] for found in both)
        assert torch.equal(first, second), name
        # The periodic state is known to 1e-10.
        torch.testing.assert_close(first, value, rtol=1e-9, atol=1e-9)


def test_parts_of_other_shapes(both: list[dict[str, Any]]):
    for found in both:
        stacked, first = found["stacked"]
        assert torch.equal(stacked, normal(2, 3, seed=1))
        assert torch.equal(first, normal(3, 2))


@pytest.mark.parametrize(("starts", "sharing"), [(2, 3), (3, 1), (16, 1)])
def test_as_many_starts_as_processes_are_shared_and_else_the_records(starts: int, sharing: int):
    ranks = Ranks()
    ranks.world = 3
    assert ranks.sharing_records(starts).world == sharing
    assert Ranks().sharing_records(starts).world == 1


def test_more_processes_than_records(both: list[dict[str, Any]]):
    for found in both:
        assert "share 1 record(s), but each needs one; start fewer" in found["refusal"]


def test_outside_torchrun_a_process_is_alone(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with connect() as ranks:
        assert type(ranks) is Ranks
    with pytest.raises(ValueError, match="timeout is 0"):
        connect(timeout=0)


# --- a lost process -------------------------------------------------------------------------


@pytest.mark.usefixtures("both")
def test_a_lost_process_ends_the_fit_with_the_best_model(folder: Path):
    best, result, seconds, again = torch.load(folder / "left.pt", weights_only=False)
    assert result.reason == Reason.PROCESS_LOST
    assert result.detail.startswith("rank 0 of 2 has no answer from rank 1 (")
    assert result.outcome == f"a process was lost: {result.detail}"
    assert again.startswith(Reason.PROCESS_LOST)
    assert result.iterations == 3
    assert seconds < 20
    assert torch.equal(unscaled(load(folder / "model")), best)


# --- train.py -------------------------------------------------------------------------------


SETTINGS = ["+data._target_=test_distributed.dataset", "name=several", "nx=2", "nn=3"]
SETTINGS += ["figures=false"]


def torchrun(*words: str, folder: Path, **env: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(TESTS), str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    return subprocess.run(
        [sys.executable, *command, str(ROOT / "train.py"), *words],
        capture_output=True, text=True, check=False, cwd=folder, timeout=100,
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"} | env,
    )  # fmt: skip


def run_folder(folder: Path) -> Path:
    """The one run there; nothing else was written."""
    assert [p.name for p in folder.iterdir()] == ["runs"]
    assert [p.name for p in (folder / "runs").iterdir()] == ["several"]
    (found,) = (folder / "runs" / "several").iterdir()
    assert len(list(found.glob("events.out.tfevents.*"))) == 1
    assert not list(found.glob(".model*"))
    return found


@pytest.mark.usefixtures("both")
def test_two_processes_make_one_run(folder: Path):
    one_run(folder / "train", "".join((folder / f"{rank}.out").read_text() for rank in range(2)))


@pytest.mark.slow
def test_torchrun_makes_one_run(tmp_path: Path):
    done = torchrun(*SETTINGS, "trainer.max_iter=3", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    one_run(tmp_path, done.stdout)


def one_run(folder: Path, printed: str):
    """The files and the text of one run, whatever the number of processes."""
    assert printed.count("training samples") == printed.count("Run in") == 1
    folder = run_folder(folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["fit"]["iterations"] == 3
    assert metrics["command"].startswith("torchrun --nproc-per-node 2 train.py +data._target_")
    assert load(folder).sizes["nx"] == 2


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_a_killed_process_leaves_the_last_model(rank: int, tmp_path: Path):
    dying = ["trainer._target_=test_distributed.Dying", f"+trainer.rank={rank}"]
    done = torchrun(*SETTINGS, *dying, folder=tmp_path)
    assert done.returncode != 0
    folder = run_folder(tmp_path)
    said = " ".join(done.stderr.split())  # lines are as long as a terminal's
    assert f"rank {1 - rank} of 2 has no answer from rank {rank} (" in said
    assert f"the best model so far is in {folder / 'model'}; to go on: " in said
    assert load(folder).sizes["nx"] == 2
    if rank == 1:  # the first process goes on to score what there is
        metrics = json.loads((folder / "metrics.json").read_text())
        assert metrics["fit"]["reason"].startswith(Reason.PROCESS_LOST)


@pytest.mark.slow
@pytest.mark.parametrize("starts", [1, 4])
def test_a_stuck_process_is_taken_for_lost(starts: int, tmp_path: Path):
    stuck = ["trainer._target_=test_distributed.Dying", "+trainer.by=SIGSTOP", "timeout=5"]
    done = torchrun(*SETTINGS, *stuck, f"starts={starts}", folder=tmp_path)
    assert done.returncode != 0
    said = " ".join(done.stderr.split())
    assert "rank 0 of 2 has no answer from rank 1 (" in said
    assert "to go on: torchrun --nproc-per-node 2 train.py resume=" in said
    assert load(run_folder(tmp_path)).sizes["nx"] == 2


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_a_killed_process_of_shared_starts_costs_no_result(rank: int, tmp_path: Path):
    dying = ["trainer._target_=test_distributed.Dying", f"+trainer.rank={rank}", "+trainer.at=17"]
    shared = [*SETTINGS, "starts=4", "trainer.max_iter=40"]
    once, broken = (tmp_path / name for name in ("once", "broken"))
    for folder in (once, broken):
        folder.mkdir()
    assert torchrun(*shared, folder=once).returncode == 0
    done = torchrun(*shared, *dying, folder=broken)
    assert done.returncode != 0
    (folder,) = (broken / "runs" / "several").iterdir()
    said = " ".join(done.stderr.split())
    assert f"rank {1 - rank} of 2 has no answer from rank {rank} (" in said
    code = [word for word in (*shared, *dying) if "_target_" in word]  # which no folder may name
    again = torchrun(f"resume={folder}", *code, folder=broken, SPARED="1")
    assert again.returncode == 0, again.stderr[:3000]
    one, other = (theta(load(run)) for run in (run_folder(once), folder))
    np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-12)
