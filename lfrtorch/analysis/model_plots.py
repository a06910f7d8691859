"""Figure of a model: frequency responses, poles, and the nonlinearity of its static map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from lfrtorch._support.arguments import typed
from lfrtorch._support.drawing import (
    LINEAR,
    NL_LFR,
    OUTPUT,
    decibel,
    frequency_axis,
    unit_label,
)
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import percent
from lfrtorch._support.types import Array
from lfrtorch.analysis.canonical_form import nearest_affine
from lfrtorch.analysis.linearisation import linear_part, linearise
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Record, as_records
from lfrtorch.engine.operating_point import double
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.linearised import linearise_map
from lfrtorch.maps.static_map import StaticMap
from lfrtorch.model.data_reach import whitening
from lfrtorch.model.model import Model

_MOST_MAPS = 4
"""Number of outputs of the static map that are drawn."""

_GRID = 121
"""Number of points of a curve, and of each side of a plane."""

_HEIGHT = 2.7
"""Height of a panel, in inches."""

_LEAST_HEIGHT = 3.6
"""Least height of the figure, in inches."""


class _Visited(NamedTuple):
    """The region in which the static map is used, and its nearest affine map there.

    z (S, nz) are its inputs, and w = slope z + offset is the affine map. ``nonlinear`` is the part
    of the rms of each w (about its mean) that this leaves; ``known`` says whether z come from data.
    """

    z: Float[Array, "S nz"]
    slope: Float[Array, "nw nz"]
    offset: Float[Array, " nw"]
    nonlinear: Float[Array, " nw"]
    known: bool


@typed()
def plot(model: Model, records: Record | Sequence[Record] | None = None) -> Figure:
    """Figure of a model: frequency responses, poles, and the nonlinearity of its static map.

    Responses and poles are those of the linear part, and of the model linearised at rest at the
    inputs' offsets. The static map is drawn minus the affine map nearest to it over the data, as
    that belongs to the linear part: over z1, over the plane of z1 and z2, or, for more z, along the
    direction in which it is least linear.

    Args:
        model: nonlinear.
        records: data that define z. Default: white noise with the rms of the training inputs.

    Raises:
        ValueError: records of other channels than the model's, or a model that diverges on them.

    Example:
        >>> figure = lfrtorch.analysis.plot(model, record)
        >>> figure.savefig("model.png")
    """
    systems = {"linear part": linear_part(model)}
    with suppress(InputError):  # it may have no rest at the offsets
        systems["at rest"] = linearise(model)
    static = _drawn(model)
    pairs = [(i, j) for i in range(len(model.outputs)) for j in range(len(model.inputs))][:4]
    maps = min(static.nw, _MOST_MAPS)
    height = max(_LEAST_HEIGHT, _HEIGHT * max(len(pairs), -(-maps // 2)))
    widths = [4.5, 3.5, *([4.0 if maps == 1 else 6.5] if maps else [])]
    figure = Figure(figsize=(sum(widths), height), layout="constrained")
    parts: NDArray[np.object_] = figure.subfigures(
        1, len(widths), squeeze=False, width_ratios=widths
    )[0]
    _responses(parts[0], systems, pairs)
    _poles(parts[1], systems)
    if maps:
        _maps(parts[2], static, visited(model, static, records), maps)
    return figure


def static_figure(model: Model, records: Record | Sequence[Record] | None = None) -> Figure:
    """The last part of the figure of ``plot``: the nonlinearity of the static map."""
    static = _drawn(model)
    if not static.nw:
        raise InputError("the model is linear and has no static map to draw.")
    maps = min(static.nw, _MOST_MAPS)
    size = (5.0 if maps == 1 else 7.5), max(_LEAST_HEIGHT, _HEIGHT * -(-maps // 2))
    figure = Figure(figsize=size, layout="constrained")
    _maps(figure, static, visited(model, static, records), maps)
    return figure


def _drawn(model: Model) -> StaticMap:
    """The learned map, beside a known model or alone; or else the known model."""
    static = double(model.lfr.cell).map
    return static.learned if static.learned.nw else static


def visited(model: Model, static: StaticMap, records: Record | Sequence[Record] | None) -> _Visited:
    """Inputs of the static map along simulations, and its nearest affine map there."""
    if records is None:
        noise = np.random.default_rng(0).standard_normal((4000, len(model.inputs)))
        signals = [model.scaler.u_offset + model.scaler.u_scale * noise]
    else:
        signals = as_records(records)
    z = np.concatenate([model.signals(one).z[0].double().numpy() for one in signals])
    z = z[:: 1 + len(z) // 20_000, z.shape[1] - static.nz :]  # z of the learned map come last
    if not np.isfinite(z).all():
        raise InputError(
            "the model diverges on the records; give others." if records is not None else
            "the model diverges under white noise of the training inputs' rms; give records."
        )  # fmt: skip
    w = _w(static, z)
    slope, offset = nearest_affine(z, w)
    deviation = np.std(w, axis=0)
    left = rms(w - z @ slope.T - offset, axis=0) / np.where(deviation > 0, deviation, 1.0)
    return _Visited(z, slope, offset, left, records is not None)


@torch.no_grad()
def _w(static: StaticMap, z: Float[Array, "S nz"]) -> Float[Array, "S nw"]:
    return static(torch.as_tensor(z)).numpy()


def _responses(
    part: SubFigure, systems: Mapping[str, LinearModel], pairs: Sequence[tuple[int, int]]
) -> None:
    """Magnitudes of the channels of each system."""
    first = next(iter(systems.values()))
    resonances = np.concatenate([np.abs(np.angle(s.poles)) for s in systems.values()])
    lowest, last = 5e-4 * first.fs, first.fs / 2
    f = np.union1d(np.geomspace(lowest, last, 500), resonances * first.fs / (2 * np.pi))
    f = f[f >= lowest]
    axes = part.subplots(len(pairs), 1, squeeze=False, sharex=True)
    for ax, (i, j) in zip(axes[:, 0], pairs, strict=True):
        for name, system in systems.items():
            colour = LINEAR if name == "linear part" else NL_LFR
            level = decibel(system.frf(f)[:, i, j])
            ax.plot(f, level, color=colour, lw=1.2, label=name)
        output, source = first.outputs[i], first.inputs[j]
        ax.set_title(f"{output.name} / {source.name}", fontsize="medium")
        ax.set_ylabel(unit_label("magnitude", output.unit, source.unit))
    frequency_axis(axes, f[0], f[-1])
    axes[0, 0].legend(fontsize="small")


def _poles(part: SubFigure, systems: Mapping[str, LinearModel]) -> None:
    """Poles in the z plane, with the unit circle."""
    ax: Axes = part.subplots()
    angle = np.linspace(0, 2 * np.pi, 361)
    ax.plot(np.cos(angle), np.sin(angle), lw=0.8, color="0.6")
    ax.axhline(0, lw=0.5, color="0.8", zorder=0)
    ax.axvline(0, lw=0.5, color="0.8", zorder=0)
    for name, system in systems.items():
        colour, marker = (LINEAR, "+") if name == "linear part" else (NL_LFR, "x")
        ax.plot(system.poles.real, system.poles.imag, marker, ms=7, color=colour)
    ax.set(aspect="equal", xlabel="real part", ylabel="imaginary part")
    ax.set_title("poles in the z plane", fontsize="medium")


def _maps(part: Figure | SubFigure, static: StaticMap, where: _Visited, count: int) -> None:
    """Nonlinear part of the static map, a panel for each w."""
    z, nz = where.z, where.z.shape[1]
    low, high = z.min(axis=0), z.max(axis=0)
    columns = 1 if count == 1 else 2
    axes = np.ravel(part.subplots(-(-count // columns), columns, squeeze=False))
    for ax in axes[count:]:
        ax.set_axis_off()

    def beyond(points: Float[Array, "S nz"]) -> Float[Array, "S nw"]:
        return _w(static, points) - points @ where.slope.T - where.offset

    sides = [np.linspace(a, b, _GRID) for a, b in zip(low, high, strict=True)]
    for j, ax in enumerate(axes[:count]):
        title = f"w{j + 1}: {percent(where.nonlinear[j])} nonlinear"
        if nz == 1:
            ax.plot(sides[0], beyond(sides[0][:, None])[:, j], color=NL_LFR, lw=1.2)
            ax.axhline(0, lw=0.5, color="0.8", zorder=0)
            ax.set_xlabel("z1 (grey: density)")
            density = ax.twinx()
            density.hist(z[:, 0], bins=60, color="0.85", density=True)
            density.set(yticks=[], ylim=(0, 4 * density.get_ylim()[1]))
            ax.set_zorder(density.get_zorder() + 1)
            ax.patch.set_visible(False)
        elif nz == 2:
            plane = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)
            values = beyond(plane.reshape(-1, 2))[:, j].reshape(_GRID, _GRID)
            reach = float(np.abs(values).max()) or 1.0
            image = ax.pcolormesh(
                *sides, values.T, cmap="coolwarm", vmin=-reach, vmax=reach, rasterized=True
            )
            part.colorbar(image, ax=ax)
            ax.plot(z[:, 0], z[:, 1], ",", color=OUTPUT, alpha=0.3)
            ax.set(xlabel="z1", ylabel="z2", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        else:
            at, share = most_nonlinear(static, where, j)
            ax.plot(at, beyond(z)[:, j], ".", ms=1.0, color=NL_LFR, rasterized=True)
            ax.axhline(0, lw=0.5, color="0.8", zorder=0)
            ax.set_xlabel(f"direction of z with {percent(share)} of it")
        ax.set_title(title, fontsize="medium")
    where_from = "over the data" if where.known else "under white noise"
    part.suptitle(f"static map less its linear part, {where_from}", fontsize="medium")


def most_nonlinear(static: StaticMap, where: _Visited, j: int) -> tuple[Float[Array, " S"], float]:
    """Return z along the direction in which output j changes its slope most, and its share.

    The direction is the leading eigenvector of the mean of g gᵀ, where g is the slope minus its
    mean and z has unit covariance (Constantine, "Active Subspaces", SIAM, 2015).
    """
    T = whitening(where.z)
    z, phi = torch.as_tensor(where.z)[None], static.flat_weights().detach()
    J = linearise_map(static, z, phi, static.code).J[0, :, j].numpy()
    g = (J - J.mean(axis=0)) @ np.linalg.inv(T)
    shares, directions = np.linalg.eigh(g.T @ g / len(g))
    total = float(shares.sum())
    at = (where.z - where.z.mean(axis=0)) @ T.T @ directions[:, -1]
    return at, float(shares[-1]) / total if total > 0 else 1.0
