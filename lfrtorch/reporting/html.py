"""The report of a run as one HTML file that needs no network: numbers, figures, advice."""

from __future__ import annotations

import base64
import math
import os
import platform
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

import jinja2
import numpy as np
import torch

from lfrtorch._support.roots import frequency_and_damping, remark
from lfrtorch._support.tables import (
    UNKNOWN,
    Cell,
    cell,
    engineering,
    number,
    percent,
    quantities,
    quantity,
    radius,
)
from lfrtorch._support.types import Array
from lfrtorch.analysis.linearisation import poles_at_rest
from lfrtorch.analysis.residual_analysis import LEGEND as RESIDUALS_LEGEND
from lfrtorch.data.records import common_unit
from lfrtorch.fitting.choice import LEGEND, choice_table
from lfrtorch.reporting.evaluation import Evaluation, training_deviations
from lfrtorch.reporting.run import Run
from lfrtorch.reporting.score_columns import (
    ALL,
    Row,
    columns,
    in_units,
    rows_of,
    use_of,
)
from lfrtorch.reporting.scores import (
    ESTIMATION,
    in_words,
    linear_name,
    own_linear,
    stability,
    starts,
)
from lfrtorch.reporting.verdict import LINEAR_MODEL, of_linear

_FEW = 3  # at most so many tests are named one by one

