"""Identify an NL-LFR model: records -> BLA -> initialisation -> fit -> scores -> files.

lfrtorch fit +bench=boucwen
lfrtorch fit resume=runs/boucwen/DATE
lfrtorch fit data=file data.path=x.csv data.inputs=[u] data.outputs=[y] data.fs=750 nx=3
torchrun --nproc-per-node 2 -m lfrtorch.cli fit ...
"""

from __future__ import annotations

import json
import math
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

import lfrtorch
from lfrtorch._atomic import whole_file
from lfrtorch.analysis.amplitude_margin import LOUDER
from lfrtorch.cli.config import CONF, opened, require, sizes_of, static_map
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.interrupts import Terminated, Termination
from lfrtorch.cli.run_folder import (
    CONFIG,
    SNAPSHOTS,
    WORLD,
    arguments,
    chosen_before,
    common,
    go_on,
    made,
    no_empty_folder,
    program,
)
from lfrtorch.cli.steps import linear_model, loaded, own_linear_models, same_channels
from lfrtorch.dataset import Dataset
from lfrtorch.distributed import LOST, ProcessLost, Ranks, connect
from lfrtorch.engine.nonlinearity import is_network
from lfrtorch.fitting.size_search import SizeSearch
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.trainer import INTERRUPTED
from lfrtorch.reporting import figures, plots
from lfrtorch.reporting import html as html_report
from lfrtorch.reporting import scores as report
from lfrtorch.reporting.advice import advise
from lfrtorch.reporting.diagnosis import evidence
from lfrtorch.reporting.monitor import Checkpoint, ProgressLine, StartsLine, TensorBoard
from lfrtorch.reporting.simulations import respond

PRINTED = 3
"""Most lines of advice that are printed; the report has all."""

WITHOUT_FILES = ["hydra.run.dir=.", "hydra.output_subdir=null", "hydra/job_logging=none"]
"""Of Hydra, for the processes beside the first."""


def identify(cfg: DictConfig, folder: Path, command: str = "", ranks: Ranks | None = None) -> float:
    """One run, its files written into ``folder`` by the first process; returns the validation RMSE.

    Raises:
        ProcessLost, Terminated: the fit ended early, and what it had found is written.
    """
    ranks = Ranks() if ranks is None else ranks
    require(cfg)
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    chosen_before(cfg, folder)
    dataset = loaded(cfg)
    shown = dataset.validation[0] if dataset.validation else dataset.train[0]

    bla, _ = linear_model(cfg, dataset.train, dataset.validation, ranks)
    chosen = sizes(cfg, bla, dataset, ranks)
    models = starts(cfg, bla, dataset)
    print(
        f"{dataset.name}: {sum(r.samples for r in dataset.train)} training samples, "
        f"{models[0].parameter_count} parameters "
        f"({models[0].net_parameter_count} without the gauge directions), {len(models)} start(s)"
    )

    best, several, judged = folder / "model", len(models) > 1, None
    if ranks.rank == 0:
        with whole_file(folder / CONFIG) as fresh:
            OmegaConf.save(cfg, fresh, resolve=True)
        if cfg.resume is None:
            shutil.rmtree(folder / SNAPSHOTS, ignore_errors=True)
    kept = folder / SNAPSHOTS if cfg.resume or ranks.rank == 0 else None
    snapshots = Snapshots(kept, writes=ranks.rank == 0)
    settings = {"trainer": instantiate(cfg.trainer), "ridge": cfg.ridge, "ranks": ranks}
    settings |= {"snapshots": snapshots, "average": average(cfg, models)}
    records = (dataset.train, dataset.validation, dataset.selection)
    search = partial(lfrtorch.fit, models, *records, **settings)
    with Termination(ranks) as termination:
        if ranks.rank > 0:
            result = search(monitors=[[termination]] * len(models))
        else:
            drawn = shown if cfg.figures else None
            board = TensorBoard(folder, drawn, bla.simulate(shown))
            keep = Checkpoint(best, least=snapshots.least)
            if several:
                line = StartsLine(len(models), models[0].outputs[0].unit)
                boards = [TensorBoard(folder / "starts" / str(i)) for i in range(len(models))]
                monitors = [[line, each, keep, termination] for each in boards]
                result = search(monitors=monitors, watch=line.round)
                board.history(result.history)
                for each in boards:
                    each.close()
            else:
                line = ProgressLine()
                result = search(monitors=[[line, board, keep, termination]])
                line.close()
            scores = write(cfg, folder, command, result, bla, dataset, board, chosen)
            judged = scores["validation"]["rmse"]
    if result.reason.startswith(LOST):
        raise ProcessLost(f"{result.reason}; the best model so far is in {best}; {go_on(folder)}")
    if termination.asked == signal.SIGTERM and result.reason == INTERRUPTED:
        raise Terminated(
            f"the fit was terminated; the best model so far is in {best}; {go_on(folder)}"
        )
    return result.history[result.chosen_iteration].train if judged is None else judged


