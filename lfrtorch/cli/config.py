"""The configuration: where it lies, and what is missing from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

import lfrtorch
from lfrtorch._checks import integer, number

_PACKAGE = Path(__file__).resolve().parents[1]

CONF = next(folder for folder in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if folder.is_dir())
"""Inside the package if it is installed, at the top of its repository otherwise."""

LAST_SIZE = {"network": ["nn"], "polynomial": ["degree"]}
"""The size of a kind of static map beside nz and nw."""


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


def sizes_of(cfg: DictConfig) -> list[str]:
    """Of the static nonlinearity: nz, nw, and a polynomial's degree or a network's nn."""
    return ["nz", "nw", *LAST_SIZE.get(cfg.static.kind, ())]


def static_map(cfg: DictConfig) -> dict[str, Any]:
    """The arguments of a start that say which static nonlinearity it has."""
    if cfg.static.kind == "network":
        return {"nn": cfg.nn, "activation": cfg.activation}
    if cfg.static.kind == "polynomial":
        return {"static": lfrtorch.Polynomial(cfg.nz, cfg.nw, cfg.degree)}
    own = {name: value for name, value in cfg.static.items() if name != "kind"}
    return {"static": instantiate(own, nz=cfg.nz, nw=cfg.nw)}


def opened(cfg: DictConfig) -> lfrtorch.Model:
    """The model of ``init_from`` as it was saved."""
    own = static_map(cfg)["static"] if cfg.static.kind == "own" else None
    return lfrtorch.load(cfg.init_from, static=own)
