"""Fits that begin at measured outputs: from short windows to long ones.

While the parameters are poor, a simulation of an unstable system over a long horizon is never near
the data: errors grow with the horizon until they carry no information. The error over a few samples
is nearly linear in the parameters. So a fit begins with short windows, and continues with longer
windows from the model that the shorter windows gave.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch

from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import quantity
from lfrtorch.engine.held import held_parameters, measured_states
from lfrtorch.fitting.given_entries import transformed
from lfrtorch.fitting.stage import Data, Job, Stage, best_start
from lfrtorch.fitting.trainer import FitResult, Trainer
from lfrtorch.fitting.windows import begins_at_outputs, windows_from_outputs
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.model.model import Model

PARTS = (0.1, 0.3)
"""Window lengths of the first two fits, relative to the horizon."""

_ITERATIONS = 10
"""Largest number of iterations of each of these fits."""


def with_measured_states(model: Model) -> Model:
    """The model in coordinates where its states are the normalised outputs; a fit keeps these."""
    cell = deepcopy(model.lfr.cell)
    own = {name: p.detach().double().cpu().numpy() for name, p in cell.named_parameters()}
    if own["Cy"].shape[0] != cell.nx or np.linalg.matrix_rank(own["Cy"]) < cell.nx:
        raise InputError(
            f"the records have start='measured', and the model has {cell.nx} states that its "
            f"{cell.ny} outputs do not determine; give nx={cell.ny}, or start='estimated'."
        )
    found = transformed(own, own["Cy"])
    with torch.no_grad():
        for name in ("A", "Bu", "Bw", "Cz"):
            cell.get_parameter(name).copy_(torch.as_tensor(found[name]))
    cell.hold(measured_states(cell))
    return replace(model, lfr=type(model.lfr)(cell))


class MeasuredStates(Stage):
    """Starts whose states are the normalised outputs."""

    def when(self, job: Job) -> bool:
        """Tell if the models are made from a linear model of all outputs."""
        made = job.settings.known is None and job.settings.init_from is None
        return made and begins_at_outputs(job.dataset.train)

    def run(self, job: Job) -> Job:
        """The models in coordinates where the states are the outputs."""
        return replace(job, models=[with_measured_states(model) for model in job.models])


class ShortWindows(Stage):
    """A fit over windows of a part of the horizon.

    Args:
        part: part of the horizon.
    """

    def __init__(self, part: float) -> None:
        self._part = part
        self.name = f"the fit over windows of {part:g} of the horizon"

    def when(self, job: Job) -> bool:
        """Tell if the records begin at outputs, and the horizon is longer than these windows."""
        horizon = job.settings.horizon
        if job.settings.init_from is not None or horizon is None:
            return False
        if held_parameters(job.models[0].lfr.cell).all():
            return False  # equations without parameters
        before = [_samples(part, horizon) for part in PARTS if part < self._part]
        return begins_at_outputs(job.dataset.train) and _samples(self._part, horizon) not in before

    def data(self, job: Job) -> Data:
        """As many short windows as there are full ones, so that these iterations cost less."""
        horizon = cast(int, job.settings.horizon)
        samples, scale = _samples(self._part, horizon), job.models[0].scaler.y_scale
        cut = [windows_from_outputs(r, samples, horizon, scale) for r in job.dataset.train]
        return Data([part for parts in cut for part in parts])

    def trainer(self, job: Job) -> Trainer:
        """A trainer with few iterations."""
        return LevenbergMarquardt(max_iter=_ITERATIONS)

    def options(self, job: Job) -> Mapping[str, Any]:
        """No horizon, as the records are cut into windows already."""
        return {"horizon": None}

    def keep(self, job: Job, result: FitResult) -> Job:
        """The job that goes on from the best start."""
        settings, models = best_start(job, result) if result.starts else (job.settings, job.models)
        job.observer.say(
            f"windows of {_samples(self._part, cast(int, settings.horizon))} samples: "
            f"{result.iterations} iterations, {quantity(result.seconds, 's')}"
        )
        return replace(job, settings=settings, models=models)


def _samples(part: float, horizon: int) -> int:
    return max(2, round(part * horizon))
