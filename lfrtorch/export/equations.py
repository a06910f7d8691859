"""Equations of a model in physical units, as all exports write them."""

from __future__ import annotations

import keyword
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import Module

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel
from lfrtorch.engine.cell import Matrices
from lfrtorch.engine.operating_point import double, equilibrium
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.formula_code import statements
from lfrtorch.maps.operations import Formula
from lfrtorch.maps.static_map import StaticMap
from lfrtorch.maps.written import Vectors, Written
from lfrtorch.model.data_reach import DataReach
from lfrtorch.model.extended_kalman_filter import NoiseCovariance, data_root
from lfrtorch.model.model import NO_OBSERVER, Model


class Signals(Vectors, Protocol):
    """An export language for expressions of vectors that knows all arrays of a model."""

    def deviation(self, u: Any) -> Any:
        """u - u_offset."""
        ...

    def total(self, to: str, terms: Mapping[str, Any], offset: str = "") -> Any:
        """Sum of matrices times signals and perhaps an offset, called ``to``."""
        ...


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations with u and y as measured and x in the coordinates of the model::

        v  = u - u_offset
        x+ = A  x + Bu  v + Bw  w
        z  = Cz x + Dzu v
        w  = f(z)
        y  = Cy x + Dyu v + Dyw w + y_offset

    Args:
        name: name of the model in an export.
        matrices: A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw; a linear model has nz = nw = 0.
        u_offset, y_offset: operating point.
        x_rest: state at rest under u_offset, (nx,), near x = 0; empty if none was found.
        map: f; nz = nw = 0 for a linear model.
        written: f in the form that exports write.
        weights: the arrays of ``written``.
        fs: sampling frequency in Hz.
        inputs, outputs: channel names and units.
        reach: range of the data of the fit; None if it is not known.
    """

    name: str
    matrices: Matrices
    u_offset: Array
    y_offset: Array
    x_rest: Array
    map: StaticMap
    written: Written
    weights: Mapping[str, Array]
    fs: float
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    reach: DataReach | None = None

    @property
    def arrays(self) -> dict[str, Array]:
        """Numbers of the model by name, in the order of the equations."""
        offsets = {"u_offset": self.u_offset, "y_offset": self.y_offset, "x_rest": self.x_rest}
        return offsets | self.matrices._asdict() | dict(self.weights)

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes nx, nu, ny, nz and nw."""
        (nz, nx), (ny, nw) = self.matrices.Cz.shape, self.matrices.Dyw.shape
        return {"nx": nx, "nu": len(self.u_offset), "ny": ny, "nz": nz, "nw": nw}

    @property
    def feedthrough(self) -> bool:
        """True if an output depends on an input at the same sample."""
        M = self.matrices
        return bool(M.Dyu.any()) or bool(M.Dyw.any() and M.Dzu.any())

    def about(self, place: str = "{0}[{1}]") -> list[str]:
        """Description for readers of the export: equations, channels, units, offsets, rate."""
        # ``place`` is a channel as the language writes it: {0} is its letter, {1} its number from 0
        # and {2} its number from 1.
        known = {"place": place, "version": version("lfrtorch"), "printable": printable}
        return self.rendered("about.txt", **known).splitlines()

    def description(self) -> dict[str, Any]:
        """Name, rate, state at rest and channels, for JSON."""
        sides = ("inputs", self.inputs, self.u_offset), ("outputs", self.outputs, self.y_offset)
        ends = {} if self.reach is None else {"inputs": self.reach.u, "outputs": self.reach.y}
        found: dict[str, Any] = {
            side: [c._asdict() | {"offset": o} for c, o in zip(channels, offset, strict=True)]
            for side, channels, offset in sides
        }
        for side, ranges in ends.items():
            for channel, (least, most) in zip(found[side], ranges.tolist(), strict=True):
                channel |= {"least": least, "most": most}
        known = {"name": self.name, "fs": self.fs, "states": self.sizes["nx"]}
        return known | {"x_rest": self.x_rest.tolist(), **found}

    @property
    def distance(self) -> tuple[Array, Array] | None:
        """T and t of |T z - t|², the square of the surprise index: at most 1 for 99 % of the data.

        It is None if the reach is not known, or the model is linear.
        """
        if self.reach is None or not self.map.nw:
            return None
        T = self.reach.z.axes / self.reach.z.farthest
        return T, T @ self.reach.z.middle

    def sample(self, language: Signals, x: Any, u: Any) -> tuple[Any, Any]:
        """x+ and y for x and u, in a language of expressions."""
        v = language.deviation(u)
        x_next, y = {"A": x, "Bu": v}, {"Cy": x, "Dyu": v}
        if self.map.nw:
            w = self.written.of(language, language.total("z", {"Cz": x, "Dzu": v}))
            x_next["Bw"], y["Dyw"] = w, w
        return language.total("x_next", x_next), language.total("y", y, "y_offset")

    def rendered(
        self, template: str, operations: Mapping[str, str] | None = None, **more: Any
    ) -> str:
        """Render a template of the folder ``templates`` with these equations and ``more``.

        If ``operations`` of the text's language are given, formulas become statements in it.
        """
        import jinja2

        def written(formula: Formula, place: str) -> tuple[list[tuple[str, str]], list[str]]:
            inputs = [place.format(i) for i in range(formula.inputs)]
            return statements(formula, inputs, operations or {})

        environment = jinja2.Environment(
            loader=jinja2.PackageLoader("lfrtorch.export"),
            trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
        )  # fmt: skip
        known = {"NAME": self.name.upper(), "rest": self.x_rest.size, **self.sizes, **vars(self)}
        known |= {n: getattr(self, n) for n in ("arrays", "distance", "feedthrough")}
        return environment.get_template(template).render(known | {"statements": written} | more)


