"""Several fits side by side in one process, on threads."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from threading import Event, Lock

from torch import Tensor

from lfrtorch._support.reasons import Reason
from lfrtorch._support.threads import each_alone, worth_threads
from lfrtorch.fitting.trainer import Fit, Monitor, Progress, Stop
from lfrtorch.model.model import Model


def any_of(halt: Event, stop: Stop | None) -> Stop:
    """Return a ``Stop`` that is True if ``halt`` is set or ``stop`` returns True."""
    return lambda: halt.is_set() or (stop is not None and stop())


class Together:
    """Fits side by side, and their monitors; ``halt`` is set if Ctrl-C ends one thread."""

    def __init__(
        self, fits: Sequence[Fit], monitors: Sequence[Sequence[Monitor]], halt: Event
    ) -> None:
        self._first = fits[0]
        self._halt, self._one = halt, Lock()
        self._monitors = {
            id(fit): [self._in_turn(monitor) for monitor in own]
            for fit, own in zip(fits, monitors, strict=True)
        }

    def agreed(self, numbers: Tensor) -> Tensor:
        """The numbers of the first process, by which all processes decide."""
        return self._first.problem.agreed(numbers)

    def advance(self, fits: Sequence[Fit], until: int) -> None:
        """Go on with some fits to an iteration."""
        first = fits[0]
        theta = first.problem.theta
        threads = worth_threads(first.problem.size, len(theta))
        alone = not first.problem.shared and theta.device.type == "cpu"
        try:
            if len(fits) > 1 and alone:
                advance = partial(self._advance_one, until=until)
                each_alone(advance, fits, self._halt.set, threads=threads)
            else:
                for fit in fits:
                    self._advance_one(fit, until)
        except KeyboardInterrupt:
            if not any(fit.history for fit in fits):
                raise
            for fit in fits:
                fit.note_end(Reason.INTERRUPTED)

    def _advance_one(self, fit: Fit, until: int) -> None:
        if fit.history or not fit.stopped():
            fit.advance(until, self._monitors[id(fit)])
        if fit.reason == Reason.INTERRUPTED:
            self._halt.set()  # Ctrl-C also ends the fits that wait for a thread

    def _in_turn(self, monitor: Monitor) -> Monitor:
        def call(model: Model, progress: Progress) -> None:
            with self._one:
                monitor(model, progress)

        return call
