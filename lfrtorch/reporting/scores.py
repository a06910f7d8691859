"""Scores of a run: an entry for each test record or group, as a table and as JSON."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from lfrtorch._support import tables
from lfrtorch._support.reasons import Reason
from lfrtorch._support.types import Array
from lfrtorch.analysis.amplitude_margin import largest_stable_amplitude
from lfrtorch.analysis.residual_analysis import Residuals
from lfrtorch.analysis.start_uncertainty import start_error
from lfrtorch.dataset import LISTED, Dataset, Published
from lfrtorch.fitting.size_search import SizeSearch
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.linear.model import LinearModel
from lfrtorch.metrics import nrmse, rmse, rmse_by_output
from lfrtorch.model import Model
from lfrtorch.records import Record, common_unit, without_coordinates
from lfrtorch.reporting.verdict import Verdict

HORIZONS = 1, 10, 100
"""Samples ahead that predictions are scored at."""

ERRORS = "rmse", "lti_rmse"
"""Entries of a score in the unit of the outputs: of the NL-LFR and of the linear model."""

NOT_SCORED = "not scored"
"""What tables say of a record of which no sample counts."""

SEEN = 0.2
"""Part of an RMSE that an error must have to be told: it makes 2 % of it."""

FROM_START = (
    "from the start: what the uncertainty of the estimated start state adds to the NL-LFR's error"
)
"""Of the column that says so."""

REFITTED = "Refitted to all estimation records: validation errors are those before it."
"""What is said of a model that was."""


@dataclass(frozen=True)
class Score:
    """Simulation errors on one record, after its skip window.

    Args:
        rmse, lti_rmse: of the model and of the linear model, in ``unit``; None without the latter.
        nrmse: rmse over the standard deviation of the measured output.
        unit: of the outputs.
        source: ``"official"``, ``"simulated"``, ``"stand-in"`` or ``"file"``.
        samples, skip: length of the record, and how many at its beginning do not count.
        use: ``"test"``, ``"validation"`` or ``"selection"``.
        scored: how many samples count.
        outputs: their names.
        rmse_by_output, lti_rmse_by_output: errors of each output.
        records: how many the score is of.
        start_error: what the uncertainty of an estimated start state adds to ``rmse``, see
            ``lfrtorch.analysis.start_uncertainty.start_error``.
    """

    rmse: float
    lti_rmse: float | None
    nrmse: float
    unit: str
    source: str
    samples: int
    skip: int
    use: str
    scored: int
    outputs: tuple[str, ...] = ()
    rmse_by_output: tuple[float, ...] = ()
    lti_rmse_by_output: tuple[float, ...] = ()
    records: int = 1
    start_error: float | None = None

    def entry(self) -> dict[str, Any]:
        """For ``metrics.json``: errors of each output and the number of records if several."""
        found = {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(self).items()}
        if len(self.outputs) < 2:
            for name in ("outputs", "rmse_by_output", "lti_rmse_by_output"):
                del found[name]
        if self.records == 1:
            del found["records"]
        return found


def score(model: Model, bla: LinearModel | None, record: Record, use: str = "test") -> Score:
    """Scores of the model, and of the linear model if there is one, on one record.

    The record says which samples are scored: see ``lfrtorch.score_window``.

    Example:
        >>> from lfrtorch.reporting.scores import score
        >>> found = score(model, bla, record)
        >>> found.samples, np.allclose(found.rmse, found.lti_rmse)  # the fit has not begun
        (400, True)
    """
    y_hat = model.simulate(record)
    y_linear = None if bla is None else bla.simulate(record)
    return Score(
        rmse=rmse(record, y_hat),
        lti_rmse=None if y_linear is None else rmse(record, y_linear),
        nrmse=nrmse(record, y_hat),
        unit=", ".join(dict.fromkeys(c.unit for c in record.outputs)),
        source=record.source,
        **counted(record),
        use=use,
        outputs=tuple(channel.name for channel in record.outputs),
        rmse_by_output=_by_output(record, y_hat),
        lti_rmse_by_output=() if y_linear is None else _by_output(record, y_linear),
        start_error=start_error(model, record, y_hat),
    )


def _by_output(record: Record, y_hat: Array) -> tuple[float, ...]:
    """RMSE of each output over the scored samples."""
    return tuple(rmse_by_output(record, y_hat).tolist())


def together(scores: Sequence[Score]) -> Score:
    """The score of a group of records: means of the RMSE of each output of each record."""
    first = scores[0]
    of_starts = [s.start_error for s in scores if s.start_error is not None]
    errors, linear = (
        np.mean([getattr(s, f"{of}_by_output") for s in scores], axis=0) for of in ERRORS
    )
    return replace(
        first,
        rmse=float(np.mean(errors)),
        lti_rmse=float(np.mean(linear)) if linear.size else None,
        nrmse=float(np.mean([s.nrmse for s in scores])),
        rmse_by_output=tuple(errors.tolist()),
        lti_rmse_by_output=tuple(linear.tolist()),
        records=len(scores),
        start_error=float(np.mean(of_starts)) if len(of_starts) == len(scores) else None,
        **{name: sum(getattr(s, name) for s in scores) for name in ("samples", "skip", "scored")},
    )


def metrics(
    result: FitResult,
    bla: LinearModel,
    dataset: Dataset,
    *,
    own: Mapping[str, LinearModel] | None = None,
    seeds: Sequence[int],
    command: str = "",
    search: SizeSearch | None = None,
    verdict: Verdict | None = None,
    refit: FitResult | None = None,
    residuals: Residuals | None = None,
) -> dict:
    """What ``metrics.json`` holds, scores by test record; None if a number is not finite.

    Args:
        result: the fit.
        bla: linear model of all training records.
        dataset: what was fitted, chosen on and is scored.
        own: linear models of single tests, by name (see ``Dataset.linear``).
        seeds: of the random starts.
        command: that made it.
        search: for the sizes, if they were not given.
        verdict: on the fit.
        refit: the fit to all estimation records, if there was one. Its model is scored on the
            tests; validation errors are those before it.
        residuals: of the record with the largest error.
    """
    model = result.model if refit is None else refit.model
    entries = evaluation(model, bla, dataset, own=own, command=command, chosen=result.model)
    entries["data"] |= {
        "samples": sum(record.samples for record in dataset.train),
        "seed": dataset.seed,
    }
    entries |= {
        "verdict": None if verdict is None else asdict(verdict),
        "sizes_search": [] if search is None else search.entries(),
        "fit": {
            "iterations": result.iterations,
            "seconds": result.seconds,
            "seconds_per_iteration": result.seconds_per_iteration,
            "reason": result.outcome,
        },
        "chosen_iteration": result.chosen_iteration,
        "refit": None
        if refit is None
        else {
            "iterations": refit.iterations,
            "seconds": refit.seconds,
            "reason": refit.outcome,
            "train_before": refit.history[0].train,
            "train": refit.history[refit.chosen_iteration].train,
        },
        "residuals": {} if residuals is None else residuals.entries(),
        "stable_to": largest_stable_amplitude(model, dataset.train),
        "starts": max(1, len(result.starts)),
        "averaged": result.averaged,
        "distilled": result.distilled,
        "ranking": [{"seed": seeds[start.number], **asdict(start)} for start in result.starts],
    }
    return _finite(entries)


def evaluation(
    model: Model,
    bla: LinearModel | None,
    dataset: Dataset,
    *,
    own: Mapping[str, LinearModel] | None = None,
    command: str,
    chosen: Model | None = None,
) -> dict:
    """What ``metrics`` has without a fit: scores of a model, and of a linear one if given, on data.

    Args:
        model, bla: what is scored.
        dataset, own, command: see :func:`metrics`.
        chosen: what is scored on validation and selection, if the model was fitted to them.
    """
    own, chosen = own or {}, chosen or model
    validation = [score(chosen, bla, record, "validation") for record in dataset.validation]
    selection = [score(chosen, bla, record, "selection") for record in dataset.selection]
    entries = {
        "bench": dataset.name,
        "sizes": model.sizes,
        "parameters": model.parameter_count,
        "parameters_net": model.net_parameter_count,
        "lti_nx": None if bla is None else bla.nx,
        "data": {"noise_rms": dataset.noise_rms, "notes": list(dataset.notes)},
        "validation": {
            "rmse": _pooled([s.rmse for s in validation], validation),
            "lti_rmse": _pooled([s.lti_rmse for s in validation], validation),
            "records": _entries(
                dataset, (*dataset.validation, *dataset.selection), (*validation, *selection)
            ),
        },
        "scores": _entries(
            dataset,
            dataset.tests,
            [
                score(model, own.get(dataset.score_of(record), bla), record)
                for record in dataset.tests
            ],
        ),
        "predictions": predictions(model, chosen, bla, dataset),
        "linear": {name: list(dataset.linear[name]) for name in own},
        "command": command,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("lfrtorch", "torch", "numpy", "scipy", "numba")},
        },
    }
    return _finite(entries)


def predictions(
    model: Model, chosen: Model, bla: LinearModel | None, dataset: Dataset
) -> dict[str, dict[str, Any]]:
    """RMSE of predictions by record: use, and errors of both models at each of ``HORIZONS``.

    Args:
        model, chosen, bla, dataset: see :func:`evaluation`; nothing of a model without K.
    """
    if model.K is None:
        return {}
    linear = None if bla is None or bla.K is None else bla.to_model()
    found = {}
    for use, records in (("test", dataset.tests), ("validation", dataset.validation)):
        own = model if use == "test" else chosen
        for record in map(without_coordinates, records):
            found[record.name] = {"use": use, "unit": common_unit(record.outputs)} | {
                name: {}
                if one is None
                else {str(h): rmse(record, one.predict(record, horizon=h)) for h in HORIZONS}
                for name, one in (("rmse", own), ("lti_rmse", linear))
            }
    return found


def prediction_table(result: Mapping[str, Any]) -> str:
    """Errors of predictions, a line a record and model; nothing without them."""
    listed = result["predictions"]
    if not listed:
        return ""
    units = {of["unit"] for of in listed.values()}
    errors = [e for of in listed.values() for part in ERRORS for e in of[part].values()]
    factor, unit = tables.engineering(errors, units.pop() if len(units) == 1 else "")
    rows = [
        [name, of["use"], which, *(tables.times(factor, e) for e in of[part].values())]
        for name, of in listed.items()
        for part, which in (("lti_rmse", "linear"), ("rmse", "NL-LFR"))
        if of[part]
    ]
    ahead = [f"{h} sample{'s' if h > 1 else ''} ahead" for h in HORIZONS]
    title = f"Prediction RMSE{f' ({unit})' if unit else ''}"
    return f"\n\n{title}\n\n{tables.table(['record', 'use', 'model', *ahead], rows)}"


def _entries(
    dataset: Dataset, records: Sequence[Record], scores: Sequence[Score]
) -> dict[str, dict[str, Any]]:
    """Entries by name: one a record, or one a group of them."""
    found: dict[str, list[Score]] = {}
    for record, of in zip(records, scores, strict=True):
        found.setdefault(dataset.score_of(record), []).append(of)
    return {
        name: (together(of) if name in dataset.groups else of[-1]).entry()
        for name, of in found.items()
    }


def table(result: Mapping[str, Any], published: Sequence[Published]) -> str:
    """Our linear model and NL-LFR beside the published ones, in one unit; tests come first."""
    sizes = result["sizes"]
    mine = (sizes["nz"], sizes["nw"])
    others = [p for p in published if p.sizes in (None, mine)]
    listed = [*result["scores"].items(), *result["validation"]["records"].items()]
    sources = any(s["source"] != "file" for _, s in listed)
    models = ["lti_rmse", "rmse"] if sizes["nz"] else ["rmse"]
    shown = [(line, s, of) for name, s in listed for line, of in lines(name, s, others)]
    tested = {line for line, s, _ in shown if s["use"] == "test"}
    factor, unit = tables.engineering(
        [s[model] for _, s in listed for model in models], unit_of(result), published_unit(others)
    )
    others = [p for p in others if tested & p.scores.keys()]
    ours = [linear_name(result), "NL-LFR"] if sizes["nz"] else ["linear"]
    uncertain = any(map(start_matters, (s for _, s, _ in shown)))
    head = ["record", "use", *["source"] * sources, "scored", *ours]
    head += ["from the start"] * uncertain + [p.label for p in others]
    rows = [
        [
            *(line, s["use"], *[s["source"]] * sources, of_samples(s)),
            *(tables.times(factor, of[model]) for model in models),
            *[tables.times(factor, s["start_error"])] * uncertain,
            *(tables.times(factor, p.scores.get(line) if line in tested else None) for p in others),
        ]
        for line, s, of in shown
    ]
    title = f"Simulation RMSE{f' ({unit})' if unit else ''}"
    static = f"degree {sizes['degree']}" if "degree" in sizes else neurons(sizes)
    title += f", nx {sizes['nx']}, "
    title += f"nz {sizes['nz']}, nw {sizes['nw']}, {static}" if sizes["nz"] else "a linear model"
    if not rows:
        return f"{title}: nothing is scored, as there is no test and no validation record"
    predicted = prediction_table(result)
    references = [FROM_START] * uncertain
    references += [own_linear(result)] if result["linear"] else []
    references += [f"{p.label}: {p.reference}" for p in others]
    simulated = [title, "", tables.table(head, rows), *[""] * bool(references), *references]
    return "\n".join(simulated) + predicted


def lines(
    name: str, entry: Mapping[str, Any], published: Sequence[Published]
) -> list[tuple[str, Mapping[str, float | None]]]:
    """The errors of a score by name: all outputs together, and those that published figures name.

    Args:
        name: of the score.
        entry: of ``metrics.json``.
        published: what stands beside it.
    """
    found: list[tuple[str, Mapping[str, float | None]]] = [(name, {of: entry[of] for of in ERRORS})]
    named = {key.rpartition(" ")[2] for p in published for key in p.scores if " " in key}
    for i, output in enumerate(entry.get("outputs", [])):
        if output in named:
            each = {of: entry[f"{of}_by_output"] for of in ERRORS}
            errors = {of: values[i] if values else None for of, values in each.items()}
            found.append((f"{name} {output}", errors))
    return found


def linear_name(result: Mapping[str, Any]) -> str:
    """The linear model with its order, which may differ from run to run."""
    nx = result["lti_nx"]
    return "linear" if nx is None else f"linear (nx {nx})"


def own_linear(result: Mapping[str, Any]) -> str:
    """Which tests have a linear model of their own, and of which records."""
    models = [
        f"{name} of {'+'.join(of) if len(of) <= LISTED else f'{len(of)} training records'}"
        for name, of in result["linear"].items()
    ]
    return f"linear: a model for each of these: {', '.join(models)}"


def published_unit(published: Sequence[Published]) -> str:
    """The unit of tables, with a prefix, that publications give; none if they leave it open."""
    return next((p.unit for p in published if p.unit), "")


def unit_of(result: Mapping[str, Any]) -> str:
    """The unit of all errors in what :func:`metrics` returns; none if there are several."""
    listed = [*result["scores"].values(), *result["validation"]["records"].values()]
    units = {s["unit"] for s in listed} - {""}
    return units.pop() if len(units) == 1 else ""


def counted(record: Record) -> dict[str, int]:
    """How many samples a record has, skips and scores."""
    return {
        "samples": record.samples,
        "skip": record.skip,
        "scored": record.scored_samples,
    }


def of_samples(score: Mapping[str, Any]) -> str:
    """Which samples count, in words: the last ones of a record."""
    scored, samples, skip = (score[name] for name in ("scored", "samples", "skip"))
    if not scored:
        return NOT_SCORED
    last = skip and scored == samples - skip and score.get("records", 1) == 1
    return f"{'last ' * bool(last)}{scored} of {samples}"


def start_matters(score: Mapping[str, Any]) -> bool:
    """Whether the uncertainty of the start state makes a part of the error that is seen."""
    added, error = score["start_error"], score["rmse"]
    return added is not None and error is not None and added > SEEN * error


def neurons(sizes: Mapping[str, int]) -> str:
    """The neurons in words; maps that are not networks have none."""
    return f"{sizes['nn']} neurons" if sizes["nn"] else "a map of one's own"


def starts_table(result: Mapping[str, Any]) -> str:
    """The starts of a fit that went to the end, the best first, and how many others there were."""
    ended, others = finalists(result)
    names = ("train", "validation", "selection")
    factor, unit = tables.engineering([s[name] for s in ended for name in names], unit_of(result))
    head = ["seed", "iterations", "training", "validation", "selection", ""]
    rows = [
        [s["seed"], s["iterations"], *(tables.times(factor, s[n]) for n in names), s["reason"]]
        for s in ended
    ]
    title = f"Starts, RMSE of the best iterate of each{f' ({unit})' if unit else ''}"
    parts = [title, tables.table(head, rows), others]
    return "\n\n".join(part for part in parts if part)


def finalists(result: Mapping[str, Any]) -> tuple[list[Mapping[str, Any]], str]:
    """The entries of the starts that no others ended, and a line on those that others did.

    Args:
        result: what ``metrics`` returns.
    """
    ended = [start for start in result["ranking"] if start["reason"] != Reason.OTHERS_BETTER]
    count = len(result["ranking"]) - len(ended)
    others = f"{count} {'others' if count > 1 else 'other'} ended earlier: see metrics.json."
    return ended, others if count else ""


def _pooled(values: list[float | None], scores: list[Score]) -> float | None:
    """RMSE over several records, each with the weight of its scored samples."""
    squares = [s.scored * v**2 for s, v in zip(scores, values, strict=True) if v is not None]
    return (sum(squares) / sum(s.scored for s in scores)) ** 0.5 if squares else None


def _finite(entry: Any) -> Any:
    """The same nested entries with None for every number that JSON cannot hold."""
    if isinstance(entry, dict):
        return {key: _finite(value) for key, value in entry.items()}
    if isinstance(entry, list):
        return [_finite(value) for value in entry]
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry
