"""One evaluation of models: every record is simulated once, and the report uses the results."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from lfrtorch._support.types import Array
from lfrtorch.analysis.residual_analysis import SHORTEST, Residuals, of_simulation
from lfrtorch.analysis.start_uncertainty import start_error
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.metrics import nrmse, rmse, rmse_by_output
from lfrtorch.data.records import Channel, Record, of_one_unit, without_coordinates
from lfrtorch.data.score_window import fitted
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model
from lfrtorch.reporting.opponent import Opponents, output

_LINEAR, _NL_LFR = "linear", "NL-LFR"  # names of the two models
_HOLD = "hold"  # name of the prediction that the last measured output stays

CROSS = "cross-validation"
"""Name of the record that takes the place of a validation record if all records are fitted."""

_STILL = 0.1  # a signal is still up to this part of its standard deviation in training

HORIZONS = 1, 10, 100
"""Numbers of samples ahead at which predictions are scored."""


@dataclass(frozen=True)
class Score:
    """Simulation errors on one record, or on a group of records, after the skip window."""

    use: str  # "train", "validation", "selection" or "test"
    source: str  # "official", "simulated", "stand-in" or "file"
    channels: tuple[Channel, ...]  # of the outputs
    samples: int
    skip: int  # samples at the beginning that do not count
    scored: int  # number of samples that count
    rmse: float | None  # error of the NL-LFR, or None; the nrmse if outputs have several units
    lti_rmse: float | None  # error of the linear model
    std: float  # standard deviation of the measured output; 1 if outputs have several units
    nrmse: float | None  # error over the standard deviation of each output
    rmse_by_output: tuple[float, ...]
    lti_rmse_by_output: tuple[float, ...]
    std_by_output: tuple[float, ...]
    start_error: float | None  # part of rmse by the uncertainty of an estimated start
    records: int = 1
    sums: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Errors summed over the samples of a horizon, by measure and by model."""
    ahead: int | None = None  # samples ahead, if these are errors of predictions

    @property
    def counted(self) -> str:
        """The samples that count, in words."""
        return of_samples(self.scored, self.samples, self.skip, self.records)

    @property
    def start_matters(self) -> bool:
        """True if the uncertainty of the start state is a visible part of the error."""
        added, error = self.start_error, self.rmse
        return added is not None and error is not None and added > 0.2 * error  # 2 % of its power

    def entry(self) -> dict[str, Any]:
        """Entry of ``metrics.json``, with errors by output and the number of records if several."""
        names = ("rmse", "lti_rmse", "nrmse")
        found: dict[str, Any] = {name: getattr(self, name) for name in names}
        found["unit"] = ", ".join(dict.fromkeys(channel.unit for channel in self.channels))
        for name in ("source", "samples", "skip", "use", "scored"):
            found[name] = getattr(self, name)
        if len(self.channels) > 1:
            found["outputs"] = [channel.name for channel in self.channels]
            found["rmse_by_output"] = list(self.rmse_by_output)
            found["lti_rmse_by_output"] = list(self.lti_rmse_by_output)
        if self.records > 1:
            found["records"] = self.records
        found |= {} if self.ahead is None else {"ahead": self.ahead}
        names = {_NL_LFR: "", _LINEAR: "lti_", _HOLD: "hold_"}
        for measure, by_model in self.sums.items():
            found |= {names[name] + measure: error for name, error in by_model.items()}
        return found | {"start_error": self.start_error}


def finite(entry: Any) -> Any:
    """The same nested entries with None in place of every number that JSON cannot hold."""
    if isinstance(entry, dict):
        return {key: finite(value) for key, value in entry.items()}
    if isinstance(entry, list):
        return [finite(value) for value in entry]
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry


def of_samples(scored: int, samples: int, skip: int, records: int = 1) -> str:
    """The scored samples in words, such as "last 400 of 2000"."""
    if not scored:
        return "not scored"
    last = skip and scored == samples - skip and records == 1
    return f"{'last ' * bool(last)}{scored} of {samples}"


@dataclass(frozen=True, eq=False)
class Response:
    """Simulations of a record by the models, in physical units."""

    record: Record
    use: str
    simulated: Mapping[str, Array]  # outputs (T, ny) by "linear" and "NL-LFR", one or both
    start_error: float | None = None
    sums: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # by measure and model
    ahead: int | None = None  # samples ahead of predicted outputs; None if they are simulated

    @property
    def y_linear(self) -> Array:
        """Output of the linear model (T, ny)."""
        return self.simulated[_LINEAR]

    @property
    def y_hat(self) -> Array:
        """Output of the NL-LFR (T, ny)."""
        return self.simulated[_NL_LFR]

    @property
    def scored(self) -> Array:
        """Measured output after the skip window (scored samples, ny)."""
        return self.record.y[self.record.skip :]

    @property
    def error(self) -> Array:
        """The NL-LFR's error after the skip window (scored samples, ny); 0 where y is not valid."""
        return self.record.errors(self.y_hat)

    @property
    def linear_error(self) -> Array:
        """Error of the linear model after the skip window; as ``error``."""
        return self.record.errors(self.y_linear)

    @property
    def diverged(self) -> bool:
        """True if the NL-LFR's output has samples that are not finite."""
        return not bool(np.isfinite(self.y_hat).all())

    @cached_property
    def score(self) -> Score:
        """Errors of both models on the samples that the record scores."""
        record, outputs = self.record, self.simulated.items()
        alike = of_one_unit(record.outputs)
        errors = {name: (rmse if alike else nrmse)(record, y) for name, y in outputs}
        by_output = {name: tuple(rmse_by_output(record, y).tolist()) for name, y in outputs}
        counted = [y[there] for y, there in zip(record.y.T, record.scored.T, strict=True)]
        std = [float(np.std(y - y[0])) if len(y) else math.nan for y in counted]
        known = np.square([deviation for deviation in std if not math.isnan(deviation)])
        return Score(
            use=self.use,
            source=record.source,
            channels=record.outputs,
            samples=record.samples,
            skip=record.skip,
            scored=record.scored_samples,
            rmse=errors.get(_NL_LFR),
            lti_rmse=errors.get(_LINEAR),
            std=(float(np.sqrt(np.mean(known))) if len(known) else math.nan) if alike else 1.0,
            nrmse=nrmse(record, self.y_hat) if _NL_LFR in errors else None,
            rmse_by_output=by_output.get(_NL_LFR, ()),
            lti_rmse_by_output=by_output.get(_LINEAR, ()),
            std_by_output=tuple(std),
            start_error=self.start_error,
            sums=self.sums,
            ahead=self.ahead,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    """An NL-LFR and linear models on all records of a dataset, each simulated once."""

    dataset: Dataset
    linear: LinearModel | None = None  # linear model of all training records
    predictors: Opponents = field(default_factory=dict)  # linear models for predictions
    model: Model | None = None
    refitted: Model | None = None  # model fitted to all estimation records, for the tests
    own: Mapping[str, LinearModel] = field(default_factory=dict)  # linear models of single tests
    horizon: int | None = None  # samples ahead at which records with measured starts are scored
    left_out: Sequence[Response] = ()  # responses of cross-validation

    @cached_property
    def simulations(self) -> list[Response]:
        """All records with both simulations."""
        # The estimated start of a training record is fitted to all its samples, as in the fit.
        found = []
        for use, record in self._records:
            linear, model = self._models(use, record)
            driven, added = fitted(record) if use == "train" else record, None
            if record.start == "measured" and self.horizon is not None:
                found.append(self._ahead(record, use, self.horizon))
                continue
            simulated = {} if linear is None else {_LINEAR: linear.simulate(driven)}
            if model is not None:
                simulated[_NL_LFR] = y_hat = model.simulate(driven)
                added = None if use == "train" else start_error(model, record, y_hat)
            found.append(Response(record, use, simulated, added))
        return [*found, *self.left_out]

    def _ahead(self, record: Record, use: str, horizon: int) -> Response:
        """Predictions of a record from each of its samples; figures show the end of each."""
        linear, model = self._models(use, record)
        models = {_LINEAR: None if linear is None else linear.to_model(), _NL_LFR: model}
        models = {name: each for name, each in models.items() if each is not None}
        measured = np.lib.stride_tricks.sliding_window_view(record.y, horizon, axis=0)[1:]
        measured = measured.transpose(0, 2, 1)
        held = np.broadcast_to(record.y[:-horizon, None], measured.shape)
        of = {name: each.ahead(record, horizon) for name, each in models.items()}
        sums = {
            measure: {
                name: float(error(y_hat, measured).mean(axis=0).sum())
                for name, y_hat in {_HOLD: held, **of}.items()
            }
            for measure, error in (self.dataset.ahead if use != "train" else {}).items()
        }
        shown = {
            name: record.shown(np.concatenate([record.y[:1], y_hat[0, :-1], y_hat[:, -1]]))
            for name, y_hat in of.items()
        }
        scored = replace(record, skip=max(record.skip, horizon))
        return Response(scored, use, shown, sums=sums, ahead=horizon)

    @cached_property
    def predictions(self) -> dict[int, list[Response]]:
        """All records with predictions by their samples ahead; empty for models without K."""
        if self.model is None or self.model.K is None:
            return {}
        found: dict[int, list[Response]] = {horizon: [] for horizon in HORIZONS}
        for use, record in self._records:
            own, model = self._models(use, record)
            assert model is not None
            driven = without_coordinates(fitted(record) if use == "train" else record)
            for horizon, responses in found.items():
                linear = self.predictors.get(horizon, own) if own is self.linear else own
                predicted = {} if linear is None else {_LINEAR: output(linear, driven, horizon)}
                predicted[_NL_LFR] = model.predict(driven, horizon=horizon)
                responses.append(Response(record, use, predicted))
        return found

    @cached_property
    def scores(self) -> dict[tuple[str, str], Score]:
        """Simulation errors by the use and the name of a record or group."""
        found: dict[tuple[str, str], list[Score]] = {}
        for response in self.simulations:
            name = self.dataset.score_of(response.record)
            found.setdefault((response.use, name), []).append(response.score)
        groups = self.dataset.groups
        return {key: _together(of) if key[1] in groups else of[-1] for key, of in found.items()}

    def scores_of(self, *uses: str) -> dict[str, Score]:
        """Scores of the records with these uses, by the name of the record or group."""
        return {n: score for use in uses for (of, n), score in self.scores.items() if of == use}

    @property
    def _records(self) -> list[tuple[str, Record]]:
        uses = {
            "train": self.dataset.train,
            "validation": self.dataset.validation,
            "selection": self.dataset.selection,
            "test": self.dataset.tests,
        }
        return [(use, record) for use, records in uses.items() for record in records]

    def _models(self, use: str, record: Record) -> tuple[LinearModel | None, Model | None]:
        """The linear model and the NL-LFR that simulate a record."""
        if use != "test":
            return self.linear, self.model
        own = self.own.get(self.dataset.score_of(record), self.linear)
        return own, self.refitted or self.model


def cross_validated(
    left_out: Sequence[tuple[Record, Array, Array]],
) -> list[Response]:
    """Responses of both models to the stretches of records that their fits left out."""
    found = []
    for record, linear, y_hat in left_out:
        name = CROSS if len(left_out) == 1 else f"{record.name}, {CROSS}"
        simulated = {_LINEAR: linear, _NL_LFR: y_hat}
        found.append(Response(replace(record, name=name), "validation", simulated))
    return found


def training_deviations(responses: Sequence[Response]) -> tuple[Array, Array]:
    """Standard deviations of inputs (nu,) and outputs (ny,) in training, or in all records."""
    train = [r for r in responses if r.use == "train"] or responses
    u, y = (np.concatenate(signal) for signal in zip(*map(_signals, train), strict=True))
    return u.std(axis=0), y.std(axis=0)


def has_settled(response: Response, deviations: tuple[Array, Array]) -> bool:
    """Tell whether inputs and outputs move little, relative to their deviations in training."""
    signals = zip(_signals(response), deviations, strict=True)
    return all((signal.std(axis=0) <= _STILL * usual).all() for signal, usual in signals)


def _signals(response: Response) -> tuple[Array, Array]:
    return response.record.u[response.record.skip :], response.scored


def ranked(responses: Sequence[Response]) -> list[Response]:
    """The tests, or the validation or training records; the NL-LFR's largest error comes first."""
    uses = [use for use in ("test", "validation", "train") if any(r.use == use for r in responses)]

    def relative(response: Response) -> float:
        error = response.score.nrmse
        return error if error is not None and math.isfinite(error) else math.inf

    chosen = (response for response in responses if response.use == uses[0])
    return sorted(chosen, key=relative, reverse=True)


def worst_residuals(responses: Sequence[Response]) -> Residuals | None:
    """Residuals of the record with the largest error among those that do not diverge."""
    for response in ranked(responses):
        if not response.diverged and len(response.scored) >= SHORTEST:
            return Residuals(of_simulation(response.record, response.y_hat))
    return None


def _together(scores: Sequence[Score]) -> Score:
    """The score of a group of records: the mean of the records' RMSE for each output."""

    def mean(values: Sequence[Any]) -> float | None:
        return None if None in values else float(np.mean(values))

    def each(name: str) -> tuple[float, ...]:
        return tuple(np.mean([getattr(s, f"{name}_by_output") for s in scores], axis=0).tolist())

    errors = {name: each(name) for name in ("rmse", "lti_rmse", "std")}
    alike = of_one_unit(scores[0].channels)
    joint = {n: e if alike else [getattr(s, n) for s in scores] for n, e in errors.items()}
    return replace(
        scores[0],
        rmse=mean(joint["rmse"]) if errors["rmse"] else None,
        lti_rmse=mean(joint["lti_rmse"]) if errors["lti_rmse"] else None,
        std=float(np.mean(joint["std"])),
        nrmse=mean([s.nrmse for s in scores]),
        start_error=mean([s.start_error for s in scores]),
        records=len(scores),
        sums={
            measure: {name: float(np.mean([s.sums[measure][name] for s in scores])) for name in of}
            for measure, of in scores[0].sums.items()
        },
        **{f"{name}_by_output": values for name, values in errors.items()},
        **{name: sum(getattr(s, name) for s in scores) for name in ("samples", "skip", "scored")},
    )
