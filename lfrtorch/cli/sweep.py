"""Several runs by one command, each in a folder of its own: ``lfrtorch fit -m nn=5,10``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hydra.types import RunMode

from lfrtorch._support.errors import InputError, LfrtorchError
from lfrtorch.cli.composition import parsed
from lfrtorch.cli.quotes import register_resolver
from lfrtorch.cli.run_folder import world

_LONGEST = 120  # largest number of characters of a folder's name; file systems allow 255 bytes

LAUNCHERS = {
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
}
"""Launchers that make several runs at once, and the packages that they need."""


class RunFailedError(LfrtorchError):
    """One of several runs ended with an error, and has printed it."""


def folder_name(varied: str) -> str:
    """The name of a run's folder from the words in which runs differ: ``nn=5,seed=0``."""
    name = quote(varied, safe="=,+[]{}:() ") or "run"
    if len(name) <= _LONGEST:
        return name
    return f"{name[: _LONGEST - 9]}-{sha256(name.encode()).hexdigest()[:8]}"


register_resolver("folder_name", folder_name, replace=True)


def words_of_runs(given: Sequence[str]) -> list[str]:
    """The command line of several runs, with words that name their folders."""
    if world() > 1:
        raise InputError("torchrun shares one fit; start several runs one after another.")
    if any(word.startswith("resume=") for word in given):
        raise InputError("resume is of one run; give it without -m.")
    words = [parsed(word) for word in given if not word.startswith("-")]
    for word in words:
        package = word.key_or_group == "hydra/launcher" and LAUNCHERS.get(str(word.value()))
        if package and find_spec(package) is None:
            raise InputError(f"{word.input_line} needs: pip install 'lfrtorch[sweep]'.")
    common = [word for word in words if not (word.is_sweep_override() or word.is_hydra_override())]
    keys = ",".join(dict.fromkeys(word.key_or_group for word in common))
    return [*given, f"hydra.job.config.override_dirname.exclude_keys=[{keys}]"]


def threads(job: Any, given: int | None) -> int | None:
    """Threads of a run: one if other runs go on beside it, or the CPUs that a cluster gives it."""
    alone = job.mode != RunMode.MULTIRUN or job.launcher._target_.endswith(".BasicLauncher")
    return given if alone or given is not None else job.launcher.get("cpus_per_task") or 1


def one_of_several(run: Callable[[], float], folder: Path, *, overwrite: bool) -> float:
    """Make a run beside others: an error of the user ends only this run, a signal all runs."""
    if (folder / "metrics.json").exists() and not overwrite:
        raise RunFailedError(
            f"'{folder}' holds a run; give another hydra.sweep.dir, or overwrite=true."
        )
    print(f"\nrun {folder.name}", flush=True)
    try:
        return run()
    except SystemExit as end:
        if end.code != 1:
            raise
        raise RunFailedError(f"the run {folder.name} failed; what it printed says why.") from None
