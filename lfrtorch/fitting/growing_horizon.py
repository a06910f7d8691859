"""First iterations over windows that grow: a way to a good minimum over whole records.

Short windows ask for little more than predictions, whose error has few poor minima; the longer they
are, the more of the slow dynamics tells. Each horizon starts from the model of the one before
(a continuation in the horizon), and the fit over whole records from that of the last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from torch.nn.utils import parameters_to_vector, vector_to_parameters

from lfrtorch._support.reasons import CUT_SHORT
from lfrtorch._support.threads import each_alone
from lfrtorch.distributed import Ranks
from lfrtorch.fitting.trainer import Fit, Stop, StoppedError
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.simulation_problem import Ridge
from lfrtorch.model import Model
from lfrtorch.records import Record

FIRST, GROWTH = 20, 4
"""Samples of the first windows for each state, and factor from horizon to horizon."""

PART, SETTLED, PATIENCE = 0.5, 0.01, 2
"""Part of the iterations that each horizon has at most; Levenberg-Marquardt goes on to the next
after so many in which the cost falls by less than a hundredth."""


def horizons(records: Sequence[Record], nx: int) -> list[int]:
    """The horizons that come before whole records.

    Example:
        >>> from lfrtorch.fitting.growing_horizon import horizons
        >>> horizons([record], nx=2)
        [40, 160]
    """
    longest = max(record.samples - record.skip for record in records)
    count = math.ceil(math.log(max(1.0, longest / (FIRST * nx)), GROWTH))
    return [FIRST * nx * GROWTH**i for i in range(count)]


def grow(
    models: Sequence[Model],
    train: Sequence[Record],
    *,
    trainer: Any,
    ridge: Ridge,
    ranks: Ranks,
    stop: Stop | None,
) -> None:
    """Fit models over windows of each of the horizons; their weights change in place.

    A model that would diverge over whole records afterwards stays as it was.

    Args:
        models: of one order.
        train, trainer, ridge, ranks, stop: see :func:`lfrtorch.fit`; the trainer is that of the
            whole fit. No record validates: over short windows a model need not simulate well.

    Raises:
        StoppedError: by Ctrl-C or ``stop``.
    """
    some = replace(trainer, max_iter=math.ceil(PART * trainer.limit))
    if isinstance(some, LevenbergMarquardt):
        some = replace(some, tolerance=max(SETTLED, some.tolerance), patience=PATIENCE)
    options: dict[str, Any] = {"ridge": ridge, "ranks": ranks, "stop": stop}

    def grown(model: Model) -> bool:
        """Whether it came to the end."""
        before = parameters_to_vector(model.lfr.parameters()).detach().clone()
        for horizon in horizons(train, model.lfr.cell.nx):
            one = Fit(model, train, trainer=some, horizon=horizon, **options)
            if not one.diverges and one.advance().reason in CUT_SHORT:
                return False
        if Fit(model, train, trainer=trainer, **options).diverges:
            vector_to_parameters(before, model.lfr.parameters())
        return True

    if ranks.world == 1 and models[0].lfr.cell.A.device.type == "cpu":
        ended = each_alone(grown, models)
    else:
        ended = [grown(model) for model in models]
    if not all(ended):
        raise StoppedError("stopped while the horizon grew, before the fit over whole records")
