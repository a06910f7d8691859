"""Several fits side by side in one process: on threads, or on a GPU in step."""

from __future__ import annotations

import time
from collections.abc import Sequence
from threading import Event, Lock

from lfrtorch._support.reasons import Reason
from lfrtorch._support.threads import each_alone, spread_by_hand
from lfrtorch.fitting.trainer import Fit, Monitor, Progress, Stop
from lfrtorch.least_squares.joint import JointProblem
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.model import Model


def any_of(halt: Event, stop: Stop | None) -> Stop:
    """Stop if one of the two says so."""
    return lambda: halt.is_set() or (stop is not None and stop())


class Together:
    """Fits side by side, and who watches them; ``halt`` is set if Ctrl-C ends one thread."""

    def __init__(
        self, fits: Sequence[Fit], monitors: Sequence[Sequence[Monitor]], halt: Event
    ) -> None:
        self.ranks = fits[0].ranks
        """The processes that all decide with."""
        self._halt, self._one = halt, Lock()
        self._monitors = {
            id(fit): [self._in_turn(monitor) for monitor in own]
            for fit, own in zip(fits, monitors, strict=True)
        }

    def advance(self, fits: Sequence[Fit], until: int) -> None:
        """Go on with some of them to an iteration."""
        first = fits[0]
        in_step = isinstance(first.trainer, LevenbergMarquardt) and first.ranks.world == 1
        in_step &= len({tuple(fit.model.sizes.items()) for fit in fits}) == 1
        try:
            if len(fits) > 1 and in_step and first.problem.theta.device.type != "cpu":
                advance_in_step(fits, until, [self._monitors[id(fit)] for fit in fits])
            elif len(fits) > 1 and first.ranks.world == 1:
                each_alone(lambda fit: self._advance_one(fit, until), fits, self._halt.set)
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

    def _in_turn(self, monitor: Monitor) -> Monitor:
        def call(model: Model, progress: Progress) -> None:
            with self._one:
                monitor(model, progress)

        return call


@spread_by_hand()
def advance_in_step(
    fits: Sequence[Fit], until: int, monitors: Sequence[Sequence[Monitor]] = ()
) -> None:
    """Go on with several fits by Levenberg-Marquardt to an iteration, evaluated together."""
    watching = dict(zip(map(id, fits), monitors or [()] * len(fits), strict=True))
    trainer = fits[0].trainer
    assert isinstance(trainer, LevenbergMarquardt)
    for fit in fits:
        if not fit.history:
            fit.begin(watching[id(fit)])
    try:
        while live := [f for f in fits if _unfinished(f, until)]:
            clock = time.perf_counter()
            after = trainer.steps(JointProblem([f.problem for f in live]), [f.state for f in live])
            each = (time.perf_counter() - clock) / len(live)
            for fit, state in zip(live, after, strict=True):
                fit.take(state, each, watching[id(fit)])
    finally:
        for fit in fits:
            fit.pause()


def _unfinished(fit: Fit, until: int) -> bool:
    return not fit.over and fit.state.iteration < until and not fit.stopped()
