"""Uncertainty of a model's parameters, and confidence bands of its outputs.

At the end of a fit θ_hat - θ = H⁻¹ Jᵀe to first order, with J the weighted rows of the model's
output, H = JᵀJ, and e the noise. So the covariance of θ_hat is a sandwich, H⁻¹ (JᵀΓJ) H⁻¹. Γ is the
covariance of the noise over time. It is estimated from the residuals as an autoregressive process,
with its own size for every record. (Lagged products of the scores J(t)ᵀe(t), the usual sandwich,
need no model of the noise. In records of 300 samples their bands of 95 % covered 80 to 91 %, these
cover 93 to 95 %.) Any number g(θ) of the model has an error of dg/dθ times the error of θ. J is
computed in the identifiable columns only (see ``gauge``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.special import ndtri
from torch import Tensor
from torch.autograd.functional import jacobian

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import number as check_number
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import in_lines, number, percent, quantity, table
from lfrtorch._support.types import Array
from lfrtorch.analysis.gradients import Gradients, root
from lfrtorch.analysis.linearisation import linear_part, linearise
from lfrtorch.analysis.noise_model import LEAST, NoiseModel, Spectra, colours, innovations
from lfrtorch.analysis.output_residuals import FINDINGS, LEVEL, ROUNDING, SLIGHT, OutputResiduals
from lfrtorch.analysis.residual_analysis import SHORTEST, of_simulation
from lfrtorch.analysis.static_slopes import infinite_slope
from lfrtorch.analysis.training_reach import TrainingReach
from lfrtorch.data.records import Channel, Record, as_records, as_signal
from lfrtorch.engine.held import held_parameters
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.linearised import fed_back
from lfrtorch.engine.operating_point import SINGULAR, linearised_at
from lfrtorch.engine.weights import Weights
from lfrtorch.least_squares.gauge import reduction
from lfrtorch.least_squares.linear_systems import GramAccumulator, QRAccumulator
from lfrtorch.least_squares.simulation_errors import Parameters
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.data_reach import FARTHEST
from lfrtorch.model.model import Model

_TRUNCATION = 1e-8
"""Singular values of J, with columns of unit length, below this part of the largest count as 0."""

_SHIFTED = 0.5
"""A note names a shift of the fit from so many standard errors on, rms over the directions."""

_NEAR = 40.0
"""The noise can reach a limit that is at most so many standard deviations away."""

NOT_AT_MINIMUM = "the fit is not at its minimum"
"""Beginning of the note on a fit that is not at its minimum."""


@dataclass(frozen=True, eq=False)
class Band:
    """A simulated output and its uncertainty, in physical units.

    Args:
        outputs: the channels.
        y: simulated output.
        std: standard deviation of y due to the uncertain parameters, and due to the start state if
            that is estimated from the record.
        noise: standard deviation of the measurement noise.
        surprises: distance of each sample from the data; 1 is the distance within which 99 % of the
            data's samples are. NaN if it is not known.

    Example:
        >>> band = lfrtorch.analysis.uncertainty(model, record).simulate(record)
        >>> low, high = band.interval()
        >>> low.shape, bool((low < band.y).all()), round(band.surprise)
        ((400, 1), True, 1)
    """

    outputs: tuple[Channel, ...]
    y: Float[Array, "T ny"]
    std: Float[Array, "T ny"]
    noise: Float[Array, " ny"]
    surprises: Float[Array, " T"]

    @property
    def surprise(self) -> float:
        """Surprise of the record: 99 % of its samples are below it."""
        return float(np.quantile(self.surprises, FARTHEST))

    def interval(
        self, level: float = 0.95, *, noise: bool = False
    ) -> tuple[Float[Array, "T ny"], Float[Array, "T ny"]]:
        """Lower and upper edge of the band that holds the true output, pointwise.

        Args:
            level: probability, 0 to 1.
            noise: include the noise of the measured output.
        """
        check_number("level", level)
        if not 0 < level < 1:
            raise InputError(f"level is {level}; give a probability between 0 and 1, as 0.95.")
        std = np.hypot(self.std, self.noise) if noise else self.std
        half = float(ndtri((1 + level) / 2)) * std
        return self.y - half, self.y + half


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of the parameters of a model; ``print(uncertainty)`` shows it.

    Args:
        model: the model, in float64 on the CPU.
        records: names of the records that it was fitted to.
        samples: number of scored samples.
        kept: parameters that vary, by their place among the free ones; the others are held, which
            changes no output.
        factor: F, so that F Fᵀ is the covariance of the kept parameters.
        rank: number of directions of the kept parameters that the data determine.
        noise: standard deviation of the measurement noise, physical units.
        relative: mean standard deviation of the training outputs, over their rms.
        doubts: why the bands may be wrong; empty if nothing is known against them.
        colour: model of the noise over time, normalised.
        reach: range of the data.

    Example:
        >>> found = lfrtorch.analysis.uncertainty(model, record)
        >>> found.covariance.shape, found.rank < len(found.kept)  # no fit yet: the map is zero
        ((21, 21), True)
    """

    model: Model
    records: tuple[str, ...]
    samples: int
    kept: Int[Tensor, " K"]
    factor: Float[Tensor, "K m"]
    rank: int
    noise: Float[Array, " ny"]
    relative: Float[Array, " ny"]
    doubts: tuple[str, ...]
    colour: NoiseModel
    reach: TrainingReach

    @property
    def covariance(self) -> Float[Array, "P P"]:
        """Covariance of all free parameters, in the order of ``model.lfr``; 0 for held ones."""
        wide = np.zeros((Parameters(self.model.lfr.cell, 0).own, self.factor.shape[1]))
        wide[self.kept.numpy()] = self.factor.numpy()
        return wide @ wide.T

    def simulate(self, data: Record | ArrayLike) -> Band:
        """Simulated output with its band, and how far the input is from the data.

        Memory grows with the samples alone, not with samples times parameters.

        Args:
            data: a record, from its own kind of start, or an input in physical units, from x = 0.

        Shape:
            data: (T, nu) or (T,).

        Raises:
            ValueError: other channels or another rate than the model's.

        Example:
            >>> band = lfrtorch.analysis.uncertainty(model, record).simulate(np.zeros(50))
            >>> band.y.shape, band.std.shape, band.surprises.shape
            ((50, 1), (50, 1), (50,))
        """
        model, scaler = self.model, self.model.scaler
        if isinstance(data, Record):
            record = data
        else:
            u = as_signal(data, model.inputs, "input")
            y = np.zeros((len(u), len(model.outputs)))
            record = Record(u, y, model.fs, inputs=model.inputs, outputs=model.outputs)
        along = Gradients(model, record, self.kept, fitted=False)
        along.basis = self.factor
        y = scaler.restore_y(along.trajectory.y[0].numpy())
        variance, surprises = np.full(y.shape, np.nan), np.full(len(y), np.nan)
        if np.isfinite(y).all():
            start = along.start_factor(self.colour) if along.estimated else self.factor[:0, :0]
            own, m = np.zeros(y.shape), self.factor.shape[1]
            for time, rows in along.blocks():
                own[time] = rows[..., :m].square().sum(-1).numpy()
                variance[time] = (rows[..., m:] @ start).square().sum(-1).numpy()
            variance += own
            surprises = self.reach.surprises(along.trajectory.z[0].numpy(), own)
        std = np.sqrt(variance) * scaler.y_scale
        return Band(model.outputs, record.shown(y), std, self.noise, surprises)

    def linear_part(self) -> LinearModel:
        """A, Bu, Cy and Dyu in physical units, with their covariance.

        Example:
            >>> linear = lfrtorch.analysis.uncertainty(model, record).linear_part()
            >>> (pole,) = lfrtorch.analysis.pole_bands(linear)
            >>> bool(pole.frequency > 0), bool(pole.frequency_std > 0)
            (True, True)
        """
        return self._with_covariance(linear_part(self.model), lambda W: (W.A, W.Bu, W.Cy, W.Dyu))

    def linearise(self, u: ArrayLike | None = None) -> LinearModel:
        """The model about its rest, as ``lfrtorch.analysis.linearise``, with its covariance.

        The rest moves with the parameters, too.

        Args:
            u: constant input, physical units. Default: the inputs' offsets in the data.

        Raises:
            ValueError: no state is at rest under u.

        Example:
            >>> local = lfrtorch.analysis.uncertainty(model, record).linearise(0.5)
            >>> band = lfrtorch.analysis.response_band(local, [0.0, 10.0])
            >>> band.response.shape, bool((band.std > 0).all())
            ((2, 1, 1), True)
        """
        found = linearise(self.model, u)
        assert found.x_offset is not None
        return self._with_covariance(found, _at_rest(self.model, found.u_offset, found.x_offset))

    def _with_covariance(
        self, linear: LinearModel, matrices: Callable[[Weights], Sequence[Tensor]]
    ) -> LinearModel:
        """A linear model with the covariance of its matrices, which are functions of θ."""
        parameters, s, nx = Parameters(self.model.lfr.cell, 0), self.model.scaler, linear.nx

        def entries(theta: Float[Tensor, " P"]) -> Float[Tensor, " n"]:
            return torch.cat([M.flatten() for M in matrices(parameters.weights(theta))])

        with torch.enable_grad():
            G = torch.as_tensor(jacobian(entries, parameters.start))[:, self.kept]
        u, y = s.u_scale, s.y_scale[:, None]
        scales = [np.ones((nx, nx)), np.ones((nx, 1)) / u, y * np.ones((len(y), nx)), y / u]
        physical = (G @ self.factor).numpy() * np.concatenate([s.ravel() for s in scales])[:, None]
        return replace(linear, covariance=physical @ physical.T)

    def __repr__(self) -> str:
        return f"Uncertainty({self.samples} samples, {self.rank} directions)"

    def __str__(self) -> str:
        head = ["output", "noise", "order of its model", "mean std of y / rms of y"]
        columns = zip(self.model.outputs, self.noise, self.colour.a, self.relative, strict=True)
        rows = [
            [channel.name, quantity(size, channel.unit), len(a) - 1, percent(float(relative))]
            for channel, size, a, relative in columns
        ]
        held = sum(p.numel() for p in self.model.lfr.parameters()) - len(self.kept)
        lines = [
            f"fitted to {self.samples} samples of {len(self.records)} record(s)",
            f"{len(self.kept)} parameters vary, {held} are held without loss; the data tell "
            f"{self.rank} directions of them",
        ]
        return "\n".join([*map(in_lines, [*self.doubts, *lines]), "", table(head, rows)])


@typed()
def uncertainty(model: Model, records: Record | Sequence[Record]) -> Uncertainty:
    """Uncertainty of the parameters of a model, from the records that it was fitted to.

    The result simulates with bands and a surprise index, and gives linear models with covariance.
    It is computed again whenever it is needed: from ``lfrtorch.load(folder)`` and the same data.

    The bands cover uncertain parameters, and noise that is independent of the inputs. They do not
    cover what the model cannot describe: ``doubts`` says so if the residuals show it.

    Args:
        model: at the minimum of its fit.
        records: records of the fit, with starts, skips and weights as in the fit.

    Raises:
        ValueError: a model that was fitted to predictions, other channels or another rate than the
            model's, fewer scored samples than parameters, or a model that diverges on a record.

    References:
        Ljung, "System Identification: Theory for the User", 2nd ed., 1999, chapter 9.
        White, "Maximum likelihood estimation of misspecified models", Econometrica 50, 1982.

    Example:
        >>> y = record.y + 0.01 * np.random.default_rng(1).standard_normal((400, 1))
        >>> noisy = lfrtorch.Record(record.u, y, fs=100.0, start="periodic")
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=30)
        >>> fitted = lfrtorch.fit(model, noisy, trainer=trainer).model
        >>> print(lfrtorch.analysis.uncertainty(fitted, noisy))
        fitted to 400 samples of 1 record(s)
        18 parameters vary, 3 are held without loss; the data tell 18 directions of them
        ...
    """
    if model.K is not None:
        raise InputError(
            "this model has K: it was fitted to predictions, and bands are of fits to simulations; "
            "fit it without noise='innovation'."
        )
    listed = as_records(records)
    for record in listed:
        model.check(record)
    cell = deepcopy(model.lfr.cell).to(device="cpu", dtype=torch.float64)
    model = replace(model, lfr=LFR(cell))
    given = any(record.start == "given" for record in listed)
    none = cell.A.new_zeros(0, cell.nx)
    kept = reduction(cell, none, coordinates=not given, fixed=held_parameters(cell)).kept
    size = sum(record.y.size for record in listed) * (len(kept) + cell.nx)
    hold = size <= 1 << 25  # numbers that are kept in memory; more are computed again
    every = [Gradients(model, r, kept, fitted=True, hold=hold) for r in listed]
    for along in every:
        if not torch.isfinite(along.errors.square().sum()):
            raise InputError(
                f"the model diverges on record '{along.record.name}'; give the records that it was "
                "fitted to."
            )
    W, seen, left = _directions(every, model)
    for along in every:
        along.basis = W
    sizes, colour, deviations = _noise(every)
    total = GramAccumulator()
    for along, own in zip(every, sizes, strict=True):
        for _, Q, _ in along.weighted():
            total.fold(own.coloured(Q))
    # A direction that the data do not determine has the variance of the least determined one.
    untold = torch.diag(float(np.trace(colour.covariance)) / cell.ny * (1.0 - seen.square()))
    scatter, rank, zs, variances = root(untold + total.G), int((seen == 1).sum()), [], []
    for along in every:
        scored = slice(along.record.skip, None)
        parts = [(Q[..., : len(kept)] @ scatter).square().sum(-1) for _, Q in along.blocks()]
        if not along.group.spectral:
            # Correct for the sample itself, as if the model were not fitted to it.
            taken = [Q.square().sum(-1) for _, Q, _ in along.weighted()]
            parts = [p / (1.0 - h).clamp_min(LEAST) for p, h in zip(parts, taken, strict=True)]
        zs.append(along.trajectory.z[0, scored].numpy())
        variances.append(torch.cat(parts)[scored].numpy())
    variance = np.concatenate(variances)
    y = np.concatenate([along.group.y[0].numpy() for along in every])
    return Uncertainty(
        model=model,
        records=tuple(record.name for record in listed),
        samples=sum(record.samples - record.skip for record in listed),
        kept=kept,
        factor=W @ scatter,
        rank=rank,
        noise=deviations * model.scaler.y_scale,
        relative=np.sqrt(variance).mean(axis=0) / np.maximum(y.std(axis=0), 1e-300),
        doubts=_doubts(every, model, sizes, rank, left)
        + _clipped(every, scatter, torch.as_tensor(deviations)),
        colour=colour,
        reach=TrainingReach.of(np.concatenate(zs), variance),
    )


