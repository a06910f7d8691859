"""Several runs by one command."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import ROOT, file_overrides, launched
from omegaconf import DictConfig, OmegaConf

from lfrtorch.cli import study

HYDRA = OmegaConf.create({
    "overrides": {"task": ["nn=2", "seed=0"]},
    "launcher": {"_target_": "joblib"},
})  # fmt: skip
CORES = {"joblib": ["hydra.launcher.n_jobs=2"]}
SHORT = ["nx=1", "trainer.max_iter=2", "bla.max_iter=1", "figures=false"]


def settings(**given: object) -> DictConfig:
    return OmegaConf.create({"overwrite": False, "resume": None, "threads": None, **given})


def written(folder: Path, command: str = "lfrtorch fit nn=2 seed=0", reason: str = "converged"):
    metrics: dict[str, Any] = {"command": command, "fit": {"reason": reason}}
    metrics |= {"validation": {"rmse": 0.5}, "ranking": [{"train": 0.1}]}
    (folder / "metrics.json").write_text(json.dumps(metrics))


def test_folders_have_names_of_a_length_that_file_systems_take():
    long = study.folder_name("data.path=" + "/a" * 300)
    assert long != study.folder_name("data.path=" + "/a" * 301)
    assert len(long) == study._LONGEST
    assert "/" not in long


def test_a_run_is_done_if_it_ended_with_the_same_words(tmp_path: Path):
    assert study.done(tmp_path, ["nn=2", "seed=0"]) is None
    written(tmp_path)
    assert study.done(tmp_path, ["seed=0", "nn=2", "overwrite=false"]) == 0.5
    assert study.done(tmp_path, ["nn=3", "seed=0"]) is None
    written(tmp_path, reason="interrupted")
    assert study.done(tmp_path, ["nn=2", "seed=0"]) is None


def killed(_: DictConfig) -> float:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0.0


def refused(_: DictConfig) -> float:
    print("error: nn is 0.", file=sys.stderr)
    raise SystemExit(1)


def broken(_: DictConfig) -> float:
    raise KeyError("a bug")


def quarter(_: DictConfig) -> float:
    return 0.25


def threads_and_folder(cfg: DictConfig, folder: str) -> float:
    return float(cfg.threads == 1 and cfg.resume == folder)


@pytest.mark.parametrize(
    ("work", "why"), [(killed, "killed by SIGKILL"), (refused, "nn is 0."), (broken, "KeyError")]
)
def test_a_run_that_fails_says_why_and_is_begun_again(
    tmp_path: Path, work: Callable[[DictConfig], float], why: str
):
    assert study.job(work, settings(), tmp_path, hydra=HYDRA) != 0.25
    assert why in (tmp_path / study.FAILED).read_text()
    assert study.job(quarter, settings(), tmp_path, hydra=HYDRA) == 0.25
    assert not (tmp_path / study.FAILED).exists()


def by_two_threads(_: DictConfig) -> float:
    torch.set_num_threads(2)
    return torch.ones(400_000).exp().sum().item()


def test_a_run_waits_for_no_threads_of_the_process_that_starts_it(tmp_path: Path):
    before = torch.get_num_threads()
    try:
        value = by_two_threads(settings())
    finally:
        torch.set_num_threads(before)
    found = study.job(by_two_threads, settings(), tmp_path, hydra=HYDRA)
    assert found == pytest.approx(value)


def test_a_run_that_is_done_is_not_begun_and_one_that_was_killed_goes_on(tmp_path: Path):
    (tmp_path / "resume").mkdir()
    asked = settings()
    work = partial(threads_and_folder, folder=str(tmp_path))
    assert study.job(work, asked, tmp_path, hydra=HYDRA) == 1.0
    written(tmp_path)
    assert study.job(broken, settings(), tmp_path, hydra=HYDRA) == 0.5
    assert study.job(quarter, settings(overwrite=True), tmp_path, hydra=HYDRA) == 0.25


def test_a_folder_is_of_one_study(tmp_path: Path):
    before = {"hydra": {"overrides": {"task": ["nx=2", "seed=0,1"]}}}
    OmegaConf.save(OmegaConf.create(before), tmp_path / "multirun.yaml")
    folder = f"hydra.sweep.dir={tmp_path}"
    study.study_words(["-m", "nx=2", "seed=range(9)", "nn=2,3", folder])
    with pytest.raises(ValueError, match=r"other settings \(nx=2, nx=3\)"):
        study.study_words(["-m", "nx=3", "seed=0,1", folder])
    study.study_words(["-m", "nx=3", "seed=0,1", folder, "overwrite=true"])
    with pytest.raises(ValueError, match="several go on by the same command"):
        study.study_words(["-m", f"resume={tmp_path}"])


def test_a_launcher_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(study, "find_spec", lambda _: None)
    with pytest.raises(ValueError, match=r"pip install 'lfrtorch\[sweep\]'"):
        study.study_words(["-m", "hydra/launcher=joblib"])


def test_processes_that_are_killed_are_replaced(capsys: pytest.CaptureFixture[str]):
    class TerminatedWorkerError(BrokenProcessPool):
        """As joblib's."""

    calls: list[int] = []

    def once_killed() -> None:
        calls.append(1)
        if len(calls) == 1:
            raise TerminatedWorkerError

    study.went_on(once_killed)
    assert len(calls) == 2
    assert "going on" in capsys.readouterr().err
    with pytest.raises(KeyError):
        study.went_on(lambda: broken(settings()))


