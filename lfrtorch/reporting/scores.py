"""Scores of a run: an entry for each test record or group, as a table and as JSON."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from lfrtorch._support import tables
from lfrtorch._support.reasons import Reason
from lfrtorch.analysis.amplitude_margin import LOUDER, largest_stable_amplitude
from lfrtorch.analysis.physical_parameters import PhysicalParameters
from lfrtorch.analysis.residual_analysis import Residuals
from lfrtorch.data.dataset import LISTED, Published
from lfrtorch.data.records import common_unit
from lfrtorch.fitting.choice import Choice
from lfrtorch.fitting.forgetting import Memory
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.reporting.evaluation import HORIZONS, Evaluation
from lfrtorch.reporting.score_columns import Row, columns, in_units, joint_unit
from lfrtorch.reporting.verdict import Verdict

ERRORS = "rmse", "lti_rmse"
"""Entries of a score in the unit of the outputs: of the NL-LFR and of the linear model."""

_MOST_ROWS = 24  # of outputs on the terminal; the report has all


def metrics(
    result: FitResult,
    evaluation: Evaluation,
    *,
    settings: Settings,
    choice: Choice | None = None,
    verdict: Verdict | None = None,
    refit: FitResult | None = None,
    residuals: Residuals | None = None,
    parameters: PhysicalParameters | None = None,
    memory: Memory | None = None,
) -> dict[str, Any]:
    """What ``metrics.json`` holds of a fit, but for its origin; None for what is not finite."""
    # A model fitted again is scored on the tests; validation errors are those before it.
    model, dataset = (refit or result).model, evaluation.dataset
    entries = scored(evaluation)
    entries["data"] |= {
        "samples": sum(record.samples for record in dataset.train),
        "seed": dataset.seed,
    }
    entries |= {
        "verdict": None if verdict is None else asdict(verdict),
        "used": settings.used,
        "sizes_search": [] if choice is None else choice.entries(),
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
        "known": {} if parameters is None else parameters.entries(),
        "residuals": {} if residuals is None else residuals.entries(),
        "stable_to": largest_stable_amplitude(model, dataset.train),
        "memory": None if memory is None else memory._asdict(),
        "starts": max(1, len(result.starts)),
        "averaged": result.averaged,
        "ranking": [
            {"seed": settings.seeds[start.number], **asdict(start)} for start in result.starts
        ],
    }
    return finite(entries)


def scored(evaluation: Evaluation, command: str = "") -> dict[str, Any]:
    """Scores of a model, and of a linear one if there is one: ``metrics`` without a fit."""
    dataset, bla = evaluation.dataset, evaluation.linear
    model = evaluation.refitted or evaluation.model
    assert model is not None
    entries = {
        use: {name: s.entry() for (of, name), s in evaluation.scores.items() if of == use}
        for use in ("validation", "selection", "test")
    }
    found = {
        "bench": dataset.name,
        "sizes": model.sizes,
        "parameters": model.parameter_count,
        "parameters_net": model.net_parameter_count,
        "known_states": model.known_states,
        "lti_nx": None if bla is None else bla.nx,
        "data": {"noise_rms": dataset.noise_rms, "notes": list(dataset.notes)},
        "validation": {
            **{error: _pooled(evaluation, error) for error in ERRORS},
            "records": entries["validation"] | entries["selection"],
        },
        "scores": entries["test"],
        "predictions": _predicted(evaluation),
        "linear": {name: list(dataset.linear[name]) for name in evaluation.own},
        "command": command,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("lfrtorch", "torch", "numpy", "scipy", "numba")},
        },
    }
    return finite(found)


def _pooled(evaluation: Evaluation, error: str) -> float | None:
    """RMSE over the validation records, each with the weight of its scored samples."""
    scores = [r.score for r in evaluation.simulations if r.use == "validation"]
    squares = [s.scored * e**2 for s in scores if (e := getattr(s, error)) is not None]
    return (sum(squares) / sum(s.scored for s in scores)) ** 0.5 if squares else None


def _predicted(evaluation: Evaluation) -> dict[str, dict[str, Any]]:
    """RMSE of predictions by record: use, and errors of both models at each of ``HORIZONS``."""
    found: dict[str, dict[str, Any]] = {}
    for use in ("test", "validation"):
        for horizon, responses in evaluation.predictions.items():
            for response in (r for r in responses if r.use == use):
                unit = common_unit(response.record.outputs)
                new = {"use": use, "unit": unit} | {error: {} for error in ERRORS}
                entry = found.setdefault(response.record.name, new)
                for error in ERRORS:
                    if (value := getattr(response.score, error)) is not None:
                        entry[error][str(horizon)] = value
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


def table(result: Mapping[str, Any], published: Sequence[Published]) -> str:
    """Our linear model and NL-LFR beside the published ones, in one unit; tests come first."""
    sizes, shown = result["sizes"], f"nx {result['sizes']['nx']}, a linear model"
    others = [p for p in published if p.sizes in (None, (sizes["nz"], sizes["nw"]))]
    rows = [
        Row(line, name, s, "", joint_unit(s), of["lti_rmse"], math.nan if e is None else e)
        for part in (result["scores"], result["validation"]["records"])
        for name, s in part.items()
        for line, of in lines(name, s, others)
        for e in (of["rmse"],)
    ]
    linear = linear_name(result)
    if sizes["nz"] or result["known_states"]:
        shown = in_words(result)
    else:
        linear, rows = "linear", [row._replace(linear=row.error, error=None) for row in rows]
    rows = in_units(rows, others)
    head, cells, _ = columns("terminal", rows, linear=linear, published=others)
    units = {row.unit for row in rows}
    listed = [*result["scores"].values(), *result["validation"]["records"].values()]
    ahead = next((s["ahead"] for s in listed if "ahead" in s), None)
    title = "Simulation RMSE" if ahead is None else f"RMSE of predictions {ahead} samples ahead"
    title += f" ({unit})" if len(units) == 1 and (unit := units.pop()) else ""
    if not rows:
        return f"{title}, {shown}: nothing is scored, as there is no test and no validation record"
    references = [
        "from the start: what the uncertainty of the estimated start state adds to the NL-LFR's "
        "error"
    ] * ("from the start" in head)
    references += [own_linear(result)] if result["linear"] else []
    references += [f"{p.label}: {p.reference}" for p in others if p.label in head]
    table = tables.table(head, cells)
    simulated = [f"{title}, {shown}", "", table, *[""] * bool(references), *references]
    more = [outputs_table(result), prediction_table(result), sums_table(result, published)]
    return "\n".join(simulated) + "".join(more)


def outputs_table(result: Mapping[str, Any]) -> str:
    """Errors of each output if there are several, of the tests or else of validation."""
    scored = result["scores"] or result["validation"]["records"]
    rows: list[list[tables.Cell]] = []
    for name, s in scored.items():
        outputs = s.get("outputs", [])
        units = s["unit"].split(", ")
        units = units if len(units) == len(outputs) else units[:1] * len(outputs)
        unknown = [None] * len(outputs)
        errors = (s.get(f"{of}_by_output") or unknown for of in ("lti_rmse", "rmse"))
        for output, unit, linear, error in zip(outputs, units, *errors, strict=True):
            rows.append([name, output, unit, linear, error])
    if not len(scored) < len(rows) <= _MOST_ROWS:  # a row a record is what the table above has
        return ""
    head = ["record", "output", "unit", linear_name(result), "NL-LFR"]
    kept = [i for i in range(len(head)) if any(row[i] not in (None, "") for row in rows)]
    listed = tables.table([head[i] for i in kept], [[row[i] for i in kept] for row in rows])
    return f"\n\nRMSE of each output\n\n{listed}"


def sums_table(result: Mapping[str, Any], published: Sequence[Published]) -> str:
    """Errors summed over the samples of a horizon, a line a record and measure; or nothing."""
    rows: list[list[tables.Cell]] = []
    for part in (result["scores"], result["validation"]["records"]):
        for name, s in part.items():
            for measure in (key.removeprefix("hold_") for key in s if key.startswith("hold_")):
                errors = [s.get(f"{which}{measure}") for which in ("hold_", "lti_", "")]
                others = [p.scores.get(f"{name} {measure}") for p in published]
                rows.append([name, s["use"], measure, *errors, *others])
    if not rows:
        return ""
    head = ["record", "use", "sum of", "hold", "linear", "NL-LFR", *(p.label for p in published)]
    kept = [i for i in range(len(head)) if any(row[i] is not None for row in rows)]
    rows = [[row[i] for i in kept] for row in rows]
    listed = tables.table([head[i] for i in kept], rows)
    return f"\n\nErrors from each sample on, summed over the horizon\n\n{listed}"


def lines(
    name: str, entry: Mapping[str, Any], published: Sequence[Published]
) -> list[tuple[str, Mapping[str, float | None]]]:
    """Errors of a score by name: all outputs together, and those that published figures name."""
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


def static_map(sizes: Mapping[str, int], known_states: int = 0) -> str:
    """The sizes in words."""
    if known_states:
        learned = f"; beside it {static_map(sizes)}" if sizes["nz"] else ""
        return f"a known model of {known_states} state(s){learned}"
    if "degree" in sizes:
        kind = f"polynomial of degree {sizes['degree']}"
    else:
        kind = f"{sizes['nn']} neurons" if sizes["nn"] else "a map of one's own"
    return f"nx {sizes['nx']}, nz {sizes['nz']}, nw {sizes['nw']}, {kind}"


def in_words(result: Mapping[str, Any]) -> str:
    """The sizes of the model of what :func:`metrics` returns; of a mean those of each model."""
    count = result.get("averaged", 1)
    each = {name: size // count for name, size in result["sizes"].items()}
    words = static_map(each, result["known_states"] // count)
    return f"mean of {count} models with {words}" if count > 1 else words


def starts_table(result: Mapping[str, Any], unit: str = "") -> str:
    """The starts of a fit that went to the end, and how many others there were."""
    unit, head, rows, others = starts(result, unit)
    title = f"Starts, RMSE of the best iterate of each{f' ({unit})' if unit else ''}"
    return "\n\n".join(part for part in (title, tables.table(head, rows), others) if part)


def starts(
    result: Mapping[str, Any], unit: str
) -> tuple[str, list[str], list[list[tables.Cell]], str]:
    """Unit, head and rows of the starts that no others ended, the best first, and of the others."""
    ended = [start for start in result["ranking"] if start["reason"] != Reason.OTHERS_BETTER]
    names = ("train", "validation", "selection")
    factor, unit = tables.engineering([s[name] for s in ended for name in names], unit)
    head = ["seed", "iterations", "training", "validation", "selection", ""]
    rows = [
        [s["seed"], s["iterations"], *(tables.times(factor, s[n]) for n in names), s["reason"]]
        for s in ended
    ]
    count = len(result["ranking"]) - len(ended)
    others = f"{count} {'others' if count > 1 else 'other'} ended earlier: see metrics.json."
    return unit, head, rows, others if count else ""


def origins(result: Mapping[str, Any]) -> list[str]:
    """What became of the best starts, if the model is not simply one of them."""
    said = []
    if result["averaged"] > 1:
        said.append(f"The model is the mean of the best {result['averaged']} starts.")
    if result["refit"] is not None:
        said.append("Refitted to all estimation records: validation errors are those before it.")
    return said


def stability(stable_to: float) -> str:
    """How much louder the training inputs may be."""
    tried = ", ".join(f"{factor:g}" for factor in LOUDER)
    if stable_to >= max(LOUDER):
        return (
            f"Stable on the training inputs {stable_to:g} times as loud, the most that was tried "
            f"({tried}). That says nothing of the accuracy there."
        )
    if stable_to < 1.0:
        return "The simulation runs away on the training inputs: the model is one for predictions."
    stable = f"{stable_to:g} times as loud" if stable_to > 1 else "as they are"
    return (
        f"Stable on the training inputs {stable}, and no longer on the next louder ones tried "
        f"({tried} times): validate at the amplitudes you will use."
    )


def finite(entry: Any) -> Any:
    """The same nested entries with None for every number that JSON cannot hold."""
    if isinstance(entry, dict):
        return {key: finite(value) for key, value in entry.items()}
    if isinstance(entry, list):
        return [finite(value) for value in entry]
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry
