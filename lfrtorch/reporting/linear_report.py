"""A linear model alone in numbers, as a table and in figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lfrtorch._support import tables
from lfrtorch._support.roots import frequency_and_damping, remark
from lfrtorch._support.tables import in_percent
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import OrderScan
from lfrtorch.reporting import figures as run_figures
from lfrtorch.reporting import linear_plots
from lfrtorch.reporting.evaluation import Evaluation, Response, finite
from lfrtorch.reporting.score_columns import ALL, columns, in_units, rows_of
from lfrtorch.reporting.verdict import judge_linear


def figures(evaluation: Evaluation, frf: FRF | None, scan: OrderScan | None) -> dict[str, Figure]:
    """All figures of a run by file name."""
    model, drawn = _model(evaluation), {}
    use = "test" if evaluation.dataset.tests else "validation"
    for response in (one for one in evaluation.simulations if one.use == use):
        drawn |= run_figures.of_record(response.record, response.simulated)[0]
    drawn["frequency_response"] = linear_plots.frequency_response(model, frf)
    drawn["poles_and_zeros"] = linear_plots.poles_and_zeros(model)
    if scan is not None:
        drawn["order_scan"] = linear_plots.order_scan(scan)
    if frf is not None and frf.distortion is not None:
        drawn["distortion"] = linear_plots.distortion(frf)
    return drawn


def numbers(evaluation: Evaluation, frf: FRF | None, scan: OrderScan | None) -> dict[str, Any]:
    """Contents of linear.json; None if a number is not finite or not known."""
    model = _model(evaluation)
    fit = model.fit
    assert fit is not None
    scores = [_score(one) for one in evaluation.simulations if one.use != "selection"]
    found: dict[str, Any] = {
        "bench": evaluation.dataset.name,
        "nx": model.nx,
        "fit": {
            "criterion": fit.criterion,
            "rmse": fit.rmse,
            "iterations": fit.iterations,
            "reason": fit.reason,
            "seconds": fit.seconds,
        },
        "scores": scores,
        "verdict": judge_linear(evaluation.simulations)._asdict(),
        "poles": frequency_and_damping(model.poles, model.fs),
        "zeros": {
            name: frequency_and_damping(z, model.fs)
            for name, z in linear_plots.zeros(model).items()
        },
        "offsets": [
            {"channel": channel.name, "offset": float(offset), "unit": channel.unit}
            for channel, offset in zip(
                (*model.inputs, *model.outputs), (*model.u_offset, *model.y_offset), strict=True
            )
        ],
        "response_std": [] if model.covariance is None else _uncertainty(model, frf),
        "frf": None,
        "scan": None,
    }
    if frf is not None:
        names = "method", "experiments", "periods"
        found["frf"] = {"lines": len(frf.frequencies)} | {n: getattr(frf, n) for n in names}
    if scan is not None:
        found["scan"] = {
            "orders": scan.orders,
            "fitted": [None if m.fit is None else m.fit.rmse for m in scan.models],
            "scores": list(scan.scores),
            "validated": scan.validated,
            "chosen": scan.chosen,
        }
    return finite(found)


def _model(evaluation: Evaluation) -> LinearModel:
    assert evaluation.linear is not None
    return evaluation.linear


def _score(response: Response) -> dict[str, Any]:
    """Simulation errors of each output after the skip window."""
    name, score = response.record.name, response.score
    return {
        "use": response.use,
        "record": name,
        **{of: getattr(score, of) for of in ("source", "samples", "skip", "scored")},
        "outputs": [
            {
                "output": row.output,
                "unit": row.unit,
                "rmse": row.linear,
                "std": row.std,
                "nrmse": row.relative(row.linear),
            }
            for row in rows_of(name, score)
            if row.output != ALL
        ],
    }


def _uncertainty(model: LinearModel, frf: FRF | None) -> list[dict[str, Any]]:
    """The largest standard deviation of each channel's response, in the band of the data."""
    f = linear_plots.frequencies(model, frf)
    std, size = model.frf_std(f), np.abs(model.frf(f))
    listed = []
    for i, j in np.ndindex(*std.shape[1:]):
        k = int(np.argmax(std[:, i, j]))
        largest, there = float(std[k, i, j]), float(size[k, i, j])
        listed.append(
            {
                "channel": f"{model.outputs[i].name}/{model.inputs[j].name}",
                "std": largest,
                "frequency": float(f[k]),
                "relative": largest / there if there > 0 else None,
            }
        )
    return listed


def table(found: Mapping[str, Any], evaluation: Evaluation) -> str:
    """The numbers of a run for people."""
    fit = found["fit"]
    parts = [f"Linear model of order {found['nx']}, {fit['criterion']} error"]
    scores = [(name, s) for (use, name), s in evaluation.scores.items() if use != "selection"]
    scored = in_units([row for name, s in scores for row in rows_of(name, s) if row.output != ALL])
    head, rows, _ = columns("linear", scored)
    parts.append(tables.table(head, rows, digits=4))
    listed = [["pole", p] for p in found["poles"]]
    listed += [[f"zero {n}".strip(), z] for n, zeros in found["zeros"].items() for z in zeros]
    rows = [
        [what, r["frequency"], r["damping"], tables.radius(r["radius"]),
         remark(r, pole=what == "pole")]
        for what, r in listed
    ]  # fmt: skip
    parts.append(tables.table(["", "frequency (Hz)", "damping", "radius", ""], rows, digits=4))
    rows = []
    for o in found["offsets"]:
        factor, unit = tables.engineering([o["offset"]], o["unit"])
        rows.append([o["channel"], factor * o["offset"], unit])
    parts.append(tables.table(["operating point", "offset", "unit"], rows, digits=4))
    if found["response_std"]:
        rows = [
            [r["channel"], r["std"], in_percent(r["relative"]), r["frequency"]]
            for r in found["response_std"]
        ]
        head = ["response", "largest std", "% of response there", "at (Hz)"]
        parts.append(tables.table(head, rows, digits=4))
    return "\n\n".join(parts)
