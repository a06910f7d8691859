"""The results of an identification."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from lfrtorch._support.tables import quantity
from lfrtorch.analysis.amplitude_margin import LOUDER, largest_stable_amplitude
from lfrtorch.analysis.dead_times import DeadTime
from lfrtorch.analysis.physical_parameters import PhysicalParameters
from lfrtorch.analysis.residual_analysis import Residuals
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import common_unit
from lfrtorch.fitting.choice import Choice
from lfrtorch.fitting.forgetting import Memory
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import OrderScan
from lfrtorch.model.model import Model
from lfrtorch.reporting import scores
from lfrtorch.reporting.advice import Advice
from lfrtorch.reporting.evaluation import Evaluation, Response, finite
from lfrtorch.reporting.verdict import Verdict


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """Result of :func:`lfrtorch.identify`; ``print(run)`` shows verdict and scores.

    Args:
        dataset: the records.
        settings: the settings, with the chosen sizes in place of ``"auto"``.
        linear: the best linear approximation of all training records.
        order_scan, choice: choice of nx and of the other sizes; None for sizes that were given.
        fit: the nonlinear fit: the best start, or the mean of several starts.
        refit: the fit to all estimation records, if ``settings`` ask for it. Its model is
            ``run.model``, and is scored on the tests; training and validation errors are those of
            ``fit.model``.
        evaluation: both models on every record.
        residuals: analysis of the record with the largest error, as the report shows it.
        parameters: parameters of the known model, if the settings contain a known model.
        dead_times: dead time of each input; empty if ``settings`` ask for no delay.
        memory: result of the test whether the simulation forgets its start; None if predictions or
            windows were fitted.
        metrics: contents of ``metrics.json``: scores by record, sizes, the fit in numbers.
        verdict: comparison of the NL-LFR with the linear model.
        advice: next steps, the most useful first.

    Example:
        >>> dataset = lfrtorch.Dataset("mine", train=[record], validation=[], tests=[record[200:]])
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=3)
        >>> run = lfrtorch.identify(dataset, lfrtorch.Settings(nx=1, nz=1, nn=4, trainer=trainer))
        >>> run
        Run(mine, nx=1, nz=1, nw=1, nn=4, maximum number of iterations)
        >>> run.model.simulate(record).shape
        (400, 1)
    """

    dataset: Dataset
    settings: Settings
    linear: LinearModel
    order_scan: OrderScan | None
    choice: Choice | None
    fit: FitResult
    refit: FitResult | None = None
    evaluation: Evaluation
    residuals: Residuals | None = None
    parameters: PhysicalParameters | None = None
    dead_times: tuple[DeadTime, ...] = ()
    memory: Memory | None = None
    metrics: Mapping[str, Any] = field(init=False)
    verdict: Verdict
    advice: list[Advice]

    def __post_init__(self) -> None:
        object.__setattr__(self, "metrics", self._metrics())

    @property
    def model(self) -> Model:
        """The nonlinear model."""
        return (self.refit or self.fit).model

    @property
    def simulations(self) -> list[Response]:
        """The responses of both models to every record."""
        return self.evaluation.simulations

    @property
    def origins(self) -> list[str]:
        """Sentences on the origin of the model, if it is not simply the best start."""
        mean = f"The model is the mean of the best {self.fit.averaged} starts."
        again = "Refitted to all estimation records: validation errors are those before it."
        return [mean] * (self.fit.averaged > 1) + [again] * (self.refit is not None)

    def __repr__(self) -> str:
        sizes = ", ".join(f"{name}={size}" for name, size in self.model.sizes.items())
        return f"Run({self.dataset.name}, {sizes}, {self.fit.outcome})"

    def __str__(self) -> str:
        fit, parts = self.fit, [f"{self.verdict}\n"]
        parts.append(
            f"{fit.outcome}; kept iteration {fit.chosen_iteration} of {fit.iterations}, "
            f"{quantity(fit.seconds, 's')}, "
            f"{quantity(1e3 * fit.seconds_per_iteration, 'ms')} an iteration\n"
        )
        if len(fit.starts) > 1:
            unit = common_unit(self.model.outputs)
            parts.append(scores.starts_table(fit, self.settings.seeds, unit) + "\n")
        parts += [f"{said}\n" for said in self.origins]
        parts.append(scores.table(self.evaluation, fit.averaged))
        if self.parameters is not None:
            parts.append(f"\n{self.parameters}\n")
        if self.dead_times:
            parts.append(f"\ndead time of {'; '.join(map(str, self.dead_times))}\n")
        if self.metrics["stable_to"] < max(LOUDER):
            parts.append(f"note: {scores.stability(self.metrics['stable_to'])}")
        if self.memory is not None and not self.memory.fades:
            parts.append(f"note: {self.memory}")
        return "\n".join(parts)

    def _metrics(self) -> dict[str, Any]:
        # A refitted model is scored on the tests; validation errors are those before the refit.
        fit, refit, dataset = self.fit, self.refit, self.dataset
        entries = scores.scored(self.evaluation)
        entries["data"] |= {
            "samples": sum(record.samples for record in dataset.train),
            "seed": dataset.seed,
        }
        entries |= {
            "verdict": self.verdict.entry(),
            "used": self.settings.used,
            "sizes_search": [] if self.choice is None else self.choice.entries(),
            "fit": {
                "iterations": fit.iterations,
                "seconds": fit.seconds,
                "seconds_per_iteration": fit.seconds_per_iteration,
                "reason": fit.outcome,
            },
            "chosen_iteration": fit.chosen_iteration,
            "refit": refit
            and {
                "iterations": refit.iterations,
                "seconds": refit.seconds,
                "reason": refit.outcome,
                "train_before": refit.history[0].train,
                "train": refit.history[refit.chosen_iteration].train,
            },
            "known": {} if self.parameters is None else self.parameters.entries(),
            "dead_times": [asdict(one) for one in self.dead_times],
            "residuals": {} if self.residuals is None else self.residuals.entries(),
            "stable_to": largest_stable_amplitude(self.model, dataset.train),
            "memory": self.memory and self.memory._asdict(),
            "starts": max(1, len(fit.starts)),
            "averaged": fit.averaged,
            "ranking": [
                {"seed": self.settings.seeds[start.number], **asdict(start)} for start in fit.starts
            ],
        }
        return finite(entries)
