"""The figures of a run: outputs, errors, static map, steps, convergence, the linear model."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from lfrtorch._support.errors import InputError
from lfrtorch.analysis.confidence_bands import Band, Uncertainty, uncertainty
from lfrtorch.analysis.model_plots import static_figure
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record, common_unit
from lfrtorch.fitting.refit import estimation_records
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.reporting import linear_plots, plots
from lfrtorch.reporting.evaluation import Response, ranked
from lfrtorch.reporting.run import Run
from lfrtorch.reporting.step_plots import steps

MOST_OUTPUTS = 4
"""Largest number of outputs in one figure."""

MOST_RECORDS = 4
"""Largest number of records of which the report shows all views."""

_MOST_WORK = 1e9
"""Largest number of samples times squared parameters with which bands are drawn: 1 to 2 s."""

Views = dict[str, dict[str, str]]
"""Captions by the names of records, then of figures."""


def of_run(run: Run) -> tuple[dict[str, Figure], Views]:
    """All figures of a run by file name, and captions of the records in the report."""
    # The report shows the tests; without tests, the validation or training records. The first has
    # the largest error. From a group with one score, only the record with the largest error is
    # shown.
    model, bla, dataset = run.fit.model, run.linear, run.dataset
    drawn, views = of_records(run.simulations, dataset, _uncertainty(run))
    with suppress(InputError):  # a linear model, or one that diverges
        drawn["static_map"] = static_figure(model, dataset.train[0])
    with suppress(InputError):  # no rest
        drawn["steps"] = steps(model, bla, dataset.train)
    unit = common_unit(model.outputs)
    drawn["convergence"] = plots.convergence(run.fit.history, run.fit.chosen_iteration, unit)
    drawn["frequency_response"] = linear_plots.frequency_response(bla, _measured(dataset.train))
    drawn["poles_and_zeros"] = linear_plots.poles_and_zeros(bla)
    if run.residuals is not None:
        drawn["residuals"] = run.residuals.plot()
    return drawn, views


def of_records(
    simulated: Sequence[Response], dataset: Dataset, known: Uncertainty | None = None
) -> tuple[dict[str, Figure], Views]:
    """Figures of the errors of all tests, and all views of the records with the largest errors."""
    largest: dict[str, Response] = {}
    for response in ranked(simulated):
        largest.setdefault(dataset.score_of(response.record), response)
    shown = list(largest.values())
    drawn: dict[str, Figure] = {}
    views: Views = {}
    for response in shown[:MOST_RECORDS]:
        record = response.record
        own, views[record.name] = of_record(record, response.simulated, known)
        drawn |= own
    for response in shown[MOST_RECORDS:]:
        if response.use == "test":
            record = response.record
            if plots.is_whole(record):
                drawn[record.name] = plots.spectrum(record, response.simulated)
            else:
                drawn[record.name] = plots.response(record, response.simulated)
                drawn[f"{record.name}_density"] = plots.density(record, response.simulated)
    return drawn, views


def of_record(
    record: Record, simulated: plots.Simulated, known: Uncertainty | None = None
) -> tuple[dict[str, Figure], dict[str, str]]:
    """All views of a record by file name, and captions of the views of its first outputs."""
    name, ny = record.name, len(record.outputs)
    whole = plots.is_whole(record)
    spectrum = plots.spectrum if whole else plots.density
    of_spectrum = "Spectrum over whole periods." if whole else "Power spectral density."
    of_near, band = "The grey stretch, near the largest error.", _band(record, known)
    if known is not None and band is not None:
        of_near += " Band: it contains 95 % of the errors, if all errors come from noise and from "
        of_near += "the uncertainty of the parameters."
        of_near += "".join(f" But {doubt.rstrip('.')}." for doubt in known.doubts[:1])
    views = (
        ("_response" * whole, plots.response, "Outputs and errors. Fit: 100 % − NRMSE."),
        ("_near", partial(plots.close_up, band=band), of_near),
        ("_density" * (not whole), spectrum, of_spectrum),
        ("_distribution", plots.distribution, "Distribution of the errors."),
    )
    drawn, captions = {}, {}
    more = f" Outputs {MOST_OUTPUTS + 1} to {ny}: in figures/." if ny > MOST_OUTPUTS else ""
    for first in range(0, ny, MOST_OUTPUTS):
        outputs = range(first, min(first + MOST_OUTPUTS, ny))
        for view, draw, caption in views:
            page = f"_{first + 1}_to_{outputs[-1] + 1}" if first else ""
            drawn[f"{name}{view}{page}"] = draw(record, simulated, outputs)
            if not first:
                captions[f"{name}{view}"] = caption + more
    return drawn, captions


def _uncertainty(run: Run) -> Uncertainty | None:
    """Uncertainty of the parameters, if simulations were fitted and the model is not too large."""
    records = run.dataset.train if run.refit is None else estimation_records(run.dataset)
    samples = sum(record.y.size for record in records)
    large = samples * run.model.parameter_count**2 > _MOST_WORK
    if large or run.settings.horizon is not None:
        return None
    try:
        return uncertainty(run.model, records)
    except ValueError:  # predictions were fitted, or there are more parameters than samples
        return None


def _band(record: Record, known: Uncertainty | None) -> Band | None:
    """The band of a record; None if the record is too long, or the band is not finite."""
    if known is None or record.y.size * len(known.kept) ** 2 > _MOST_WORK:
        return None
    band = known.simulate(record)
    return band if np.isfinite(band.std).all() else None


def _measured(records: Sequence[Record]) -> FRF | None:
    """The nonparametric frequency response, if the records give one in seconds."""
    # Up to this length, the estimate takes at most 3 s.
    if sum(record.samples for record in records) > 500_000:
        return None
    try:
        return estimate_frf(records)
    except ValueError:
        return None