def printable(text: str) -> str:
    """Put a text on one line: names of channels come from files."""
    return "".join(sign if sign.isprintable() else " " for sign in text)


def equations(
    model: Model | LinearModel,
    name: str = "model",
    own: Callable[[Module, int], Written | None] = lambda *_: None,
) -> Equations:
    """The equations of a model; ``own`` writes a static map of nz inputs without own equations."""
    check_name(name)
    model = model.to_model().with_delay_line()
    cell, s = double(model.lfr.cell), model.scaler
    written = cell.map.written
    if written is None and cell.static is not None:
        written = own(cell.static, cell.nz)
    if written is None:
        raise InputError(
            f"the static map is a {type(cell.static).__name__}, a class of your own, whose "
            "equations are not known.\nA Network, a Polynomial, a known model or a StaticMap with "
            "equations can be exported, and your class to onnx and torch alone."
        )
    M, y_scale = cell.matrices(), s.y_scale[:, None]
    found = Equations(
        name=name,
        matrices=M._replace(
            Bu=M.Bu / s.u_scale, Dzu=M.Dzu / s.u_scale,
            Cy=M.Cy * y_scale, Dyu=M.Dyu * y_scale / s.u_scale, Dyw=M.Dyw * y_scale,
        ),
        u_offset=np.asarray(s.u_offset, dtype=np.float64),
        y_offset=np.asarray(s.y_offset, dtype=np.float64),
        x_rest=np.empty(0),
        map=cell.map,
        written=written,
        weights={name: array.detach().numpy() for name, array in written.arrays.items()},
        fs=model.fs,
        inputs=model.inputs,
        outputs=model.outputs,
        reach=model.reach,
    )  # fmt: skip
    parts = [*found.matrices, found.u_offset, found.y_offset, numbers(cell.map.flat_weights())]
    if written.formula is not None:
        parts.append(np.array([row.number for row in written.formula.rows]))
    if not all(np.isfinite(part).all() for part in parts):
        raise InputError("the model has weights that are not finite; nothing can be exported.")
    rest = equilibrium(cell, torch.zeros(cell.nu, dtype=torch.float64))
    return found if rest is None else replace(found, x_rest=numbers(rest))


def numbers(weight: Tensor) -> Array:
    """Convert a weight to an array of float64."""
    return weight.detach().cpu().double().numpy()


class Observer(NamedTuple):
    """The numbers of an observer by name: with roots of covariances, or with the covariances.

    Both have K (nx, ny) of x+ = f(x, u) + K (y - y_hat). A filter has G with G Gᵀ = [R Sᵀ; S Q]
    and U0 with U0 U0ᵀ = P0 of the states in the data; or Q, S, R and P0. No observer, no numbers.
    """

    roots: dict[str, Array]
    covariances: dict[str, Array]


def observer_equations(model: Model | LinearModel, observer: bool | NoiseCovariance) -> Observer:
    """Gain or noise of an observer."""
    if observer is False:
        return Observer({}, {})
    nx, model = model.to_model().lfr.cell.nx, model.to_model().with_delay_line()
    if isinstance(observer, NoiseCovariance):
        line = np.zeros(model.lfr.cell.nx - nx)
        observer = observer.extended(line, nx) if len(line) else observer
        cell, ny = model.lfr.cell, model.lfr.cell.ny
        G, U = observer.root(cell.nx, ny), data_root(cell)
        joint = G @ G.T
        parts = {"Q": joint[ny:, ny:], "S": joint[ny:, :ny], "R": joint[:ny, :ny], "P0": U @ U.T}
        return Observer({"G": G, "U0": U}, parts)
    if model.K is None:
        raise InputError(NO_OBSERVER)
    gain = {"K": np.ascontiguousarray(numbers(model.K) / model.scaler.y_scale)}
    return Observer(gain, gain)


_RESERVED = {
    "case", "catch", "classdef", "else", "elseif", "end", "function", "otherwise", "parfor",
    "persistent", "spmd", "switch", "hess", "jac", "null",
}  # fmt: skip
"""Keywords of MATLAB and CasADi, in addition to those of Python."""


def check_name(name: str) -> None:
    """Refuse a name that is not an identifier in each of the languages."""
    word = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) and "__" not in name
    if not word or keyword.iskeyword(name) or name in _RESERVED:
        raise InputError(
            f"name is {name!r}; give letters, digits and single underscores, a letter first, and "
            "no keyword of a language, as name=engine."
        )
