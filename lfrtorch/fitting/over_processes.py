"""Starts of one fit that several processes share: each process fits some starts to all records.

A round is cut into legs. At the end of each leg the processes exchange data: if one is asked to
stop, all stop, and the first process receives the state of every start for its snapshots. At the
end of a round each process takes over the states of the others' starts, bit-identically, so that
all processes rank and choose alike. If a process is lost, the others take over the states that its
starts had at the end of the leg before.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event

import torch
from torch import Tensor

from lfrtorch._support.reasons import Reason
from lfrtorch.distributed import ProcessLostError, Ranks, current
from lfrtorch.fitting.side_by_side import Together
from lfrtorch.fitting.trainer import Fit, Monitor, Stop

SHORT = 10.0
"""If a leg takes fewer seconds, the next leg has twice the iterations."""

LONG = 60.0
"""If a leg takes more seconds, the next leg has half the iterations. A process that waits longer
than its timeout treats the others as lost."""

Take = Callable[[int, bytes], None]
"""Called with the number of a start and the state of its fit, as ``Fit.save`` writes it."""


class OverProcesses(Together):
    """Fits that the processes share; after ``advance`` each process has the states of all fits."""

    # Monitors are called after each iteration of this process's own fits. At the end of a round
    # they are called with the best and the last iterate of the others' fits. ``take`` is called at
    # the end of a leg with the states of the others' fits.

    def __init__(
        self,
        fits: Sequence[Fit],
        monitors: Sequence[Sequence[Monitor]],
        halt: Event,
        *,
        stop: Stop,
        take: Take,
    ) -> None:
        super().__init__(fits, monitors, halt)
        self.ranks, self._stop, self._take = current(), stop, take
        self._numbers = {id(fit): number for number, fit in enumerate(fits)}
        self._stride = 1
        self._states: dict[int, bytes] = {}

    def agreed(self, numbers: Tensor) -> Tensor:
        """The numbers of the first process, by which all processes decide."""
        return self.ranks.first(numbers)

    def advance(self, fits: Sequence[Fit], until: int) -> None:
        """Go on with some fits to an iteration, each process with its share."""
        own = self.ranks.share(list(fits))
        others = [fit for fit in fits if not any(fit is mine for mine in own)]
        self._states = {}
        try:
            asked = self._legs(own, until, self._first_iteration(fits))
        except ProcessLostError as lost:
            self.ranks = Ranks()
            self._take_over(others)
            if not any(fit.history for fit in fits):
                raise
            for fit in fits:
                fit.note_end(Reason.PROCESS_LOST, lost.detail)
        else:
            self._take_over(others)
            for fit in fits if asked else ():
                fit.note_end(Reason.INTERRUPTED)

    def _legs(self, own: Sequence[Fit], until: int, at: int) -> bool:
        """Go on with this process's fits in legs; return True if a process is asked to stop."""
        while at < until:
            at, clock = min(until, at + self._stride), time.perf_counter()
            if own:
                super().advance(own, at)
            stopped = self._stop() or any(fit.reason == Reason.INTERRUPTED for fit in own)
            row = [float(stopped), time.perf_counter() - clock]
            met = self.ranks.stack(torch.tensor([row], dtype=torch.float64))
            self._hand_on(own)
            asked, longest = met.amax(0).tolist()
            if asked:
                return True
            if longest < SHORT:
                self._stride *= 2
            elif longest > LONG:
                self._stride = max(1, self._stride // 2)
        return False

    def _first_iteration(self, fits: Sequence[Fit]) -> int:
        """The iteration that all fits go on from, as the first process knows it."""
        # Processes that read the files of snapshots at different times may differ.
        least = min((fit.state.iteration for fit in fits if fit.state is not None), default=0)
        return int(self.ranks.first(torch.tensor(least)))

    def _hand_on(self, own: Sequence[Fit]) -> None:
        """Send the states of this process's fits to the others, and receive those of their fits."""
        mine: dict[int, bytes] = {}
        for fit in own:
            if fit.state is not None:
                with TemporaryDirectory() as folder:
                    fit.save(path := Path(folder) / "fit")
                    mine[self._numbers[id(fit)]] = path.read_bytes()
        sizes = [[number, len(state)] for number, state in mine.items()]
        listed = self.ranks.stack(torch.tensor(sizes, dtype=torch.int64).reshape(-1, 2))
        if not len(listed):
            return
        together = bytearray(b"".join(mine.values()))
        sent = torch.frombuffer(together, dtype=torch.uint8) if together else torch.empty(0)
        everything = self.ranks.stack(sent.to(torch.uint8)).numpy().tobytes()
        begin = 0
        for number, size in listed.tolist():
            if number not in mine:
                self._states[number] = everything[begin : begin + size]
                self._take(number, self._states[number])
            begin += size

    def _take_over(self, others: Sequence[Fit]) -> None:
        """Put the others' fits at their last known states, and call the monitors."""
        for fit in others:
            state = self._states.pop(self._numbers[id(fit)], None)
            if state is None:
                continue
            with TemporaryDirectory() as folder:
                path = Path(folder) / "fit"
                path.write_bytes(state)
                fit.restore(path)
            monitors = self._monitors[id(fit)]
            for monitor in monitors:
                monitor(fit.model, fit.kept)
            if monitors and fit.history[-1] is not fit.kept:
                fit.show_last(monitors)
