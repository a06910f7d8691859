"""Identified model: an LFR with its scaling, ready to simulate in physical units."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast, overload

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from lfrtorch._support import checkpoint
from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer, reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.frames import check_index, columns_of, framed, is_frame, places_of
from lfrtorch._support.old_checkpoints import SCALING
from lfrtorch._support.types import Array
from lfrtorch.data.records import (
    Channel,
    NormalisedRecord,
    Record,
    Scaler,
    Start,
    as_records,
    as_signal,
    check_rate,
    check_start,
    shifted,
    with_past_outputs,
)
from lfrtorch.engine.delay_line import delay_line_cell
from lfrtorch.engine.description import delays, in_columns, levels, listed, system_lines
from lfrtorch.engine.disturbance import (
    disturbance_scale,
    disturbed_cell,
    drift_variance,
    tells_apart,
)
from lfrtorch.engine.gauge_directions import free_directions
from lfrtorch.engine.initial_state import measured_start
from lfrtorch.engine.innovation import predictor_cell, split_predictor
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.linearised import static_slope
from lfrtorch.engine.operating_point import double, equilibrium, linear_part, linearised_at
from lfrtorch.engine.record_starts import begun
from lfrtorch.engine.resampling import resampled_cell
from lfrtorch.engine.simulation import Trajectory, simulate
from lfrtorch.maps.static_map import StaticMap
from lfrtorch.model.data_reach import DataReach
from lfrtorch.model.extended_kalman_filter import (
    ExtendedKalmanFilter,
    NoiseCovariance,
    inside_limits,
    with_variances,
)
from lfrtorch.model.information import Information
from lfrtorch.model.state_observer import StateObserver, SteadyGainObserver

NO_OBSERVER = (
    "this model has no innovation gain K: give noise=lfrtorch.NoiseCovariance(Q, R) for a Kalman "
    "filter, or fit it with noise='innovation'."
)

Disturbance = Literal["input", "output"] | ArrayLike
"""Place of constant disturbances: all inputs, all outputs, or a matrix of their effects."""

_STEPS = 100
"""Number of random steps of the input on which a resampled model is compared."""

_HELD = 20
"""Number of common samples for which each of these steps is held."""

_COMMON = 100
"""Largest length of the common sample of two rates, in samples of either."""

_TOGETHER = 1000
"""Number of predictions that are simulated at once."""

if TYPE_CHECKING:
    from pandas import DataFrame


def simulate_record(lfr: LFR, normalised: NormalisedRecord, start: Start) -> Trajectory:
    """Return all signals of a record from a start other than ``"given"``, with R = 1."""
    like, record = lfr.cell.A, normalised.record
    signals = normalised.u, normalised.y, record.start_factors
    u, y, weight = (torch.tensor(signal).to(like).unsqueeze(0) for signal in signals)
    lfr.cell.check()
    return begun(start, lfr.cell, u, y, weight)


class Resampled(NamedTuple):
    """A model at another sampling rate.

    Args:
        model: the model at that rate.
        error: rms of the difference from the output of the original, (ny,), physical units, at
            common samples of an input of random steps within the range of the data.

    Example:
        >>> faster, error = model.resample(2 * model.fs)
        >>> error.shape
        (1,)
    """

    model: Model
    error: Float[Array, " ny"]


@dataclass(frozen=True, eq=False)
class Model:
    """An LFR with scaling, sampling rate, channel names and units.

    Args:
        lfr: the model in normalised units.
        scaler: conversion of inputs and outputs between physical and normalised units.
        fs: sampling frequency in Hz.
        inputs, outputs: channel names and units.
        fitted_to: description of the data, for ``print(model)``.
        K: gain of the innovations e in x+ = A x + Bu u + Bw w + K e, y = ... + e, with x and y
            normalised. Default: no noise model; ``lfrtorch.fit`` finds one with
            ``noise="innovation"``.
        reach: range of the data; ``reaching`` finds it.
        information: that of the data on the parameters, for ``lfrtorch.update``.

    Shape:
        K: (nx, ny).

    Raises:
        ValueError: weights, scales, channels or a gain of wrong sizes, a scale that is not
            positive, or an invalid sampling rate.

    ``print(model)`` shows sizes, channels, poles and gains: of the linear part A, Bu, Cy, Dyu, and
    of the model linearised at rest at the inputs' offsets. ``lfrtorch.analysis`` plots the model,
    tests its residuals on records, and linearises it about any point.

    Example:
        >>> model.sizes, model.parameter_count
        ({'nx': 1, 'nz': 1, 'nw': 1, 'nn': 4}, 21)
        >>> model.inputs, model.fs
        ((Channel(name='u', unit=''),), 100.0)
        >>> model
        Model(u -> y, 100 Hz, nx=1, nz=1, nw=1, nn=4)
    """

    lfr: LFR
    scaler: Scaler
    fs: float
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    fitted_to: str = ""
    K: Float[Tensor, "nx ny"] | None = None
    reach: DataReach | None = None
    information: Information | None = None

    def __post_init__(self) -> None:
        cell, s = self.lfr.cell, self.scaler
        cell.check()
        for side, size, channels, offset, scale in (
            ("inputs", cell.nu, self.inputs, s.u_offset, s.u_scale),
            ("outputs", cell.ny, self.outputs, s.y_offset, s.y_scale),
        ):
            if not np.shape(offset) == np.shape(scale) == (len(channels),) == (size,):
                raise InputError(
                    f"the model has {size} {side}, {len(channels)} channels, offsets of shape "
                    f"{np.shape(offset)} and scales of shape {np.shape(scale)}; give one for each."
                )
        if not (np.concatenate([s.u_scale, s.y_scale]) >= np.finfo(float).tiny).all():
            raise InputError("a scale is not positive.")
        check_rate("the sampling frequency", self.fs)
        if self.K is not None and self.K.shape != (cell.nx, cell.ny):
            raise InputError(f"K has the shape {tuple(self.K.shape)}; give ({cell.nx}, {cell.ny}).")

    def __repr__(self) -> str:
        sizes = ", ".join(f"{name}={size}" for name, size in self.sizes.items())
        sizes = f"{self.known_states} known states, {sizes}" if self.known_states else sizes
        sizes += f", delay={list(self.delay)}" * any(self.delay)
        return f"Model({listed(self.inputs)} -> {listed(self.outputs)}, {self.fs:g} Hz, {sizes})"

    def __str__(self) -> str:
        cell, scaler = double(self.lfr.cell), self.scaler
        offset = cell.A.new_zeros(cell.nu)
        systems, rest = {"": linear_part(cell).physical(scaler)}, ""
        if cell.static is not None:
            x = equilibrium(cell, offset)
            systems = {} if self.known_states else {"linear part": systems[""]}
            if x is None:
                rest = "none found at the inputs' offsets"
            else:
                systems["at rest"] = linearised_at(cell, offset, x).physical(scaler)
        sizes = ", ".join(f"{name} {size}" for name, size in self.sizes.items())
        sizes = f"{self.known_states} known states, {sizes}" if self.known_states else sizes
        counts = f"{self.parameter_count} parameters, {self.net_parameter_count} net"
        first, *others = map(str, cell.map.maps)
        facts = [
            ("sampled at", f"{self.fs:g} Hz"),
            ("inputs", levels(self.inputs, scaler.u_offset, scaler.u_scale)),
            ("outputs", levels(self.outputs, scaler.y_offset, scaler.y_scale)),
            ("delay", delays(self.inputs, self.delay)),
            ("sizes", f"{sizes}; {counts}"),
            ("static map", first.split("\n")[0] if cell.nw else ""),
            *(("beside it", other) for other in others),
            ("fitted to", self.fitted_to),
            ("noise", "" if self.K is None else "innovation form: model.predict, model.observer"),
            ("rest", rest),
        ]
        lines = [
            f"{'Linear' if cell.static is None else 'NL-LFR'} model",
            *in_columns(facts),
            *(system_lines(systems, self.fs, self.inputs, self.outputs) if systems else []),
        ]
        return "\n".join(lines)

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes nx, nz, nw, and nn or the degree of a polynomial; nn = 0 for a user's map."""
        cell, learned = self.lfr.cell, self.lfr.cell.map.learned
        nx = cell.nx - self.known_states
        return {"nx": nx, "nz": learned.nz, "nw": learned.nw, **learned.sizes}

    @property
    def delay(self) -> tuple[int, ...]:
        """Whole samples by which each input acts later; the states do not include them.

        The model may know a part of a sample more, see ``lfrtorch.analysis.dead_times``.

        Example:
            >>> model.delay, model.delayed(3).delay
            ((0,), (3,))
        """
        return self.scaler.delay or (0,) * len(self.inputs)

    def delayed(self, delay: int | Sequence[int]) -> Model:
        """The model with other delays of its inputs, in whole samples: one number, or one each.

        Example:
            >>> later = model.delayed(3)
            >>> np.allclose(later.simulate(record.u)[3:], model.simulate(record.u)[:-3])
            True
        """
        given = delay if isinstance(delay, Sequence) else (delay,) * len(self.inputs)
        if len(given) != len(self.inputs):
            raise InputError(
                f"delay has {len(given)} numbers, and the model {len(self.inputs)} input(s); give "
                "one for each."
            )
        for one in given:
            integer("delay", one, 0)
        return replace(self, scaler=replace(self.scaler, delay=tuple(int(d) for d in given)))

    def with_delay_line(self) -> Model:
        """The same model whose delays are states after its own, the inputs of the last samples.

        The model itself if it has no delay. Observers and exports, which take a sample at a time,
        are of this model. A model in innovation form keeps its gain K.

        Example:
            >>> whole = model.delayed(3).with_delay_line()
            >>> whole.sizes["nx"], whole.delay
            (4, (0,))
            >>> np.allclose(whole.simulate(record), model.delayed(3).simulate(record))
            True
        """
        if not any(self.delay):
            return self
        whole, K = LFR(delay_line_cell(self.lfr.cell, self.delay)), self.K
        if K is not None:
            K = torch.cat([K, K.new_zeros(sum(self.delay), K.shape[1])])
        scaler = replace(self.scaler, delay=())
        return replace(self, lfr=whole, scaler=scaler, K=K, information=None)

    @property
    def known_states(self) -> int:
        """Number of states of the known model, the first ones; 0 if there is none."""
        known = self.lfr.cell.map.known
        return 0 if known is None else known.nx

    @property
    def state_covariance(self) -> Float[Array, "nx nx"]:
        """Second moment E x xᵀ of the states over the training data, about 0.

        If such data begin at an unknown state, it is the covariance of the error of x = 0. The
        states are those of the simulation or, for a model with K, of the prediction. The diagonal
        is 1 after a fit; before a fit the matrix is the identity.

        Example:
            >>> model.state_covariance
            array([[1.]])
        """
        return self.lfr.cell.state_covariance.double().cpu().numpy()

    def reaching(self, records: Record | Sequence[Record]) -> Model:
        """The model with the reach of these data: the ranges of u, y and the simulated z.

        Models from ``lfrtorch.identify`` have the reach of their estimation data. Exports and
        ``lfrtorch.analysis.linearise`` use it to tell where the model extrapolates.

        Example:
            >>> model.reaching(record).reach.u.round(1).tolist() == [
            ...     [record.u.min().round(1), record.u.max().round(1)]
            ... ]
            True
        """
        given = as_records(records)
        z = np.concatenate([self.signals(record).z[0].double().numpy() for record in given])
        with np.errstate(over="ignore"):
            if not np.isfinite(np.sum(z**2)):
                return replace(self, reach=None)
        u, y = (np.concatenate([part(r) for r in given]) for part in (_inputs, inside_limits))
        return replace(self, reach=DataReach.of(u, y, z))

    def outside(self, u: Float[Array, " nu"], x: Float[Array, " nx"]) -> str:
        """Parts of u (physical units) and x outside the data, in words; empty if none are.

        Example:
            >>> model.reaching(record).outside(np.zeros(1), np.zeros(1))
            ''
        """
        if self.reach is None:
            return ""
        cell, s = double(self.lfr.cell), self.scaler
        v, state = (torch.as_tensor(part) for part in ((u - s.u_offset) / s.u_scale, x))
        with torch.no_grad():
            y, z = s.restore_y(cell(v, state)[0].numpy()), cell.internal(v, state)[0].numpy()
        return self.reach.outside(u, y, z, self.inputs, self.outputs)

    @property
    def parameter_count(self) -> int:
        """Number of parameters P, without held entries."""
        cell = self.lfr.cell
        held = sum(int(mask.sum()) for mask in cell.held.values())
        return sum(p.numel() for p in cell.parameters()) - held

    @property
    def net_parameter_count(self) -> int:
        """P minus the number of gauge directions, which change parameters but not the output.

        The gauge directions are nx² for the coordinates of x, nz² and nw² for those of z and w (a
        network and a polynomial absorb them), max(0, nw - ny) for a constant w that shifts the
        origin of the state, and nz nw for the linear terms of a polynomial, which A, Bu, Cy and Dyu
        contain as well. Held entries leave fewer directions. If only n < nz signals enter z (the
        inputs, or the states without feedthrough), the map counts as a map with n inputs.
        """
        cell = self.lfr.cell
        shapes = {"Cz": (cell.nz, cell.nx), "Dzu": (cell.nz, cell.nu)}
        none = {name: torch.zeros(shape, dtype=torch.bool) for name, shape in shapes.items()}
        first_z = 0 if cell.map.known is None else cell.map.known.nz
        fed = sum(
            int((~cell.held.get(name, none[name])[first_z:]).any(dim=0).sum()) for name in none
        )
        learned = cell.map.learned
        beside = cell.ny if cell.map.known is None else None
        hidden = learned.redundant(fed, beside) - StaticMap.redundant(learned, fed)
        return self.parameter_count - free_directions(cell) - hidden

    @typed("data")
    def simulate(
        self,
        data: Record | ArrayLike | DataFrame,
        *,
        start: Start | None = None,
        x0: ArrayLike | None = None,
    ) -> Array:
        """Simulated output in physical units.

        Args:
            data: a record, an input in physical units, or a pandas data frame with a column for
                each input name; for a frame, the result is a frame with the same index.
            start: ``"zero"`` (x = 0: at rest at the input's offset, up to the network's bias),
                ``"given"`` (x0), ``"periodic"``, ``"measured"``: from the state determined by the
                record's first output, or ``"estimated"``: from the most probable state, given the
                record's output in the samples it skips, or in all if it skips none.
                Default: the record's own, and ``"zero"`` for a bare input.
            x0: initial state in the model's coordinates, for ``start="given"``.

        Shape:
            data: (T, nu) or (T,), x0: (nx,) -> (T, ny).

        Raises:
            ValueError: an input of the wrong shape, rate or with NaN or infinite samples.

        Example:
            >>> model.simulate(record).shape
            (400, 1)
            >>> model.simulate(np.zeros(50)).shape  # any input, from x = 0
            (50, 1)
        """
        signals = self._inputs_of(data) if is_frame(data) else cast("Record | ArrayLike", data)
        y = self.signals(signals, start=start, x0=x0).y[0].double().numpy()
        y = self.scaler.restore_y(y)
        if is_frame(data):
            return framed(y, [channel.name for channel in self.outputs], data)
        return data.shown(y) if isinstance(data, Record) else y

    def _inputs_of(self, frame: Any) -> Array:
        """Inputs among the columns of a frame."""
        check_index(frame, self.fs)
        wanted = [channel.name for channel in self.inputs]
        return columns_of(frame, places_of(frame, wanted, "model's inputs"))

    def signals(
        self, data: Record | ArrayLike, *, start: Start | None = None, x0: ArrayLike | None = None
    ) -> Trajectory:
        """All signals x, z, w, y of the simulation, normalised, on the CPU, with R = 1.

        Example:
            >>> trajectory = model.signals(record)
            >>> trajectory.x.shape, trajectory.z.shape  # (records, samples and one more, nx) and nz
            (torch.Size([1, 401, 1]), torch.Size([1, 400, 1]))
        """
        if isinstance(data, Record):
            self.check(data)
            u, start = data.u, start or data.start
            x0 = data.x0 if x0 is None and start == "given" else x0
        else:
            u, start = as_signal(data, self.inputs, "input"), start or "zero"
        check_start(start, "simulation")
        if start == "given" and x0 is None:
            raise InputError("start='given' needs a start state: pass x0.")
        like, s = self.lfr.cell.A, self.scaler
        v = s.normalise_u(shifted(u, s.delay, s.u_offset, start))
        v, state = torch.as_tensor(v).to(like).unsqueeze(0), None
        if x0 is not None:
            given = reals("x0", x0).ravel()
            if len(given) != self.lfr.cell.nx:
                raise InputError(f"x0 has {len(given)} entries; the model has {self.lfr.cell.nx}.")
            if not np.isfinite(given).all():
                raise InputError("x0 has NaN, infinite or masked entries; give finite numbers.")
            state = torch.tensor(given).to(like).reshape(1, -1)
        if start in ("estimated", "measured"):
            if not isinstance(data, Record):
                raise InputError(f"start='{start}' needs a record, whose y determines the state.")
            trajectory = simulate_record(self.lfr, s.normalise(data, start), start)
        else:
            trajectory = self.lfr.trajectory(v, state, start)
        return Trajectory(*(signal.cpu() for signal in trajectory))

    @typed()
    def predict(self, record: Record, *, horizon: int = 1) -> Array:
        """Output (T, ny) predicted ``horizon`` samples ahead, in physical units.

        The prediction of a sample uses the inputs up to it, and the outputs up to ``horizon``
        samples before it. The first ``horizon`` samples are simulated instead. A model
        without K predicts from the single output ``horizon`` samples before, which must determine
        its states: the start of its records is ``"measured"``.

        Args:
            record: inputs and measured outputs.
            horizon: 1 is the next sample.

        Raises:
            ValueError: a model without K, a record of other channels or another rate, or a horizon
                below 1.

        Example:
            >>> linear = lfrtorch.estimate_bla(record, nx=1, refine="prediction")
            >>> started = lfrtorch.initialise(linear, record, nz=1, nw=1, nn=4)
            >>> started.predict(record, horizon=5).shape
            (400, 1)
            >>> np.allclose(started.predict(record), linear.predict(record))  # without a fit
            True
        """
        integer("horizon", horizon, 1)
        self.check(record)
        if self.K is None and record.start == "measured":
            first = self.ahead(record[: horizon + 1], min(horizon, record.samples - 1))[0]
            later = self.ahead(record, horizon)[:, -1] if record.samples > horizon else first[:0]
            return record.shown(np.concatenate([record.y[:1], first[:-1], later]))
        states = self.predictor().signals(with_past_outputs(record)).x[0, :-1]
        cell, T = self.lfr.cell, record.samples
        u = torch.as_tensor(self.scaler.normalise(record).u).to(cell.A)
        x, y = states.to(cell.A), cell.A.new_empty(T, cell.ny)
        with torch.no_grad():
            for ahead in range(min(horizon, T)):  # x has the states predicted so far
                y[ahead:], after = cell(u[ahead:], x)
                x = after[:-1]
        return record.shown(self.scaler.restore_y(y.double().cpu().numpy()))

    def ahead(self, record: Record, horizon: int) -> Array:
        """Outputs predicted 1 to ``horizon`` samples ahead of every sample, in physical units.

        Each prediction begins in the state determined by the output of its sample, and uses the
        inputs that follow.

        Shape:
            (T - horizon, horizon, ny), not finite where the model diverges.

        Raises:
            ValueError: a record that is no longer than the horizon, of other channels or rate.

        Example:
            >>> model.ahead(record, 5).shape
            (395, 5, 1)
        """
        integer("horizon", horizon, 1)
        self.check(record)
        if record.samples <= horizon:
            raise InputError(
                f"record '{record.name}' has {record.samples} samples and horizon is {horizon}; "
                "give a longer record or a shorter horizon."
            )
        cell, normalised = double(self.lfr.cell).cpu(), self.scaler.normalise(record)
        u, y = (torch.as_tensor(signal) for signal in (normalised.u, normalised.y))
        windows = u.unfold(0, horizon + 1, 1).mT
        found = []
        for first in range(0, len(windows), _TOGETHER):
            part = windows[first : first + _TOGETHER].contiguous()
            x0 = measured_start(cell, part[:, 0], y[first : first + len(part)])
            found.append(simulate(cell, part, x0).y[:, 1:].numpy())
        return self.scaler.restore_y(np.concatenate(found))

    @overload
    def observer(
        self, *, after: Record | None = None, x0: ArrayLike | None = None
    ) -> SteadyGainObserver: ...

    @overload
    def observer(
        self,
        *,
        noise: NoiseCovariance,
        disturbance: Disturbance | None = None,
        after: Record | None = None,
        x0: ArrayLike | None = None,
        P0: ArrayLike | None = None,
    ) -> ExtendedKalmanFilter: ...

    @typed()
    def observer(
        self,
        *,
        noise: NoiseCovariance | None = None,
        disturbance: Disturbance | None = None,
        after: Record | None = None,
        x0: ArrayLike | None = None,
        P0: ArrayLike | None = None,
    ) -> StateObserver:
        """Observer that estimates the states of a running system, sample by sample.

        If ``noise`` is given, it is an extended Kalman filter, for any model. Otherwise it uses the
        constant gain K, which a model in innovation form has.

        Args:
            noise: covariances of the noise on states and outputs. Default: the gain K.
            disturbance: also estimate unmeasured constant disturbances, such as a load, on the
                ``"input"``, the ``"output"``, or by a matrix, see ``with_disturbance``. Offset-free
                control needs such estimates. Default: none.
            after: measurements until now; the states continue from the end of this record. A
                filter begins at its first sample, with x = 0 and P0.
            x0: initial states without ``after``, in the model's coordinates. Default: 0.
            P0: covariance of the error of a filter's initial states, their variances, or one
                variance. Default: ``state_covariance``, which suits data like those of the fit.

        Raises:
            ValueError: neither K nor noise, invalid covariances, both a record and a state, a
                record of other channels or another rate, or a disturbance without noise or that is
                not detectable from the outputs.

        Example:
            >>> linear = lfrtorch.estimate_bla(record, nx=1, refine="prediction")
            >>> started = lfrtorch.initialise(linear, record, nz=1, nw=1, nn=4)
            >>> observer = started.observer(after=record[:100])
            >>> np.allclose(observer.predict(record.u[100]), started.predict(record[:101])[100])
            True
        """
        if after is not None:
            if x0 is not None:
                raise InputError("after and x0 both set the initial states; give only one of them.")
            self.check(after)
        if any(self.delay):
            return self._observer_of_line(noise, disturbance, after, x0, P0)
        known = self.lfr.cell, self.scaler, self.inputs, self.outputs
        begin = np.zeros(self.lfr.cell.nx) if x0 is None else x0
        if noise is not None:
            nd = 0
            if disturbance is not None:
                whole, noise = self.with_disturbance(disturbance, noise)
                nd = whole.lfr.cell.nx - self.lfr.cell.nx
                known = whole.lfr.cell, *known[1:]
                begin = np.append(reals("x0", begin), np.zeros(nd))
                if P0 is not None:
                    P0 = with_variances(
                        "P0", P0, np.diag(whole.state_covariance)[-nd:], self.lfr.cell.nx
                    )
            found = ExtendedKalmanFilter(*known, begin, noise, P0, nd)
            if after is not None:
                found.follow(after.u, inside_limits(after))
            return found
        if disturbance is not None:
            raise InputError(
                "a disturbance is estimated by a Kalman filter: give noise, too, for example "
                "noise=lfrtorch.estimate_noise(model, record)."
            )
        if self.K is None:
            raise InputError(NO_OBSERVER)
        if after is not None:
            begin = self.predictor().signals(with_past_outputs(after)).x[0, -1].double().numpy()
        return SteadyGainObserver(*known, begin, self.K)

    def _observer_of_line(
        self,
        noise: NoiseCovariance | None,
        disturbance: Disturbance | None,
        after: Record | None,
        x0: ArrayLike | None,
        P0: ArrayLike | None,
    ) -> StateObserver:
        """Observer of the states and of the delay line, whose inputs are known without noise."""
        whole, nx, line = self.with_delay_line(), self.lfr.cell.nx, np.zeros(sum(self.delay))
        if x0 is not None:
            x0 = np.append(reals("x0", x0), line)
        if noise is None:
            return whole.observer(after=after, x0=x0)
        P0 = None if P0 is None else with_variances("P0", P0, line, nx)
        noise = noise.extended(line, nx)
        return whole.observer(noise=noise, disturbance=disturbance, after=after, x0=x0, P0=P0)

    @typed()
    def with_disturbance(
        self, at: Disturbance, noise: NoiseCovariance
    ) -> tuple[Model, NoiseCovariance]:
        """Model with constant disturbances as states, and the noise of all its states.

        The states are x, then d in physical units: u + Eu d replaces u, and Ey d is added to y. The
        model may be exported with its observer. A controller that predicts with this model, from
        estimates of x and d, has no offset.

        Args:
            at: ``"input"``, a disturbance on each input; ``"output"``, a disturbance on each
                output; or the matrix [Eu; Ey] with a row for each input, then each output, and a
                column for each disturbance.
            noise: covariances of the model's noise. Unless Q includes the disturbances, they drift
                in the slowest time constant by a tenth of their channel's scale, rms.

        Shape:
            at: (nu + ny, nd).

        Raises:
            ValueError: a matrix of another size, or disturbances that are not detectable from the
                outputs at rest: more disturbances than outputs, for example.

        References:
            Pannocchia and Rawlings, "Disturbance models for offset-free model-predictive control",
            AIChE Journal 49(2), 2003.

        Example:
            >>> noise = lfrtorch.NoiseCovariance(Q=1e-4, R=1e-2)
            >>> disturbed, all_noise = model.with_disturbance("input", noise)
            >>> disturbed.sizes["nx"], np.shape(all_noise.Q)
            (2, (2, 2))
            >>> observer = model.observer(noise=noise, disturbance="input")
            >>> e = observer.correct(0.3, u=0.5)
            >>> observer.state.shape, observer.disturbance.shape
            ((1,), (1,))
        """
        if any(self.delay):
            line = np.zeros(sum(self.delay))
            noise = noise.extended(line, self.lfr.cell.nx)
            return self.with_delay_line().with_disturbance(at, noise)
        cell, scaler = double(self.lfr.cell), self.scaler
        nu, ny, nx = cell.nu, cell.ny, cell.nx
        E = self._entries(at)
        nd = E.shape[1]
        whole = disturbed_cell(cell, E, scaler)
        at_rest = equilibrium(cell, cell.A.new_zeros(nu))
        x = cell.A.new_zeros(nx + nd)
        if at_rest is not None:
            x[:nx] = at_rest
        local = linearised_at(whole, cell.A.new_zeros(nu), x)
        if not tells_apart(local, nx):
            raise InputError(
                f"the {ny} output(s) at rest do not distinguish {nd} disturbance(s) and the "
                "states; give a matrix with fewer disturbances."
            )
        if np.shape(noise.Q) != (nx + nd, nx + nd):
            moduli = np.abs(np.linalg.eigvals(local.A[:nx, :nx]))
            drift = drift_variance(moduli, disturbance_scale(E, scaler))
            noise = noise.extended(drift, nx)
        return replace(self, lfr=LFR(whole), K=None), noise

    def resample(self, fs: float) -> Resampled:
        """The model at another sampling rate, with inputs that are held over a sample.

        The model linearised at rest is resampled exactly, by the logarithm of its matrices. The
        static map is evaluated at the new samples, so the models differ away from rest; ``error``
        is the rms of the difference. The gain K of a noise model is dropped.

        Args:
            fs: new sampling rate in Hz.

        Raises:
            ValueError: an invalid rate, or a pole at 0 or on the negative real axis, which no
                continuous system has.

        References:
            Franklin, Powell and Workman, "Digital Control of Dynamic Systems", 1998, chapter 4.

        Example:
            >>> faster = model.resample(4 * model.fs)
            >>> faster.model.fs, bool(faster.error[0] < 0.02 * record.y.std())
            (400.0, True)
        """
        check_rate("fs", fs)
        cell = double(self.lfr.cell)
        rest = equilibrium(cell, cell.A.new_zeros(cell.nu))
        x = cell.A.new_zeros(cell.nx) if rest is None else rest
        z = cell.internal(cell.A.new_zeros(cell.nu), x)[0]
        K = static_slope(cell, z[None, None])[0, 0].detach().numpy()
        made = LFR(resampled_cell(cell, K, self.fs / fs))
        other = replace(self, lfr=made, fs=fs, K=None)
        other = other.delayed([round(one * fs / self.fs) for one in self.delay])
        # Both models simulate the same input, held over the samples of both.
        slow, fast = sorted([fs, self.fs])
        ratio = Fraction(fast / slow).limit_denominator(_COMMON)
        ratio = 1 / ratio if fs < self.fs else ratio
        steps = np.random.default_rng(0).uniform(-1.0, 1.0, (_STEPS, cell.nu))
        ends = self.scaler.u_scale * np.sqrt(3.0)
        levels = np.repeat(self.scaler.u_offset + ends * steps, _HELD, axis=0)
        if self.reach is not None:
            levels = np.clip(levels, *self.reach.u.T)
        old, new = (
            one.simulate(np.repeat(levels, n, axis=0))[::n]
            for one, n in ((self, ratio.denominator), (other, ratio.numerator))
        )
        return Resampled(other, np.sqrt(np.mean((new - old) ** 2, axis=0)))

    def _entries(self, at: Disturbance) -> Float[Array, "n nd"]:
        """Matrix [Eu; Ey] of disturbances."""
        nu, ny = len(self.inputs), len(self.outputs)
        named = {"input": np.eye(nu + ny, nu), "output": np.eye(nu + ny)[:, nu:]}
        if isinstance(at, str):
            if at not in named:
                raise InputError(f"disturbance is '{at}'; give 'input', 'output' or a matrix.")
            return named[at]
        E = reals("disturbance", at)
        E = E[:, None] if E.ndim == 1 else E
        if E.ndim != 2 or len(E) != nu + ny or not (np.isfinite(E).all() and E.any(axis=0).all()):
            raise InputError(
                f"disturbance has the shape {E.shape}; give 'input', 'output', or {nu + ny} rows "
                f"of finite numbers, for {listed(self.inputs)}, {listed(self.outputs)}, "
                "and a column for each disturbance, not all 0."
            )
        return E

    def to_model(self) -> Model:
        """Return the model itself, for code that also takes linear models.

        Example:
            >>> model.to_model() is model
            True
        """
        return self

    def predictor(self) -> Model:
        """One-step predictor of the output as a model; its inputs are u, then y.

        Raises:
            ValueError: a model without K.

        Example:
            >>> linear = lfrtorch.estimate_bla(record, nx=1, refine="prediction")
            >>> started = lfrtorch.initialise(linear, record, nz=1, nw=1, nn=4)
            >>> started.predictor()
            Model(u, y -> y, 100 Hz, nx=1, nz=1, nw=1, nn=4)
        """
        if self.K is None:
            raise InputError(
                "this model has no innovation gain K: fit it with noise='innovation', from a start "
                "with the linear model of estimate_bla(..., refine='prediction')."
            )
        s = self.scaler
        offset = np.concatenate([s.u_offset, s.y_offset])
        scale = np.concatenate([s.u_scale, s.y_scale])
        later = s.delay and (*s.delay, *(0,) * len(self.outputs))
        scaler = Scaler(offset, scale, s.y_offset, s.y_scale, later)
        cell = predictor_cell(self.lfr.cell, self.K)
        inputs = (*self.inputs, *self.outputs)
        return replace(self, lfr=LFR(cell), scaler=scaler, inputs=inputs, K=None)

    def innovation_form(self) -> Model:
        """Model of the system, with K, from its predictor; the inverse of ``predictor``.

        Example:
            >>> linear = lfrtorch.estimate_bla(record, nx=1, refine="prediction")
            >>> started = lfrtorch.initialise(linear, record, nz=1, nw=1, nn=4)
            >>> again = started.predictor().innovation_form()
            >>> np.allclose(again.simulate(record), started.simulate(record))
            True
        """
        cell, K = split_predictor(self.lfr.cell)
        nu, s = cell.nu, self.scaler
        scaler = Scaler(s.u_offset[:nu], s.u_scale[:nu], s.y_offset, s.y_scale, s.delay[:nu])
        return replace(self, lfr=LFR(cell), scaler=scaler, inputs=self.inputs[:nu], K=K)

    def check(self, record: Record) -> None:
        """Refuse a record of other channels or another rate with a ValueError.

        Example:
            >>> try:
            ...     model.check(lfrtorch.Record(record.u, record.y, fs=50.0))
            ... except lfrtorch.InputError as error:
            ...     print(error)
            record 'record' is sampled at 50.0 Hz and the model at 100.0 Hz; resample the record.
        """
        for side, signal, channels in (
            ("input", record.u, self.inputs),
            ("output", record.y, self.outputs),
        ):
            if signal.shape[1] != len(channels):
                names = ", ".join(channel.name for channel in channels)
                raise InputError(
                    f"record '{record.name}' has {signal.shape[1]} {side}(s), but the model has "
                    f"{len(channels)} ({names}); give a column for each."
                )
        if record.x0 is not None and len(record.x0) != self.lfr.cell.nx:
            raise InputError(
                f"record '{record.name}' has a start state x0 of {len(record.x0)} entries, but the "
                f"model has {self.lfr.cell.nx} states; give an entry for each."
            )
        if not np.isclose(record.fs, self.fs):
            raise InputError(
                f"record '{record.name}' is sampled at {record.fs} Hz and the model at {self.fs} "
                "Hz; resample the record."
            )

    def save(self, folder: str | Path) -> Path:
        """Write the checkpoint folder; ``lfrtorch.load`` reads it back to the same bits.

        Example:
            >>> folder = model.save("model")
            >>> again = lfrtorch.load(folder)
            >>> np.array_equal(again.simulate(record), model.simulate(record))
            True
        """
        return write_model(folder, self)


