"""Scores of a run, with an entry for each test record or group, as a table and as JSON."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from lfrtorch._support import tables
from lfrtorch._support.reasons import Reason
from lfrtorch.analysis.amplitude_margin import LOUDER
from lfrtorch.data.dataset import LISTED
from lfrtorch.data.records import common_unit
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.reporting.evaluation import HORIZONS, Evaluation, finite
from lfrtorch.reporting.score_columns import ALL, columns, in_units, named_rows, rows_of

ERRORS = "rmse", "lti_rmse"
"""Entries of a score in the unit of the outputs: errors of the NL-LFR and the linear model."""

ESTIMATION = "validation", "selection"
"""Uses of records that choose among models, and are not fitted."""

_MOST_ROWS = 24  # a longer table of outputs is only in the report


def scored(evaluation: Evaluation, command: str = "") -> dict[str, Any]:
    """Scores of a model, and of a linear model if there is one, as in ``metrics.json``."""
    dataset, bla = evaluation.dataset, evaluation.linear
    model = evaluation.refitted or evaluation.model
    assert model is not None
    chosen_on, tests = (
        {name: score.entry() for name, score in evaluation.scores_of(*uses).items()}
        for uses in (ESTIMATION, ("test",))
    )
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
            "records": chosen_on,
        },
        "scores": tests,
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
    """RMSE over all scored samples of the validation records."""
    scores = [r.score for r in evaluation.simulations if r.use == "validation"]
    squares = [s.scored * e**2 for s in scores if (e := getattr(s, error)) is not None]
    return (sum(squares) / sum(s.scored for s in scores)) ** 0.5 if squares else None


def _predicted(evaluation: Evaluation) -> dict[str, dict[str, Any]]:
    """Entries by record: its use, and the RMSE of both models' predictions at ``HORIZONS``."""
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


def table(
    evaluation: Evaluation,
    averaged: int = 1,  # number of models whose mean our model is
) -> str:
    """Table of errors of our models and of published models, in one unit; tests come first."""
    model, published = evaluation.refitted or evaluation.model, evaluation.dataset.published
    assert model is not None
    others = [p for p in published if p.sizes in (None, (model.sizes["nz"], model.sizes["nw"]))]
    tests, chosen_on = evaluation.scores_of("test"), evaluation.scores_of(*ESTIMATION)
    listed = [*tests.items(), *chosen_on.items()]
    rows = [row for name, score in listed for row in named_rows(name, score, others)]
    linear, shown = linear_name(evaluation), in_words(model.sizes, model.known_states, averaged)
    if not model.sizes["nz"] and not model.known_states:
        linear, shown = "linear", f"nx {model.sizes['nx']}, a linear model"
        rows = [row._replace(linear=row.error, error=None) for row in rows]
    rows = in_units(rows, others)
    units = {row.unit for row in rows}
    ahead = next((s.ahead for _, s in listed if s.ahead is not None), None)
    title = "Simulation RMSE" if ahead is None else f"RMSE of predictions {ahead} samples ahead"
    title += _in_brackets(units.pop() if len(units) == 1 else "")
    if not rows:
        return f"{title}, {shown}: nothing is scored, as there is no test and no validation record"
    head, cells, _ = columns("terminal", rows, linear=linear, published=others)
    references = [
        "from the start: what the uncertainty of the estimated start state adds to the NL-LFR's "
        "error"
    ] * ("from the start" in head)
    references += own_linear(evaluation)
    references += [f"{p.label}: {p.reference}" for p in others if p.label in head]
    parts = [f"{title}, {shown}", tables.table(head, cells)]
    parts += ["\n".join(references)] * bool(references)
    several = [row for name, s in (tests or chosen_on).items() for row in rows_of(name, s)]
    several = [r for r in several if len(r.score.channels) > 1 and r.output != ALL]
    if 0 < len(several) <= _MOST_ROWS:  # the table above has a row for each record
        head, cells, _ = columns("outputs", several, linear=linear_name(evaluation))
        parts += ["RMSE of each output", tables.table(head, cells)]
    return "\n\n".join([*parts, *_prediction_table(evaluation), *_sums_table(evaluation)])


