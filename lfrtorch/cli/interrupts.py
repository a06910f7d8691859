"""Ctrl-C and SIGTERM: a fit ends between two iterations, and what it found is kept."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self

from lfrtorch._support.errors import LfrtorchError


class TerminatedError(LfrtorchError):
    """A signal ended the program, SIGTERM or another ``number``."""

    def __init__(self, message: str, number: int = signal.SIGTERM) -> None:
        super().__init__(message)
        self.number = number


@contextmanager
def handled(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Inside, ``handler`` takes SIGTERM, and Ctrl-C unless it is ignored."""
    # What it raises while compiled code calls Python, as numba's compiler does, is lost there.
    hook = sys.unraisablehook

    def lost(failed: sys.UnraisableHookArgs) -> None:
        number = getattr(failed.exc_value, "number", signal.SIGINT)
        if not isinstance(failed.exc_value, TerminatedError | KeyboardInterrupt):
            hook(failed)
        elif handler is as_error:
            # It comes again once the library is done.
            again = threading.Timer(0.05, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()

    numbers = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # as in a shell's background job
        numbers.append(signal.SIGINT)
    usual = {number: signal.signal(number, handler) for number in numbers}
    sys.unraisablehook = lost
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, before in usual.items():
            signal.signal(number, before)


def at_once(number: int, _: Any = None) -> None:
    """End the program while modules load: an import might take an exception for its own."""
    how = "interrupted" if number == signal.SIGINT else "terminated"
    os.write(2, f"{how} before it began: nothing to keep\n".encode())
    os._exit(128 + number)


def as_error(number: int, _: Any = None) -> None:
    """End the program outside a fit, with no unfinished file left behind."""
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise TerminatedError("terminated outside the fit: nothing to keep")


class Termination:
    """Ctrl-C and SIGTERM as a request that a fit asks for before each iteration, its ``stop``."""

    # So no write is torn. A second Ctrl-C ends the program at once, and before a fit has begun the
    # first one does. A batch system sends SIGTERM before it kills, and torchrun to processes that
    # are left.

    def __init__(self) -> None:
        self.asked = 0
        self._fitting = False

    def __enter__(self) -> Self:
        self._handled = handled(self._note)
        self._handled.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._handled.__exit__(None, None, None)

    def __call__(self) -> bool:
        """True if the fit is to end."""
        self._fitting = True
        return bool(self.asked)

    def _note(self, number: int, _: Any) -> None:
        again, self.asked = self.asked == number, number
        if not self._fitting or (again and number == signal.SIGINT):
            as_error(number)
        if number == signal.SIGINT:
            print("\nending after this iteration; Ctrl-C again: at once", file=sys.stderr)
