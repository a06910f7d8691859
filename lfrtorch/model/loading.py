"""Load a model with any static map of the package, or with the user's own."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from torch.nn import Module

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch.maps.descriptions import foreign, made
from lfrtorch.model.checkpoint import MapMaker, read_model
from lfrtorch.model.model import Model


@typed()
def load(folder: str | Path, *, static: Module | None = None) -> Model:
    """The model in a checkpoint folder, or in the ``model/`` folder of a run's folder.

    A linear model is one without a static map; ``LinearModel.load`` has its covariance as well.

    Args:
        folder: where it was saved.
        static: the module of the static nonlinearity, if it is of the user's own class: a
            checkpoint holds weights, never code.

    Raises:
        ValueError: no checkpoint, a damaged one, one of another program or a newer version, or a
            file that may carry code (it is not opened).

    Example:
        >>> folder = model.save("model")
        >>> lfrtorch.load(folder).sizes
        {'nx': 1, 'nz': 1, 'nw': 1, 'nn': 4}
    """
    return read_model(folder, partial(_maker, folder, static), ("model", "linear"))[0]


def _maker(folder: str | Path, static: Module | None, own: Any) -> MapMaker:
    """Maker of the map of a description, or the user's map."""
    if not static and (name := foreign(own)):
        raise InputError(
            f"'{folder}' holds a static nonlinearity of class {name}, which is not part of this "
            "package; pass an instance of it: load(folder, static=...)."
        )
    if isinstance(own, dict) and own.get("layers", 1) != 1:
        raise InputError(
            f"'{folder}' holds a network of {own['layers']} hidden layers, and this version has "
            "networks of one.\nVersions of 0.1.0 from before 2026-11-25 (commit 84a9d8a) read it; "
            "or fit again with a torch module of your own: static=own."
        )
    return partial(made, own=static)
