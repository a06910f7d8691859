"""The linear model alone: records -> frequency response -> BLA -> table, figures, checkpoint.

lfrtorch linear +bench=boucwen
lfrtorch linear data=file data.path=x.csv data.inputs=[u] data.outputs=[y] data.fs=750 nx=auto
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

import lfrtorch
from lfrtorch._support import tables
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.errors import InputError
from lfrtorch._support.roots import frequency_and_damping, remark
from lfrtorch._support.tables import in_lines, in_percent, percent
from lfrtorch._support.types import Array
from lfrtorch.cli import CONF
from lfrtorch.cli.composition import take_words
from lfrtorch.cli.config import configured, limit_threads, loaded
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.hydra_versions import MAIN, instantiate
from lfrtorch.cli.run_folder import CONFIG, arguments, no_empty_folder, program
from lfrtorch.cli.words import Terminal
from lfrtorch.dataset import Dataset
from lfrtorch.distributed import Ranks
from lfrtorch.job import linear_model, linear_records
from lfrtorch.linear.requirements import of_response
from lfrtorch.metrics import rmse_by_output
from lfrtorch.reporting import figures as run_figures
from lfrtorch.reporting import linear_plots
from lfrtorch.reporting.scores import counted, of_samples
from lfrtorch.reporting.verdict import EXPLAINS_NOTHING
from lfrtorch.score_window import fitted


def identify(cfg: DictConfig, folder: Path, command: str = "") -> None:
    """One run, its files written into ``folder``."""
    settings = configured(cfg)
    limit_threads(cfg)
    dataset = loaded(cfg).with_windows()
    print(f"{dataset.name}: {sum(r.samples for r in dataset.train)} training samples")
    frf, notes = response(cfg, dataset.train)
    # A fit to the response takes the one that the figures show.
    terminal = Terminal(cfg)
    data = frf if frf and wants_response(cfg, dataset.train) else None
    data = data or linear_records(dataset.train, settings, terminal)
    model, scan = linear_model(data, settings, dataset.validation, observer=terminal, ranks=Ranks())
    cfg.nx = model.nx
    assert model.fit is not None
    for note in notes:
        if note not in model.fit.notes:
            terminal.say(f"note: {note}")

    found = numbers(model, dataset, frf, scan)
    found |= {
        "notes": list(dict.fromkeys([*dataset.notes, *notes, *model.fit.notes])),
        "command": command,
    }
    print(f"\n{in_lines(found['verdict']['text'])}\n\n{table(found)}")
    model.save(folder / "linear")
    text = json.dumps(found, indent=2, allow_nan=False)
    with whole_file(folder / "linear.json") as fresh:
        fresh.write_text(text + "\n")
    with whole_file(folder / CONFIG) as fresh:
        OmegaConf.save(cfg, fresh, resolve=True)
    for name, figure in figures(model, dataset, frf, scan).items():
        with whole_file(folder / "figures" / f"{name}.png") as fresh:
            figure.savefig(fresh, dpi=150)
    print(f"\nRun in {folder}")


def response(
    cfg: DictConfig, records: Sequence[lfrtorch.Record]
) -> tuple[lfrtorch.FRF | None, list[str]]:
    """The measured frequency response, if the records give one, and notes."""
    asked_for = cfg.frf.method != "auto" or wants_response(cfg, records)
    try:
        frf: lfrtorch.FRF = instantiate(cfg.frf, records)
    except InputError as failed:
        if asked_for:
            raise
        return None, [f"no measured frequency response: {failed}"]
    return frf, list(frf.notes)


def wants_response(cfg: DictConfig, records: Sequence[lfrtorch.Record]) -> bool:
    """Whether the model is fitted to the measured frequency response."""
    return cfg.bla.refine == "frequency" or (cfg.bla.refine is None and of_response(records))


def figures(
    model: lfrtorch.LinearModel,
    dataset: Dataset,
    frf: lfrtorch.FRF | None,
    scan: lfrtorch.OrderScan | None,
) -> dict:
    """All figures of a run by file name."""
    drawn = {}
    for record in dataset.tests or dataset.validation:
        drawn |= run_figures.of_record(record, {"linear": model.simulate(record)})[0]
    drawn["frequency_response"] = linear_plots.frequency_response(model, frf)
    drawn["poles_and_zeros"] = linear_plots.poles_and_zeros(model)
    if scan is not None:
        drawn["order_scan"] = linear_plots.order_scan(scan)
    if frf is not None and frf.distortion is not None:
        drawn["distortion"] = linear_plots.distortion(frf)
    return drawn


def numbers(
    model: lfrtorch.LinearModel,
    dataset: Dataset,
    frf: lfrtorch.FRF | None,
    scan: lfrtorch.OrderScan | None,
) -> dict[str, Any]:
    """What linear.json holds; None if a number is not finite or not known."""
    fit = model.fit
    assert fit is not None
    used = {"train": dataset.train, "validation": dataset.validation, "test": dataset.tests}
    scores = [score(model, r, use) for use, records in used.items() for r in records]
    found: dict[str, Any] = {
        "bench": dataset.name,
        "nx": model.nx,
        "fit": {
            "criterion": fit.criterion,
            "rmse": fit.rmse,
            "iterations": fit.iterations,
            "reason": fit.reason,
            "seconds": fit.seconds,
        },
        "scores": scores,
        "verdict": verdict(scores),
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
        "response_std": [] if model.covariance is None else uncertainty(model, frf),
        "frf": None,
        "scan": None,
    }
    if frf is not None:
        names = "method", "experiments", "periods"
        found["frf"] = {"lines": len(frf.frequencies)} | {n: getattr(frf, n) for n in names}
    if scan is not None:
        found["scan"] = {
            "orders": scan.orders,
            "fitted": [None if m.fit is None else finite(m.fit.rmse) for m in scan.models],
            "scores": [finite(s) for s in scan.scores],
            "validated": scan.validated,
            "chosen": scan.chosen,
        }
    return found


def score(model: lfrtorch.LinearModel, record: lfrtorch.Record, use: str) -> dict[str, Any]:
    """Simulation errors of each output after the skip window.

    The estimated start of a training record is fitted to all samples, as in the fit.
    """
    y = record.y[record.skip :]
    y_hat = model.simulate(fitted(record) if use == "train" else record)
    rmse, deviation = rmse_by_output(record, y_hat), np.std(y, axis=0)
    return {
        "use": use,
        "record": record.name,
        "source": record.source,
        **counted(record),
        "outputs": [
            {
                "output": channel.name,
                "unit": channel.unit,
                "rmse": finite(rmse[i]),
                "std": finite(deviation[i]),
                "nrmse": finite(rmse[i] / deviation[i]) if deviation[i] > 0 else None,
            }
            for i, channel in enumerate(record.outputs)
        ],
    }


def verdict(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Whether the model explains what was not fitted: its worst output on the tests.

    Without tests that are scored it is judged on validation, and else on training.
    """
    errors = {use: relative_errors(scores, use) for use in ("test", "validation", "train")}
    judged = next((use for use, found in errors.items() if found), None)
    if judged is None:
        return {"usable": None, "text": "Not judged: nothing is scored."}
    name, error = max(errors[judged].items(), key=lambda item: item[1])
    usable = error < EXPLAINS_NOTHING
    output = "the output" if len(errors[judged]) == 1 else f"'{name}'"
    size = f"{percent(error)} of the standard deviation of {output}"
    if not math.isfinite(error):
        size = f"without bound at {output}"
    where = "training" if judged == "train" else judged
    text = f"{'' if usable else 'Not usable: '}on {where} the linear model's error is {size}"
    fitted_error = errors["train"].get(name)
    if not usable and judged != "train" and fitted_error is not None:
        text += f" (in training {percent(fitted_error)})"
    return {
        "usable": usable,
        "text": f"{text[0].upper()}{text[1:]}.",
        "on": judged,
        "output": name,
        "nrmse": finite(error),
    }


