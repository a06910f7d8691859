"""A checkpoint: a folder with a JSON description and safetensors weights, no code and no pickle."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from lfrtorch._support.atomic import TEMPORARY, whole_file, whole_folder
from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.memory import check_memory
from lfrtorch._support.paths import expanded, real

FORMAT = "lfrtorch"
VERSION = 1
DESCRIPTION, _WEIGHTS = "model.json", "weights.safetensors"
_NEXT = "next.safetensors"  # name of the weights while another model replaces a checkpoint
_DIGEST = "sha256"  # in the metadata of tensors: detects damage that leaves valid numbers

# Extensions of files that may carry code: none of them belongs to a checkpoint.
_CODE = (".pt", ".pth", ".ckpt", ".pkl", ".pickle", ".joblib", ".py", ".pyc", ".so")


def write(folder: str | Path, description: dict[str, Any], weights: dict[str, Tensor]) -> Path:
    """Write a checkpoint folder whole or not at all; an existing checkpoint is replaced.

    An existing one stays readable at every moment. Other files in its folder stay where they are.
    """
    folder = real(folder)  # a link's target is replaced, not the link
    replaced = (folder / DESCRIPTION).is_file()
    if folder.exists() and not replaced and _occupied(folder):
        raise InputError(
            f"'{folder}' exists and is not a checkpoint; choose another folder to save to."
        )
    described = {"format": FORMAT, "version": VERSION, **description}
    if not replaced:
        with whole_folder(folder) as fresh:
            _describe(fresh / DESCRIPTION, described)
            write_tensors(fresh / _WEIGHTS, weights)
        return folder
    before = _described(folder)
    if before == json.loads(json.dumps(described)):  # the same model, with other weights
        _replace(folder / _WEIGHTS, weights)
    else:  # two files cannot be replaced at once: never the weights that the description names
        for name in (_WEIGHTS,) if before.get("weights") == _NEXT else (_NEXT, _WEIGHTS):
            _replace(folder / name, weights)
            with whole_file(folder / DESCRIPTION) as fresh:
                _describe(fresh, described if name == _WEIGHTS else {**described, "weights": _NEXT})
    (folder / _NEXT).unlink(missing_ok=True)
    return folder


def write_tensors(path: Path, tensors: dict[str, Tensor], **metadata: str) -> None:
    """Write a safetensors file with a digest; a full disk is an OSError."""
    held = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}
    try:
        save_file(held, path, metadata={**metadata, _DIGEST: _digest(held, metadata)})
    except SafetensorError as error:
        raise OSError(f"'{path.parent}' cannot be written to: {error}") from None


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a safetensors file and its metadata; older files have no digest."""
    if path.exists() and not path.is_file():
        raise OSError("it is not a file")
    try:
        check_memory(path.stat().st_size, "it", "copy it again")
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, InputError, UnicodeError) as error:
        raise OSError(brief(error)) from None
    written = metadata.pop(_DIGEST, None)
    if written is not None and written != _digest(tensors, metadata):
        raise OSError("its numbers are not those that were written")
    return tensors, metadata


def _digest(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """SHA-256 of the names, shapes and values of a file of tensors."""
    found = sha256(repr(sorted(metadata.items())).encode())
    for name, tensor in sorted(tensors.items()):
        found.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        found.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return found.hexdigest()


def read(
    folder: str | Path, inside: Sequence[str] = ("model", "linear")
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read the description and weights of a checkpoint, or of one ``inside`` the folder of a run.

    Refuse damaged ones, newer versions, and files that may carry code, which are never opened.
    """
    folder = _located(expanded(folder), inside)
    try:
        check_memory((folder / DESCRIPTION).stat().st_size, "it", "copy it again")
        description = json.loads((folder / DESCRIPTION).read_text())
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"'{folder / DESCRIPTION}' is damaged or cut off ({brief(error)}); "
            "copy the checkpoint again from where it was saved, or train anew."
        ) from None
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise InputError(f"'{folder / DESCRIPTION}' was not written by {FORMAT}.")
    version = description.get("version")
    if type(version) is not int or version < 1:
        raise InputError(
            f"'{folder / DESCRIPTION}' is damaged (version {version!r}); "
            "copy the checkpoint again from where it was saved."
        )
    if version > VERSION:
        raise InputError(
            f"'{folder}' has checkpoint version {version} and this program reads up to {VERSION}; "
            f"install a newer {FORMAT}."
        )
    file = folder / (_NEXT if description.get("weights") == _NEXT else _WEIGHTS)
    try:
        weights, _ = read_tensors(file)
    except OSError as error:
        raise InputError(
            f"'{file}' is damaged or missing ({brief(error)}); "
            "copy the checkpoint again from where it was saved, or train anew."
        ) from None
    return description, weights


def _below(folder: Path, at: str, inside: Sequence[str]) -> list[str]:
    """List checkpoints whose paths match a pattern."""
    return [
        str(path)
        for path in sorted(folder.glob(at))
        if not path.name.startswith(TEMPORARY)
        and any((path / name / DESCRIPTION).is_file() for name in ("", *inside))
    ]


def _located(folder: Path, inside: Sequence[str]) -> Path:
    """Find the folder that holds the description; refuse all else, code above all."""
    if folder.is_file():
        raise InputError(
            f"'{folder}' is a file, and a checkpoint is a folder with {DESCRIPTION} and "
            f"{_WEIGHTS}; give that folder, or the folder of a run.\nOther files "
            f"({', '.join(_CODE[:4])}) may carry code and are never opened."
        )
    places = [folder, *(folder / name for name in inside)]
    found = next((place for place in places if (place / DESCRIPTION).is_file()), None)
    looked_in = folder if found is None else found
    code = sorted(p.name for p in looked_in.glob("*") if p.suffix.lower() in _CODE)
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


def _replace(path: Path, weights: dict[str, Tensor]) -> None:
    """Replace a file of weights."""
    with whole_file(path) as fresh:
        write_tensors(fresh, weights)


def _describe(path: Path, description: dict[str, Any]) -> None:
    """Write a description."""
    path.write_text(json.dumps(description, indent=2) + "\n")


def _described(folder: Path) -> dict[str, Any]:
    """Read the description in a checkpoint; empty if it is damaged."""
    try:
        found = json.loads((folder / DESCRIPTION).read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _occupied(folder: Path) -> bool:
    """Tell if ``folder`` is a file, or a folder that is not empty."""
    return not folder.is_dir() or any(folder.iterdir())
