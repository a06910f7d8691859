"""The report of a run as one HTML file that needs no network: numbers, figures, advice."""

from __future__ import annotations

import base64
import math
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

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
    times,
)
from lfrtorch._support.types import Array
from lfrtorch.analysis.linearisation import poles_at_rest
from lfrtorch.analysis.residual_analysis import LEGEND as RESIDUALS_LEGEND
from lfrtorch.fitting.size_search import LEGEND, size_table
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.linear.model import LinearModel
from lfrtorch.records import common_unit
from lfrtorch.reporting.evaluation import Evaluation, Score
from lfrtorch.reporting.run import Run
from lfrtorch.reporting.scores import (
    linear_name,
    neurons,
    of_samples,
    origins,
    own_linear,
    published_unit,
    stability,
    start_matters,
    starts,
)
from lfrtorch.reporting.verdict import LINEAR_MODEL, of_linear

_USES = {"train": "fitted", "validation": "chooses the iterate", "selection": "chooses the start"}
_FEW = 3  # most tests that the verdict names one by one
_ALL = "all"  # name of several outputs together


class _Errors(NamedTuple):
    """RMSE of the linear model and of the NL-LFR, linear / error, and both over the deviation."""

    output: str
    unit: str
    linear: float
    error: float
    ratio: float
    linear_relative: float
    relative: float


def render(
    run: Run,
    images: Mapping[str, bytes],
    *,
    views: Mapping[str, Mapping[str, str]] | None = None,
    command: str = "",
    config: str = "",
) -> str:
    """Make the page of a run.

    The images are PNG by the names of figures, and ``views`` has captions by the same names, of
    each record that is shown. The first two of the first record follow the verdict.
    """
    tried = run.metrics["sizes_search"]
    groups = [(name, w) for name, w in run.fit.model.lfr.cell.named_parameters() if w.numel()]
    return page(
        "report.html",
        images,
        run=run,
        metrics=run.metrics,
        command=command or UNKNOWN,
        config=config,
        date=datetime.now().strftime("%d %B %Y, %H:%M"),
        sizes=_sizes(run.metrics["sizes"]),
        comparisons=comparisons(run.evaluation),
        linear_is_used=run.verdict.use == LINEAR_MODEL,
        scores=_scores(run.metrics, run.evaluation),
        data=_data(run.evaluation),
        records=[{"name": name, "views": list(own.items())} for name, own in (views or {}).items()],
        residuals_legend=RESIDUALS_LEGEND,
        linear=_linear(run.linear, run.fit),
        fit=_fit(run),
        search=(len(tried), size_table(tried), LEGEND.splitlines()),
        parameters=[
            [name, " × ".join(map(str, w.shape)), w.numel()] for name, w in groups if w.numel()
        ],
        stability=stability(run.metrics["stable_to"]),
        facts=_facts(run),
    )


