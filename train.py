"""Identify an NL-LFR model: records -> BLA -> initialisation -> fit -> scores -> files.

python train.py +bench=boucwen
python train.py resume=runs/boucwen/DATE
python train.py data=file data.path=x.csv data.inputs=[u] data.outputs=[y] data.fs=750 nx=3
torchrun --nproc-per-node 2 train.py ...
"""

from __future__ import annotations

import json
import math
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

import lfrtorch
from lfrtorch._atomic import whole_file
from lfrtorch._checks import integer, number
from lfrtorch._threads import each_alone
from lfrtorch.analysis.amplitude_margin import LOUDER
from lfrtorch.cli.interrupts import Terminated, Termination
from lfrtorch.dataset import Dataset
from lfrtorch.distributed import LOST, ProcessLost, Ranks, connect
from lfrtorch.engine.nonlinearity import is_network
from lfrtorch.fitting.size_search import SizeSearch
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.trainer import INTERRUPTED
from lfrtorch.linear.order_scan import OrderScan
from lfrtorch.reporting import figures, plots
from lfrtorch.reporting import html as html_report
from lfrtorch.reporting import scores as report
from lfrtorch.reporting.advice import advise
from lfrtorch.reporting.diagnosis import evidence
from lfrtorch.reporting.monitor import Checkpoint, ProgressLine, StartsLine, TensorBoard
from lfrtorch.reporting.simulations import respond
from lfrtorch.survey.findings import findings

CONF = Path(__file__).resolve().parent / "conf"

WORLD = int(os.environ.get("WORLD_SIZE", "1"))
"""Processes, where torchrun starts them."""

CONFIG, SNAPSHOTS = "config.yaml", "resume"
"""In the folder of a run: its settings, and its starts as far as they came."""

LAST_SIZE = {"network": ["nn"], "polynomial": ["degree"]}
"""The size of a kind of static map beside nz and nw."""

OLD_WORDS = {
    "init=polynomial": "static=polynomial",
    "trainer.epochs": "trainer.max_iter",
}
"""Words of the command line that have other names now; saved runs may have them."""

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

    bla, _ = linear(cfg, dataset.train, dataset.validation, ranks)
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


def static_map(cfg: DictConfig) -> dict[str, Any]:
    """The arguments of a start that say which static nonlinearity it has."""
    if cfg.static.kind == "network":
        return {"nn": cfg.nn, "activation": cfg.activation}
    if cfg.static.kind == "polynomial":
        return {"static": lfrtorch.Polynomial(cfg.nz, cfg.nw, cfg.degree)}
    own = {name: value for name, value in cfg.static.items() if name != "kind"}
    return {"static": instantiate(own, nz=cfg.nz, nw=cfg.nw)}


def average(cfg: DictConfig, models: Sequence[lfrtorch.Model]) -> int:
    """Of how many starts the model is the mean, at most; 1 with a note where there is no mean."""
    if cfg.average > 1 and not all(is_network(model.lfr.cell.static) for model in models):
        print("note: average is for networks; the best start is kept")
        return 1
    return cfg.average


def loaded(cfg: DictConfig) -> Dataset:
    """The records; what is to be known of them is printed."""
    dataset: Dataset = instantiate(cfg.data)
    measured = [record for record in dataset.train if record.source == "file"]
    for note in (*dataset.notes, *(findings(measured) if measured else ())):
        print(f"note: {note}")
    return dataset


def linear(
    cfg: DictConfig,
    data: Sequence[lfrtorch.Record] | lfrtorch.FRF,
    validation: Sequence[lfrtorch.Record],
    ranks: Ranks,
) -> tuple[lfrtorch.LinearModel, OrderScan | None]:
    """The best linear approximation; with nx=auto of the order that a scan chooses, now ``cfg.nx``.

    What is known of it is printed.
    """
    scan: OrderScan | None = None
    if cfg.nx == "auto":
        options = {k: v for k, v in cfg.bla.items() if k != "nx"}
        options["_target_"] = partial(lfrtorch.scan_orders, validation=validation)
        scan = cast(OrderScan, instantiate(options, data, range(1, cfg.nx_max + 1)))
        print(scan.table())
        # Rounding may differ from machine to machine, and the order must not.
        cfg.nx = int(ranks.first(torch.tensor(scan.chosen)))
        bla = scan.models[scan.orders.index(cfg.nx)]
    else:
        bla = instantiate(cfg.bla, data)
    fit = bla.fit
    assert fit is not None
    print(
        f"BLA: order {bla.nx}, {fit.criterion} error {fit.rmse:.3g} (normalised), "
        f"{fit.iterations} iterations, {fit.reason}, {fit.seconds:.1f} s"
    )
    for note in fit.notes:
        print(f"note: {note}")
    return bla, scan


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


