"""Several runs by one command."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
from command_line import ROOT, file_overrides, launched
from hydra.types import RunMode
from omegaconf import OmegaConf

from lfrtorch.cli import sweep

SHORT = ["nx=1", "trainer.max_iter=2", "bla.max_iter=1", "figures=false"]


def test_folders_have_names_of_a_length_that_file_systems_take():
    long = sweep.folder_name("data.path=" + "/a" * 300)
    assert long != sweep.folder_name("data.path=" + "/a" * 301)
    assert len(long) <= 120
    assert "/" not in long


def test_what_several_runs_cannot_have_is_refused(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ValueError, match="resume is of one run"):
        sweep.words_of_runs(["-m", "resume=runs/a"])
    monkeypatch.setattr(sweep, "find_spec", lambda _: None)
    with pytest.raises(ValueError, match=r"pip install 'lfrtorch\[sweep\]'"):
        sweep.words_of_runs(["-m", "hydra/launcher=joblib"])


@pytest.mark.parametrize(
    ("mode", "launcher", "given", "found"),
    [
        (RunMode.RUN, {"_target_": "a.JoblibLauncher"}, None, None),
        (RunMode.MULTIRUN, {"_target_": "a.BasicLauncher"}, None, None),
        (RunMode.MULTIRUN, {"_target_": "a.JoblibLauncher"}, None, 1),
        (RunMode.MULTIRUN, {"_target_": "a.JoblibLauncher"}, 3, 3),
        (RunMode.MULTIRUN, {"_target_": "a.SlurmLauncher", "cpus_per_task": 4}, None, 4),
    ],
)
def test_runs_beside_others_have_the_threads_that_are_theirs(mode, launcher, given, found):
    job = OmegaConf.create({"mode": mode, "launcher": launcher})
    assert sweep.threads(job, given) == found


@pytest.mark.numeric
@pytest.mark.usefixtures("untraced")
def test_a_run_that_fails_stops_no_other_and_none_is_replaced(csv, tmp_path, monkeypatch, capfd):
    few = ["-m", str(csv), "inputs=u", "outputs=y", "fs=10", "start=zero"]
    few += [*SHORT, f"hydra.sweep.dir={tmp_path}"]
    with pytest.raises(SystemExit) as ended:
        launched(monkeypatch, *few, "nn=0,2")
    assert ended.value.code == 1
    said = capfd.readouterr().err
    assert "error: nn is 0" in said
    assert "the run nn=0 failed" in said
    assert "in one_of_several" not in said  # no traceback
    before = (tmp_path / "nn=2" / "metrics.json").read_text()
    with pytest.raises(SystemExit):
        launched(monkeypatch, *few, "nn=2,3")
    assert "holds a run" in capfd.readouterr().err
    assert (tmp_path / "nn=2" / "metrics.json").read_text() == before
    assert (tmp_path / "nn=3" / "model").is_dir()
    table = subprocess.run(
        [sys.executable, ROOT / "scripts" / "compare.py", tmp_path],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert len(re.findall(r"nn=[23] +\*? +\d+ +[\d.e-]+", table)) == 2
    assert "maximum number of iterations" in table


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_runs_are_started_at_once(csv: Path, tmp_path: Path, launcher: str):
    package = sweep.LAUNCHERS[launcher]
    if find_spec(package) is None:
        pytest.skip(f"needs {package}: pip install 'lfrtorch[sweep]'")
    words = ["-m", *file_overrides(csv), *SHORT, "nn=2,3", "seed=0,1"]
    words += [f"hydra.sweep.dir={tmp_path}", f"hydra/launcher={launcher}"]
    subprocess.run([sys.executable, "-m", "lfrtorch.cli", "fit", *words], cwd=ROOT, check=True)
    assert len([*tmp_path.glob("nn=*,seed=*/metrics.json")]) == 4


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_all_runs_and_keeps_what_the_present_one_found(
    csv: Path, tmp_path: Path, number: signal.Signals
):
    words = ["-m", *file_overrides(csv), "nx=1", "trainer.max_iter=100000", "figures=false"]
    words += ["trainer.tolerance=0", "nn=2", "seed=0,1", f"hydra.sweep.dir={tmp_path}"]
    process = subprocess.Popen(
        [sys.executable, "-m", "lfrtorch.cli", "fit", *words],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    deadline = time.monotonic() + 300
    while not [*tmp_path.glob("*/resume/*.safetensors")]:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(number)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + number, said
    assert (tmp_path / "seed=0" / "model").is_dir()
    assert not (tmp_path / "seed=1").exists()
