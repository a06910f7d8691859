"""Ctrl-C and SIGTERM: a fit ends between two iterations, and what it found is kept."""

from __future__ import annotations

import signal
import sys
from typing import Any, Self

from lfrtorch._support.errors import LfrtorchError


class TerminatedError(LfrtorchError):
    """A signal ended the program, SIGTERM or another ``number``."""

    def __init__(self, message: str, number: int = signal.SIGTERM) -> None:
        super().__init__(message)
        self.number = number


class Termination:
    """Ctrl-C and SIGTERM as a request that a fit asks for before each iteration, its ``stop``.

    So no write is torn. A second Ctrl-C ends the program at once, and before a fit has begun to ask
    the first one does. A batch system sends SIGTERM before it kills, and torchrun sends it to the
    processes that are left.
    """

    def __init__(self) -> None:
        self.asked = 0
        self._fitting = False
        self._signals = [signal.SIGTERM]
        if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # as in a shell's background job
            self._signals.append(signal.SIGINT)

    def __enter__(self) -> Self:
        self._usual = [signal.signal(number, self._note) for number in self._signals]
        return self

    def __exit__(self, *_: object) -> None:
        for each, usual in zip(self._signals, self._usual, strict=True):
            signal.signal(each, usual)

    def __call__(self) -> bool:
        """Whether the fit is to end."""
        self._fitting = True
        return bool(self.asked)

    def _note(self, number: int, _: Any) -> None:
        again, self.asked = self.asked == number, number
        if number == signal.SIGINT:
            if again or not self._fitting:
                raise KeyboardInterrupt
            print("\nending after this iteration; Ctrl-C again: at once", file=sys.stderr)
        elif not self._fitting:
            raise TerminatedError("terminated outside the fit: nothing to keep")
