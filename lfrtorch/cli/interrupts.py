"""Ctrl-C and SIGTERM: a fit ends between two iterations, and its best iterate is kept."""

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
    """The program was ended by SIGTERM, or by another signal ``number``."""

    def __init__(self, message: str, number: int = signal.SIGTERM) -> None:
        super().__init__(message)
        self.number = number


@contextmanager
def handled(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Context in which ``handler`` handles SIGTERM, and Ctrl-C unless the system ignores it."""
    # An exception of the handler is lost if compiled code, such as numba's, has called Python.
    hook = sys.unraisablehook

    def lost(failed: sys.UnraisableHookArgs) -> None:
        number = getattr(failed.exc_value, "number", signal.SIGINT)
        if not isinstance(failed.exc_value, TerminatedError | KeyboardInterrupt):
            hook(failed)
        elif handler is as_error:
            # The signal is sent again, after the library is done.
            again = threading.Timer(0.05, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()

    numbers = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # ignored in a shell's background job
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
    """End the program while modules load: an import could catch an exception as its own."""
    how = "interrupted" if number == signal.SIGINT else "terminated"
    os.write(2, f"{how} before it began: nothing to keep\n".encode())
    os._exit(128 + number)


def as_error(number: int, _: Any = None) -> None:
    """End the program outside a fit, by an exception, so that no unfinished file is left."""
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise TerminatedError("terminated outside the fit: nothing to keep")


class Termination:
    """Function ``stop`` of a fit: tells, before each iteration, if Ctrl-C or SIGTERM came."""

    # So no file is left half written. A second Ctrl-C ends the program at once; before the fit has
    # begun, the first one does. Batch systems send SIGTERM before they kill a program, and torchrun
    # sends it to the remaining processes.

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
