"""Contraction of a model: a proof that all trajectories under the same input converge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import factor_of, number
from lfrtorch._support.types import Array
from lfrtorch.analysis.linearisation import levels_of
from lfrtorch.data.records import Channel, Record
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.linearised import linearise, spectral_radius
from lfrtorch.engine.operating_point import double
from lfrtorch.guarantees.bounds import amplitudes, reach
from lfrtorch.guarantees.certificate import (
    SLOWEST,
    Certificate,
    Differences,
    certificate,
    common_norm,
    gain,
)
from lfrtorch.maps.activations import FAR
from lfrtorch.maps.enclosure import ROUNDING, Enclosure, Interval, everywhere
from lfrtorch.model.data_reach import Cloud, DataReach
from lfrtorch.model.model import Model

_FARTHEST = 2.0**20
"""The largest amplitude is searched between 1/_FARTHEST and _FARTHEST times the data's rms."""

# Solver calls for the rate in the region of the data: bisections, and additions of cells.
_HALVINGS, _MORE_CELLS = 6, 20

_FIRST_CELLS, _LAST_CELLS = 2**12, 2**16  # cells of that region in the first grid, and in all

_SLACK = 0.02
"""Part of 1 - ρ that a proof in that region may lose by the size of its cells."""

_LEAST = 1e-3
"""1 - ρ is searched between this part of the largest possible 1 - ρ and all of it."""


@dataclass(frozen=True, eq=False)
class Contraction:
    """Result of the search for a proof; ``print(contraction)`` shows it in words.

    Args:
        amplitude: largest |u - offset| of the inputs that the proof holds for, (nu,), physical
            units: infinite if it holds for all inputs; 0 if no proof was found.
        rate: ρ. The norm of the difference shrinks to at most ρ times its size in every sample;
            NaN if no proof was found.
        gain: γ, the largest ratio of the outputs' difference to the inputs' difference, as root
            sums of squares of all channels together, in physical units; NaN if none was found.
        P: matrix of the norm √(ΔxᵀPΔx), (nx, nx), in the model's coordinates; ``None`` if none was
            found.
        data_rate: ρ as long as z stays in the region of the data, in another norm; NaN if it was
            not searched or not found.
        reason: why no proof was found, or how a smaller rate may be found.
        inputs, outputs: channel names and units.

    Example:
        >>> contraction = lfrtorch.analysis.contraction(model)
        >>> contraction.found, contraction.rate < 1
        (True, True)
    """

    amplitude: Array
    rate: float
    gain: float
    P: Float[Array, "nx nx"] | None
    reason: str
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    data_rate: float = math.nan

    @property
    def found(self) -> bool:
        """True if the model was proven to contract."""
        return self.P is not None

    def __str__(self) -> str:
        if not self.found:
            lines = [f"no proof that the model contracts was found: {self.reason}"]
            return "\n".join([*lines, *self._near_data()])
        for_which = "all inputs"
        if np.isnan(self.amplitude).any():
            for_which = "z in the region of the data"
        elif np.isfinite(self.amplitude).all():
            for_which = f"inputs within {levels_of(self.inputs, self.amplitude)} of their offsets"
        samples = number(-1.0 / math.log(self.rate)) if self.rate > 0 else "0"
        lines = [
            f"The model contracts, for {for_which}: differences of states under the same input",
            f"shrink to {self.rate:.6g} of their size or less in every sample, to 1/e in {samples} "
            "samples.",
        ]
        if math.isfinite(self.gain):
            lines.append(f"Incremental gain: {number(self.gain)}{self._gain_unit()}")
        return "\n".join([*lines, *filter(None, [self.reason]), *self._near_data()])

    def _near_data(self) -> list[str]:
        """A line on the rate in the region of the data, if it differs from ``rate``."""
        if math.isnan(self.data_rate) or self.data_rate == self.rate:
            return []
        return [f"As long as z is in the region of the data, they shrink to {self.data_rate:.6g}."]

    def _gain_unit(self) -> str:
        """The unit of the gain, and the channels whose root sums of squares it compares."""
        y, u = (
            list(dict.fromkeys(channel.unit for channel in channels))
            for channels in (self.outputs, self.inputs)
        )
        if len(y) > 1 or len(u) > 1:
            of, over = (", ".join(unit or "1" for unit in units) for units in (y, u))
            return f", of all outputs together ({of}) over all inputs ({over})"
        unit = f"{factor_of(y[0]) or '1'}/{factor_of(u[0])}" if u[0] else y[0]
        several = len(self.outputs) > 1 or len(self.inputs) > 1
        return f" {unit}".rstrip() + ", of all channels together" * several


