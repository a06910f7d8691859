"""The figures of a run: outputs and errors, the static map, convergence, the linear model."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from lfrtorch.dataset import Dataset
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.model import LinearModel
from lfrtorch.metrics import nrmse
from lfrtorch.records import Record
from lfrtorch.reporting import linear_plots, plots
from lfrtorch.reporting.simulations import Response

MOST_OUTPUTS, MOST_RECORDS = 4, 4
"""Outputs in one figure, and records of which the report has all views."""

MOST_MEASURED = 500_000
"""Training samples up to which a nonparametric response is estimated for the report: 3 s."""


Views = dict[str, dict[str, str]]
"""Of records, by their names: captions by the names of their figures."""


def of_run(
    result: FitResult,
    bla: LinearModel,
    dataset: Dataset,
    simulated: Sequence[Response],
) -> tuple[dict[str, Figure], Views]:
    """All figures of a run's folder by file name, and those of the records that the report shows.

    The records are the tests; without tests those of validation, and else those of training. The
    first is that with the largest error.
    """
    model = result.model
    drawn, views = of_records(simulated)
    signals = model.signals(dataset.train[0])
    of_best = [s[0, :, : s.shape[2] // result.averaged].numpy() for s in (signals.z, signals.w)]
    drawn["static_map"] = plots.static_map(*of_best)
    units = {channel.unit for channel in model.outputs}
    unit = units.pop() if len(units) == 1 else ""
    drawn["convergence"] = plots.convergence(result.history, result.chosen_iteration, unit)
    drawn["frequency_response"] = linear_plots.frequency_response(bla, measured(dataset.train))
    drawn["poles_and_zeros"] = linear_plots.poles_and_zeros(bla)
    return drawn, views


def of_records(simulated: Sequence[Response]) -> tuple[dict[str, Figure], Views]:
    """Errors of all tests, and all views of the records with the largest errors."""
    uses = [use for use in ("test", "validation", "train") if any(r.use == use for r in simulated)]
    shown = [response for response in simulated if response.use == uses[0]]
    shown.sort(key=_relative, reverse=True)
    drawn: dict[str, Figure] = {}
    views: Views = {}
    for response in shown[:MOST_RECORDS]:
        views[response.record.name] = {}
        ny = len(response.record.outputs)
        for first in range(0, ny, MOST_OUTPUTS):
            outputs = range(first, min(first + MOST_OUTPUTS, ny))
            suffix = f"_outputs_{first + 1}_to_{outputs[-1] + 1}" if first else ""
            page, captions = _views(response, outputs, suffix)
            drawn |= page
            if not first:
                more = (
                    "" if ny <= MOST_OUTPUTS else f" Outputs from {MOST_OUTPUTS + 1} on: figures/."
                )
                views[response.record.name] = {n: text + more for n, text in captions.items()}
    for response in shown[MOST_RECORDS:]:
        if response.use == "test":
            record, signals = response.record, (response.record, response.y_linear, response.y_hat)
            drawn[record.name] = plots.errors(*signals)
            if not plots.is_whole(record):
                drawn[f"{record.name}_density"] = plots.density(*signals)
    return drawn, views


def _relative(response: Response) -> float:
    """The NL-LFR's error over the deviation of the output; infinite if it diverges."""
    error = nrmse(response.record, response.y_hat)
    return error if math.isfinite(error) else math.inf


def _views(
    response: Response, outputs: Sequence[int], suffix: str
) -> tuple[dict[str, Figure], dict[str, str]]:
    """Figures of a record and their captions, by names that end with the suffix."""
    record, name = response.record, response.record.name
    of = (record, response.y_linear, response.y_hat, outputs)
    whole = plots.is_whole(record)
    spectrum = plots.spectrum if whole else plots.density
    found = {
        f"{name}_response" if whole else name: (
            plots.response,
            "Measured and simulated output, and the errors. Fit: 100 % - NRMSE.",
        ),
        f"{name}_near": (plots.close_up, "The grey stretch: where the error is largest."),
        name if whole else f"{name}_density": (
            spectrum,
            "Spectrum over whole periods." if whole else "Power spectral density.",
        ),
        f"{name}_distribution": (plots.distribution, "How often which error occurs."),
    }
    drawn = {key + suffix: draw(*of) for key, (draw, _) in found.items()}
    return drawn, {key + suffix: text for key, (_, text) in found.items()}


def measured(records: Sequence[Record]) -> FRF | None:
    """The nonparametric frequency response, if the records give one in seconds."""
    if sum(record.samples for record in records) > MOST_MEASURED:
        return None
    try:
        return estimate_frf(records)
    except ValueError:
        return None
