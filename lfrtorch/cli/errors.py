"""Errors of users in one line, and notes in words of the command line."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.errors import InstantiationException

from lfrtorch._support.errors import LfrtorchError
from lfrtorch._support.tables import in_lines
from lfrtorch.cli.hydra_versions import NODE, notes_of
from lfrtorch.cli.interrupts import TerminatedError, as_error, handled


@contextmanager
def user_errors() -> Iterator[None]:
    """End the program with a message and exit code 1 for errors of users; bugs keep a traceback."""
    rank = os.environ.get("RANK", "0")
    # A message names the group of the configuration to which the function's argument belongs:
    # ``data: seed is -1``.
    error = "error" if rank == "0" else f"error on rank {rank}"

    def show(message: str) -> None:
        print(in_lines(f"{error}: {message}"), file=sys.stderr)

    try:
        with handled(as_error):
            yield
        return
    except TerminatedError as end:  # exit as if the signal had ended the program
        if rank == "0":
            print(end, file=sys.stderr)
        sys.exit(128 + end.number)
    except (LfrtorchError, OSError, InstantiationException) as failed:
        show(f"{_where(failed)}{failed}")
    except (MemoryError, RuntimeError, ImportError, TypeError) as failed:
        if _of_memory(failed):
            lack = "there is not enough memory; give smaller sizes or shorter records."
            show(f"{_where(failed)}{lack}")
        elif _of_the_settings(failed):
            show(f"{_where(failed)}{failed}")
        else:
            raise
    except KeyboardInterrupt:
        print("interrupted outside the fit: nothing to keep", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    sys.exit(1)


def _where(error: BaseException) -> str:
    """Name, for the message, of the group of the configuration that made the call."""
    nodes = [note.removeprefix(NODE) for note in notes_of(error) if note.startswith(NODE)]
    return f"{nodes[0]}: " if nodes and nodes[0] else ""


def _of_the_settings(error: BaseException) -> bool:
    """Tell if a call from the configuration failed because of its arguments."""
    called = any(note.startswith(NODE) for note in notes_of(error))
    wrong = "unexpected keyword argument" in str(error)
    return called and (isinstance(error, ImportError) or (isinstance(error, TypeError) and wrong))


def _of_memory(error: BaseException) -> bool:
    """Tell if memory was too small; torch reports this as a RuntimeError."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and "memory" in str(error) and "alloc" in str(error)
    )


def as_words(note: str) -> str:
    """Return a note with its settings as words of a command, such as ``feedthrough=false``."""
    note = note.replace("by Record(valid=...) or ", "by ").replace(", or Record(valid=...)", "")
    note = re.sub(r"\b(\w+)='(\w+)'", r"\1=\2", note)
    return re.sub(r"\b(\w+)=(True|False)\b", lambda m: f"{m[1]}={m[2].lower()}", note)