def sizes_of(cfg: DictConfig) -> list[str]:
    """Of the static nonlinearity: nz, nw, and a polynomial's degree or a network's nn."""
    return ["nz", "nw", *LAST_SIZE.get(cfg.static.kind, ())]


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


def go_on(folder: Path) -> str:
    """How to go on with a run that ended early."""
    return f"to go on: python train.py resume={folder}"


def chosen_before(cfg: DictConfig, folder: Path) -> None:
    """Take the sizes that the run to go on with chose from the data."""
    if cfg.resume is None or not (folder / CONFIG).is_file():
        return
    before = OmegaConf.load(folder / CONFIG)
    for name in ("nx", "nz", "nw", "nn", "degree"):
        if cfg[name] == "auto":
            cfg[name] = OmegaConf.select(before, name)


def require(cfg: DictConfig) -> None:
    """Say what is missing from the command line before anything is computed."""
    require_data(cfg)
    if cfg.nx is None and cfg.init_from is not None:
        cfg.nx = opened(cfg).sizes["nx"]
    if cfg.nx is None:
        raise ValueError(
            "nx, the number of states, is not set: add nx=2, for example, or nx=auto "
            "(+bench=boucwen sets it and all else for that benchmark)."
        )
    for name in ("nx", "nz", "nw", "nn", "degree"):
        integer(name, cfg[name], 1, word="auto")
    for name in {"nn", "degree"} - {*sizes_of(cfg)}:
        if cfg[name] == "auto":
            used = sizes_of(cfg)[-1]
            raise ValueError(f"{name} is auto, and this static map has none; give {used}=auto.")
    if cfg.static.kind == "own" and "auto" in (cfg.nz, cfg.nw):
        raise ValueError("nz or nw is auto, and a map of one's own is not searched; give numbers.")
    integer("sizes_search.starts", cfg.sizes_search.starts, 1)
    number("sizes_search.iterations", cfg.sizes_search.iterations, positive=True)
    integer("nx_max", cfg.nx_max, 1)
    integer("seed", cfg.seed, 0)
    integer("starts", cfg.starts, 1)
    integer("average", cfg.average, 1)
    if cfg.threads is not None:
        integer("threads", cfg.threads, 1)
    if cfg.dtype not in ("float32", "float64"):
        raise ValueError(f"dtype is {cfg.dtype}; give float64 or float32.")
    try:
        torch.empty(0, device=cfg.device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"device is {cfg.device}, which torch cannot use here ({reason}); "
            "device=cpu always works."
        ) from None


def require_data(cfg: DictConfig) -> None:
    """Say how data are chosen where none are."""
    if cfg.get("data") is None:
        raise ValueError(
            "no data chosen: add +bench=boucwen, or data=file data.path=FILE "
            "data.inputs=[...] data.outputs=[...] data.fs=HZ nx=ORDER (or nx=auto)."
        )


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


def opened(cfg: DictConfig) -> lfrtorch.Model:
    """The model of ``init_from`` as it was saved."""
    own = static_map(cfg)["static"] if cfg.static.kind == "own" else None
    return lfrtorch.load(cfg.init_from, static=own)


def same_channels(model: lfrtorch.Model, record: lfrtorch.Record, folder: str) -> None:
    """Refuse data of other channels than those of the model in ``folder`` with a ValueError."""
    for side, channels, found in (
        ("inputs", model.inputs, record.inputs),
        ("outputs", model.outputs, record.outputs),
    ):
        if channels != found:
            raise ValueError(
                f"the model in '{folder}' has the {side} {', '.join(map(str, channels))} "
                f"and the data {', '.join(map(str, found))}; give data of the same channels."
            )


def own_linear_models(cfg: DictConfig, dataset: Dataset) -> dict[str, lfrtorch.LinearModel]:
    """Linear models of single tests, where their table has them, by the test's name."""
    records = {record.name: record for record in dataset.train}
    # Tests that share their records share the model.
    of = list(dict.fromkeys(dataset.linear.values()))
    estimate = partial(instantiate, cfg.bla)
    models = each_alone(estimate, [[records[name] for name in names] for names in of])
    by_records = dict(zip(of, models, strict=True))
    return {test: by_records[names] for test, names in dataset.linear.items()}