def relative_errors(scores: Sequence[Mapping[str, Any]], use: str) -> dict[str, float]:
    """Of each output that moves the error over the standard deviation, all records of a use."""
    powers: dict[str, Array] = {}
    for s in scores:
        for o in s["outputs"]:
            if s["use"] == use and s["scored"] and o["std"]:
                error = math.inf if o["rmse"] is None else o["rmse"]
                own = s["scored"] * np.square([error, o["std"]])
                powers[o["output"]] = powers.get(o["output"], np.zeros(2)) + own
    return {name: float(np.sqrt(error / own)) for name, (error, own) in powers.items()}


def uncertainty(model: lfrtorch.LinearModel, frf: lfrtorch.FRF | None) -> list[dict[str, Any]]:
    """The largest standard deviation of each channel's response, in the band of the data."""
    f = linear_plots.frequencies(model, frf)
    std, size = model.frf_std(f), np.abs(model.frf(f))
    listed = []
    for i, output in enumerate(model.outputs):
        for j, source in enumerate(model.inputs):
            k = int(np.argmax(std[:, i, j]))
            largest, there = float(std[k, i, j]), float(size[k, i, j])
            listed.append(
                {
                    "channel": f"{output.name}/{source.name}",
                    "std": finite(largest),
                    "frequency": float(f[k]),
                    "relative": finite(largest / there) if there > 0 else None,
                }
            )
    return listed


def table(found: dict[str, Any]) -> str:
    """The numbers of a run for people."""
    fit = found["fit"]
    parts = [f"Linear model of order {found['nx']}, {fit['criterion']} error"]
    sources = any(s["source"] != "file" for s in found["scores"])
    about = ["record", "use", *["source"] * sources]
    errors: dict[str, list[float | None]] = {}
    for o in (o for s in found["scores"] for o in s["outputs"]):
        errors.setdefault(o["unit"], []).append(o["rmse"])
    prefixed = {unit: tables.engineering(own, unit) for unit, own in errors.items()}
    scores = [
        [
            *(s[key] for key in about),
            of_samples(s),
            o["output"],
            tables.times(prefixed[o["unit"]][0], o["rmse"]),
            prefixed[o["unit"]][1],
            in_percent(o["nrmse"]),
        ]
        for s in found["scores"]
        for o in s["outputs"]
    ]
    head = [*about, "scored", "output", "RMSE", "unit", "% of std"]
    parts.append(tables.table(head, scores, digits=4))
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


def finite(value: float) -> float | None:
    """The number, None if JSON cannot hold it."""
    return float(value) if math.isfinite(value) else None


@hydra.main(**MAIN, config_path=str(CONF), config_name="linear")
def main(cfg: DictConfig) -> None:
    """The command line."""
    run = HydraConfig.get()
    command = shlex.join([*program("scripts/bla.py"), *run.overrides.task])
    folder = Path(run.runtime.output_dir)
    with user_errors(cfg=cfg), no_empty_folder(folder):
        identify(cfg, folder, command)


def launch() -> None:
    """The command, with the settings of the run in ``resume=DIR`` before its words."""
    with user_errors():
        take_words("linear", arguments)
    main()