@typed()
def simulate_blocks(
    model: Model, blocks: Iterable[ArrayLike], *, x0: ArrayLike | None = None
) -> Iterator[Array]:
    """Simulate an input block by block, with the same output as in one simulation.

    The output is bit-identical if the model runs compiled on the CPU (linear, ``Network`` or
    ``Polynomial``), otherwise equal up to rounding. Only one block is in memory at a time.

    Args:
        model: the model to simulate; for a linear one, ``LinearModel.to_model`` gives it.
        blocks: the input in physical units, as blocks of any lengths.
        x0: initial state in the model's coordinates. Default: 0. The initial state of a measured
            record is ``model.signals(record, start="estimated").x[0, 0]``.

    Shape:
        blocks: (n, nu) or (n,), x0: (nx,) -> (n, ny) for each block, physical units.

    Raises:
        ValueError: when a block has the wrong shape or NaN, or the model diverges in it; the
            message gives the sample of the whole input.

    Example:
        >>> blocks = [record.u[:150], record.u[150:]]
        >>> y_hat = np.concatenate(list(lfrtorch.simulate_blocks(model, blocks)))
        >>> np.array_equal(y_hat, model.simulate(record.u))
        True
    """
    # States stay in float64 from block to block; signals have the dtype of the model.
    cell, scaler, like = double(model.lfr.cell), model.scaler, model.lfr.cell.A
    first, state = 0, torch.zeros(1, cell.nx, dtype=torch.float64)
    if x0 is not None:
        state = model.signals(np.zeros((1, cell.nu)), start="given", x0=x0).x[:, 0].double()
    delay, past = model.delay, None
    for block in blocks:
        u = as_signal(block, model.inputs, "input", first=first)
        if past is None:  # as for one simulation
            past = np.tile(scaler.u_offset if x0 is None else u[0], (max(delay), 1))
        since = np.concatenate([past, u])
        past = since[len(u) :]
        later = [since[len(past) - d :, j][: len(u)] for j, d in enumerate(delay)]
        v = torch.as_tensor(scaler.normalise_u(np.stack(later, 1))).to(like).unsqueeze(0)
        trajectory = simulate(cell, v.cpu().double(), state)
        y = scaler.restore_y(trajectory.y[0].to(like.dtype).double().numpy())
        lost = ~np.isfinite(y).all(axis=1)
        if lost.any():
            raise InputError(
                f"the model diverges: its output is not finite at sample {first + lost.argmax()}; "
                "are the inputs in its units, and no louder than those that it was fitted to?"
            )
        yield y
        first, state = first + len(u), trajectory.x[:, -1]


