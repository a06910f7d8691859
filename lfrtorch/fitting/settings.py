"""All choices of an identification, checked before anything is computed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import signature
from typing import Any, Literal

import torch
from torch.nn import Module

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer, number
from lfrtorch._support.errors import InputError
from lfrtorch.engine.cell import check_dtype
from lfrtorch.engine.nonlinearity import Polynomial
from lfrtorch.fitting.exclusions import USUAL, refuse_together
from lfrtorch.fitting.prediction import Noise
from lfrtorch.fitting.trainer import Trainer
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.simulation_errors import Ridge
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.model import Model

Size = int | Literal["auto"]
"""A number, or one that the data choose."""

LAST_SIZE = {"network": "nn", "polynomial": "degree"}
"""The third size of a static nonlinearity, after nz and nw."""

SEED_STEP = 1000
"""Distance of the seeds of several starts."""


@dataclass(frozen=True, kw_only=True)
class SizesSearch:
    """What is tried for the sizes that are ``"auto"``, see :func:`lfrtorch.search_sizes`.

    Args:
        nx: the numbers of states to try above the linear model's order, up to ``nx_max``, if nx and
            another size are ``"auto"``.
        nz, nw, nn, degree: the numbers to try.
        starts: random starts of each size, at most.
        finalists: models that get all iterations of the search; 8 times as many begin it.
        iterations: part of the iterations of the fit that they get.
        folds: if not 0, the finalists are compared by cross-validation over so many stretches of
            the training and validation records: for short records.

    Example:
        >>> lfrtorch.SizesSearch(nn=(5, 10), starts=2).nn
        (5, 10)
    """

    nx: Sequence[int] = (2, 3, 4, 6, 8, 10, 12)
    nz: Sequence[int] = (1, 2, 3)
    nw: Sequence[int] = (1, 2, 3)
    nn: Sequence[int] = (5, 10, 15, 25)
    degree: Sequence[int] = (2, 3, 5)
    starts: int = 4
    finalists: int = 6
    iterations: float = 0.375
    folds: int = 0

    def __post_init__(self) -> None:
        integer("sizes_search.starts", self.starts, 1)
        integer("sizes_search.finalists", self.finalists, 1)
        integer("sizes_search.folds", self.folds, 0)
        number("sizes_search.iterations", self.iterations, positive=True)


@typed("init_from", "trainer", "static", "nx", "nz", "nw", "nn", "degree")
@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a model is identified; see :func:`lfrtorch.identify`.

    Args:
        nx: states. ``"auto"``: the lowest order up to ``nx_max`` whose linear model does as well as
            the best, and more if an NL-LFR makes use of them and another size is ``"auto"``, too.
            Required, unless ``init_from`` brings it.
        nx_max: highest order that ``nx="auto"`` tries.
        nz, nw: inputs and outputs of the static nonlinearity; ``"auto"`` searches for them.
        nn, activation: neurons of ``static="network"``, or ``"auto"``, and their function.
        degree: of ``static="polynomial"``, or ``"auto"``.
        static: ``"network"``, ``"polynomial"``, or what makes a map of one's own: called with the
            keywords nz and nw it returns a module from (..., nz) to (..., nw), for example the
            module's class.
        init: where the fit starts, see :func:`lfrtorch.initialise`.
        relaxations, modes: that w alone drives, one and two states each beside the ``nx`` of the
            linear model, see :func:`lfrtorch.initialise`.
        z_feedthrough: whether the input acts on z at once; False for a nonlinearity of the states
            alone, see :func:`lfrtorch.initialise`.
        feedthrough: whether it acts on the output at once; False for data under feedback without a
            delay. The linear model has none then, either.
        structure: of which blocks the model is made, see :func:`lfrtorch.initialise`.
        linear: options of :func:`lfrtorch.estimate_bla`, for example ``{"offset": False}``.
        trainer: the search. Default: Levenberg-Marquardt.
        ridge, average: see :func:`lfrtorch.fit`.
        noise: where it acts, ``"output"`` or ``"innovation"``, see :func:`lfrtorch.fit`. In the
            latter case the linear model has ``refine="prediction"``, too, and validation errors
            are those of predictions one sample ahead.
        horizon: samples of the windows that training and validation records are cut into in a
            fit, see :func:`lfrtorch.fit`. Default: records are simulated whole.
        distil: whether one model takes the place of a mean of several if it does as well, see
            :func:`lfrtorch.distil`.
        refit: whether the model that validation chose is fitted to all estimation records at last,
            see :func:`lfrtorch.refit`.
        first_part: part of the training samples that the first iterations fit, which cost as much
            less and choose one of the starts: the shortest records, those of a length spread
            evenly; the beginning of each if the part is less than a record. The search for sizes
            fits them, too. 1 is for all.
        first_iterations: how many.
        starts: random starts, of which the best is kept; at least 2 if sizes are searched.
        seed: of the first start; the others have seed + 1000, seed + 2000, ... If sizes are
            searched, the first start of the fit is the one that brought the sizes chosen.
        init_from: a model to go on from, in place of ``init``; its sizes replace those given here.
        sizes_search: what is tried for the sizes that are ``"auto"``.
        device, dtype: of the fit.

    Raises:
        ValueError: a setting that cannot be.

    Example:
        >>> settings = lfrtorch.Settings(nx=2, nn="auto", starts=3)
        >>> settings.searched, settings.seeds
        (('nn',), (0, 1000, 2000))
    """

    nx: Size | None = None
    nx_max: int = 12
    nz: Size = 2
    nw: Size = 1
    nn: Size = 15
    activation: str = "tanh"
    degree: Size = 3
    static: Literal["network", "polynomial"] | Callable[..., Module] = "network"
    init: Literal["zero_output", "paper"] = "zero_output"
    relaxations: int = 0
    modes: int = 0
    z_feedthrough: bool = True
    feedthrough: bool = True
    structure: str = "free"
    linear: Mapping[str, Any] = field(default_factory=dict)
    trainer: Trainer = field(default_factory=LevenbergMarquardt)
    ridge: Ridge = 0.0
    noise: Noise = "output"
    horizon: int | None = None
    average: int = 1
    distil: bool = False
    refit: bool = False
    first_part: float = 1.0
    first_iterations: int = 40
    starts: int = 1
    seed: int = 0
    init_from: Model | None = None
    sizes_search: SizesSearch = field(default_factory=SizesSearch)
    device: str = "cpu"
    dtype: torch.dtype = torch.float64

    def __post_init__(self) -> None:
        if not isinstance(self.init_from, Model | None):
            raise InputError(
                f"init_from is {self.init_from!r}; give a model: lfrtorch.load({self.init_from!r})."
            )
        if not callable(getattr(self.trainer, "step", None)) or isinstance(self.trainer, type):
            raise InputError(
                f"trainer is {self.trainer!r}; give lfrtorch.LevenbergMarquardt() or "
                "lfrtorch.Adam()."
            )
        if self.init_from is None:
            self._check_sizes()
        if self.init_from is not None:
            for name, size in self.init_from.sizes.items():
                object.__setattr__(self, name, size)
        for name in ("nx_max", "starts", "average"):
            integer(name, getattr(self, name), 1)
        if self.horizon is not None:
            integer("horizon", self.horizon, 2)
        refuse_together(**self._that_exclude())
        if self.noise != "output":
            refine = self.linear.get("refine") or "prediction"
            object.__setattr__(self, "linear", {**self.linear, "refine": refine})
        integer("seed", self.seed, 0)
        if not self.feedthrough:
            object.__setattr__(self, "linear", {**self.linear, "feedthrough": False})
        known = [*signature(estimate_bla).parameters][2:]
        for name in self.linear:
            if name not in known:
                raise InputError(f"linear has no option '{name}'; there are {', '.join(known)}.")
        number("first_part", self.first_part, positive=True)
        if self.first_part > 1:
            raise InputError(f"first_part is {self.first_part}; give a part: above 0, 1 at most.")
        integer("first_iterations", self.first_iterations, 1)
        for name in ("relaxations", "modes"):
            integer(name, getattr(self, name), 0)
        check_dtype(self.dtype)
        try:
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(
                f"device is {self.device}, which torch cannot use here ({reason}); "
                "the device cpu always works."
            ) from None

    def _check_sizes(self) -> None:
        if self.nx is None:
            raise InputError(
                "nx, the number of states, is not set: give nx=2, for example, or nx='auto'."
            )
        for name in ("nx", "nz", "nw", "nn", "degree"):
            integer(name, getattr(self, name), 1, word="auto")
        known = isinstance(self.static, str) and self.static in LAST_SIZE
        if not (known or callable(self.static)):
            raise InputError(
                f"static is {self.static!r}; use 'network', 'polynomial', or a module's class."
            )
        for name in {"nn", "degree"} - {*self.size_names}:
            if getattr(self, name) == "auto":
                used = self.size_names[-1]
                raise InputError(
                    f"{name} is auto, and this static map has none; give {used}='auto'."
                )
        if callable(self.static) and "auto" in (self.nz, self.nw):
            raise InputError(
                "nz or nw is auto, and a map of one's own is not searched; give numbers."
            )

    def _that_exclude(self) -> dict[str, Any]:
        """Return the settings that may exclude each other, those of parts by their own names.

        A model of ``init_from`` has a static map, sizes and a structure of its own.
        """
        own = (
            {"static", "structure", "nz", "nw", "nn", "degree"}
            if self.init_from is not None
            else set()
        )
        given = {name: getattr(self, name, None) for name in {*USUAL} - own}
        parts = {"guarantee": getattr(self.trainer, "guarantee", None)}
        return given | parts | {"integrators": self.linear.get("integrators", 0)}

    @property
    def size_names(self) -> tuple[str, ...]:
        """Sizes of the static nonlinearity: nz, nw, and nn or degree."""
        if self.init_from is not None:
            return tuple(n for n in self.init_from.sizes if n != "nx")
        return ("nz", "nw", *(size for kind, size in LAST_SIZE.items() if self.static == kind))

    @property
    def searched(self) -> tuple[str, ...]:
        """Names of the sizes that are ``"auto"``."""
        return tuple(name for name in self.size_names if getattr(self, name) == "auto")

    @property
    def sizes(self) -> dict[str, Size | None]:
        """nx, and the sizes of the static nonlinearity."""
        return {name: getattr(self, name) for name in ("nx", *self.size_names)}

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the starts; neighbouring values of ``seed`` have none in common."""
        return self.first_seeds(self.starts)

    def first_seeds(self, count: int) -> tuple[int, ...]:
        """Seeds of so many starts."""
        return tuple(self.seed + SEED_STEP * number for number in range(count))

    def static_map(self) -> dict[str, Any]:
        """The arguments of :func:`lfrtorch.initialise` that say which static map there is."""
        if self.static == "network":
            return {"nn": self.nn, "activation": self.activation}
        if self.static == "polynomial":
            assert isinstance(self.nz, int)
            assert isinstance(self.nw, int)
            assert isinstance(self.degree, int)
            return {"static": Polynomial(self.nz, self.nw, self.degree)}
        assert callable(self.static)
        return {"static": self.static(nz=self.nz, nw=self.nw)}