def _directions(
    every: Sequence[Gradients], model: Model
) -> tuple[Float[Tensor, "K K"], Float[Tensor, " K"], tuple[float, float]]:
    """W with orthonormal columns of J W, how much of each J sees (1: all), and the distance left.

    The distance left is that of a Gauss-Newton step: in standard errors, and of the cost.
    """
    total, samples = QRAccumulator(), 0
    for along in every:
        samples += int((along.group.weight != 0).sum())
        for _, rows, errors in along.weighted():
            total.fold(torch.cat([rows, errors.unsqueeze(-1)], -1).flatten(0, 1))
    K = len(every[0].kept)
    if samples <= K:
        raise InputError(
            f"the records have {samples} scored numbers and the model {K} parameters that vary; "
            "give the records that it was fitted to, more samples than parameters."
        )
    if not total.R.isfinite().all():
        found = infinite_slope(model, [along.record for along in every])
        raise InputError(f"{found or 'derivatives of the outputs are not finite'}.")
    J, r = total.R[:, :-1], total.R[:, -1]
    scale = torch.linalg.vector_norm(J, dim=0)
    scale[scale == 0] = 1.0
    U, s, Vh = torch.linalg.svd(J / scale, full_matrices=False)
    least = _TRUNCATION * (s[0] if s[0] > 0 else 1.0)  # 0: no parameter matters
    seen = s.clamp_min(least)
    step, cost = float((U.mT @ r)[s >= least].square().sum()), float(r.square().sum())
    rank = int((s >= least).sum())
    variance = (cost - step) / (samples - rank)
    left = math.sqrt(step / (max(rank, 1) * variance)) if variance > ROUNDING**2 else 0.0
    return (Vh.mT / seen) / scale.unsqueeze(-1), s / seen, (left, step / cost if cost else 0.0)


