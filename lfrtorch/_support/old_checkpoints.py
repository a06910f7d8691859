"""Checkpoints of earlier versions, converted to the present form."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

SCALING = ("u_offset", "u_scale", "y_offset", "y_scale")
"""Fields of a scaler in a checkpoint."""

Checkpoint = tuple[dict[str, Any], dict[str, Tensor]]
"""A description and its weights."""


def innermost(description: dict[str, Any]) -> tuple[Any, int]:
    """Static map that a description names, and the number of canonical coordinates around it."""
    own, folds = description.get("static"), 0
    while isinstance(own, dict) and own.get("type") == "Beyond":
        own, folds = own.get("base"), folds + 1
    return own, folds


def of_today(description: dict[str, Any], weights: dict[str, Tensor]) -> Checkpoint:
    """Convert a model to the present form: linear models, canonical forms, covariances.

    The entries that a fit holds stand in the description of some (``structure``,
    ``feedthrough``), and are read with the model.
    """
    weights = dict(weights)
    if "sizes" not in description:
        description, weights = _linear(description, weights)
    own, folds = innermost(description)
    for _ in range(folds):
        weights = _folded(weights)
    description = {**description, "static": own}
    if "state_covariance" not in weights:
        weights["state_covariance"] = torch.eye(description["sizes"]["nx"])
    return description, weights


def _linear(description: dict[str, Any], weights: dict[str, Tensor]) -> Checkpoint:
    """A linear model in physical units as a model without a static map, of scales 1."""
    made = description["linear"]
    A, B, C, D = (weights.pop(name).double() for name in ("A", "B", "C", "D"))
    nx, nu, ny = len(A), B.shape[1], len(C)
    sizes = {"nu": nu, "ny": ny, "nx": nx, "nz": 0, "nw": 0}
    found = {**description, "sizes": sizes, "static": None, "dtype": "float64", "fs": made["fs"]}
    of_cell = {"A": A, "Bu": B, "Cy": C, "Dyu": D}
    empty = {"Bw": (nx, 0), "Cz": (0, nx), "Dzu": (0, nu), "Dyw": (ny, 0)}
    of_cell |= {name: A.new_zeros(shape) for name, shape in empty.items()}
    for side, size in (("u", nu), ("y", ny)):
        of_cell[f"scaler.{side}_offset"] = weights.pop(f"{side}_offset")
        of_cell[f"scaler.{side}_scale"] = torch.ones(size, dtype=A.dtype)
    if "state_covariance" in weights:
        of_cell["state_covariance"] = weights["state_covariance"]
    if "K" in weights:
        of_cell["K"] = weights.pop("K")
    return found, of_cell | {f"linear.{name}": weight for name, weight in weights.items()}


def _folded(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights of a model with f in the place of its map w = W (f(Z z) - L Z z)."""
    L, Z, W = (weights.pop(f"static.{name}") for name in ("slope", "into", "out"))
    found = {name.replace("static.base.", "static.", 1): weight for name, weight in weights.items()}
    for name in ("Cz", "Dzu", "reach.middle"):
        found |= {name: Z @ found[name]} if name in found else {}
    if "reach.axes" in found:
        found["reach.axes"] = found["reach.axes"] @ torch.linalg.inv(Z)
    for into, of_x, of_u in (("Bw", "A", "Bu"), ("Dyw", "Cy", "Dyu")):
        found[into] = found[into] @ W
        found[of_x] = found[of_x] - found[into] @ L @ found["Cz"]
        found[of_u] = found[of_u] - found[into] @ L @ found["Dzu"]
    return found
