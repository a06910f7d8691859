"""Ctrl-C and SIGTERM during a fit: it ends between two iterations, and what it found is kept."""

from __future__ import annotations

import signal
import sys
from typing import Any, Self

import torch

from lfrtorch.distributed import Ranks
from lfrtorch.fitting.trainer import Progress
from lfrtorch.model import Model


class Terminated(Exception):
    """SIGTERM ended the fit; what it had found is written."""


class Termination:
    """Ctrl-C and SIGTERM as a monitor: the fit ends after an iteration, and files are written.

    So no write is torn; a second Ctrl-C ends it at once. A batch system sends SIGTERM before it
    kills, and torchrun to the processes that are left: several end together where one is asked to.
    """

    def __init__(self, ranks: Ranks) -> None:
        self.ranks, self.asked = ranks, 0
        self._signals = [signal.SIGTERM]
        if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # as in a shell's background job
            self._signals.append(signal.SIGINT)

    def __enter__(self) -> Self:
        self._usual = [signal.signal(number, self._note) for number in self._signals]
        return self

    def __exit__(self, *_: object) -> None:
        for each, usual in zip(self._signals, self._usual, strict=True):
            signal.signal(each, usual)

    def __call__(self, model: Model, progress: Progress) -> None:
        """End the fit where that was asked for."""
        if self.ranks.sum(torch.tensor(self.asked)):
            raise KeyboardInterrupt

    def _note(self, number: int, _: Any) -> None:
        if number == signal.SIGINT:
            if self.asked == number:
                raise KeyboardInterrupt
            print("\nending after this iteration; Ctrl-C again: at once", file=sys.stderr)
        self.asked = number