def starts(cfg: DictConfig, bla: lfrtorch.LinearModel, dataset: Dataset) -> list[lfrtorch.Model]:
    """The models to start from; that of ``init_from`` is the only one."""
    if cfg.init_from is None:
        models = [
            instantiate(cfg.init, bla, dataset.train, seed=seed, **static_map(cfg))
            for seed in report.seeds(cfg.seed, cfg.starts)
        ]
    else:
        models = [continued(cfg, dataset)]
    for model in models:
        model.lfr.to(device=cfg.device, dtype=getattr(torch, cfg.dtype))
    return models


def average(cfg: DictConfig, models: Sequence[lfrtorch.Model]) -> int:
    """Of how many starts the model is the mean, at most; 1 with a note where there is no mean."""
    if cfg.average > 1 and not all(is_network(model.lfr.cell.static) for model in models):
        print("note: average is for networks; the best start is kept")
        return 1
    return cfg.average


def sizes(
    cfg: DictConfig, bla: lfrtorch.LinearModel, dataset: Dataset, ranks: Ranks
) -> SizeSearch | None:
    """The search for the sizes that are auto, now those of ``cfg``; None where none is.

    Raises:
        KeyboardInterrupt, Terminated: it ended early.
    """
    names = sizes_of(cfg)
    if cfg.init_from is not None or not any(cfg[name] == "auto" for name in names):
        return None
    options = cfg.sizes_search
    seeds = report.seeds(cfg.seed, max(2, min(cfg.starts, options.starts)))
    iterations = math.ceil(options.iterations * cfg.trainer.max_iter)

    def start(tried: dict[str, Any], seed: int) -> lfrtorch.Model:
        own = OmegaConf.merge(cfg, tried, {"seed": seed, "starts": 1})
        return starts(cast(DictConfig, own), bla, dataset)[0]

    print(f"sizes: {len(seeds)} starts of {iterations} iterations for each model", flush=True)
    with Termination(ranks) as termination:
        try:
            search = lfrtorch.search_sizes(
                start,
                dataset.train,
                dataset.validation,
                **{name: options[name] if cfg[name] == "auto" else cfg[name] for name in names},
                linear=bla,
                seeds=seeds,
                trainer=instantiate(cfg.trainer, max_iter=iterations),
                ridge=cfg.ridge,
                monitors=[termination],
                watch=partial(print, flush=True),
                ranks=ranks,
            )
        except KeyboardInterrupt:
            if termination.asked == signal.SIGTERM:
                raise Terminated("terminated while sizes were searched: nothing to keep") from None
            raise KeyboardInterrupt("while sizes were searched") from None
    print(search.table())
    for note in search.notes:
        print(f"note: {note}")
    cfg.update(search.chosen.sizes)
    return search