def _prediction_table(evaluation: Evaluation) -> list[str]:
    """Table of prediction errors, with a line for each record and model; empty without them."""
    listed = _predicted(evaluation)
    if not listed:
        return []
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
    head = ["record", "use", "model", *ahead]
    return [f"Prediction RMSE{_in_brackets(unit)}", tables.table(head, rows)]


def _sums_table(evaluation: Evaluation) -> list[str]:
    """Table of errors summed over a horizon, a line for each record and measure; may be empty."""
    published = evaluation.dataset.published
    names = "hold", "linear", "NL-LFR"
    rows: list[list[tables.Cell]] = [
        [
            name,
            score.use,
            measure,
            *(finite(by_model.get(model)) for model in names),
            *(p.scores.get(f"{name} {measure}") for p in published),
        ]
        for name, score in evaluation.scores_of("test", *ESTIMATION).items()
        for measure, by_model in score.sums.items()
    ]
    if not rows:
        return []
    head = ["record", "use", "sum of", *names, *(p.label for p in published)]
    kept = [i for i in range(len(head)) if any(row[i] is not None for row in rows)]
    shown = tables.table([head[i] for i in kept], [[row[i] for i in kept] for row in rows])
    return ["Errors from each sample on, summed over the horizon", shown]


def _in_brackets(unit: str) -> str:
    return f" ({unit})" if unit else ""


def linear_name(evaluation: Evaluation) -> str:
    """The name of the linear model with its order, which may differ from run to run."""
    return "linear" if evaluation.linear is None else f"linear (nx {evaluation.linear.nx})"


def own_linear(evaluation: Evaluation) -> list[str]:
    """A line on the tests that have their own linear models, and the records of each model."""
    linear = {name: evaluation.dataset.linear[name] for name in evaluation.own}
    models = [
        f"{name} from {'+'.join(of) if len(of) <= LISTED else f'{len(of)} training records'}"
        for name, of in linear.items()
    ]
    return [f"linear: each of these has its own model: {', '.join(models)}"] if models else []


def in_words(sizes: Mapping[str, int], known_states: int = 0, averaged: int = 1) -> str:
    """The sizes of a model in words; for a mean, the sizes of each of its models."""
    if averaged > 1:
        each = {name: size // averaged for name, size in sizes.items()}
        return f"mean of {averaged} models with {in_words(each, known_states // averaged)}"
    if known_states:
        learned = f"; beside it {in_words(sizes)}" if sizes["nz"] else ""
        return f"a known model of {known_states} state(s){learned}"
    if "degree" in sizes:
        kind = f"polynomial of degree {sizes['degree']}"
    else:
        kind = f"{sizes['nn']} neurons" if sizes["nn"] else "a map of one's own"
    return f"nx {sizes['nx']}, nz {sizes['nz']}, nw {sizes['nw']}, {kind}"


def starts_table(result: FitResult, seeds: Sequence[int], unit: str = "") -> str:
    """Table of the starts of a fit that ran to the end, and the number of the others."""
    unit, head, rows, others = starts(result, seeds, unit)
    title = f"Starts, RMSE of the best iterate of each{_in_brackets(unit)}"
    return "\n\n".join(part for part in (title, tables.table(head, rows), others) if part)


def starts(
    result: FitResult, seeds: Sequence[int], unit: str
) -> tuple[str, list[str], list[list[tables.Cell]], str]:
    """Unit, head and rows of the starts that ran to the end, and a sentence on the others."""
    ended = [start for start in result.starts if start.reason != Reason.OTHERS_BETTER]
    errors = [(start.train, start.validation, start.selection) for start in ended]
    factor, unit = tables.engineering([e for each in errors for e in each], unit)
    head = ["seed", "iterations", "training", "validation", "selection", ""]
    rows: list[list[tables.Cell]] = [
        [seeds[s.number], s.iterations, *(factor * e for e in each), s.reason]
        for s, each in zip(ended, errors, strict=True)
    ]
    count = len(result.starts) - len(ended)
    others = f"{count} {'others' if count > 1 else 'other'} ended earlier: see metrics.json."
    return unit, head, rows, others if count else ""


def stability(stable_to: float) -> str:
    """A sentence on the amplitude up to which the model is stable on the training inputs."""
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