def _noise(
    every: Sequence[Gradients],
) -> tuple[list[NoiseModel], NoiseModel, Float[Array, " ny"]]:
    """The noise model of each record as weighted, of all with one size, and standard deviations.

    Records share the colour, and each has its own size. Spectral lines count as independent.
    """
    ny = every[0].group.y.shape[2]
    spectra = Spectra(max(along.record.samples for along in every), ny)
    left = []
    for along in every:
        counted, taken = np.zeros((2, ny))
        for _, rows, errors in along.weighted():
            Q = rows.numpy()
            counted += np.any(Q, axis=2).sum(axis=0)
            taken += np.square(Q).sum(axis=(0, 2))
            if not along.group.spectral:
                spectra.add(errors.numpy(), Q)
        left.append(np.maximum(counted - taken, np.maximum(LEAST * counted, 1.0)))
    white = tuple(np.ones(1) for _ in range(ny))
    a, variances = colours(spectra) if spectra.samples.any() else (white, np.zeros(ny))
    colour_of = [white if along.group.spectral else a for along in every]
    products, power = [], np.zeros(ny)
    for along, own in zip(every, colour_of, strict=True):
        e = innovations(own, along.group.weigh(along.errors[None])[0].numpy())
        products.append(e.T @ e)
        counted = along.group.scored if along.group.spectral else along.group.weight != 0
        power += np.square((along.errors * counted[0]).numpy()).sum(axis=0)
    plain = [i for i, own in enumerate(colour_of) if own is a] or range(len(every))
    pooled = _ratio(*(np.sum([each[i] for i in plain], axis=0) for each in (products, left)))
    # The spectra tell better than n - p how much of the noise the fit has absorbed.
    known, gain = np.diag(pooled) > 0, np.ones(ny)
    if spectra.samples.any():
        gain[known] = np.sqrt(variances[known] / np.diag(pooled)[known])
    each = [
        NoiseModel(own, _ratio(product, dof) * (np.outer(gain, gain) if own is a else 1.0))
        for own, product, dof in zip(colour_of, products, left, strict=True)
    ]
    deviations = np.sqrt(power / np.sum(left, axis=0))
    return each, NoiseModel(a, pooled * np.outer(gain, gain)), deviations


