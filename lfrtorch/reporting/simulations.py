"""A record beside its simulations: errors of each output, in its unit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lfrtorch._support.types import Array
from lfrtorch.analysis.residual_analysis import SHORTEST, Residuals, of_simulation
from lfrtorch.dataset import Dataset
from lfrtorch.linear.model import LinearModel
from lfrtorch.metrics import nrmse
from lfrtorch.model import Model
from lfrtorch.records import Record, without_coordinates
from lfrtorch.score_window import fitted


@dataclass(frozen=True, eq=False)
class Response:
    """What the linear model and the NL-LFR make of a record, in physical units.

    Args:
        record: the measurement.
        use: ``"train"``, ``"validation"`` or ``"test"``.
        y_linear, y_hat: simulated outputs.

    Shape:
        y_linear, y_hat: (T, ny).
    """

    record: Record
    use: str
    y_linear: Array
    y_hat: Array

    @property
    def simulated(self) -> Mapping[str, Array]:
        """Both simulations by the names of their models."""
        return {"linear": self.y_linear, "NL-LFR": self.y_hat}

    @property
    def scored(self) -> Array:
        """Measured output after the skip window (scored samples, ny)."""
        return self.record.y[self.record.skip :]

    @property
    def error(self) -> Array:
        """Error of the NL-LFR after the skip window (scored samples, ny), 0 if y is not valid."""
        return self.record.errors(self.y_hat)

    @property
    def linear_error(self) -> Array:
        """Error of the linear model after the skip window (scored samples, ny), likewise."""
        return self.record.errors(self.y_linear)

    @property
    def diverged(self) -> bool:
        """Whether the NL-LFR's output has samples that are not finite."""
        return not bool(np.isfinite(self.y_hat).all())


def respond(
    model: Model,
    bla: LinearModel,
    dataset: Dataset,
    own: Mapping[str, LinearModel],
    *,
    refitted: Model | None = None,
    ahead: int = 0,
) -> list[Response]:
    """All records beside their simulations; tests with linear models of their own have those.

    Estimated starts of training records are fitted to all samples, as in the fit. If the model was
    fitted again to all of them, the tests are simulated by what came of it.

    Args:
        model, bla, dataset: what is simulated.
        own: linear models of single tests, by name.
        refitted: the model that was fitted again.
        ahead: predictions so many samples ahead in the place of simulations, of models with K.
    """
    used = {
        "train": dataset.train,
        "validation": dataset.validation,
        "selection": dataset.selection,
        "test": dataset.tests,
    }
    found = []
    for use, records in used.items():
        for record in records:
            linear, chosen = bla, model
            if use == "test":
                linear, chosen = own.get(dataset.score_of(record), bla), refitted or model
            driven = fitted(record) if use == "train" else record
            outputs = [_output(each, driven, ahead) for each in (linear, chosen)]
            found.append(Response(record, use, *outputs))
    return found


def _output(model: Model | LinearModel, record: Record, ahead: int) -> Array:
    """Simulated, or predicted so many samples ahead."""
    if not ahead:
        return model.simulate(record)
    if isinstance(model, LinearModel):
        model, record = model.to_model(), without_coordinates(record)
    return model.predict(record, horizon=ahead)


def ranked(responses: Sequence[Response]) -> list[Response]:
    """The tests, without tests validation, else training; the largest error of the NL-LFR first."""
    uses = [use for use in ("test", "validation", "train") if any(r.use == use for r in responses)]
    return sorted(
        (response for response in responses if response.use == uses[0]),
        key=_relative,
        reverse=True,
    )


def worst_residuals(responses: Sequence[Response]) -> Residuals | None:
    """Residuals of the record with the largest error, of those that do not diverge."""
    for response in ranked(responses):
        if not response.diverged and len(response.scored) >= SHORTEST:
            return Residuals(of_simulation(response.record, response.y_hat))
    return None


def _relative(response: Response) -> float:
    """The NL-LFR's error over the deviation of the output; infinite if it diverges."""
    error = nrmse(response.record, response.y_hat)
    return error if math.isfinite(error) else math.inf