def made(folder: Path) -> Path:
    """The folder, made where it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def common(folder: Path, ranks: Ranks) -> Path:
    """The first process's folder."""
    name = torch.tensor(list(str(folder).encode()), dtype=torch.uint8)
    return Path(bytes(ranks.first(name).tolist()).decode())


@contextmanager
def no_empty_folder(folder: Path) -> Iterator[None]:
    """A run that fails before it has a model leaves no folder, where nothing else is in it."""
    try:
        yield
    except BaseException:
        passing = {".hydra", CONFIG, SNAPSHOTS, "starts"}
        names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        if names and all(name in passing or name.startswith("events.out") for name in names):
            shutil.rmtree(folder)
        raise


@contextmanager
def user_errors(rank: str = "0") -> Iterator[None]:
    """User errors end the program with one message and exit code 1, no traceback."""
    error = "error" if rank == "0" else f"error on rank {rank}"
    try:
        yield
        return
    except InstantiationException as failed:
        print(f"{error}: {failed.__cause__ or failed}", file=sys.stderr)
    except (ValueError, OSError, ProcessLost) as failed:
        print(f"{error}: {failed}", file=sys.stderr)
    except Terminated as end:
        if rank == "0":
            print(end, file=sys.stderr)
        sys.exit(128 + signal.SIGTERM)
    except KeyboardInterrupt as stop:
        print(f"interrupted {str(stop) or 'outside the fit'}: nothing to keep", file=sys.stderr)
        sys.exit(130)
    sys.exit(1)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(cfg: DictConfig) -> float:
    """The command line."""
    run, rank = HydraConfig.get(), os.environ.get("RANK", "0")
    start = ["python"]
    if WORLD > 1:
        start = ["torchrun", "--nproc-per-node", os.environ.get("LOCAL_WORLD_SIZE", str(WORLD))]
    command = shlex.join([*start, "train.py", *run.overrides.task])
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


def arguments(given: Sequence[str]) -> list[str]:
    """The command line with the settings of the run in ``resume=DIR``, if there is one, before it.

    Raises:
        ValueError: no run there, or a folder given for a new run that holds another one.
    """
    values = dict(argument.split("=", 1) for argument in given if "=" in argument)
    folder = values.get("resume", "null")
    if folder != "null":
        overrides = Path(folder) / ".hydra" / "overrides.yaml"
        if not overrides.is_file():
            raise ValueError(
                f"resume is '{folder}', which is not the folder of a run: there is no {overrides}; "
                "give the folder that train.py named at its end, runs/NAME/DATE."
            )
        before = [now(str(o)) for o in OmegaConf.load(overrides)]
        before = [word for word in before if not word.startswith("resume=")]
        escaped = folder.replace("\\", "\\\\").replace("'", "\\'")
        return [*before, *given, f"hydra.run.dir='{escaped}'"]
    for word in given:
        if now(word) != word:
            raise ValueError(f"{word} is called {now(word)} now.")
    for name, mark in (("hydra.run.dir", CONFIG), ("hydra.sweep.dir", "multirun.yaml")):
        folder = values.get(name, "").strip("'\"")
        taken = bool(folder) and (Path(folder) / mark).exists()
        if taken and values.get("overwrite", "").lower() != "true":
            raise ValueError(
                f"{name} is '{folder}', which holds a run; give another folder, resume={folder} "
                "to go on with that run, or overwrite=true to replace it."
            )
    return list(given)


def now(word: str) -> str:
    """The word of the command line by its present name."""
    for old, new in OLD_WORDS.items():
        if word == old or word.startswith(f"{old}="):
            return new + word.removeprefix(old)
    return word


def launch() -> None:
    """``main``; of several processes the first alone has Hydra write files."""
    if WORLD > 1 and {"-m", "--multirun"} & set(sys.argv):
        sys.exit("error: torchrun shares one fit; start several runs one after another.")
    with user_errors(os.environ.get("RANK", "0")):
        sys.argv[1:] = arguments(sys.argv[1:])
    if WORLD > 1 and os.environ["RANK"] != "0":
        sys.argv += WITHOUT_FILES
    main()


if __name__ == "__main__":
    launch()