@typed()
def contraction(
    model: Model,
    records: Record | Sequence[Record] | None = None,
    *,
    amplitude: ArrayLike | None = None,
) -> Contraction:
    """Search for a proof that a model contracts, with its rate and gain.

    Under the same input, the difference of any two states shrinks to at most ``rate`` times its
    size in each sample, in a norm that is the same everywhere. So the model forgets its start, and
    responds to a periodic input with the same period. A change of the input changes the output by
    at most ``gain`` times as much.

    For inputs up to an amplitude, only slopes of the static map within the bounds of z that
    ``bound`` proves are considered, and only states that such inputs reach from x = 0. Rate and
    gain may then be far smaller than for all inputs.

    For records, the slopes are those in the smallest box that contains z of their simulations; its
    sides are along the principal axes of z. The proof then holds for trajectories whose z stays in
    the box. This rate, ``data_rate``, is also searched without records if the model knows the range
    of its data (``model.reach``).

    Args:
        model: a linear model, or a model with any network. With an amplitude, A must be stable,
            and the network must have tanh, sigmoid or rbf neurons.
        records: records whose region of z the proof shall hold for. Default: none.
        amplitude: largest |u - offset| of the inputs, physical units. Default: all inputs, or the
            largest amplitude with a proof if there is none for all inputs.

    Shape:
        amplitude: (nu,) or a number for all inputs.

    Raises:
        ValueError: a map whose slopes are not known to be bounded; an amplitude, for a model that
            ``bound`` refuses; both records and an amplitude; or the package clarabel is missing
            (``lfrtorch[certificate]``).

    Example:
        >>> contraction = lfrtorch.analysis.contraction(model)
        >>> bool(np.isinf(contraction.amplitude).all())
        True
        >>> nearby = lfrtorch.analysis.contraction(model, amplitude=0.1)
        >>> nearby.found
        True
        >>> lfrtorch.analysis.contraction(model, record).data_rate <= contraction.rate
        True
    """
    cell = double(model.lfr.cell)
    anywhere = cell.map.enclosure(everywhere(cell.nz))
    if cell.nw and anywhere is None:
        raise InputError(
            f"the static map is a {cell.map.title}, whose slopes are not known to be bounded; a "
            "certificate needs a network, or no map."
        )
    scale, channels = model.scaler.u_scale, (model.inputs, model.outputs)
    if records is not None:
        if amplitude is not None:
            raise InputError("records and amplitude are both given; give only one of them.")
        model = model.reaching(records)
    in_data = _in_data(cell, model.reach)
    if records is not None:
        unknown = np.full(cell.nu, math.nan)
        if isinstance(in_data, str):
            return Contraction(0.0 * scale, math.nan, math.nan, None, in_data, *channels)
        return Contraction(unknown, in_data.rate, math.nan, in_data.P, "", *channels, in_data.rate)
    data_rate = math.nan if isinstance(in_data, str) else in_data.rate
    if amplitude is not None:
        size = amplitudes(amplitude, cell.nu)
        proof = _proof(cell, _slopes_within(cell, size / scale))
    else:
        size = np.full(cell.nu, np.inf)
        proof = _proof(cell, anywhere)
        if isinstance(proof, str):
            size, proof = _largest(cell, proof)
            size = size * scale
    if isinstance(proof, str):
        nothing = 0.0 * scale
        return Contraction(nothing, math.nan, math.nan, None, proof, *channels, data_rate)
    system, found = proof
    rate, found = _fastest(system, found)
    y = model.scaler.y_scale[:, None]
    physical = replace(
        system,
        Bu=system.Bu / scale, D=system.D / scale,
        Cy=y * system.Cy, Dy=y * system.Dy, Dyu=y * system.Dyu / scale,
    )  # fmt: skip
    proven = gain(physical)
    proven = math.nan if proven is None else proven
    # True if forgetting takes more than twice as long as the spectral radius allows.
    slow = np.isinf(size).all() and rate**2 > _radius(system)
    hint = ""
    if slow and cell.nw and math.isnan(data_rate):
        hint = (
            "For inputs of an amplitude the rate may be far smaller: "
            "contraction(model, amplitude=...)."
        )
    return Contraction(size, rate, proven, found.P, hint, *channels, data_rate)


