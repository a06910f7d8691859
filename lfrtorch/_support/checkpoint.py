"""A checkpoint: a folder with a JSON description and safetensors weights, no code and no pickle."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from lfrtorch._support.atomic import umask
from lfrtorch._support.errors import InputError

FORMAT = "lfrtorch"
VERSION = 1
DESCRIPTION, WEIGHTS = "model.json", "weights.safetensors"

CODE = (".pt", ".pth", ".ckpt", ".pkl", ".pickle", ".joblib", ".py", ".pyc", ".so")
"""Extensions of files that may carry code: none of them belongs to a checkpoint."""


def write(folder: str | Path, description: dict[str, Any], weights: dict[str, Tensor]) -> Path:
    """Write a checkpoint folder whole or not at all; an existing checkpoint is replaced.

    Raises:
        ValueError: ``folder`` exists and is not a checkpoint.
    """
    folder = Path(folder).resolve()  # a link's target is replaced, not the link
    if folder.exists() and not (folder / DESCRIPTION).is_file() and _occupied(folder):
        raise InputError(
            f"'{folder}' exists and is not a checkpoint; choose another folder to save to."
        )
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        text = json.dumps({"format": FORMAT, "version": VERSION, **description}, indent=2) + "\n"
        (fresh / DESCRIPTION).write_text(text)
        save_file({k: t.detach().contiguous().cpu() for k, t in weights.items()}, fresh / WEIGHTS)
        os.chmod(fresh, 0o777 & ~umask())
        if _holds(folder, text):  # other weights of the same model: at no moment is there neither
            os.replace(fresh / WEIGHTS, folder / WEIGHTS)
        elif folder.exists():
            old = fresh.with_name(fresh.name + "-old")
            folder.rename(old)
            fresh.rename(folder)
            shutil.rmtree(old)
        else:
            fresh.rename(folder)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return folder


def read(
    folder: str | Path, inside: Sequence[str] = ("model", "linear")
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Description and weights of a checkpoint folder, or of a run's folder that holds one.

    Args:
        folder: the checkpoint, or the run.
        inside: where in a run's folder, the first that is there.

    Raises:
        ValueError: no checkpoint there, a damaged one, one of another program or newer version, or
            files that may carry code, which are never opened.
    """
    folder = _located(Path(folder), inside)
    try:
        description = json.loads((folder / DESCRIPTION).read_text())
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            f"'{folder / DESCRIPTION}' is damaged or cut off ({error}); "
            "copy the checkpoint again from where it was saved, or train anew."
        ) from None
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise InputError(f"'{folder / DESCRIPTION}' was not written by {FORMAT}.")
    if not isinstance(description.get("version"), int) or description["version"] > VERSION:
        raise InputError(
            f"'{folder}' has checkpoint version {description.get('version')} and this program "
            f"reads up to {VERSION}; install a newer {FORMAT}."
        )
    try:
        weights = load_file(folder / WEIGHTS)
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"'{folder / WEIGHTS}' is damaged or missing ({error}); "
            "copy the checkpoint again from where it was saved, or train anew."
        ) from None
    return description, weights


def _below(folder: Path, at: str, inside: Sequence[str]) -> list[str]:
    """Checkpoints whose paths match a pattern."""
    return [
        str(path)
        for path in sorted(folder.glob(at))
        if any((path / name / DESCRIPTION).is_file() for name in ("", *inside))
    ]


def _located(folder: Path, inside: Sequence[str]) -> Path:
    """The folder that holds the description; refuse all else, code above all."""
    if folder.is_file():
        raise InputError(
            f"'{folder}' is a file, and a checkpoint is a folder with {DESCRIPTION} and {WEIGHTS}; "
            f"give that folder, or the folder of a run.\nOther files ({', '.join(CODE[:4])}) may "
            "carry code and are never opened."
        )
    places = [folder, *(folder / name for name in inside)]
    found = next((place for place in places if (place / DESCRIPTION).is_file()), None)
    looked_in = folder if found is None else found
    code = sorted(p.name for p in looked_in.glob("*") if p.suffix.lower() in CODE)
    if not folder.exists():
        raise InputError(
            f"there is no '{folder}'; give the folder of a run or of a saved model, a checkpoint."
        )
    if found is None:
        below = next(filter(None, (_below(folder, at, inside) for at in ("*", "*/*"))), [])
        if below:
            raise InputError(
                f"'{folder}' is not a checkpoint; give one of those in it: {', '.join(below[-5:])}."
            )
        raise InputError(
            f"'{folder}' is not a checkpoint: no {DESCRIPTION} in it or in its "
            f"{' or '.join(f'{name}/' for name in inside)} folder; "
            "give the folder of a run or of a saved model."
            + (f"\n{', '.join(code)} may carry code and is never opened." if code else "")
        )
    if code:
        raise InputError(
            f"'{found}' holds {', '.join(code)} beside the model: a checkpoint carries no code; "
            "move the file away if you know where it comes from, or do not trust this folder."
        )
    return found


def _holds(folder: Path, description: str) -> bool:
    """Whether ``folder`` is a checkpoint with that description."""
    try:
        return (folder / DESCRIPTION).read_text() == description
    except (OSError, UnicodeDecodeError):
        return False


def _occupied(folder: Path) -> bool:
    """Whether ``folder`` is a file or a folder that is not empty."""
    return not folder.is_dir() or any(folder.iterdir())
