"""Errors of users as one line."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from hydra.errors import InstantiationException
from omegaconf import DictConfig

from lfrtorch._support.errors import LfrtorchError
from lfrtorch._support.tables import in_lines
from lfrtorch.cli.interrupts import TerminatedError, as_error, handled
from lfrtorch.cli.words import translated


@contextmanager
def user_errors(rank: str = "0", cfg: DictConfig | None = None) -> Iterator[None]:
    """Errors of users end the program with one message and exit code 1; bugs keep their traceback.

    A message names the group of the configuration, which a function's argument belongs to:
    ``data: seed is -1``. With ``cfg`` it speaks in words of the command line.
    """
    error = "error" if rank == "0" else f"error on rank {rank}"

    def show(message: str) -> None:
        text = message if cfg is None else translated(message, cfg)
        print(in_lines(f"{error}: {text}"), file=sys.stderr)

    try:
        with handled(as_error):
            yield
        return
    except InstantiationException as failed:
        if isinstance(failed.__cause__, TerminatedError):
            _end(failed.__cause__, rank)
        if failed.__cause__ and not _of_the_user(failed.__cause__):
            raise failed.__cause__ from None
        group = re.search(r"^full_key: (.+)$", str(failed), re.MULTILINE)
        where = f"{group[1]}: " if group and failed.__cause__ else ""
        show(f"{where}{_said(failed.__cause__ or failed)}")
    except TerminatedError as end:
        _end(end, rank)
    except (LfrtorchError, OSError) as failed:
        show(str(failed))
    except (MemoryError, RuntimeError) as failed:
        if not _of_memory(failed):
            raise
        show(_said(failed))
    except KeyboardInterrupt:
        print("interrupted outside the fit: nothing to keep", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    sys.exit(1)


def _end(end: TerminatedError, rank: str) -> NoReturn:
    """Exit as a program does that a signal ended."""
    if rank == "0":
        print(end, file=sys.stderr)
    sys.exit(128 + end.number)


def _of_the_user(cause: BaseException) -> bool:
    """Whether a call from the configuration failed because of what it was given."""
    if isinstance(cause, TypeError):
        return "unexpected keyword argument" in str(cause)
    return isinstance(cause, LfrtorchError | OSError | ImportError) or _of_memory(cause)


def _of_memory(error: BaseException) -> bool:
    """Whether there was not enough memory; torch says so with a RuntimeError."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and "memory" in str(error) and "alloc" in str(error)
    )


def _said(error: BaseException) -> str:
    """The message of an error; those of memory have none, or one of the allocator."""
    if _of_memory(error):
        return "there is not enough memory; give smaller sizes or shorter records."
    return str(error)