def page(template: str, images: Mapping[str, bytes], **values: Any) -> str:
    """Fill a template of ours, with images (PNG by name) inside."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lfrtorch.reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["cell"] = cell
    inside = {
        name: f"data:image/png;base64,{base64.b64encode(png).decode()}"
        for name, png in images.items()
    }
    return environment.get_template(template).render(images=inside, **values)


def comparisons(evaluation: Evaluation) -> list[str]:
    """How far the NL-LFR came, beside the linear model: a line for each output of a few tests.

    Without tests the lines are on the validation records, or else on the training records.
    """
    responses = evaluation.simulations
    uses = ("test", "validation", "train")
    use = next(use for use in uses if any(response.use == use for response in responses))
    shown = []
    for response in (response for response in responses if response.use == use):
        errors = [each for each in _errors(response.score) if each.output != _ALL]
        for each in errors:
            name = response.record.name + (f", {each.output}" if len(errors) > 1 else "")
            shown.append((name, each))
    scored = sorted((item for item in shown if item[1].ratio > 0), key=lambda item: item[1].ratio)
    if len(shown) <= _FEW or not scored:
        return [_line(*item) for item in shown]
    least, most = (f"{percent(1 / e.ratio)} ({name})" for name, e in (scored[-1], scored[0]))
    relative = [errors.relative for _, errors in scored]
    line = (
        f"{len(scored)} {use} errors: {least} to {most} of the linear model's, "
        f"NRMSE {percent(min(relative))} to {percent(max(relative))}"
    )
    return [line, *(_line(*item) for item in shown if item not in scored)]


def _line(name: str, errors: _Errors) -> str:
    if not math.isfinite(errors.error):
        return f"{name}: the NL-LFR diverges"
    error, linear = quantities([errors.error, errors.linear], errors.unit)
    relative = percent(errors.relative)
    beside = of_linear(errors.error / errors.linear) if errors.linear > 0 else "not comparable"
    return f"{name}: error {beside} ({error} against {linear}), NRMSE {relative}"


def _sizes(sizes: Mapping[str, int]) -> str:
    """The sizes of the model in words."""
    degree = sizes.get("degree")
    static = neurons(sizes) if degree is None else f"polynomial of degree {degree}"
    return f"nx {sizes['nx']}, nz {sizes['nz']}, nw {sizes['nw']}, {static}"


def _scores(metrics: Mapping[str, Any], evaluation: Evaluation) -> dict[str, Any]:
    sizes = metrics["sizes"]["nz"], metrics["sizes"]["nw"]
    published = [p for p in evaluation.dataset.published if p.sizes in (None, sizes)]
    compared = {key: _errors(score) for key, score in evaluation.scores.items()}
    in_unit = _units(compared.values(), published_unit(published))
    outputs = evaluation.dataset.train[0].outputs
    several, units = len(outputs) > 1, any(channel.unit for channel in outputs)
    what = [*["output"] * several, *["unit"] * (several and units)]
    errors = [linear_name(metrics), "NL-LFR", "ratio", "linear NRMSE", "NRMSE"]
    tests, others = [], []
    for (use, name), each in compared.items():
        for row, found in enumerate(each):
            factor, shown = in_unit[found.unit]
            cells = [*[found.output, shown][: len(what)], *_cells(found, factor)]
            if use == "test":
                key = name if row == 0 else f"{name} {found.output}"
                values = [times(factor, p.scores.get(key)) for p in published]
                known = values if row == 0 else ["" if v is None else v for v in values]
                tests.append([name if row == 0 else "", *cells, *known])
            else:
                others.append([*([name, _USES[use]] if row == 0 else ["", ""]), *cells])
    references = [own_linear(metrics)] if metrics["linear"] else []
    references += [f"{p.label}: {p.reference}" for p in published if tests]
    references += [
        f"{name}: the uncertainty of its start state adds {quantity(s['start_error'], s['unit'])} "
        f"to the NL-LFR's error of {quantity(s['rmse'], s['unit'])}"
        for name, s in (metrics["scores"] | metrics["validation"]["records"]).items()
        if start_matters(s)
    ]
    return {
        "unit": "" if several else in_unit[outputs[0].unit][1],
        "words": 1 + len(what),
        "head": ["record", *what, *errors, *(p.label for p in published)],
        "tests": tests,
        "references": references,
        "others_head": ["record", "use", *what, *errors],
        "others": others,
    }


def _errors(score: Score) -> list[_Errors]:
    """The errors of each output; before several of one unit those of all together."""
    columns = zip(
        score.channels,
        score.lti_rmse_by_output,
        score.rmse_by_output,
        score.std_by_output,
        strict=True,
    )
    single = [_compared(c.name, c.unit, *errors) for c, *errors in columns]
    units = {channel.unit for channel in score.channels}
    if len(single) == 1 or len(units) > 1:
        return single
    assert score.lti_rmse is not None
    assert score.rmse is not None
    return [_compared(_ALL, units.pop(), score.lti_rmse, score.rmse, score.std), *single]


def _compared(output: str, unit: str, linear: float, error: float, std: float) -> _Errors:
    std = std or math.nan
    ratio = linear / error if error > 0 else math.nan
    return _Errors(output, unit, linear, error, ratio, linear / std, error / std)


def _units(compared: Iterable[Sequence[_Errors]], shown: str = "") -> dict[str, tuple[float, str]]:
    """Of each unit of the outputs a factor and the unit with a prefix, for all of their errors."""
    values: dict[str, list[float]] = {}
    for errors in (errors for each in compared for errors in each):
        values.setdefault(errors.unit, []).extend([errors.linear, errors.error])
    return {unit: engineering(own, unit, shown) for unit, own in values.items()}


def _cells(errors: _Errors, factor: float) -> list[Cell]:
    shown = factor * errors.error if math.isfinite(errors.error) else "diverges"
    relative = percent(errors.linear_relative), percent(errors.relative)
    return [factor * errors.linear, shown, errors.ratio, *relative]


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
        [r.name, _USES.get(one.use, one.use), r.source, r.start, of_samples(one.score.entry()),
         r.period]
        for one, r in ((response, response.record) for response in evaluation.simulations)
    ]  # fmt: skip
    return {
        "summary": summary,
        "channels": channels,
        "records": records,
    }


def _moments(x: Array) -> list[float]:
    """Mean, rms about it, smallest and largest sample; a mean that is rounding errors is 0."""
    mean, deviation = float(np.mean(x)), float(np.std(x))
    mean = 0.0 if abs(mean) < 1e-12 * deviation else mean
    return [mean, deviation, float(np.min(x)), float(np.max(x))]


def _linear(bla: LinearModel, result: FitResult) -> dict[str, Any]:
    summary, notes = f"Order {bla.nx}.", ()
    if bla.fit is not None:
        notes = bla.fit.notes
        summary = (
            f"Order {bla.nx}, {bla.fit.criterion} error {number(bla.fit.rmse)} (normalised), "
            f"{_count(bla.fit.iterations, 'iteration')}, {bla.fit.reason}."
        )
    caption = "Frequency response of the model, over the measured one if the records give one"
    if bla.covariance is not None:
        caption += "; band: ± 2 standard deviations"
    poles: list[Sequence[Cell]] = []
    for model, values in (("linear", bla.poles), ("NL-LFR", poles_at_rest(result.model))):
        poles += [
            [
                model,
                *(number(p[key], 4) for key in ("frequency", "damping")),
                radius(p["radius"]),
                remark(p, pole=True),
            ]
            for p in frequency_and_damping(values, bla.fs)
        ]
    return {"summary": summary, "notes": notes, "caption": f"{caption}.", "poles": poles}


def _fit(run: Run) -> dict[str, Any]:
    fit, count = run.metrics["fit"], len(run.metrics["ranking"])
    unit, head, rows, others = starts(run.metrics, common_unit(run.model.outputs))
    judge = "validation" if run.dataset.validation else "training"
    said = [
        f"{fit['reason'].capitalize()}; kept iteration {run.metrics['chosen_iteration']} of "
        f"{fit['iterations']}, the best on {judge}.",
        *[f"The best of {count} starts."] * (count > 1),
        *origins(run.metrics),
    ]
    return {"summary": " ".join(said), "unit": unit, "head": head, "starts": rows, "others": others}


def _facts(run: Run) -> list[list[str]]:
    fit, found = run.metrics["fit"], run.linear.fit
    weight = run.fit.model.lfr.cell.A
    facts = [
        ["time of the fit", f"{number(fit['seconds'])} s"],
        ["an iteration", f"{number(1e3 * fit['seconds_per_iteration'])} ms"],
    ]
    if found is not None:
        facts.append(["time of the linear model", f"{number(found.seconds)} s"])
    return [
        *facts,
        ["machine", f"{platform.machine()}, {_count(os.cpu_count() or 1, 'CPU')}"],
        ["threads, device, dtype", f"{torch.get_num_threads()}, {weight.device}, "
         f"{str(weight.dtype).removeprefix('torch.')}"],
        ["platform", platform.platform()],
        *([name, known] for name, known in run.metrics["versions"].items()),
    ]  # fmt: skip


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"