def _ratio(product: Float[Array, "ny ny"], left: Float[Array, " ny"]) -> Float[Array, "ny ny"]:
    """Covariance of the residuals, from their products and their degrees of freedom."""
    return product / np.sqrt(np.outer(left, left))


def _weighted_step(every: Sequence[Gradients], sizes: Sequence[NoiseModel]) -> Float[Tensor, " K"]:
    """Gauss-Newton step of a fit that weights each record by one over its noise."""
    total = QRAccumulator()
    for along, own in zip(every, sizes, strict=True):
        power = torch.as_tensor(np.diag(own.covariance).copy())
        by = torch.where(power > 0, power, torch.inf).rsqrt().unsqueeze(-1)
        for _, Q, errors in along.weighted():
            total.fold((torch.cat([Q, -errors.unsqueeze(-1)], -1) * by).flatten(0, 1))
    R = total.R[: total.R.shape[1] - 1]
    return torch.linalg.pinv(R[:, :-1], rtol=_TRUNCATION) @ R[:, -1]


def _dependent(
    every: Sequence[Gradients], model: Model, step: Float[Tensor, " K"] | None = None
) -> list[tuple[OutputResiduals, str]]:
    """Residuals that depend on the inputs, and how, after a step of the parameters."""
    parts = []
    for along in every:
        if along.record.samples - along.record.skip < SHORTEST:
            continue
        y = along.trajectory.y[0].clone()
        if step is not None:
            for time, rows in along.blocks():
                y[time] += rows[..., : len(step)] @ step
        y_hat = along.record.shown(model.scaler.restore_y(y.numpy()))
        parts += of_simulation(along.record, y_hat)
    tests = 3 * len(parts)
    return [
        (part, name)
        for part in parts
        for name, each in part.tests.items()
        if tests * part.p[name] <= LEVEL
        and max(abs(c.at(c.largest)[0]) for c in each) >= SLIGHT
        and not part.exact
    ]


def _doubts(
    every: Sequence[Gradients],
    model: Model,
    sizes: Sequence[NoiseModel],
    rank: int,
    left: tuple[float, float],
) -> tuple[str, ...]:
    """Return sentences on why the bands may be wrong."""
    found = []
    wrong = _dependent(every, model)
    if wrong and len(every) > 1:
        # Noise of a loud record affects the parameters, and so the residuals of a quiet record.
        wrong = _dependent(every, model, _weighted_step(every, sizes))
    if wrong:
        part, name = min(wrong, key=lambda pair: pair[0].p[pair[1]])
        found.append(
            f"the residuals of {part.output.name} in record '{part.record}' depend on "
            f"{FINDINGS[name][1]} still: the model is too small, and the bands are too narrow, as "
            "they know noise only."
        )
    if left[0] > 1.0:  # standard errors, rms over the directions
        found.append(
            f"{NOT_AT_MINIMUM}: a step would be {number(left[0], 2)} standard errors "
            f"long and lower the squared error by {percent(left[1])}; bands are about the minimum."
        )
    if rank < (K := len(every[0].kept)):
        found.append(
            f"the data tell {rank} of {K} directions of the parameters; where the others "
            "matter, surprise and bands are large."
        )
    return tuple(found)


