"""Settings that validate best, by Optuna."""

from __future__ import annotations

import json
import math
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_line import file_overrides
from omegaconf import DictConfig

from lfrtorch.cli import compare, search, study
from lfrtorch.cli.composition import parsed

optuna = pytest.importorskip("optuna", reason="needs optuna: pip install 'lfrtorch[search]'")
from optuna.distributions import (  # noqa: E402
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import TrialState, create_trial  # noqa: E402

SHORT = ["nx=1", "trainer.max_iter=16", "bla.max_iter=1", "figures=false"]


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("nn=5,10", CategoricalDistribution(["5", "10"])),
        ("init=paper,zero_output", CategoricalDistribution(["paper", "zero_output"])),
        ("nn=range(2,9)", IntDistribution(2, 8)),
        ("nn=range(2,9,5)", IntDistribution(2, 7, step=5)),
        ("ridge=range(0,1,0.5)", CategoricalDistribution(["0.0", "0.5"])),
        ("nn=int(interval(2,9))", IntDistribution(2, 9)),
        ("ridge=tag(log,interval(1e-8,1e-2))", FloatDistribution(1e-8, 1e-2, log=True)),
    ],
)
def test_values_of_a_word_are_a_distribution(word: str, expected: Any):
    assert search.distribution(parsed(word)) == expected


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nx=1"], "no word has several values"),
        (["nx=1,2", "trials=none"], "trials is none; give a whole number"),
        (["nx=1,2", "workers=0"], "workers is 0"),
        (["nx=1,2", "minutes=-1"], "minutes is -1; give a number above 0"),
        (["nx=1,2", "objective=time"], "objective is time; give error, front, front_time"),
        (["nm=1,2"], "there is no setting 'nm'"),
    ],
)
def test_words_that_cannot_be_searched_are_refused(words: list[str], said: str):
    with pytest.raises(ValueError, match=said):
        search.plan(words)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The folders of runs whose error is least at nn = 7, and which fails at nn = 3."""
    made: list[str] = []

    def job(work: Any, cfg: DictConfig, folder: Path, *, hydra: Any) -> float:
        made.append(folder.name)
        (folder / study.FAILED).write_text("nn is 3")
        return math.nan if cfg.nn == 3 else 1.0 + abs(cfg.nn - 7)

    monkeypatch.setattr(study, "job", job)
    monkeypatch.setattr(compare, "run", lambda folders: None)
    return made


def test_a_search_goes_on_in_its_folder(
    tmp_path: Path, runs: list[str], capsys: pytest.CaptureFixture[str]
):
    words = ["nx=1", "nn=range(2,12)", f"out={tmp_path}"]
    search.search([*words, "trials=4"])
    assert len(runs) == 4
    assert "best: nn=" in capsys.readouterr().out
    search.search([*words, "trials=4"])
    assert len(runs) == 4
    search.search([*words, "trials=5"])
    assert len(runs) == 5
    with pytest.raises(ValueError, match="whose runs have other settings"):
        search.search(["nx=2", *words[1:]])


def test_a_trial_whose_worker_was_killed_is_tried_again(
    tmp_path: Path, runs: list[str], monkeypatch: pytest.MonkeyPatch
):
    found = search.plan(["nx=1", "nn=range(2,12)", f"out={tmp_path}", "trials=2"])
    left = search.opened(found).ask(found.space)
    search.try_again(found, search.opened(found))  # its worker may be about to begin
    assert search.begun(search.opened(found)) == 1
    later = SimpleNamespace(now=lambda: datetime.now() + timedelta(seconds=2 * search.BEGINS))
    monkeypatch.setattr(search, "datetime", later)
    search.folder_of(found, left.params).mkdir()
    with study.alone(search.folder_of(found, left.params)):
        search.try_again(found, search.opened(found))  # it is at work
    assert search.begun(search.opened(found)) == 1
    search.work(found)
    assert runs[0] == f"nn={left.params['nn']}"
    assert len(runs) == 2


def test_a_run_that_others_leave_behind_is_pruned(tmp_path: Path):
    found = search.plan(["nx=1", "nn=range(2,12)", f"out={tmp_path}"])
    opened = search.opened(found)
    for _ in range(search.TRIED):
        done = create_trial(
            params={"nn": 5},
            distributions=found.space,
            intermediate_values={i: 1.0 / (1 + i) for i in range(10)},
            value=0.1,
        )
        opened.add_trial(done)
    trial = opened.ask(found.space)
    told: Any = search.report(tmp_path, trial._trial_id, least=3)
    progress = [SimpleNamespace(iteration=i, train=2.0, validation=math.nan) for i in range(4)]
    for each in progress[:3]:
        told(None, each)
    with pytest.raises(search.PrunedError, match="pruned after 3 iterations"):
        told(None, progress[3])


def test_a_front_is_of_errors_beside_what_they_cost(tmp_path: Path, runs: list[str]):
    for objective, cost in (("front", 5), ("front_time", 0.5)):
        folder = tmp_path / objective
        for nn in range(2, 12):
            run = folder / f"nn={nn}"
            run.mkdir(parents=True)
            metrics = {"parameters_net": 5, "fit": {"seconds": 0.5}}
            (run / "metrics.json").write_text(json.dumps(metrics))
        words = ["nx=1", "nn=range(2,12)", f"out={folder}", f"objective={objective}"]
        found = search.plan([*words, "trials=4"])
        search.work(found)
        whole = [t.values for t in search.opened(found).trials if t.state == TrialState.COMPLETE]
        assert whole
        assert all(value[1] == cost for value in whole)


@pytest.mark.slow
def test_workers_share_a_search_of_fits(csv: Path, tmp_path: Path):
    words = [*file_overrides(csv), *SHORT, "nn=range(2,5)", "ridge=interval(0.0,0.1)"]
    search.search([*words, f"out={tmp_path}", "trials=6", "workers=2"])
    found = search.opened(search.plan([*words, f"out={tmp_path}"]))
    states = [trial.state for trial in found.trials]
    assert len(states) in (6, 7)
    assert set(states) <= {TrialState.COMPLETE, TrialState.PRUNED}
    assert (tmp_path / "comparison.html").is_file()
    assert (
        search.folder_of(found=search.plan([*words, f"out={tmp_path}"]), params=found.best_params)
        / "model"
    ).is_dir()
