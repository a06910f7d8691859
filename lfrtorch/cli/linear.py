"""The linear model alone: records -> frequency response -> BLA -> table, figures, checkpoint.

lfrtorch linear +bench=boucwen
lfrtorch linear x.csv inputs=force outputs=disp fs=750 nx=auto
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

import lfrtorch
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import in_lines
from lfrtorch.analysis.dead_times import dead_times
from lfrtorch.cli.config import configured, limit_threads, loaded
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.hydra_versions import instantiate
from lfrtorch.cli.run_folder import CONFIG, no_empty_folder, program
from lfrtorch.fitting.acting_inputs import acting
from lfrtorch.fitting.linear_start import linear_model, linear_records
from lfrtorch.fitting.stage import Job
from lfrtorch.linear.requirements import of_response
from lfrtorch.reporting import linear_report, plots
from lfrtorch.reporting.console import Console
from lfrtorch.reporting.evaluation import Evaluation


def identify(cfg: DictConfig, folder: Path, command: str = "") -> None:
    """Make one run, and write its files into ``folder``."""
    settings = configured(cfg)
    limit_threads(cfg)
    given, terminal = loaded(cfg), Console()
    print(f"{given.name}: {sum(r.samples for r in given.train)} training samples")
    job = acting(
        Job(given=given, dataset=given.with_windows(), settings=settings, observer=terminal)
    )
    dataset = job.dataset
    frf, notes = response(cfg, dataset.train)
    # A fit to the response uses the response that the figures show.
    data = frf if frf and wants_response(cfg, dataset.train) else None
    data = data or linear_records(dataset.train, settings, terminal)
    model, scan = linear_model(data, settings, dataset.validation, observer=terminal)
    cfg.nx = model.nx
    assert model.fit is not None
    for note in notes:
        if note not in model.fit.notes:
            terminal.say(f"note: {note}")

    evaluation = Evaluation(dataset=dataset, linear=model)
    found = linear_report.numbers(evaluation, frf, scan)
    found |= {
        "notes": list(dict.fromkeys([*dataset.notes, *notes, *model.fit.notes])),
        "command": command,
    }
    print(f"\n{in_lines(found['verdict']['text'])}\n\n{linear_report.table(found, evaluation)}")
    model = replace(model, delay=job.delay)
    times = dead_times(model) if job.delay else ()
    for one in times:
        print(f"\ndead time of {one}")
    found["dead_times"] = [asdict(one) for one in times]
    model.save(folder / "linear")
    text = json.dumps(found, indent=2, allow_nan=False)
    with whole_file(folder / "linear.json") as fresh:
        fresh.write_text(text + "\n")
    with whole_file(folder / CONFIG) as fresh:
        OmegaConf.save(cfg, fresh, resolve=True)
    plots.save(linear_report.figures(evaluation, frf, scan), folder / "figures")
    print(f"\nRun in {folder}")


def response(
    cfg: DictConfig, records: Sequence[lfrtorch.Record]
) -> tuple[lfrtorch.FRF | None, list[str]]:
    """The measured frequency response, or None, and notes."""
    asked_for = cfg.frf.method != "auto" or wants_response(cfg, records)
    try:
        frf: lfrtorch.FRF = instantiate(cfg.frf, records)
    except InputError as failed:
        if asked_for:
            raise
        return None, [f"no measured frequency response: {failed}"]
    return frf, list(frf.notes)


def wants_response(cfg: DictConfig, records: Sequence[lfrtorch.Record]) -> bool:
    """Tell if the model is fitted to the measured frequency response."""
    return cfg.bla.refine == "frequency" or (cfg.bla.refine is None and of_response(records))


@user_errors()
def main(cfg: DictConfig) -> None:
    """The command."""
    run = HydraConfig.get()
    folder = Path(run.runtime.output_dir)
    with no_empty_folder(folder):
        identify(cfg, folder, shlex.join([*program("scripts/bla.py"), *run.overrides.task]))