def state_moment(model: Model, records: Record | Sequence[Record]) -> Float[Tensor, "nx nx"]:
    """Return E x xᵀ of the simulated states over all samples of records, about 0, in float64."""
    nx, samples = model.lfr.cell.nx, 0
    total = torch.zeros(nx, nx, dtype=torch.float64)
    for record in as_records(records):
        x = model.signals(record).x[0].double()
        total, samples = total + x.mT @ x, samples + len(x)
    return (total + total.mT) / (2 * samples)


def write_model(
    folder: str | Path,
    model: Model,
    about: Mapping[str, Any] | None = None,
    known: Mapping[str, Tensor] | None = None,
) -> Path:
    """Write the checkpoint of a model; ``about`` and ``known`` are further data of a linear one."""
    cell, s = model.lfr.cell, model.scaler
    description = {
        "sizes": {"nu": cell.nu, "ny": cell.ny, "nx": cell.nx, "nz": cell.nz, "nw": cell.nw},
        "static": cell.map.describe(),
        "dtype": str(cell.A.dtype).removeprefix("torch."),
        "fs": model.fs,
        "inputs": [c._asdict() for c in model.inputs],
        "outputs": [c._asdict() for c in model.outputs],
    }
    description |= {"fitted_to": model.fitted_to} if model.fitted_to else {}
    description |= {"delay": model.delay} if any(model.delay) else {}
    description |= {} if about is None else {"linear": dict(about)}
    weights = dict(cell.state_dict())
    weights |= {f"scaler.{name}": torch.tensor(getattr(s, name)) for name in SCALING}
    weights |= {f"fixed.{name}": mask.to(cell.A) for name, mask in cell.held.items()}
    weights |= {f"linear.{name}": tensor for name, tensor in (known or {}).items()}
    if model.K is not None:
        weights["K"] = model.K
    if model.reach is not None:
        weights |= {f"reach.{name}": torch.tensor(v) for name, v in _flat(model.reach).items()}
    if model.information is not None:
        told = vars(model.information)
        weights |= {f"information.{name}": torch.as_tensor(value) for name, value in told.items()}
    return checkpoint.write(folder, description, weights)


def _flat(reach: DataReach) -> dict[str, Array]:
    """Arrays of a reach, for a checkpoint."""
    return {"u": reach.u, "y": reach.y, **{k: np.asarray(v) for k, v in vars(reach.z).items()}}


def _inputs(record: Record) -> Array:
    return record.u


def check_channels(model: Model, record: Record) -> None:
    """Raise a ValueError if channels are not those of the model; unknown units are accepted."""
    for side, channels, found in (
        ("inputs", model.inputs, record.inputs),
        ("outputs", model.outputs, record.outputs),
    ):
        alike = [
            own.name == other.name and (own.unit == other.unit or not (own.unit and other.unit))
            for own, other in zip(channels, found, strict=False)
        ]
        if len(channels) != len(found) or not all(alike):
            raise InputError(
                f"the model has the {side} {', '.join(map(str, channels))}, but the data have "
                f"{', '.join(map(str, found))}; give data of the same channels."
            )
