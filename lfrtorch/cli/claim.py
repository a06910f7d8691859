"""Lock on the folder of a run, so that no other program writes into it."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from lfrtorch._support.atomic import remove_leftovers
from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import real
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.run_folder import CONFIG, SNAPSHOTS

PARTS = ("model", "linear", "figures", SNAPSHOTS, f"{SNAPSHOTS}/begun")
"""Folders in the folder of a run whose files a new run replaces."""

_locks: dict[Path, int] = {}
"""Open folders that are locked; the system unlocks them when the program ends or is killed."""


class Claim(Callback):
    """Callback of Hydra before it makes the folder of a single run (for several see ``sweep``)."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Claim ``hydra.run.dir``."""
        if os.environ.get("RANK", "0") == "0":
            with user_errors():
                claim(Path(config.hydra.run.dir), config)


def claim(folder: Path, cfg: DictConfig) -> None:
    """Lock a folder until the program ends, or refuse it; make the folder if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"hydra.run.dir is '{folder}', which cannot be written to ({error.strerror}); "
            "give another folder."
        ) from None
    if not locked(real(folder)):
        raise InputError(
            f"hydra.run.dir is '{folder}', where another run is at work; "
            "give another folder, or wait."
        )
    if (folder / CONFIG).exists() and cfg.resume is None and cfg.overwrite is not True:
        raise InputError(
            f"hydra.run.dir is '{folder}', which holds a run; give another folder, resume={folder} "
            "to go on with that run, or overwrite=true to replace it."
        )
    tidy(folder)


def tidy(folder: Path) -> None:
    """Remove unfinished files that a killed run left in its folder."""
    if (folder / CONFIG).exists() or (folder / SNAPSHOTS).exists():
        for part in ("", *PARTS):
            remove_leftovers(folder / part)


def locked(folder: Path) -> bool:
    """Lock a folder and tell if that succeeded; True if the system has no locks."""
    try:
        import fcntl
    except ImportError:
        return True
    for other in list(_locks):
        os.close(_locks.pop(other))
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return False
    except OSError:  # a file system without locks
        os.close(handle)
        return True
    _locks[folder] = handle
    return True
