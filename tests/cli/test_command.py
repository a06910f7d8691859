"""The command ``lfrtorch``: its help, at once and of its own settings."""

import gc
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from lfrtorch.cli import CONF, command, errors

ALL_HELP = """
import contextlib, sys
from lfrtorch.cli.command import COMMANDS, main
for word in COMMANDS:
    sys.argv = ["lfrtorch", word, "--help"]
    with contextlib.suppress(SystemExit):
        main()
print("loaded", *sorted({name.split(".")[0] for name in sys.modules}))
"""


HELP = {
    "preview": "PATH path= inputs= outputs= fs= time= test= out=",
    "linear": "data.path= nx=auto bla.refine= frf.method= +bench= linear.json",
    "evaluate": "checkpoint= out= overwrite=true +bench= data=file effect",
    "simulate": "checkpoint= data.path= data.inputs= data.outputs= data.time= data.fs= start= "
    "estimate= x0= skip= out= format= overwrite=",
}
"""Words that the help of a command has."""


OWN = {"linear": ("data/file", "bla/state_space"), "evaluate": ("data/file",)}
"""Files of settings that the help of a command lists."""


def test_garbage_is_collected_again_when_all_is_imported(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lfrtorch preview", "x.csv"])
    monkeypatch.setattr(command, "run", lambda *_: None)
    command.start("preview")
    assert gc.isenabled()


@pytest.mark.parametrize("word", HELP)
def test_help_says_how_to_use_it_and_leaves_nothing_behind(
    word: str, tmp_path: Path, monkeypatch, capsys
):
    """It lists the settings of the command and no others."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lfrtorch", word, "--help"])
    with pytest.raises(SystemExit) as stop:
        command.main()
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert [one for one in HELP[word].split() if one not in printed] == []
    for file in OWN.get(word, ()):
        names = [str(name) for name in OmegaConf.load(CONF / f"{file}.yaml") if name != "_target_"]
        if word == "evaluate":
            names.remove("reference")  # of use to the linear fit alone
        group = file.split("/")[0]
        assert [name for name in names if f"{group}.{name}" not in printed] == []
        assert "init_from" not in printed
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(("script", "word"), [("bla.py", "linear"), ("preview.py", "preview")])
def test_a_script_runs_anywhere(script: str, word: str, tmp_path: Path):
    done = subprocess.run(
        [sys.executable, str(CONF.parent / "scripts" / script), "--help"],
        capture_output=True, text=True, check=True, cwd=tmp_path,
    )  # fmt: skip
    assert [one for one in HELP[word].split() if one not in done.stdout] == []


def test_help_comes_without_what_computes():
    done = subprocess.run(
        [sys.executable, "-c", ALL_HELP], capture_output=True, text=True, check=True
    )
    text, loaded = done.stdout.rsplit("loaded", 1)
    assert text.count("data.path") >= len(command.COMMANDS) - 1  # but export
    assert {"torch", "numba", "scipy", "numpy", "pandas", "matplotlib"}.isdisjoint(loaded.split())


WHILE_MODULES_LOAD = """
import os, sys
from lfrtorch.cli import command
def load(name):
    os.kill(os.getpid(), {number})
command.import_module = load
sys.argv = ["lfrtorch", "preview", "x.csv"]
command.main()
"""


@pytest.mark.parametrize(
    ("number", "word"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")]
)
def test_a_signal_while_modules_load_ends_in_a_line(number: int, word: str):
    done = subprocess.run(
        [sys.executable, "-c", WHILE_MODULES_LOAD.format(number=int(number))],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert done.returncode == 128 + number
    assert done.stderr == f"{word} before it began: nothing to keep\n"


def test_sigterm_outside_a_fit_ends_in_a_line(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end, errors.user_errors():
        os.kill(os.getpid(), signal.SIGTERM)
    assert end.value.code == 128 + signal.SIGTERM
    assert "terminated outside the fit: nothing to keep" in capsys.readouterr().err
