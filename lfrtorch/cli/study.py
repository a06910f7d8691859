"""Several runs by one command: each in a process and a folder of its own, and no run twice."""

from __future__ import annotations

import json
import math
import os
import shlex
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from hashlib import sha256
from importlib.util import find_spec
from multiprocessing import (
    get_all_start_methods,
    get_context,
    get_start_method,
    set_start_method,
)
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from threadpoolctl import threadpool_limits

from lfrtorch._support import tables
from lfrtorch._support.errors import InputError
from lfrtorch._support.reasons import CUT_SHORT
from lfrtorch.cli.claim import tidy
from lfrtorch.cli.composition import SWEEPS, parsed
from lfrtorch.cli.interrupts import TerminatedError
from lfrtorch.cli.quotes import register_resolver
from lfrtorch.cli.run_folder import SNAPSHOTS

LOG, FAILED = "log.txt", "failed.txt"
"""In the folder of a run: what it printed, why it failed, and what says that a process is at it."""

_LONGEST = 120  # characters of a folder's name; file systems take 255 bytes

ATTEMPTS = 3
"""How often the runs that are left are begun if processes are killed that many runs share."""


_KILLED = {"BrokenProcessPool", "UncompletedJobError"}
"""Errors of joblib and submitit if one of their processes is."""

LOADED = ("lfrtorch.cli.fit", "lfrtorch._public", "pandas", "scipy.signal")

LAUNCHERS = {
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
}
"""What starts several runs at once, and the package that it needs."""


PROCESSES = get_context("forkserver") if sys.platform == "linux" else get_context("spawn")
"""Runs begin as copies of a process that has loaded what they need and has computed nothing: its
threads are not copied, and a run would wait for them. Other systems' libraries allow no copies.
"""


def folder_name(varied: str) -> str:
    """The name of a run's folder, from its own words: ``nn=5,seed=0``."""
    name = quote(varied, safe="=,+[]{}:() ") or "run"
    if len(name) <= _LONGEST:
        return name
    return f"{name[: _LONGEST - 9]}-{sha256(name.encode()).hexdigest()[:8]}"


register_resolver("folder_name", folder_name, replace=True)


def study_words(given: Sequence[str]) -> list[str]:
    """The command line of several runs, with what names their folders."""
    if any(word.startswith("resume=") for word in given):
        raise InputError(
            "resume is of one run; several go on by the same command with hydra.sweep.dir=DIR."
        )
    words = [parsed(word) for word in given if not word.startswith("-")]
    for word in words:
        package = word.key_or_group == "hydra/launcher" and LAUNCHERS.get(str(word.value()))
        if package and find_spec(package) is None:
            raise InputError(f"{word.input_line} needs: pip install 'lfrtorch[sweep]'.")
    common = [word for word in words if not (word.is_sweep_override() or word.is_hydra_override())]
    for word in words:
        if word.get_key_element() == "hydra.sweep.dir" and "overwrite=true" not in given:
            _same_study(Path(str(word.value())), sorted(str(word.input_line) for word in common))
    keys = ",".join(dict.fromkeys(word.key_or_group for word in common))
    return [*given, f"hydra.job.config.override_dirname.exclude_keys=[{keys}]"]


def _same_study(folder: Path, common: Sequence[str]) -> None:
    """Refuse a folder whose runs were made with other words than those they share now."""
    if not (folder / "multirun.yaml").is_file():
        return
    listed = OmegaConf.load(folder / "multirun.yaml")
    before: Any = OmegaConf.to_container(OmegaConf.select(listed, "hydra.overrides.task"))
    words = [word for word in map(parsed, before) if not word.is_sweep_override()]
    old, new = _compared([str(word.input_line) for word in words]), _compared(common)
    if old != new:
        changed = ", ".join(sorted(set(old) ^ set(new)))
        raise InputError(
            f"hydra.sweep.dir is '{folder}', whose runs have other settings ({changed}); give "
            "another folder, or overwrite=true to replace those runs."
        )


def _compared(words: Sequence[str]) -> list[str]:
    """The words that say what a run computes, in an order of their own."""
    return sorted(word for word in words if word.partition("=")[0] not in ("overwrite", "resume"))


def job(work: Callable[[DictConfig], float], cfg: DictConfig, folder: Path, *, hydra: Any) -> float:
    """One of several runs, unless it is done; returns its validation RMSE, nan if it failed."""
    # Its outcome is a line on the terminal. A run that fails, or is killed, is noted in its folder
    # and stops no other. One that was killed goes on, on as many threads as its place has.
    with alone(folder) as lock:
        known = None if cfg.overwrite else done(folder, list(hydra.overrides.task))
        if known is not None:
            print(f"{folder.name}: done before", flush=True)
            return known
        one_by_one = hydra.launcher._target_.endswith(".BasicLauncher")
        if cfg.threads is None and not one_by_one:
            cfg.threads = hydra.launcher.get("cpus_per_task") or 1
        if not cfg.overwrite and cfg.resume is None and (folder / SNAPSHOTS).is_dir():
            cfg.resume = str(folder)
        tidy(folder)
        for old in (FAILED, LOG):
            (folder / old).unlink(missing_ok=True)
        begun = time.perf_counter()
        value, end = _apart(work, cfg, folder / LOG, lock)
        if value is None:
            (folder / FAILED).write_text(f"{end}\n", encoding="utf-8")
            print(f"{folder.name}: failed: {end}", flush=True)
            return math.nan
        took = tables.quantity(time.perf_counter() - begun, "s")
        print(f"{folder.name}: error {tables.number(value)}, {took}", flush=True)
        return value