def write(
    cfg: DictConfig,
    folder: Path,
    command: str,
    result: lfrtorch.FitResult,
    bla: lfrtorch.LinearModel,
    dataset: Dataset,
    board: TensorBoard,
    search: SizeSearch | None,
) -> dict[str, Any]:
    """Print the scores, and write all files of a run; returns what ``metrics.json`` holds."""
    print(
        f"{result.reason}; kept iteration {result.chosen_iteration} of {result.iterations}, "
        f"{result.seconds:.1f} s, {1e3 * result.seconds_per_iteration:.0f} ms an iteration\n"
    )
    result.model.save(folder / "model")
    bla.save(folder / "linear")
    own = own_linear_models(cfg, dataset)
    metrics = report.metrics(
        result,
        bla,
        dataset,
        own=own,
        seed=cfg.seed,
        data_seed=cfg.data.get("seed"),
        command=command,
        search=search,
    )
    if search is not None:
        board.text("sizes", search.table())
    if len(result.starts) > 1:
        print(report.starts_table(metrics) + "\n")
    if result.averaged > 1:
        print(f"The model is the mean of the best {result.averaged} starts, side by side.\n")
    text = json.dumps(metrics, indent=2, allow_nan=False)
    with whole_file(folder / "metrics.json") as fresh:
        fresh.write_text(text + "\n")
    table = report.table(metrics, dataset.published)
    print(table)
    if metrics["stable_to"] < max(LOUDER):
        print(
            f"note: stable on the training inputs {metrics['stable_to']:g} times as loud, and no "
            "longer on the next louder ones tried; validate at the amplitudes you will use."
        )
    board.text("scores", table)
    simulated = respond(result.model, bla, dataset, own)
    advice = advise(
        evidence(
            result,
            simulated,
            noise_rms=dataset.noise_rms,
            continued=cfg.init_from is not None,
            ridge=cfg.ridge != 0.0,
            searched=search is not None,
        )
    )
    if cfg.figures:
        drawn = figures.of_run(result, bla, dataset, simulated)
        images = {name: plots.png(figure) for name, figure in drawn.items()}
        for name, image in images.items():
            (made(folder / "figures") / f"{name}.png").write_bytes(image)
            board.image(f"result/{name}", image, result.iterations)
        more, views = figures.of_tests(simulated)
        images |= {name: plots.png(figure) for name, figure in more.items()}
        page = html_report.render(
            metrics, result, bla, dataset, simulated, images, advice,
            views=views, config=OmegaConf.to_yaml(cfg, resolve=True),
        )  # fmt: skip
        with whole_file(folder / "report.html") as path:
            path.write_text(page, encoding="utf-8")
    board.close()
    for item in advice[:PRINTED]:
        print(f"next: {item}")
    print(f"\nRun in {folder}" + f", its report in {folder / 'report.html'}" * cfg.figures)
    print(f"TensorBoard: tensorboard --logdir {folder}")
    if result.reason == INTERRUPTED:
        print(go_on(folder))
    return metrics


def continued(cfg: DictConfig, dataset: Dataset) -> lfrtorch.Model:
    """The model of ``init_from``; its sizes replace those of the configuration."""
    model = opened(cfg)
    same_channels(model, dataset.train[0], cfg.init_from)
    for name, size in model.sizes.items():
        if cfg[name] != size:
            print(
                f"note: {name} is {size}, that of the model in '{cfg.init_from}', not {cfg[name]}"
            )
            cfg[name] = size
    return model


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(cfg: DictConfig) -> float:
    """The command line."""
    run, rank = HydraConfig.get(), os.environ.get("RANK", "0")
    command = shlex.join([*program("train.py"), *run.overrides.task])
    folder = Path(run.runtime.output_dir)
    with ExitStack() as stack:
        stack.enter_context(user_errors(rank))
        if rank == "0":
            stack.enter_context(no_empty_folder(folder))
        ranks = stack.enter_context(connect(cfg.device, cfg.timeout))
        if ranks.rank > 0:
            stack.enter_context(redirect_stdout(stack.enter_context(open(os.devnull, "w"))))
        return identify(cfg, common(folder, ranks), command, ranks)
    raise AssertionError  # user_errors does not return


def launch() -> None:
    """``main``; of several processes the first alone has Hydra write files."""
    if WORLD > 1 and {"-m", "--multirun"} & set(sys.argv):
        sys.exit("error: torchrun shares one fit; start several runs one after another.")
    with user_errors(os.environ.get("RANK", "0")):
        sys.argv[1:] = arguments(sys.argv[1:])
    if WORLD > 1 and os.environ["RANK"] != "0":
        sys.argv += WITHOUT_FILES
    main()