@pytest.mark.numeric
@pytest.mark.usefixtures("untraced")
def test_runs_follow_each_other(csv, tmp_path, monkeypatch, capfd):
    few = ["-m", str(csv), "inputs=u", "outputs=y", "fs=10", "start=zero"]
    words = ["-m", *file_overrides(csv), *SHORT, "nn=2,0", f"hydra.sweep.dir={tmp_path}"]
    with pytest.raises(SystemExit):
        launched(monkeypatch, *few, *SHORT, "nn=2,0", f"hydra.sweep.dir={tmp_path}")
    said = capfd.readouterr().out
    assert "1 of 2 runs" in said
    assert "nn=0: failed: nn is 0" in said
    run = tmp_path / "nn=2"
    assert (run / "model").is_dir()
    assert "NL-LFR" in (run / study.LOG).read_text()
    with suppress(SystemExit):
        launched(monkeypatch, *words)
    assert "nn=2: done before" in capfd.readouterr().out
    table = subprocess.run(
        [sys.executable, ROOT / "scripts" / "compare.py", tmp_path],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert re.search(r"nn=2 +\* +\d+ +[\d.e-]+", table)
    assert "maximum number of iterations" in table


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_runs_at_once_survive_a_process_that_is_killed(csv: Path, tmp_path: Path, launcher: str):
    package = study.LAUNCHERS[launcher]
    if find_spec(package) is None:
        pytest.skip(f"needs {package}: pip install 'lfrtorch[sweep]'")
    words = ["-m", *file_overrides(csv), *SHORT, "nn=2,3", "seed=0,1"]
    words += [f"hydra.sweep.dir={tmp_path}", f"hydra/launcher={launcher}"]
    words += CORES.get(launcher, [])
    process = subprocess.Popen(
        [sys.executable, "-m", "lfrtorch.cli", "fit", *words],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    deadline = time.monotonic() + 300
    while not (workers := [pid for pid in below(process.pid) if works(pid)]):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.kill(workers[0], signal.SIGKILL)
    said, _ = process.communicate(timeout=300)
    assert "a process was killed: going on" in said
    assert "4 of 4 runs" in said
    assert process.returncode == 0, said


def test_a_study_whose_runs_failed_says_so(tmp_path, capsys):
    for name, file in (("nn=2", "metrics.json"), ("nn=3", study.FAILED)):
        (tmp_path / name / ".hydra").mkdir(parents=True)
        (tmp_path / name / ".hydra" / "overrides.yaml").write_text("[]")
        (tmp_path / name / file).write_text("{}" if file == "metrics.json" else "nn is 3")
    report: Any = study.Report()
    with pytest.raises(SystemExit) as ended:
        report.on_multirun_end(OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}}))
    assert ended.value.code == 1
    said = capsys.readouterr()
    assert "1 of 2 runs" in said.out
    assert "nn is 3" in said.out


def below(pid: int) -> list[int]:
    """The processes that a process started, and those that they did."""
    listed = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True)
    pairs = [tuple(map(int, line.split())) for line in listed.stdout.splitlines()]
    found = [pid]
    for one in found:
        found += [child for child, parent in pairs if parent == one]
    return found[1:]


def works(pid: int) -> bool:
    """Whether it is a process of joblib or submitit that runs share."""
    try:
        command = Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return False
    return any(name in command for name in ("popen_loky", "submitit.core._submit"))