class _Norm(NamedTuple):
    """A norm, and the rate at which it shrinks."""

    P: Float[Array, "nx nx"]
    rate: float


def _in_data(cell: LFRCell, reach: DataReach | None) -> _Norm | str:
    """The best norm for z in the box of the data, or the reason why there is none."""
    # The mean slope between two z in the box is a mean of slopes in its cells. So a norm that
    # shrinks for the slopes of all cells shrinks the difference of any two trajectories.
    if not cell.nw:
        proof = _proof(cell, None)
        return proof if isinstance(proof, str) else _Norm(proof[1].P, _fastest(*proof)[0])
    if reach is None:
        return "the reach of the data is not known."
    box = _Box(cell, reach.z)
    slopes = box.slopes(box.grid())
    if slopes is None:
        return "the slopes of the static map in the region of the data are not known."
    J = slopes.middle
    A = box.A(J)
    radii = np.abs(np.linalg.eigvals(A)).max(axis=1)
    steepest = float(radii.max())
    if steepest >= 1.0:
        return (
            f"linearised in the region of the data it has an eigenvalue of modulus {steepest:.4g}, "
            "so no norm shrinks there."
        )
    # The solver begins with a few cells. Then the cell that violates its result most is added.
    entries = J.reshape(len(A), -1)
    used = {int(radii.argmax()), *entries.argmin(axis=0), *entries.argmax(axis=0)}
    best: _Norm | None = None
    low, high = steepest, 1.0
    for _ in range(_HALVINGS):
        tried, P = (low + high) / 2, None
        for _ in range(_MORE_CELLS):
            P = common_norm(A[sorted(used)], tried)
            if P is None:
                break
            norms = _norms(P, A)
            if norms.max() <= tried * (1.0 + ROUNDING):
                break
            used.add(int(norms.argmax()))
        low, high = (tried, high) if P is None else (low, tried)
        rate = 1.0 if P is None else box.rate(P)
        if P is not None and rate < (1.0 if best is None else best.rate):
            best = _Norm(P, rate)
    return best or "no norm was found that shrinks for all slopes in the region of the data."


def _norms(P: Float[Array, "nx nx"], A: Float[Array, "C nx nx"]) -> Float[Array, " C"]:
    """The norm of each A that the norm of P induces."""
    L = np.linalg.cholesky(P).T
    return np.linalg.norm(L @ A @ np.linalg.inv(L), 2, axis=(1, 2))


@dataclass(frozen=True, eq=False)
class _Box:
    """The box of v = T (z - middle), where T has the axes of a cloud."""

    cell: LFRCell
    z: Cloud

    def slopes(self, cells: Interval) -> Interval | None:
        """Bounds of ∂w/∂v over cells of v."""
        into = np.asarray(np.linalg.inv(self.z.axes), dtype=np.float64)
        return self.cell.map.slopes_in(cells, into, self.z.middle)

    def grid(self) -> Interval:
        """A first grid of cells of the box."""
        cells = Interval(*self.z.ends.T[:, None])
        while 2 ** cells.low.shape[1] * len(cells.low) <= _FIRST_CELLS:
            cells = cells.parts()
        return cells

    def A(self, J: Float[Array, "C nw nz"]) -> Float[Array, "C nx nx"]:
        """∂x+/∂x for slopes ∂w/∂v."""
        M = self.cell.matrices()
        return M.A + M.Bw @ J @ self.z.axes @ M.Cz

    def rate(self, P: Float[Array, "nx nx"]) -> float:
        """Proven contraction rate in the norm of P: cells are halved where the bound is loose."""
        L = np.linalg.cholesky(P).T
        M = self.cell.matrices()
        left, right = np.abs(L @ M.Bw), np.abs(self.z.axes @ M.Cz @ np.linalg.inv(L))
        cells, proven, count = self.grid(), 0.0, 0
        while len(cells.low):
            J = self.slopes(cells)
            assert J is not None
            norms = _norms(P, self.A(J.middle))
            rates = norms + np.linalg.norm(left @ J.radius @ right, 2, axis=(1, 2)) + ROUNDING
            count += len(rates)
            # The middles of the cells bound the true rate from below: no better rate is searched.
            goal = max(proven, float(norms.max()) + _SLACK * (1.0 - float(norms.max())))
            open_ = rates > goal
            if count > _LAST_CELLS:
                return max(proven, float(rates.max()))
            proven = max(proven, float(rates[~open_].max(initial=0.0)))
            cells = Interval(cells.low[open_], cells.high[open_]).parts()
        return proven


