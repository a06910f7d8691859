"""Fits over a horizon: records are cut into windows, and each window is simulated by itself.

A simulation error of a whole record asks the model for the right output after thousands of samples.
Far from the minimum it has many poor ones, and where small changes of θ grow along a trajectory
(unstable transients, chaos) it is no smooth function of θ (Ribeiro et al., 2020). Over windows of
h samples changes grow for h samples at most, and the error is still one of a simulation.

Each window begins in a state of its own that is fitted with the parameters, as that of a record
with an estimated start is: multiple shooting without constraints. Of white noise on the outputs
nx ny errors of each window go into its state, whatever the parameters are, so that windows of a
linear model have the minimum of whole records but for chance. The alternative, a state from the
one-step predictor of an innovation form (the error of predictions 1 to h samples ahead), needs the
gain K, which the data do not tell while the model is poor, and does not exist for models with exact
integrators; and it still depends on θ through all samples before the window. As start states are
eliminated (``lfrtorch.least_squares.start_states``), theirs are no parameters of a step's system.
No constraint joins a window to the next one.

Windows of the validation records choose the iterate. A whole simulation is a poor judge of a model
on its way: of the oscillator of van der Pol (``benchmarks/horizon.py``, windows of 50 samples, seed
3) it found no iterate better than the start, 37 % error in 100 samples; windows chose one of 2.0 %.

References:
    Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", in Modelling of
    Chemical Reaction Systems, 1981.
    Ribeiro, Tiels, Umenberger, Schön and Aguirre, "On the smoothness of nonlinear system
    identification", Automatica 121, 2020.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch.records import Record

Horizon = int | Literal["grow"] | None
"""Samples of a window; ``"grow"``: of more and more, up to whole records. None: whole records."""


def check_horizon(horizon: Horizon, noise: str = "output") -> None:
    """Refuse what is no horizon, or one for predictions, with a ValueError."""
    if horizon is None:
        return
    if horizon != "grow":
        integer("horizon", horizon, 2, word="grow")
    if noise != "output":
        raise InputError(
            f"horizon is {horizon!r}, and noise is {noise!r}, which fits predictions one sample "
            "ahead; give horizon=None or noise='output'."
        )


def windows(records: Sequence[Record], horizon: int, nx: int) -> list[Record]:
    """The samples that a fit scores, in windows of ``horizon`` samples.

    Windows of a record are spread evenly and overlap as little as they can; their samples have the
    weight of the record's together. The first one begins as the record does, with what is skipped,
    and all others in states to be estimated. A record of no more samples than that stays whole.

    Args:
        records: of any lengths.
        horizon: samples.
        nx: states of the model.

    Raises:
        ValueError: too few samples for the states, or a record with weights by spectral line.

    Example:
        >>> from lfrtorch.fitting.windows import windows
        >>> [(w.samples, w.start) for w in windows([record[:400]], 150, nx=2)]
        [(150, 'zero'), (150, 'estimated'), (150, 'estimated')]
    """
    found = []
    for record in records:
        if record.samples - record.skip <= horizon:
            found.append(record)
            continue
        if horizon * record.y.shape[1] < 2 * nx:
            raise InputError(
                f"horizon is {horizon}, too few samples of {record.y.shape[1]} output(s) to tell "
                f"{nx} states; give {math.ceil(2 * nx / record.y.shape[1])} or more."
            )
        if record.line_weight is not None:
            raise InputError(
                f"record '{record.name}' has line_weight, and windows have other lines; give "
                "horizon=None, or records without it."
            )
        found += _windows(record, horizon)
    return found


def _windows(record: Record, horizon: int) -> list[Record]:
    """Those of one record that is longer."""
    scored = record.samples - record.skip
    count = math.ceil(scored / horizon)
    begins = record.skip + np.linspace(0, scored - horizon, count).round().astype(int)
    weight = np.asarray(record.weight) * scored / (count * horizon)
    found = [replace(record[b : b + horizon], start="estimated", weight=weight) for b in begins]
    if record.start != "periodic":
        end = record.skip + horizon
        whole = replace(record, period=None, weight=weight)
        found[0] = replace(whole, **record.signals_in(slice(end)))
    return found
