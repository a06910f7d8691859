"""Identify an NL-LFR model: records -> linear model -> starts -> fit -> scores -> files.

lfrtorch fit +bench=boucwen
lfrtorch fit -m +bench=boucwen 'seed=range(20)' nn=5,10 hydra.sweep.dir=DIR
lfrtorch fit resume=runs/boucwen/DATE
lfrtorch fit x.csv inputs=force outputs=disp fs=750 nx=3
lfrtorch fit update=runs/run new.csv inputs=force outputs=disp fs=750
torchrun --nproc-per-node 2 -m lfrtorch.cli fit ...
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.errors import InputError
from lfrtorch._support.reasons import Reason
from lfrtorch.cli import sweep
from lfrtorch.cli.checks import check_plain
from lfrtorch.cli.config import configured, limit_threads, loaded
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.interrupts import TerminatedError, Termination
from lfrtorch.cli.run_folder import (
    CONFIG,
    SNAPSHOTS,
    STARTS,
    USED,
    chosen_before,
    go_on,
    no_empty_folder,
    program,
    resumable,
)
from lfrtorch.cli.update import updated
from lfrtorch.data.dataset import Dataset
from lfrtorch.distributed import ProcessLostError, agreed, connect, current
from lfrtorch.fitting.observer import Watching
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.trainer import FitResult, Round, StoppedError
from lfrtorch.job import identify
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model
from lfrtorch.reporting.console import Console
from lfrtorch.reporting.monitor import Checkpoint, TensorBoard, quiet_writers
from lfrtorch.reporting.run_files import write
from lfrtorch.reporting.verdict import LINEAR_MODEL


def run(cfg: DictConfig, folder: Path, command: str = "") -> float:
    """Identify, and let the first process write files; return the validation RMSE."""
    # If a fit ended early, its files are written before the error is raised.
    first = current().rank == 0
    cfg = chosen_before(cfg, folder)
    if cfg["update"] is not None:  # cfg.update is a method of a mapping
        if current().world > 1:
            raise InputError("an update is the work of one process; start it without torchrun.")
        check_plain(cfg)
        limit_threads(cfg)
        return updated(cfg, loaded(cfg), folder)
    settings = configured(cfg)
    limit_threads(cfg)
    dataset = loaded(cfg)
    if cfg.resume is None and first:
        for old in (SNAPSHOTS, STARTS):
            shutil.rmtree(folder / old, ignore_errors=True)
    kept = folder / SNAPSHOTS if cfg.resume or first else None
    snapshots = Snapshots(kept, writes=first)
    files = _Folder(cfg, folder, least=snapshots.least) if first else None
    with Termination() as stop, resumable(folder):
        try:
            found = identify(dataset, settings, observer=files, snapshots=snapshots, stop=stop)
        except StoppedError as stopped:
            number = stop.asked or signal.SIGINT
            raise TerminatedError(f"{stopped}: nothing to keep", number) from None
        if files is not None:
            print(found)
            config = OmegaConf.to_yaml(files.cfg)
            write(
                found, folder, command=command, config=config, draw=cfg.figures, board=files.board
            )
            # At most five items of advice are printed; the report has all.
            for item in found.advice[:5]:
                print(f"next: {item.text}\n      ({item.evidence})")
                if typed := item.command(command):
                    print(f"      {typed}")
            if found.verdict.use == LINEAR_MODEL:
                checkpoint = shlex.quote(f"checkpoint={folder / 'linear'}")
                print(
                    f"\nThe linear model: lfrtorch simulate {checkpoint} NEW.csv out=PREDICTED.csv"
                )
            print(f"\nRun in {folder}" + f", its report in {folder / 'report.html'}" * cfg.figures)
            print(f"TensorBoard: tensorboard --logdir {folder}")
    reason = found.fit.reason
    best = f"the best model so far is in {folder / 'model'}; {go_on(folder)}"
    if reason == Reason.PROCESS_LOST:
        raise ProcessLostError(f"{found.fit.detail}; {best}")
    if reason == Reason.INTERRUPTED:
        how = "terminated" if stop.asked == signal.SIGTERM else "interrupted"
        raise TerminatedError(f"the fit was {how}; {best}", stop.asked or signal.SIGINT)
    judged = found.metrics["validation"]["rmse"]
    return found.fit.history[found.fit.chosen_iteration].train if judged is None else judged


class _Folder(Console):
    """First process, which prints and keeps the folder of the run up to date during the fit."""

    def __init__(self, cfg: DictConfig, folder: Path, *, least: float) -> None:
        super().__init__()
        self.cfg, self.folder, self._least = cfg, folder, least

    def begin(
        self, dataset: Dataset, settings: Settings, linear: LinearModel, models: Sequence[Model]
    ) -> Watching:
        asked: Any = OmegaConf.to_container(self.cfg, resolve=True)
        self.cfg = OmegaConf.create({**asked, USED: settings.used})
        with whole_file(self.folder / CONFIG) as fresh:
            OmegaConf.save(self.cfg, fresh)
        shown = (dataset.validation or dataset.train)[0] if self.cfg.figures else None
        y_linear = None if shown is None else linear.simulate(shown)
        self.board = TensorBoard(self.folder, shown, y_linear, say=self.note)
        keep = Checkpoint(self.folder / "model", least=self._least)
        printing, watch = super().begin(dataset, settings, linear, models)
        if len(models) == 1:
            self._boards = []
            return Watching([[*printing[0], self.board, keep]], watch)
        self._boards = [
            TensorBoard(self.folder / STARTS / f"{i:02d}", finalist=True, say=self.note)
            for i in range(len(models))
        ]
        own = list(zip(printing, self._boards, strict=True))
        rounds = TensorBoard(self.folder / STARTS, say=self.note)
        self._boards.append(rounds)

        def told(ended: Round) -> None:
            watch(ended)
            rounds.round(ended)

        return Watching([[*lines, board, keep] for lines, board in own], told)

    def note(self, text: str) -> None:
        self.say(f"note: {text}")

    def end(self, result: FitResult) -> None:
        super().end(result)
        for board in self._boards:
            board.close()


def main(cfg: DictConfig) -> float:
    """Run the command as the command line asks."""
    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    cfg.threads = sweep.threads(job, cfg.threads)
    command = shlex.join([*program("train.py"), *job.overrides.task])
    if job.mode == RunMode.MULTIRUN:
        work = partial(launched, cfg, folder, command)
        return sweep.one_of_several(work, folder, overwrite=cfg.overwrite is True)
    return launched(cfg, folder, command)


def launched(cfg: DictConfig, folder: Path, command: str) -> float:
    """Make one run with all processes of torchrun; errors of users end the program."""
    rank = os.environ.get("RANK", "0")
    with ExitStack() as stack:
        stack.enter_context(user_errors())
        stack.enter_context(quiet_writers())
        if rank == "0":
            stack.enter_context(no_empty_folder(folder))
        if stack.enter_context(connect(cfg.device, cfg.timeout)).rank > 0:
            stack.enter_context(redirect_stdout(stack.enter_context(open(os.devnull, "w"))))
        return run(cfg, _common(folder), command)
    raise AssertionError  # user_errors does not return


def _common(folder: Path) -> Path:
    """The folder of the first process, in all processes."""
    name = torch.tensor(list(str(folder).encode()), dtype=torch.uint8)
    return Path(bytes(agreed(name).tolist()).decode())
