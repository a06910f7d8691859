"""The folder of a run: its words, its settings, and how the run goes on."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.paths import expanded

CONFIG = "config.yaml"
"""File of the settings, in the folder of a run."""

SNAPSHOTS = "resume"
"""Folder of the snapshots of the starts, in the folder of a run."""

STARTS = "starts"
"""Folder of the events of the starts that run to the end, in the folder of a run."""

USED = "used"
"""Key in ``CONFIG`` of the numbers that the fit has chosen, or was given."""

OVERRIDES = Path(".hydra", "overrides.yaml")
"""File of the words of the command line, in the folder of a run."""


SILENT = ("hydra.run.dir=.", "hydra.output_subdir=null", "hydra/job_logging=none")
"""Settings of Hydra for all processes of a fit but the first: only the first writes files."""


def world() -> int:
    """Number of processes of one fit that torchrun started."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def arguments(given: Sequence[str]) -> list[str]:
    """The command line; with ``resume=DIR``, the words of that run come before."""
    values = dict(argument.split("=", 1) for argument in given if "=" in argument)
    folder = values.get("resume", "null")
    if folder != "null":
        overrides = expanded(Path(folder) / OVERRIDES)
        if not overrides.is_file():
            found = (Path(folder).glob(f"{at}/{OVERRIDES}") for at in ("*", "*/*"))
            runs = sorted(str(path.parents[1]) for paths in found for path in paths)
            raise InputError(
                f"resume is '{folder}', which is not the folder of a run; give "
                + (
                    f"one of the runs in it: {', '.join(runs[-5:])}."
                    if runs
                    else "the folder that the run named at its end, runs/NAME/DATE."
                )
            )
        before = [word for word in words_of(folder, given) if word not in given]
        escaped = folder.replace("\\", "\\\\").replace("'", "\\'")
        return [*before, *given, f"hydra.run.dir='{escaped}'"]
    return list(given)


def words_of(folder: str | Path, given: Sequence[str] = ()) -> list[str]:
    """The words that made the run in a folder; words that name code must be given again."""
    overrides = expanded(Path(folder) / OVERRIDES)
    listed = read_settings(overrides)
    if not (isinstance(listed, list) and all(isinstance(word, str) for word in listed)):
        raise InputError(f"'{overrides}' is damaged: it is no list of words; begin a new run.")
    for word in listed:
        if ("_target_" in word or word.lstrip("+~").startswith("hydra")) and word not in given:
            raise InputError(
                f"the run in '{folder}' names code: {brief(word)}; add that word to the "
                "command line if you know where the run comes from."
            )
    return [word for word in listed if not word.startswith("resume=")]


def read_settings(path: Path) -> Any:
    """Contents of a YAML file in a run's folder; refuse a damaged file, or one with aliases."""
    try:
        text = path.read_text(encoding="utf-8")
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader)):
            raise InputError("it has aliases")
        return OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except (OSError, ValueError, RecursionError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise InputError(
            f"'{path}' is damaged ({brief(error)}); copy the run again, or begin a new one."
        ) from None


def chosen_before(cfg: DictConfig, folder: Path) -> DictConfig:
    """The configuration with as many starts as the resumed run had.

    ``starts=auto`` follows from the number of iterations, which may be larger now. Sizes are chosen
    again, with the same result.
    """
    if cfg.resume is None or cfg.starts != "auto" or not (folder / CONFIG).is_file():
        return cfg
    before = read_settings(folder / CONFIG)
    used = before.get(USED, before) if isinstance(before, dict) else {}
    if "starts" not in used:
        raise InputError(f"'{folder / CONFIG}' lacks starts; begin a new run.")
    return cast(DictConfig, OmegaConf.merge(cfg, {"starts": used["starts"]}))


def program(script: str) -> list[str]:
    """The words that started this command: ``lfrtorch NAME``, or Python and the script."""
    installed = sys.argv[0].startswith("lfrtorch ")
    if world() > 1:
        several = ["torchrun", "--nproc-per-node", os.environ.get("LOCAL_WORLD_SIZE", str(world()))]
        named = ["-m", "lfrtorch.cli", *sys.argv[0].split()[1:]] if installed else [script]
        return [*several, *named]
    return sys.argv[0].split() if installed else ["python", script]


def go_on(folder: Path) -> str:
    """Text with the command that continues a run that ended early."""
    return f"to go on: {shlex.join(program('train.py'))} resume={folder}"


@contextmanager
def resumable(folder: Path) -> Iterator[None]:
    """Context in which the message on a disk failure says how to continue."""
    try:
        yield
    except OSError as error:
        if not (folder / SNAPSHOTS).is_dir():
            raise
        raise OSError(f"{error}; {go_on(folder)}") from error


@contextmanager
def no_empty_folder(folder: Path) -> Iterator[None]:
    """Context that removes the folder of a run that fails before it has a model."""
    try:
        yield
    except BaseException:
        passing = {".hydra", CONFIG, SNAPSHOTS, STARTS}
        names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        if names and all(name in passing or name.startswith("events.out") for name in names):
            shutil.rmtree(folder)
        raise
