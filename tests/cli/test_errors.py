"""Errors of users are one line, and bugs keep their traceback."""

from __future__ import annotations

import builtins
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lfrtorch import InputError, LfrtorchError
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.hydra_versions import instantiate
from lfrtorch.cli.interrupts import TerminatedError, as_error, handled
from lfrtorch.distributed import ProcessLostError


def fails(kind: Callable[[str], Exception], message: str) -> None:
    raise kind(message)


def fails_by_name(kind: str, message: str) -> None:
    named = {"InputError": InputError, "LfrtorchError": LfrtorchError, **vars(builtins)}
    fails(named[kind], message)


def failing(kind: Any, message: str) -> dict[str, Any]:
    """A node of settings whose target raises an error."""
    return {"_target_": fails_by_name, "kind": kind.__name__, "message": message}


def printed(capsys: pytest.CaptureFixture[str], call: Callable[[], object]) -> str:
    with pytest.raises(SystemExit) as stop, user_errors():
        call()
    assert stop.value.code == 1
    return capsys.readouterr().err


@pytest.mark.parametrize("kind", [InputError, FileNotFoundError, LfrtorchError])
def test_errors_of_users_are_one_line(kind: Callable[[str], Exception], capsys):
    message = str(kind("nx is 0"))
    assert printed(capsys, lambda: fails(kind, "nx is 0")) == f"error: {message}\n"
    target = failing(kind, "nx is 0")
    assert printed(capsys, lambda: instantiate(target)) == f"error: {message}\n"
    assert printed(capsys, lambda: instantiate({"a": target})["a"]) == f"error: a: {message}\n"


def test_a_signal_while_hydra_builds_an_object_ends_the_program(capsys):
    target = {"_target_": signal.raise_signal, "_args_": [signal.SIGTERM]}
    with pytest.raises(SystemExit) as ended, user_errors():
        instantiate({"data": target})
    assert ended.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "terminated outside the fit: nothing to keep\n"


class Swallows:
    """Loses what is raised in it, as a library does where compiled code calls Python."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


def test_a_signal_that_a_library_loses_comes_again(capsys):
    def end() -> None:
        with handled(as_error):
            Swallows()
            time.sleep(60)

    with pytest.raises(TerminatedError, match="terminated"):
        end()
    assert not capsys.readouterr().err


def test_memory_that_there_is_not_is_one_line(capsys):
    for call in (
        lambda: fails(MemoryError, ""),
        lambda: fails(RuntimeError, "DefaultCPUAllocator: can't allocate memory: 8 TB"),
        lambda: instantiate(failing(MemoryError, "")),
    ):
        assert "error: there is not enough memory; give smaller" in printed(capsys, call)


def test_a_lost_process_is_one_line(capsys):
    err = printed(capsys, lambda: fails(ProcessLostError, "rank 1"))
    assert err == "error: a process was lost: rank 1\n"


@pytest.mark.parametrize("kind", [ValueError, TypeError, KeyError])
def test_bugs_are_raised_as_they_are(kind: Callable[[str], Exception]):
    with pytest.raises(kind, match="bug") as found, user_errors():  # pyright: ignore
        fails(kind, "bug")
    assert found.traceback[-1].name == "fails"
    with pytest.raises(kind, match="bug") as found, user_errors():  # pyright: ignore
        instantiate(failing(kind, "bug"))
    assert found.traceback[-1].name == "fails"


def test_an_argument_that_there_is_not_is_an_error_of_the_user(capsys):
    err = printed(capsys, lambda: instantiate({"_target_": fails, "foo": 1}))
    assert err.startswith("error: ")
    assert "unexpected keyword argument 'foo'" in err
    assert "Error loading 'no.such'" in printed(
        capsys, lambda: instantiate({"_target_": "no.such"})
    )


def test_other_ranks_say_which_they_are(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setenv("RANK", "1")
    with pytest.raises(SystemExit), user_errors():
        (tmp_path / "no").read_text()
    assert capsys.readouterr().err.startswith("error on rank 1: ")


def test_termination_has_the_exit_code_of_its_signal(capsys):
    with pytest.raises(SystemExit) as stop, user_errors():
        raise TerminatedError("ended")
    assert stop.value.code == 143
    assert capsys.readouterr().err == "ended\n"
    with pytest.raises(SystemExit) as stop, user_errors():
        raise TerminatedError("ended", signal.SIGINT)
    assert stop.value.code == 130


def test_bad_input_is_a_value_error_as_well():
    assert issubclass(InputError, ValueError)
    assert not issubclass(ProcessLostError, ValueError)