_Proof = tuple[Differences, Certificate]


def _slopes_within(cell: LFRCell, amplitude: Array) -> Enclosure | None:
    """Enclosure of the static map for inputs of an amplitude; None without a map."""
    return reach(cell, amplitude, np.zeros(cell.nx)).map


def _proof(cell: LFRCell, slopes: Enclosure | None) -> _Proof | str:
    """A system with its certificate, or the reason why there is none."""
    if slopes is not None:
        radius, place = _steepest(cell, slopes)
        if radius >= 1.0:
            return (
                f"linearised {place} it has an eigenvalue of modulus {radius:.4g}, so no norm "
                "shrinks there."
            )
    for system in Differences.of(cell, slopes):
        found = certificate(system, _slow(system))
        if found is not None:
            return system, found
    return "no norm was found that shrinks for all slopes that the static map may have."


def _steepest(cell: LFRCell, slopes: Enclosure) -> tuple[float, str]:
    """Largest spectral radius among linearisations within the box, and its place in words.

    Only z that some state and input can reach are tried.
    """
    every = max(1, len(slopes.centres) // 500)
    z = torch.as_tensor(slopes.centres[::every])
    onto = torch.cat([cell.Cz, cell.Dzu], dim=1).detach()
    z = z @ (onto @ torch.linalg.pinv(onto)).mT
    radii = spectral_radius(linearise(cell, z.unsqueeze(0)).F[0])
    worst = int(radii.argmax())
    place = f"at z = ({', '.join(f'{v:.3g}' for v in z[worst].tolist())})"
    far = bool(z[worst].abs().max() >= math.sqrt(FAR))
    return float(radii[worst]), "far from its data" if far else place


def _largest(cell: LFRCell, reason: str) -> tuple[Array, _Proof | str]:
    """The largest amplitude with a proof, relative to the data's rms; or 0 and the reason."""
    nothing = np.zeros(cell.nu)

    def attempt(factor: float) -> _Proof | str:
        return _proof(cell, _slopes_within(cell, np.full(cell.nu, factor)))

    try:
        at_rest = attempt(1.0 / _FARTHEST)
    except InputError as error:  # z has no bounds
        text = str(error).split("\n", 1)[0]
        return nothing, f"{reason}\nNor is there one for an amplitude: {text}"
    if isinstance(at_rest, str):
        return (
            nothing,
            f"{at_rest}\nThis holds even within the bounds proven for the smallest inputs.",
        )
    low, high, best = 1.0 / _FARTHEST, _FARTHEST, at_rest
    while high > 1.02 * low:
        factor = math.sqrt(low * high)
        proof = attempt(factor)
        if isinstance(proof, str):
            high = factor
        else:
            low, best = factor, proof
    return np.full(cell.nu, low), best


def _slow(system: Differences) -> float:
    """Largest rate that counts as contraction."""
    return max(SLOWEST, 1.0 - _LEAST * (1.0 - _radius(system)))


def _radius(system: Differences) -> float:
    """The spectral radius for slopes in the middle of their bounds; no rate is below it."""
    return float(np.abs(np.linalg.eigvals(system.A)).max())


def _fastest(system: Differences, slow: Certificate) -> tuple[float, Certificate]:
    """The smallest rate that is proven, with its certificate."""
    rate, found, best = _slow(system), slow, _radius(system)
    low, high = _LEAST, 1.0
    for _ in range(9):  # bisections of the logarithm
        part = math.sqrt(low * high)
        tried = 1.0 - part * (1.0 - best)
        closer = certificate(system, tried)
        if closer is None:
            high = part
        else:
            low, rate, found = part, tried, closer
    return rate, found
