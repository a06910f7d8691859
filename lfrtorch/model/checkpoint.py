"""Reads the model of a checkpoint; the caller defines which static maps it may have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import Module

from lfrtorch._support import checkpoint
from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.old_checkpoints import SCALING, innermost, of_today
from lfrtorch.data.records import Scaler, described_channels
from lfrtorch.engine import held
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.model.data_reach import Cloud, DataReach
from lfrtorch.model.information import Information
from lfrtorch.model.model import Model

MapMaker = Callable[[Any, int, int, torch.dtype], Module | None]
"""Makes a static map from its description, nz, nw and dtype; None if there is no map."""


def read_model(
    folder: str | Path, maker_of: Callable[[Any], MapMaker], inside: Sequence[str]
) -> tuple[Model, dict[str, Any] | None, dict[str, Tensor]]:
    """The model in a checkpoint, and the ``about`` and ``known`` that ``write_model`` was given.

    ``maker_of`` returns the maker of a static map from the map's description.
    """
    description, weights = checkpoint.read(folder, inside)
    own, _ = innermost(description)
    maker = maker_of(own)
    try:
        description, weights = of_today(description, weights)
        known = _under(weights, "linear.")
        about = description.get("linear")
        if not isinstance(about, dict | None):
            raise InputError(f"linear is {about!r}")
        return _made(description, weights, maker), about, known
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise InputError(
            f"'{folder}' is damaged: its description and weights do not fit ({brief(error)})."
        ) from None


def _made(description: dict[str, Any], weights: dict[str, Tensor], maker: MapMaker) -> Model:
    """The model of a description and its weights."""
    sizes, dtype = description["sizes"], getattr(torch, description["dtype"])
    if not (isinstance(dtype, torch.dtype) and dtype.is_floating_point):
        raise InputError(f"dtype is {description['dtype']}")
    lost = [n for n, w in weights.items() if not n.endswith(".bounds") and not w.isfinite().all()]
    if lost:
        raise InputError(f"{', '.join(lost)} have numbers that are not finite")
    scaling = {name: weights.pop(f"scaler.{name}").numpy() for name in SCALING}
    scaler = Scaler(**scaling, delay=tuple(map(int, description.get("delay", ()))))
    if scaler.delay and (len(scaler.delay) != sizes["nu"] or min(scaler.delay) < 0):
        raise InputError(f"delay is {scaler.delay}")
    if weights["A"].shape != (sizes["nx"],) * 2:
        raise InputError("they are of other sizes")
    static = maker(description["static"], sizes["nz"], sizes["nw"], dtype)
    cell = LFRCell(**sizes, static=static, dtype=dtype, random=False).to(dtype)
    K, masks, parts = weights.pop("K", None), _under(weights, "fixed."), _under(weights, "reach.")
    told, information = _under(weights, "information."), None
    if told:
        information = Information(
            told["theta"], told["R"], *(float(told[n]) for n in ("rmse", "samples"))
        )
    reach = None
    if parts:
        names = ("u", "y", "middle", "axes", "ends", "farthest")
        of_u, of_y, middle, axes, ends, far = (parts[name].numpy() for name in names)
        reach = DataReach(of_u, of_y, Cloud(middle, axes, ends, float(far)))
    cell.load_state_dict(weights)
    named = description.get("structure", "free")
    if named not in held.STRUCTURES:
        raise InputError(f"structure is {named!r}")
    z, y = (description.get(name, True) for name in ("z_feedthrough", "feedthrough"))
    for given in (
        {name: (mask != 0, cell.get_parameter(name).detach()) for name, mask in masks.items()},
        held.structure(cell, named),  # old checkpoints have no masks, but these settings
        held.no_feedthrough(cell, z=z, y=y),
        held.integrators(cell) if cell.nw else {},
    ):
        cell.hold(given)
    inputs, outputs = (described_channels(description[side]) for side in ("inputs", "outputs"))
    about = float(description["fs"]), inputs, outputs, str(description.get("fitted_to", ""))
    return Model(LFR(cell), scaler, *about, K, reach, information)


def _under(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Take out the tensors whose names begin with a prefix, and remove the prefix."""
    names = [name for name in weights if name.startswith(prefix)]
    return {name.removeprefix(prefix): weights.pop(name) for name in names}