def _clipped(
    every: Sequence[Gradients], scatter: Float[Tensor, "K m"], noise: Float[Tensor, " ny"]
) -> tuple[str, ...]:
    """Return a note on a large shift of the fit, by noise that the limits of a sensor cut off."""
    K, total = len(scatter), scatter.new_zeros(len(scatter))
    for along in every:
        if along.group.limits is None or not noise.all():
            continue
        # The error of a sample whose output is d beyond a limit is e where d + e < 0, and min(d, 0)
        # elsewhere. Noise e of variance σ² leaves a mean of σ φ(d/σ) + min(d, 0) Φ(d/σ), inwards.
        mean = torch.zeros_like(along.errors)
        for sign, limit in zip((-1.0, 1.0), along.group.limits[0], strict=True):
            d = (sign * (along.trajectory.y[0] - limit) / noise).clamp_min(-_NEAR)
            density = torch.exp(-0.5 * d.square()) / math.sqrt(2.0 * math.pi)
            mean += sign * noise * (density + d.clamp_max(0.0) * torch.special.ndtr(d))
        mean *= torch.as_tensor(along.record.factors).square()
        for time, rows in along.blocks():
            total += torch.einsum("tok,to->k", rows[..., :K], mean[time])
    shift = torch.linalg.pinv(scatter, rtol=_TRUNCATION) @ total
    errors = float(shift.square().mean().sqrt())
    if errors < _SHIFTED:
        return ()
    return (
        "noise is not small beside the limits of the sensor: they cut it off on one side,\nwhich "
        f"shifts the fit by some {number(errors, 2)} standard errors, which errors and bands do "
        "not know;\na sensor of more range or less noise helps.",
    )


def _at_rest(
    model: Model, u: Float[Array, " nu"], rest: Float[Array, " nx"]
) -> Callable[[Weights], Sequence[Tensor]]:
    """A, B, C and D about the rest under u, normalised, as a function of all weights.

    One step of Newton's method from the rest, x + (I - F)⁻¹ (f(x, u) - x) with F held, has the same
    first derivatives as the rest itself.
    """
    v, x = torch.as_tensor(model.scaler.normalise_u(u)), torch.as_tensor(rest)
    F = torch.as_tensor(linearised_at(model.lfr.cell, v, x).A)
    inverse = torch.linalg.pinv(torch.eye(len(x), dtype=x.dtype) - F, rtol=SINGULAR)

    def matrices(W: Weights) -> Sequence[Tensor]:
        z, _ = W.internal(v, x + inverse @ (W.step(v, x) - x))
        return fed_back(W, W.map.slope(z[None, None], W.phi)[0, 0])

    return matrices


@typed()
def spread(models: Sequence[Model], data: Record | ArrayLike) -> Band:
    """The mean output of several models, and their standard deviation.

    Models from several starts, or the members of an ensemble, differ in what the data do not
    determine. ``std`` is their standard deviation; at least two models are needed.

    Args:
        models: two or more of the same channels and rate.
        data: as in ``Model.simulate``.

    Raises:
        ValueError: fewer than two models, or models of other channels or rates.

    Example:
        >>> models = [lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4, seed=i) for i in range(3)]
        >>> band = lfrtorch.analysis.spread(models, record)
        >>> band.y.shape, bool((band.std >= 0).all())
        ((400, 1), True)
    """
    if len(models) < 2:
        raise InputError(f"a spread is of two models at least; {len(models)} given.")
    first = models[0]
    for model in models:
        if (model.inputs, model.outputs, model.fs) != (first.inputs, first.outputs, first.fs):
            raise InputError(
                f"a spread is of models of the same channels and rate; {first!r} and {model!r} "
                "differ."
            )
    outputs = np.stack([model.simulate(data) for model in models])
    unknown = np.full(outputs.shape[1], np.nan)
    return Band(
        first.outputs, outputs.mean(axis=0), outputs.std(axis=0, ddof=1),
        np.zeros(len(first.outputs)), unknown,
    )  # fmt: skip