_PAGES = jinja2.Environment(
    loader=jinja2.PackageLoader("lfrtorch.reporting"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(
    run: Run,
    images: Mapping[str, bytes],
    *,
    views: Mapping[str, Mapping[str, str]] | None = None,
    command: str = "",
    config: str = "",
) -> str:
    """Make the page of a run; ``images`` are PNG files by name, ``views`` captions by record."""
    tried = run.metrics["sizes_search"]
    groups = [(name, w) for name, w in run.fit.model.lfr.cell.named_parameters() if w.numel()]
    return _PAGES.get_template("report.html").render(
        images={name: _address(png) for name, png in images.items()},
        run=run,
        metrics=run.metrics,
        command=command or UNKNOWN,
        typed=command,
        config=config,
        date=datetime.now().strftime("%d %B %Y, %H:%M"),
        sizes=in_words(run.model.sizes, run.model.known_states, run.fit.averaged),
        comparisons=comparisons(run.evaluation),
        linear_is_used=run.verdict.use == LINEAR_MODEL,
        scores=_scores(run.evaluation),
        data=_data(run.evaluation),
        records=[{"name": name, "views": list(own.items())} for name, own in (views or {}).items()],
        residuals_legend=RESIDUALS_LEGEND,
        linear=run.linear,
        poles=_poles(run),
        fit=run.fit,
        starts=starts(run.fit, run.settings.seeds, common_unit(run.model.outputs)),
        search=(len(tried), choice_table(tried), LEGEND.splitlines()),
        parameters=[[name, " × ".join(map(str, w.shape)), w.numel()] for name, w in groups],
        stability=stability(run.metrics["stable_to"]),
        machine=_machine(run),
    )


def _address(png: bytes) -> str:
    """An image inside the page."""
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def comparisons(evaluation: Evaluation) -> list[str]:
    """Errors of the NL-LFR and of the linear model: a line for each output of a few tests."""
    # Without tests, the lines are about the validation records, or else the training records.
    responses = evaluation.simulations
    _, usual = training_deviations(responses)
    uses = ("test", "validation", "train")
    use = next(use for use in uses if any(response.use == use for response in responses))
    shown = []
    for response in (response for response in responses if response.use == use):
        rows = [r for r in rows_of(response.record.name, response.score) if r.output != ALL]
        # As in the verdict: a record in which little happens is not a measure.
        rows = [r._replace(std=np.fmax(r.std, own)) for r, own in zip(rows, usual, strict=True)]
        shown += [(r.record + f", {r.output}" * (len(rows) > 1), r) for r in rows]
    scored = sorted((item for item in shown if item[1].ratio > 0), key=lambda item: item[1].ratio)
    if len(shown) <= _FEW or not scored:
        return [_line(*item) for item in shown]
    least, most = (f"{percent(1 / e.ratio)} ({name})" for name, e in (scored[-1], scored[0]))
    relative = sorted(row.relative(row.error) or 0.0 for _, row in scored)
    line = (
        f"{len(scored)} {use} errors: {least} to {most} of the linear model's, "
        f"{percent(relative[0])} to {percent(relative[-1])} of the output's standard deviation"
    )
    return [line, *(_line(*item) for item in shown if item not in scored)]


def _line(name: str, row: Row) -> str:
    if row.error is None or not math.isfinite(row.error):
        return f"{name}: the NL-LFR diverges"
    error, linear = quantities([row.error, row.linear], row.unit)
    beside = of_linear(row.error / row.linear) if row.linear else "not comparable"
    relative = percent(row.relative(row.error))
    both = f"({error} against {linear})"
    return f"{name}: error {beside} {both}, {relative} of the output's standard deviation"


def _scores(evaluation: Evaluation) -> dict[str, Any]:
    model = evaluation.refitted or evaluation.model
    sizes = None if model is None else (model.sizes["nz"], model.sizes["nw"])
    published = [p for p in evaluation.dataset.published if p.sizes in (None, sizes)]
    found = evaluation.scores.items()
    rows = in_units([r for (_, name), s in found for r in rows_of(name, s)], published)
    of_tests = [row for row in rows if row.score.use == "test"]
    others = [row for row in rows if row.score.use != "test"]
    linear, references = linear_name(evaluation), own_linear(evaluation)
    references += [f"{p.label}: {p.reference}" for p in published if of_tests]
    references += [
        f"{name}: the uncertainty of its start state adds {quantity(s.start_error, unit)} to "
        f"the NL-LFR's error of {quantity(s.rmse, unit)}"
        for name, s in evaluation.scores_of("test", *ESTIMATION).items()
        if s.start_matters
        for unit in (common_unit(s.channels),)
    ]
    return {
        "unit": "" if len(evaluation.dataset.train[0].outputs) > 1 else rows[0].unit,
        "tests": columns("tests", of_tests, linear=linear, published=published),
        "references": references,
        "others": columns("others", others, linear=linear),
    }


def _data(evaluation: Evaluation) -> dict[str, Any]:
    dataset, train = evaluation.dataset, evaluation.dataset.train
    fs, samples = train[0].fs, sum(record.samples for record in train)
    summary = f"{_count(len(train), 'training record')}, {samples} samples"
    summary += f", sampled at {fs:g} Hz: {number(samples / fs)} s." if fs != 1.0 else "."
    if dataset.noise_rms is not None:
        noise = quantity(dataset.noise_rms, train[0].outputs[0].unit)
        summary += f" Noise of {noise} rms was added."
    channels = []
    for side, named in (("input", train[0].inputs), ("output", train[0].outputs)):
        signals = [r.u if side == "input" else r.y for r in train]
        signal = np.concatenate([s[r.skip :] for s, r in zip(signals, train, strict=True)])
        for channel, x in zip(named, signal.T, strict=True):
            moments = _moments(x)
            factor, unit = engineering([moments[1]], channel.unit)
            channels.append([channel.name, side, unit, *(factor * moment for moment in moments)])
    records = [
        [r.name, use_of(one.use, r.name), r.source, r.start, one.score.counted,
         r.period]
        for one, r in ((response, response.record) for response in evaluation.simulations)
    ]  # fmt: skip
    ranges = [
        f"{name} {number(low)} to {number(high)} {unit}".rstrip()
        for name, side, unit, _, _, low, high in channels
        if side == "input"
    ]
    more = f" and {len(ranges) - _FEW} more" if len(ranges) > _FEW else ""
    return {
        "fs": fs,
        "ranges": ", ".join(ranges[:_FEW]) + more,
        "summary": summary,
        "channels": channels,
        "records": records,
    }


def _moments(x: Array) -> list[float]:
    """Mean, standard deviation, smallest and largest sample; a mean of rounding errors is 0."""
    mean, deviation = float(np.mean(x)), float(np.std(x))
    mean = 0.0 if abs(mean) < 1e-12 * deviation else mean
    return [mean, deviation, float(np.min(x)), float(np.max(x))]


def _poles(run: Run) -> list[Sequence[Cell]]:
    """Rows of the table of poles of both models; the NL-LFR's poles are those at rest."""
    of = ("linear", run.linear.poles), ("NL-LFR", poles_at_rest(run.fit.model))
    return [
        [model, number(p["frequency"], 4), number(p["damping"], 4), radius(p["radius"]),
         remark(p, pole=True)]
        for model, values in of
        for p in frequency_and_damping(values, run.linear.fs)
    ]  # fmt: skip


def _machine(run: Run) -> list[Sequence[Cell]]:
    weight = run.fit.model.lfr.cell.A
    dtype = str(weight.dtype).removeprefix("torch.")
    return [
        ["machine", f"{platform.machine()}, {_count(os.cpu_count() or 1, 'CPU')}"],
        ["threads, device, dtype", f"{torch.get_num_threads()}, {weight.device}, {dtype}"],
        ["platform", platform.platform()],
        *run.metrics["versions"].items(),
    ]


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


_PAGES.filters |= {"cell": cell, "number": number, "count": _count}
