"""Identify an NL-LFR model: records -> BLA -> initialisation -> fit -> scores -> files.

python train.py +bench=boucwen
python train.py data=file data.path=x.csv data.inputs=[u] data.outputs=[y] data.fs=750 nx=3
"""

from __future__ import annotations

import json
import math
import shlex
import sys
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

import lfrtorch
from lfrtorch import plots, report
from lfrtorch.checks import integer
from lfrtorch.datasets import Dataset
from lfrtorch.monitor import ProgressLine, TensorBoard

CONF = Path(__file__).resolve().parent / "conf"


def identify(cfg: DictConfig, folder: Path, command: str = "") -> float:
    """One run, its files written into ``folder``; returns the validation RMSE."""
    require(cfg)
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    dataset: Dataset = instantiate(cfg.data)
    shown = dataset.validation[0] if dataset.validation else dataset.train[0]

    bla: lfrtorch.LinearModel = instantiate(cfg.bla, dataset.train)
    if cfg.init_from is None:
        model: lfrtorch.Model = instantiate(cfg.init, bla, dataset.train)
    else:
        model = continued(cfg, dataset)
    print(
        f"{dataset.name}: {sum(r.samples for r in dataset.train)} training samples, "
        f"{model.parameters} parameters ({model.parameters_net} without the gauge directions)"
    )

    line = ProgressLine()
    board = TensorBoard(folder, shown, bla.simulate(shown))
    result = lfrtorch.fit(
        model,
        dataset.train,
        dataset.validation,
        optimiser=instantiate(cfg.trainer),
        ridge=cfg.ridge,
        monitors=[line, board],
    )
    line.close()
    print(
        f"{result.reason}; kept iteration {result.chosen_iteration} of {result.iterations}, "
        f"{result.seconds:.1f} s, {1e3 * result.seconds_per_iteration:.0f} ms an iteration\n"
    )

    model.save(folder / "model")
    metrics = report.metrics(result, bla, dataset, seed=cfg.data.get("seed"), command=command)
    text = json.dumps(metrics, indent=2, allow_nan=False)
    (folder / "metrics.json").write_text(text + "\n")
    OmegaConf.save(cfg, folder / "config.yaml", resolve=True)
    table = report.table(metrics, dataset.published)
    print(table)
    board.text("scores", table)
    for name, figure in figures(result, bla, dataset).items():
        figure.savefig(made(folder / "figures") / f"{name}.png", dpi=150)
        board.figure(f"result/{name}", figure, result.iterations)
    board.close()
    print(f"\nRun in {folder}\nTensorBoard: tensorboard --logdir {folder}")
    kept = result.history[result.chosen_iteration]
    return kept.train if math.isnan(kept.validation) else kept.validation


def require(cfg: DictConfig) -> None:
    """Say what is missing from the command line before anything is computed."""
    if cfg.get("data") is None:
        raise ValueError(
            "no data chosen: add +bench=boucwen, or data=file data.path=FILE "
            "data.inputs=[...] data.outputs=[...] data.fs=HZ nx=ORDER."
        )
    if cfg.nx is None:
        raise ValueError(
            "nx, the number of states, is not set: add nx=2, for example "
            "(+bench=boucwen sets it and all else for that benchmark)."
        )
    if cfg.threads is not None:
        integer("threads", cfg.threads, 1)


def continued(cfg: DictConfig, dataset: Dataset) -> lfrtorch.Model:
    """The model of ``init_from``; its sizes replace those of the configuration."""
    model = lfrtorch.load(cfg.init_from)
    record = dataset.train[0]
    for side, channels, found in (
        ("inputs", model.inputs, record.inputs),
        ("outputs", model.outputs, record.outputs),
    ):
        if channels != found:
            raise ValueError(
                f"the model in '{cfg.init_from}' has the {side} {', '.join(map(str, channels))} "
                f"and the data {', '.join(map(str, found))}; continue on data of the same channels."
            )
    for name, size in model.sizes.items():
        if cfg[name] != size:
            print(f"{name} is {size}, that of the model in '{cfg.init_from}', not {cfg[name]}")
            cfg[name] = size
    return model


def figures(result: lfrtorch.FitResult, bla: lfrtorch.LinearModel, dataset: Dataset) -> dict:
    """All figures of a run by file name: errors of each test, static map, convergence."""
    model = result.model
    drawn = {}
    for record in dataset.tests:
        y_lti, y_hat = bla.simulate(record), model.simulate(record)
        draw = plots.spectrum if record.start == "periodic" else plots.response
        drawn[record.name] = draw(record, y_lti, y_hat)
    signals = model.signals(dataset.train[0])
    drawn["static_map"] = plots.static_map(signals.z[0].numpy(), signals.w[0].numpy())
    unit = model.outputs[0].unit
    drawn["convergence"] = plots.convergence(result.history, result.chosen_iteration, unit)
    return drawn


def made(folder: Path) -> Path:
    """The folder, made where it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(cfg: DictConfig) -> float:
    """The command line: user errors end with one message and exit code 1, no traceback."""
    run = HydraConfig.get()
    command = shlex.join(["python", "train.py", *run.overrides.task])
    try:
        return identify(cfg, Path(run.runtime.output_dir), command)
    except InstantiationException as error:
        print(f"error: {error.__cause__ or error}", file=sys.stderr)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
    except KeyboardInterrupt:
        print("interrupted outside the fit: nothing to keep", file=sys.stderr)
        sys.exit(130)
    sys.exit(1)


if __name__ == "__main__":
    main()
