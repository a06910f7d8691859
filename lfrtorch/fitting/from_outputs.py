"""Fits that begin at measured outputs: from short windows to long ones.

Of an unstable system no simulation over a long horizon is near the data while the parameters are
poor: errors grow with the horizon until they say nothing. The error over a few samples is nearly
linear in the parameters, so a fit begins there, and goes on with longer windows from where the
shorter ones led.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from lfrtorch._support.errors import InputError
from lfrtorch._support.reasons import CUT_SHORT
from lfrtorch._support.tables import quantity
from lfrtorch.engine.held import measured_states
from lfrtorch.fitting.given_entries import transformed
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.stage import Stage
from lfrtorch.fitting.trainer import StoppedError
from lfrtorch.fitting.windows import windows, windows_from_outputs
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.model import Model
from lfrtorch.records import Record

_PARTS = (0.1, 0.3)
"""Of the horizon, that windows have first."""

_ITERATIONS = 10
"""With each of them."""


def begins_at_outputs(records: Sequence[Record]) -> bool:
    """Whether all records have measured starts; a ValueError if some have."""
    measured = {record.start == "measured" for record in records}
    if len(measured) > 1:
        raise InputError(
            "some records have start 'measured' and others not; give all the same, as the model's "
            "states are then its outputs."
        )
    return measured == {True}


def in_windows(stage: Stage) -> list[Record]:
    """The training records as the fit simulates them: whole, or in windows from outputs."""
    train, horizon = stage.dataset.train, stage.settings.horizon
    if horizon is None or not begins_at_outputs(train):
        return train
    return windows(train, horizon, train[0].y.shape[1])


def with_measured_states(model: Model) -> Model:
    """The model with its normalised outputs as states; a fit leaves them so."""
    cell = deepcopy(model.lfr.cell)
    own = {name: p.detach().double().cpu().numpy() for name, p in cell.named_parameters()}
    if own["Cy"].shape[0] != cell.nx or np.linalg.matrix_rank(own["Cy"]) < cell.nx:
        raise InputError(
            f"the records have start 'measured' and the model {cell.nx} states for {cell.ny} "
            f"outputs; give nx={cell.ny}, or start='estimated'."
        )
    found = transformed(own, own["Cy"])
    with torch.no_grad():
        for name in ("A", "Bu", "Bw", "Cz"):
            cell.get_parameter(name).copy_(torch.as_tensor(found[name]))
    cell.hold(measured_states(cell))
    return replace(model, lfr=type(model.lfr)(cell))


def begun_on_short_windows(
    stage: Stage, models: Sequence[Model], **options: Any
) -> tuple[Settings, list[Model]]:
    """The best start after fits over short windows, and the settings with its seed."""
    settings, dataset, observer = stage.settings, stage.dataset, stage.observer
    found, best = list(models), 0
    if settings.horizon is None:
        return settings, found
    scale = models[0].scaler.y_scale
    for horizon in sorted({max(2, round(part * settings.horizon)) for part in _PARTS}):
        monitor = observer.searching()
        # As many windows as there will be whole ones: these iterations cost so much less.
        cut = [windows_from_outputs(r, horizon, settings.horizon, scale) for r in dataset.train]
        short = LevenbergMarquardt(max_iter=_ITERATIONS)
        result = fit(
            found,
            [part for parts in cut for part in parts],
            monitors=None if monitor is None else [[monitor]] * len(found),
            **{**stage.options, "trainer": short, "horizon": None, **options},
        )
        if result.reason in CUT_SHORT:
            raise StoppedError(f"stopped during the fit over windows of {horizon} samples")
        best = result.starts[0].number if len(found) > 1 else best
        found = [result.model]
        observer.say(
            f"windows of {horizon} samples: {result.iterations} iterations, "
            f"{quantity(result.seconds, 's')}"
        )
    return replace(settings, seed=settings.seeds[best], starts=1), found
