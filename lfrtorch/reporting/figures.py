"""The figures of a run: errors on the tests, the static map, convergence, the linear model."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from lfrtorch.dataset import Dataset
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.model import LinearModel
from lfrtorch.records import Record
from lfrtorch.reporting import linear_plots, plots
from lfrtorch.reporting.simulations import Response

MOST_MEASURED = 500_000
"""Training samples up to which a nonparametric response is estimated for the report: 3 s."""


def of_run(
    result: FitResult,
    bla: LinearModel,
    dataset: Dataset,
    simulated: Sequence[Response],
) -> dict[str, Figure]:
    """All figures of a run's folder by file name."""
    model = result.model
    drawn: dict[str, Figure] = {}
    for shown in simulated:
        if shown.use == "test":
            record, signals = shown.record, (shown.record, shown.y_linear, shown.y_hat)
            drawn[record.name] = plots.errors(*signals)
            if not plots.is_whole(record):
                drawn[f"{record.name}_density"] = plots.density(*signals)
    signals = model.signals(dataset.train[0])
    of_best = [s[0, :, : s.shape[2] // result.averaged].numpy() for s in (signals.z, signals.w)]
    drawn["static_map"] = plots.static_map(*of_best)
    unit = model.outputs[0].unit
    drawn["convergence"] = plots.convergence(result.history, result.chosen_iteration, unit)
    drawn["frequency_response"] = linear_plots.frequency_response(bla, measured(dataset.train))
    drawn["poles_and_zeros"] = linear_plots.poles_and_zeros(bla)
    return drawn


def of_tests(simulated: Sequence[Response]) -> tuple[dict[str, Figure], dict[str, dict[str, str]]]:
    """Further figures of the tests, and of each test all its figures with captions."""
    drawn: dict[str, Figure] = {}
    views: dict[str, dict[str, str]] = {}
    for shown in simulated:
        if shown.use != "test":
            continue
        record, signals = shown.record, (shown.record, shown.y_linear, shown.y_hat)
        name, near = record.name, f"{record.name}_near"
        drawn[near] = plots.close_up(*signals)
        if plots.is_whole(record):
            response, spectrum, of = f"{name}_response", name, "Spectrum over whole periods."
            drawn[response] = plots.response(*signals)
        else:
            response, spectrum, of = name, f"{name}_density", "Power spectral density."
        views[name] = {
            response: "Measured output and errors against time.",
            near: "The same about the largest error of the NL-LFR.",
            spectrum: of,
        }
    return drawn, views


def measured(records: Sequence[Record]) -> FRF | None:
    """The nonparametric frequency response, if the records give one in seconds."""
    if sum(record.samples for record in records) > MOST_MEASURED:
        return None
    try:
        return estimate_frf(records)
    except ValueError:
        return None