def done(folder: Path, words: Sequence[str]) -> float | None:
    """The validation RMSE of a run with these words that came to its end; None if none did."""
    if not (folder / "metrics.json").is_file():
        return None
    found = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    made = shlex.split(found["command"])[2:]
    if _compared(made) != _compared(words) or found["fit"]["reason"].startswith(tuple(CUT_SHORT)):
        return None
    judged = found["validation"]["rmse"]
    return found["ranking"][0]["train"] if judged is None else judged


@contextmanager
def alone(folder: Path) -> Iterator[Connection | None]:
    """No other process is at this run: one left of a study that was killed ends first."""
    # The open file is locked until all processes that have it close it. It is a connection, since
    # these may be handed to another process.
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield None
        return
    with Connection(os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o666)) as lock:
        fcntl.flock(lock.fileno(), fcntl.LOCK_EX)
        yield lock


def _apart(
    work: Callable[[DictConfig], float], cfg: DictConfig, log: Path, lock: Connection | None
) -> tuple[float | None, str]:
    """The value of the work, None if it failed, and how it ended; what it prints is in a file."""
    if get_start_method() not in get_all_start_methods():  # joblib's, which our processes lack
        set_start_method(PROCESSES.get_start_method(), force=True)
    # Modules that runs need are loaded before they begin: some take seconds.
    PROCESSES.set_forkserver_preload(list(LOADED))
    ours, theirs = PROCESSES.Pipe(duplex=False)
    process = PROCESSES.Process(target=_send, args=(theirs, work, cfg, log, lock))
    process.start()
    theirs.close()
    try:
        while process.exitcode is None:
            process.join(1.0)
    except KeyboardInterrupt:  # it was asked to end as well, and keeps what it found
        process.join()
        raise
    except TerminatedError:
        process.terminate()
        process.join()
        raise
    if process.exitcode == 0:
        return ours.recv()
    code = process.exitcode or 0
    return None, f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _send(
    pipe: Connection,
    work: Callable[[DictConfig], float],
    cfg: DictConfig,
    log: Path,
    _lock: Connection | None,  # held until this process ends
) -> None:
    """In a process of its own: the value and how it ended."""
    with log.open("a") as file:
        for number in (1, 2):
            os.dup2(file.fileno(), number)  # of libraries that are not Python's, too
    pipe.send(_logged(work, cfg, log))


def _logged(
    work: Callable[[DictConfig], float], cfg: DictConfig, log: Path
) -> tuple[float | None, str]:
    """The same in this process."""
    with (
        log.open("a", buffering=1, encoding="utf-8") as file,
        redirect_stdout(file),
        redirect_stderr(file),
        threadpool_limits(cfg.threads),
    ):
        try:
            return work(cfg), "done"
        except SystemExit as end:
            error = f"exit code {end.code}"
        except Exception:
            traceback.print_exc()
            error = "a bug"
    lines = log.read_text(encoding="utf-8").splitlines()
    said = [line for line in lines if line.startswith("error: ")] or [x for x in lines if x.strip()]
    return None, said[-1].removeprefix("error: ") if said else error


class Report(Callback):
    """Says where the runs are, and at the end what became of them; Hydra calls it."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Before the first run."""
        folder = shlex.quote(f"hydra.sweep.dir={config.hydra.sweep.dir}")
        print(f"Runs in {config.hydra.sweep.dir}; the same command with {folder} goes on there")

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """After the last one."""
        folder = Path(config.hydra.sweep.dir)
        runs = sorted(path.parents[1] for path in folder.rglob(".hydra/overrides.yaml"))
        failed = [run for run in runs if (run / FAILED).is_file()]
        ended = sum((run / "metrics.json").is_file() for run in runs if run not in failed)
        print(f"\n{ended} of {len(runs)} runs in {folder} are done")
        if failed:
            why = [(run / FAILED).read_text(encoding="utf-8").strip() for run in failed]
            names = [str(run.relative_to(folder)) for run in failed]
            rows = [list(pair) for pair in zip(names, why, strict=True)]
            print(f"\n{tables.table(['failed', 'why'], rows)}")
            sys.exit(1)


def went_on(launched: Callable[[], Any]) -> None:
    """Start the runs; those that are left again if a process that works on them is killed."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come here, and not as a traceback
    for _ in range(ATTEMPTS):
        try:
            return launched()
        except (KeyboardInterrupt, TerminatedError) as end:
            number = getattr(end, "number", signal.SIGINT)
            how = "interrupted" if number == signal.SIGINT else "terminated"
            print(f"{how}: the same command with that folder goes on", file=sys.stderr)
            sys.exit(128 + number)
        except Exception as error:
            if not {kind.__name__ for kind in type(error).__mro__} & _KILLED:
                raise
            print("a process was killed: going on with the runs that are left", file=sys.stderr)
    sys.exit(f"processes were killed {ATTEMPTS} times: is there memory enough for so many at once?")


def is_study(given: Sequence[str]) -> bool:
    """Whether the command line asks for several runs."""
    return not SWEEPS.isdisjoint(given)


def of_several(hydra: Any) -> bool:
    """Whether this run is one of them."""
    return hydra.mode == RunMode.MULTIRUN
