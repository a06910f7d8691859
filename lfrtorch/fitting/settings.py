"""All settings of an identification, checked before anything is computed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from inspect import signature
from typing import Any, Literal, cast

import numpy as np
import torch
from torch.nn import Module

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.settings import check_settings, documented, setting
from lfrtorch.engine.cell import check_dtype
from lfrtorch.engine.held import IN_SERIES, TIED
from lfrtorch.engine.weights import MATRICES
from lfrtorch.fitting.exclusions import USUAL, refuse_together
from lfrtorch.fitting.plain_settings import PlainSettings, Size
from lfrtorch.fitting.trainer import Trainer
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.maps.direct_sum import DirectSum
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.model.known import Known
from lfrtorch.model.model import Model

LAST_SIZE = {"network": "nn", "polynomial": "degree"}
"""Name of the third size of a static nonlinearity, after nz and nw."""

SEED_STEP = 1000
"""Difference between the seeds of successive starts."""


@typed("init_from", "trainer", "static", "known", "nx", "nz", "nw", "nn", "degree", "starts")
@documented
@dataclass(frozen=True, kw_only=True)
class Settings(PlainSettings):
    """Settings of an identification; see :func:`lfrtorch.identify`.

    Raises:
        ValueError: an invalid setting, or two settings that exclude each other.

    Example:
        >>> settings = lfrtorch.Settings(nx=2, nn="auto", starts=3)
        >>> settings.searched, settings.seeds
        (('nn',), (0, 1000, 2000))
    """

    static: Literal["network", "polynomial"] | Callable[..., Module] = setting(
        "network",
        '``"network"``, ``"polynomial"``, or a callable that makes a map of your own, such as a '
        "module's class: called with the keywords nz and nw, it returns a module from (..., nz) to "
        "(..., nw).",
    )
    known: Known | None = setting(
        None,
        "a model of the physics. nz, nw and nn or degree are then the sizes of the map learned "
        "beside it (nn=0: no map), and nx is the number of states learned beside its own. If they "
        "are auto, nn and nx are 0, and z and w have all that it sees and acts on. Default: none.",
    )
    fixed: Mapping[str, Any] = setting(
        dict,
        'given entries of matrices, with u and y in physical units, ``{"Cy": [[1.0, 0.0]]}``; NaN '
        "marks free entries. The start is transformed to state coordinates that have these "
        "entries; sizes that are auto follow from the shapes.",
    )
    linear: Mapping[str, Any] = setting(
        dict, 'options of :func:`lfrtorch.estimate_bla`, for example ``{"offset": False}``.'
    )
    trainer: Trainer = setting(LevenbergMarquardt, "the search. Default: Levenberg-Marquardt.")
    init_from: Model | None = setting(
        None, "model to start from, in place of ``init``; its sizes replace those given here."
    )
    dtype: torch.dtype = setting(torch.float64, "dtype of the fit: float64 or float32.")

    def __new__(cls, *_: Any, **given: Any) -> Settings:
        """Refuse options of the trainer, with the advice to give them to the trainer."""
        options, own = (signature(kind).parameters for kind in (LevenbergMarquardt, cls))
        for name, value in given.items():
            if name in options and name not in own:
                raise InputError(
                    f"{name} is an option of the trainer: give "
                    f"trainer=lfrtorch.LevenbergMarquardt({name}={value!r})."
                )
        return super().__new__(cls)

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
        if not isinstance(self.known, Known | None):
            raise InputError(f"known is {self.known!r}; give an lfrtorch.Known.")
        if self.known is not None:
            self._complete_known(self.known)
        if self.init_from is None and self.nx is None:
            raise InputError(
                "nx, the number of states, is not set: give nx=2, for example, or nx='auto'."
            )
        without = [] if self.init_from is None else [*self.init_from.sizes]
        if self.known is not None:
            self._check_known()
            without += ["nx", "nn"]
        self._take_given_sizes()
        check_settings(self, without=without)
        if self.init_from is None:
            self._check_sizes()
        else:
            if self.ridge == "auto":
                raise InputError(
                    "ridge is auto, but the model of init_from was fitted to the samples that "
                    "would be left out to choose it; give a number."
                )
            for name, size in self.init_from.sizes.items():
                object.__setattr__(self, name, size)
        refuse_together(**self._that_exclude())
        if self.average > 1 and not self.averages:
            raise InputError(
                f"average is {self.average}; a mean of predictors breaks entries that structure or "
                "fixed hold in their systems; give average=1 or noise='output'."
            )
        if self.noise != "output" and not np.any(self.linear.get("integrators", 0)):
            refine = self.linear.get("refine") or "prediction"
            object.__setattr__(self, "linear", {**self.linear, "refine": refine})
        if not self.feedthrough:
            object.__setattr__(self, "linear", {**self.linear, "feedthrough": False})
        self._take_delay()
        known = [*signature(estimate_bla).parameters][2:]
        for name in self.linear:
            if name not in known:
                raise InputError(f"linear has no option '{name}'; there are {', '.join(known)}.")
        check_dtype(self.dtype)
        try:
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(
                f"device is {self.device}, which torch cannot use here ({reason}); "
                "the device cpu always works."
            ) from None

    def _complete_known(self, known: Known) -> None:
        """Set sizes that are auto: nx and nn to 0, nz and nw to all that it sees and acts on."""
        nx = 0 if self.nx in (None, "auto") else cast(int, self.nx)
        states = [name for name in known.acts_on if name != "y"]
        rule = {"nx": nx, "nz": nx + len(known.sees), "nw": nx + max(1, len(states)), "nn": 0}
        for name, size in rule.items():
            if getattr(self, name) in (None, "auto"):
                object.__setattr__(self, name, size)
        if self.ridge == "auto" and not self.learns:
            object.__setattr__(self, "ridge", 0.0)

    def _take_given_sizes(self) -> None:
        """Set sizes that are auto to those of the matrices in ``fixed``."""
        for name, value in self.fixed.items() if isinstance(self.fixed, Mapping) else ():
            for axis, size in zip(MATRICES.get(name, ()), np.shape(value), strict=False):
                if getattr(self, f"n{axis}", None) != "auto":
                    continue
                driven = self.relaxations + 2 * self.modes
                of_linear = (size - driven) // (1 + (self.structure in IN_SERIES))
                object.__setattr__(self, f"n{axis}", of_linear if axis == "x" else size)

    def _take_delay(self) -> None:
        """Refuse delays that are no numbers; several become a tuple."""
        given = np.asarray(self.delay)
        if given.ndim == 0 and given.item() == "auto":
            return
        if (
            given.ndim > 1
            or given.dtype.kind not in "iuf"
            or not ((given >= 0) & (given < np.inf)).all()
        ):
            raise InputError(
                f"delay is {self.delay!r}; give 'auto', or a number of at least 0, or one for each "
                "input: samples."
            )
        object.__setattr__(
            self, "delay", given.item() if given.ndim == 0 else tuple(given.tolist())
        )

    def _check_known(self) -> None:
        """Refuse settings that a known model cannot have."""
        integer("nx", self.nx, 0)
        integer("nn", self.nn, 0)
        driven = self.relaxations + 2 * self.modes
        if driven and self.static == "network" and not self.nn:
            raise InputError(
                f"relaxations is {self.relaxations} and modes is {self.modes}, but no map learned "
                "beside the known model has a w to drive their states; give nn=6, for example."
            )

    def _check_sizes(self) -> None:
        known = isinstance(self.static, str) and self.static in LAST_SIZE
        if not (known or callable(self.static)):
            raise InputError(
                f"static is {self.static!r}; use 'network', 'polynomial', or a module's class."
            )
        for name in {"nn", "degree"} - {*self.size_names}:
            if getattr(self, name) == "auto":
                used = self.size_names[-1]
                raise InputError(
                    f"{name} is auto, but this static map has no {name}; give {used}='auto'."
                )

    def _that_exclude(self) -> dict[str, Any]:
        """Return the settings that may exclude each other, including guarantee and integrators.

        Static map, sizes and structure are left out if the model of ``init_from`` has its own.
        """
        own = (
            {"static", "structure", "nz", "nw", "nn", "degree"}
            if self.init_from is not None
            else set()
        )
        given = {name: getattr(self, name, None) for name in {*USUAL} - own}
        parts = {"guarantee": getattr(self.trainer, "guarantee", None)}
        return given | parts | {"integrators": int(np.max(self.linear.get("integrators", 0)))}

    @property
    def known_states(self) -> int:
        """Number of states of the known model, in the settings or ``init_from``; 0 without one."""
        if self.init_from is not None:
            return self.init_from.known_states
        return 0 if self.known is None else len(self.known.states)

    @property
    def learns(self) -> bool:
        """True if a map or states are learned, be it beside a known model."""
        return self.known is None or bool(self.nn or self.nx or self.static != "network")

    @property
    def averages(self) -> bool:
        """True if a mean of models keeps entries held in their systems; some predictors do not."""
        integrates = bool(np.any(self.linear.get("integrators", 0)))
        holds = self.structure not in ("free", "hammerstein") or not {*TIED}.isdisjoint(self.fixed)
        return self.noise == "output" or not (holds or integrates)

    @property
    def states(self) -> Size | None:
        """Number of states of a start that is made from a linear model."""
        if not isinstance(self.nx, int):
            return self.nx
        return self.nx * (1 + (self.structure in IN_SERIES)) + self.relaxations + 2 * self.modes

    @property
    def size_names(self) -> tuple[str, ...]:
        """Names of the sizes of the static nonlinearity: nz, nw, and nn or degree."""
        if self.init_from is not None:
            return tuple(n for n in self.init_from.sizes if n != "nx")
        return ("nz", "nw", *(size for kind, size in LAST_SIZE.items() if self.static == kind))

    @property
    def searched(self) -> tuple[str, ...]:
        """Names of the settings that cross-validation chooses: sizes of the map, and the ridge."""
        return tuple(name for name in (*self.size_names, "ridge") if getattr(self, name) == "auto")

    @property
    def sizes(self) -> dict[str, Size | None]:
        """nx, and the sizes of the static nonlinearity."""
        return {name: getattr(self, name) for name in ("nx", *self.size_names)}

    @property
    def used(self) -> dict[str, Any]:
        """Sizes, ridge, starts and iterations by name, with the numbers that were chosen."""
        names = ("ridge", "starts", "average", "seed")
        numbers = {name: getattr(self, name) for name in names}
        numbers |= {"delay": self.delay} if self.delay != 0 else {}
        if isinstance(self.ridge, Mapping):
            numbers["ridge"] = dict(self.ridge)
        return {**self.sizes, **numbers, "max_iter": self.trainer.limit}

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the starts; two values of ``seed`` less than 1000 apart share no start."""
        return self.first_seeds(1 if self.starts == "auto" else self.starts)

    def first_seeds(self, count: int) -> tuple[int, ...]:
        """Seeds of the first ``count`` starts."""
        return tuple(self.seed + SEED_STEP * number for number in range(count))

    def static_map(self) -> dict[str, Any]:
        """The static map as a keyword of :func:`lfrtorch.initialise`; empty for a network."""
        if self.static == "network":
            return {}
        assert isinstance(self.nz, int)
        assert isinstance(self.nw, int)
        if self.structure != "parallel":
            return {"static": self._map_of(self.nz, self.nw)}
        branches = [self._map_of(1, 1) for _ in range(self.nz)]
        return {"static": DirectSum(branches, [(1, 1)] * self.nz)}

    def _map_of(self, nz: int, nw: int) -> Module:
        """A static map of these sizes."""
        if callable(self.static):
            return self.static(nz=nz, nw=nw)
        assert isinstance(self.degree, int)
        return Polynomial(nz, nw, self.degree)
