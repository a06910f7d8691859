"""Records of input and output signals, and the scaling between physical and normalised units.

A :class:`Record` has numpy arrays in physical units; inside the engine signals are torch tensors in
normalised units. ``_support/types.py`` has the letters of all axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfrtorch._support.checks import integer, number, reals
from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.frames import columns_of, index_grid, is_frame, places_of
from lfrtorch._support.headers import names_and_units
from lfrtorch._support.types import Array, Booleans

Start = Literal["zero", "given", "estimated", "periodic", "measured"]

_SMALLEST = 1e-100
"""Smallest level of a signal, and sampling frequency, whose square does not vanish."""

_LARGEST = 1e100
"""Largest level of a signal, and sampling frequency, whose square does not overflow."""

PAST_OUTPUTS = "a prediction from past outputs (noise=innovation or both)"  # in messages


class Channel(NamedTuple):
    """Name and unit of one signal.

    Example:
        >>> print(lfrtorch.Channel("force", "N"))
        force (N)
    """

    name: str
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.name} ({self.unit})" if self.unit else self.name


def described_channels(entries: Any) -> tuple[Channel, ...]:
    """Describe channels for a JSON file."""
    found = tuple(Channel(**entry) for entry in entries)
    if not all(isinstance(text, str) for channel in found for text in channel):
        raise TypeError("a name or a unit of a channel is not text")
    return found


def common_unit(channels: Sequence[Channel]) -> str:
    """Return the common unit of all channels; empty if they differ."""
    units = {channel.unit for channel in channels}
    return units.pop() if len(units) == 1 else ""


def of_one_unit(channels: Sequence[Channel]) -> bool:
    """Tell if all channels have the same unit; errors of different units add up relatively only.

    A channel without a unit differs from a channel with one.
    """
    return len({channel.unit for channel in channels}) == 1


@dataclass(frozen=True, eq=False)
class Record:
    """Measurement: input, output, and their use in simulations and scores.

    Args:
        u, y: input and output, physical units. A one-dimensional array is one channel.
        fs: sampling frequency in Hz.
        start: ``"zero"`` simulates from x = 0 (near rest at the input's offset), ``"given"`` from
            ``x0``. ``"estimated"`` fits the initial state, too: in a fit together with the
            parameters; in a simulation to the skipped samples alone, or to all if none is skipped.
            ``"measured"`` computes the states from the first output; states that it does not
            determine are at rest. ``"periodic"``: the record is a whole number of periods in steady
            state.
        skip: samples at the beginning that are left out of cost and score. Default for an estimated
            start: a score leaves out the first 50, or the first fifth of a shorter record.
        x0: the given start state, in the coordinates of the model.
        weight: factor of the squared normalised errors in a fit, one number or one for each output.
        line_weight: factors of the squared errors in a fit by spectral line, for whole periods
            without ``skip``: line f is that of ``numpy.fft.rfft``. 1 for all lines is plain least
            squares; 1 / noise variance is maximum likelihood (Pintelon and Schoukens, 2012,
            chapter 9).
        limits: smallest and largest output that the sensors show, each a number for all outputs or
            one for each, or ``None``. A sample at a limit means that the output is there or beyond:
            a fit counts errors on the inner side alone, and an estimated start leaves the sample
            out. A simulation of the record is clipped to the limits.
        source: ``"official"``, ``"simulated"``, ``"stand-in"`` or ``"file"``, the origin.
        inputs, outputs: channel names and units, one for each column of ``u`` and ``y``.
        period: samples of one period of the input, if it repeats; a ``"periodic"`` record holds
            a whole number of them. Default: one.
        reference: noise-free signal of each input, known to the experimenter: the setpoint if a
            controller makes the input, the generator's signal if the input is measured with
            noise. Best linear approximations are estimated from it, see
            :func:`lfrtorch.estimate_frf`.
        valid: mask of the output samples that are measurements: False for outliers and dropouts.
            The model is simulated through them; they are neither fitted nor scored. ``y`` may be
            NaN there, and is interpolated, for figures and for first guesses. Default: all.

    Shape:
        u: (T, nu), y: (T, ny), reference: (T, nu), x0: (nx,), weight: () or (ny,),
        line_weight: (T // 2 + 1,) or (T // 2 + 1, ny), limits: (2, ny), valid: (T,) or (T, ny).

    Raises:
        ValueError: NaN, infinite or masked samples, levels or an ``fs`` beyond 1e-100 to 1e100,
            different lengths, wrong shapes, negative weights, a ``skip`` or a ``valid`` that leaves
            no sample, a measured start from an output that is not valid, a period that does not
            fit, or a reference of other samples or channels than the input.

    Example:
        >>> record = lfrtorch.Record(np.sin(np.arange(100.0)), np.zeros(100), fs=50.0, skip=10)
        >>> record.samples, record.u.shape, str(record.inputs[0])
        (100, (100, 1), 'u')
        >>> record[20:]  # a part is a record, too
        Record('record': u -> y, 80 samples at 50 Hz, start zero)
    """

    u: Array
    y: Array
    fs: float = 1.0
    start: Start = "zero"
    skip: int = 0
    name: str = "record"
    source: str = "file"
    inputs: tuple[Channel, ...] = ()
    outputs: tuple[Channel, ...] = ()
    period: int | None = None
    x0: Array | None = None
    weight: float | Array = 1.0
    line_weight: Array | None = None
    limits: Sequence[ArrayLike | None] | Array | None = None
    reference: Array | None = None
    valid: Booleans | None = None

    def __post_init__(self) -> None:
        inputs, u = _side(self.inputs, self.u, "u", f"record '{self.name}': input")
        outputs, y = _side(self.outputs, self._measured(), "y", f"record '{self.name}': output")
        if len(u) != len(y):
            raise InputError(
                f"record '{self.name}': the input has {len(u)} samples and the output {len(y)}; "
                "both must be sampled at the same instants: cut or resample one of them."
            )
        check_rate(f"record '{self.name}': the sampling frequency", self.fs)
        check_start(self.start, f"record '{self.name}'")
        integer(f"record '{self.name}': skip", self.skip, 0)
        if self.skip >= len(u):
            raise InputError(
                f"record '{self.name}': skip={self.skip} leaves no sample of {len(u)}; "
                "use a smaller skip or a longer record."
            )
        self._check_period(len(u))
        if (self.start == "given") != (self.x0 is not None):
            raise InputError(
                f"record '{self.name}': start is {self.start!r} and x0 is {self.x0}; "
                "a start state goes with start='given', and only with it."
            )
        if self.x0 is not None:
            x0 = reals(f"record '{self.name}': x0", self.x0).reshape(-1).copy()
            if not np.isfinite(x0).all():
                raise InputError(f"record '{self.name}': x0 is {x0}; give finite numbers.")
            object.__setattr__(self, "x0", x0)
        self._check_weights(len(u), y.shape[1])
        self._check_limits(y.shape[1])
        self._check_reference(u)
        for field, value in (("u", u), ("y", y), ("inputs", inputs), ("outputs", outputs)):
            object.__setattr__(self, field, value)
        self._check_valid()

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        fs: float | None = None,
        **options: Any,
    ) -> Record:
        """Make a record from columns of a pandas data frame; outputs without a value are not valid.

        Args:
            frame: rows are samples.
            inputs, outputs: one or several columns by name; "force (N)", with its unit, is also
                called "force".
            fs: sampling frequency in Hz. Default: from an index of date-times, time differences or
                seconds, evenly spaced. If the index is uneven, the signals are interpolated to even
                times of ``fs``; where a few rows are missing, outputs are not valid.
            options: other arguments of a record.

        Raises:
            ValueError: a column that is missing or has no numbers, infinite values, inputs without
                a value, an index that is not an even time, or several runs.

        Example:
            >>> import pandas as pd
            >>> frame = pd.DataFrame({"force (N)": record.u[:, 0], "disp": record.y[:, 0]})
            >>> lfrtorch.Record.from_frame(frame, "force", "disp", fs=100.0)
            Record('record': force (N) -> disp, 400 samples at 100 Hz, start zero)
        """
        if not is_frame(frame):
            raise InputError(f"frame is {brief(repr(frame))}; give a pandas DataFrame.")
        channels = [Channel(*each) for each in names_and_units([*map(str, frame.columns)], {})]
        sides = ("inputs", inputs), ("outputs", outputs)
        places = [places_of(frame, [n] if isinstance(n, str) else n, side) for side, n in sides]
        u, y = (columns_of(frame, each) for each in places)
        for each, signals in zip(places, (u, y), strict=True):
            if np.isinf(signals).any():
                row, i = np.argwhere(np.isinf(signals))[0]
                raise InputError(
                    f"the column {str(frame.columns[each[i]])!r} is infinite in row {row}; correct "
                    "it, or leave it empty, as NaN."
                )
        rate, rows = index_grid(frame, fs, [*places[0], *places[1]])
        u, y = rows.on_grid(u), np.where(rows.missing()[:, None], np.nan, rows.on_grid(y))
        given = {
            side: tuple(channels[i] for i in each)
            for (side, _), each in zip(sides, places, strict=True)
        }
        valid = None if np.isfinite(y).all() else np.isfinite(y)
        return cls(u, y, rate, **given, **{"valid": valid, **options})

    def _measured(self) -> ArrayLike:
        """Output, interpolated where it is not valid."""
        if self.valid is None:
            return self.y
        what = f"record '{self.name}': valid"
        y, valid = reals(f"record '{self.name}': output", self.y), np.asarray(self.valid)
        y = y[:, None] if y.ndim == 1 else y
        if valid.dtype != bool or valid.shape not in (y.shape, y.shape[:1]):
            raise InputError(
                f"{what} has shape {valid.shape} and type {valid.dtype}; give True and False for "
                f"each of the {len(y)} samples, or for each sample of each output."
            )
        valid = np.broadcast_to(valid if valid.ndim == 2 else valid[:, None], y.shape)
        object.__setattr__(self, "valid", None if valid.all() else valid)
        if not valid.any(axis=0).all():
            raise InputError(f"{what} leaves no sample of an output; leave that output out.")
        return interpolated(y, valid)

    def _check_valid(self) -> None:
        """Refuse settings that need every sample to be valid."""
        if self.valid is None:
            return
        if self.start == "periodic" or self.line_weight is not None:
            raise InputError(
                f"record '{self.name}' has outputs that are not valid, and start is "
                f"{self.start!r}: a steady state needs whole periods. Give start='estimated'."
            )
        if self.start == "measured" and not self.valid[0].all():
            raise InputError(
                f"record '{self.name}' has start 'measured', but its first output is not valid; "
                "cut the record to where all outputs are valid, or give start='estimated'."
            )
        if not self.scored.any():
            raise InputError(
                f"record '{self.name}': valid and skip={self.skip} leave no sample; use a smaller "
                "skip or a longer record."
            )

    def _check_period(self, T: int) -> None:
        if self.period is None:
            return
        integer(f"record '{self.name}': period", self.period, 1)
        if self.period > T or (self.start == "periodic" and T % self.period):
            wanted = "it must hold at least one."
            if self.start == "periodic":
                wanted = "a steady-state record holds a whole number of periods: cut it to one."
            raise InputError(
                f"record '{self.name}' has {T} samples and a period of {self.period}; {wanted}"
            )

    def _check_weights(self, T: int, ny: int) -> None:
        weight = reals(f"record '{self.name}': weight", self.weight).copy()
        if weight.shape not in ((), (1,), (ny,)):
            raise InputError(
                f"record '{self.name}': weight has shape {weight.shape}; give one number, or one "
                f"for each of the {ny} output(s)."
            )
        lines = self.line_weight
        if lines is not None:
            given = reals(f"record '{self.name}': line_weight", lines).copy()
            lines = given[:, None] if given.ndim == 1 else given
            F = T // 2 + 1
            if lines.shape not in ((F, 1), (F, ny)):
                raise InputError(
                    f"record '{self.name}': line_weight has shape {given.shape}; "
                    f"{T} samples have {F} lines from 0 to fs / 2: give ({F},) or ({F}, {ny})."
                )
            if self.start != "periodic" or self.skip:
                raise InputError(
                    f"record '{self.name}': line_weight needs start='periodic' and skip=0, not "
                    f"start={self.start!r} and skip={self.skip}."
                )
            lines = np.broadcast_to(lines, (F, ny))
        for name, values in (("weight", weight), ("line_weight", lines)):
            if values is not None:
                if not (np.isfinite(values).all() and (values >= 0).all() and values.any()):
                    raise InputError(
                        f"record '{self.name}': {name} must be finite, at least 0 and not all 0."
                    )
                object.__setattr__(self, name, values)

    def _check_limits(self, ny: int) -> None:
        if self.limits is None:
            return
        if self.line_weight is not None:
            raise InputError(
                f"record '{self.name}' has limits and line_weight; a sample at a limit has no "
                "spectrum: give one of the two."
            )
        try:
            low, high = self.limits
            low, high = -np.inf if low is None else low, np.inf if high is None else high
            limits = np.stack(np.broadcast_arrays(low, high, np.zeros(ny))[:2]).astype(np.float64)
        except (TypeError, ValueError):
            limits = np.zeros((2, ny))
        if limits.shape != (2, ny) or not (limits[0] < limits[1]).all():
            raise InputError(
                f"record '{self.name}': limits is {self.limits!r}; give the least and the greatest "
                "output that the sensors show, as (None, 10), or a number for each output."
            )
        object.__setattr__(self, "limits", limits)

    def _check_reference(self, u: Array) -> None:
        if self.reference is None:
            return
        what = f"record '{self.name}': reference"
        _, r = _side((), self.reference, "r", what)
        if r.shape != u.shape:
            raise InputError(
                f"{what} has shape {r.shape} and the input {u.shape}; give as many samples, and a "
                "reference for each input."
            )
        object.__setattr__(self, "reference", r)

    def __repr__(self) -> str:
        parts = [f"{self.samples} samples at {self.fs:g} Hz", f"start {self.start}"]
        parts += [f"skip {self.skip}"] if self.skip else []
        parts += [f"period {self.period}"] if self.period else []
        parts += ["with reference"] if self.reference is not None else []
        parts += [f"{(~self.valid).sum()} outputs not valid"] if self.valid is not None else []
        return f"Record({self.name!r}: {signals(self)}, {', '.join(parts)})"

    @property
    def is_valid(self) -> Booleans:
        """Mask (T, ny) of the outputs that are measurements."""
        return np.ones(self.y.shape, dtype=bool) if self.valid is None else self.valid

    @property
    def scored(self) -> Booleans:
        """Mask (T, ny) of the outputs that count: valid ones after the skipped samples."""
        return self.is_valid & (np.arange(len(self.y))[:, None] >= self.skip)

    @property
    def scored_samples(self) -> int:
        """Number of samples at which an output counts."""
        return int(self.scored.any(axis=1).sum())

    @property
    def factors(self) -> Array:
        """Factors of the errors (T, ny) in a fit: √weight, 0 if not scored."""
        return np.sqrt(self.weight) * self.scored

    def errors(self, y_hat: Array) -> Array:
        """Errors y - y_hat after the skipped samples (T - skip, ny), 0 where y is not valid."""
        found = (self.y - y_hat)[self.skip :]
        return found if self.valid is None else np.where(self.valid[self.skip :], found, 0.0)

    def require_all_valid(self, what: str) -> None:
        """Refuse samples that are not valid with a ValueError: ``what`` needs all of them."""
        if self.valid is not None:
            raise InputError(
                f"record '{self.name}' has {(~self.valid).sum()} output sample(s) that are not "
                f"valid; {what} needs all of them: cut the record there, or interpolate them."
            )

    @property
    def start_factors(self) -> Array:
        """Factors of the errors for an estimated start of a given model: √weight, 0 if scored."""
        counts = self.is_valid & (self.beyond == 0)
        if self.skip:
            counts = counts & (np.arange(len(self.y))[:, None] < self.skip)
        return np.sqrt(self.weight) * counts

    @property
    def beyond(self) -> Array:
        """Direction in which the output (T, ny) may be beyond a limit: 1 up, -1 down, 0 inside."""
        if self.limits is None:
            return np.zeros(self.y.shape)
        low, high = np.asarray(self.limits)
        return (self.y >= high) * 1.0 - (self.y <= low)

    def shown(self, y: Array) -> Array:
        """Clip an output (T, ny) to the limits of the sensors."""
        return y if self.limits is None else np.clip(y, *np.asarray(self.limits))

    @property
    def samples(self) -> int:
        """Number of samples T, the skipped ones included."""
        return len(self.u)

    def __getitem__(self, window: slice) -> Record:
        """Return the part of the record in ``window``, with start ``"zero"`` and nothing skipped.

        A part of a record whose start is measured has a measured start, too.
        """
        if not isinstance(window, slice) or window.step not in (None, 1):
            raise InputError(f"a record is cut by record[first:last], not by {window!r}.")
        if self.line_weight is not None:
            raise InputError(
                f"record '{self.name}' has line_weight, and a part of it has other lines; cut "
                "replace(record, line_weight=None), and give the part weights of its own."
            )
        period = self.period
        if period is not None and period > len(self.u[window]):
            period = None
        start = "measured" if self.start == "measured" else "zero"
        return self.part(window, start=start, skip=0, period=period, x0=None)

    def part(
        self,
        window: slice | NDArray[np.integer],
        *,
        start: Start,
        skip: int,
        period: int | None,
        **others: Any,
    ) -> Record:
        """Return some samples of the record with their start; ``others`` are other fields."""
        return self.with_signals(
            **self.signals_in(window), limits=self.limits, start=start, skip=skip, period=period,
            **others,
        )  # fmt: skip

    def with_signals(
        self,
        *,
        u: Array,
        y: Array,
        reference: Array | None,
        valid: Booleans | None,
        limits: Sequence[ArrayLike | None] | Array | None,
        start: Start,
        skip: int,
        period: int | None,
        **others: Any,
    ) -> Record:
        """Return a record of the same kind with other signals; ``others`` are other fields.

        Every field that depends on the signals is an argument, so that none is kept by mistake.
        """
        return replace(
            self, u=u, y=y, reference=reference, valid=valid, limits=limits, start=start, skip=skip,
            period=period, **others,
        )  # fmt: skip

    def delayed(self, delay: Sequence[int], level: Array, start: Start | None = None) -> Record:
        """Return the record with each input later by whole samples, and as many samples.

        Inputs before the first sample are at their ``level`` (nu,) for a start at rest, repeat in
        steady state, and equal the first one otherwise. An estimated start leaves out the outputs
        that unknown inputs act on. ``start`` replaces that of the record.
        """
        start, longest = start or self.start, max(delay, default=0)
        if not longest:
            return self
        u, reference = (
            None if signal is None else shifted(signal, delay, level, start)
            for signal in (self.u, self.reference)
        )
        known = self.is_valid & (np.arange(len(self.y))[:, None] >= longest)
        masked = start == "estimated" and known[self.skip :].any(axis=0).all()
        return replace(self, u=u, reference=reference, valid=known if masked else self.valid)

    def mean_period(self) -> Record:
        """Return one period: the mean of all P periods of a record in steady state, with weight P.

        A fit of the simulation error gives the same model if the input has no noise, and is faster.
        Noise of the input keeps 1 / P of its power in the mean, and 1 / P of its bias in a model.

        Example:
            >>> from dataclasses import replace
            >>> halves = replace(record, period=200).mean_period()
            >>> halves.samples, halves.weight, halves.start
            (200, array(2.), 'periodic')
        """
        if self.start != "periodic":
            raise InputError(
                f"record '{self.name}': start is {self.start!r}; mean_period is for whole periods "
                "in steady state: start='periodic'."
            )
        N = self.period or self.samples
        P = self.samples // N
        means: dict[str, Any] = {
            name: None if signal is None else signal.reshape(P, N, -1).mean(axis=0)
            for name, signal in self.signals_in(slice(None)).items()
        }
        lines = None if self.line_weight is None else self.line_weight[::P]
        weight = P * np.asarray(self.weight)
        return self.with_signals(
            **means, limits=None, start="periodic", skip=0, period=self.period, weight=weight,
            line_weight=lines,
        )  # fmt: skip

    def joined(self, other: Record) -> Record:
        """Append the scored samples of another record that continues this one."""
        here, there = (
            record.signals_in(slice(first, None)) | {"valid": record.is_valid[first:]}
            for record, first in ((self, 0), (other, other.skip))
        )
        both: dict[str, Any] = {
            name: None if one is None or there[name] is None else np.concatenate([one, there[name]])
            for name, one in here.items()
        }
        return self.with_signals(
            **both, limits=self.limits, start=self.start, skip=self.skip, period=self.period
        )

    def signals_in(self, window: slice | NDArray[np.integer]) -> dict[str, Any]:
        """Return the signals in ``window`` by name, for ``with_signals``."""
        several = {name: getattr(self, name) for name in ("u", "y", "reference", "valid")}
        return {name: one if one is None else one[window] for name, one in several.items()}


def shifted(u: Array, delay: Sequence[int], level: Array, start: Start) -> Array:
    """Inputs (T, nu) later by whole samples each; what precedes them depends on the start."""
    found = u.copy()
    for j, d in enumerate(delay):
        found[:, j] = np.roll(u[:, j], d)
        if start != "periodic":
            found[:d, j] = level[j] if start == "zero" else u[0, j]
    return found


def interpolated(y: Array, valid: Booleans) -> Array:
    """Replace the samples of outputs that are not valid by straight lines."""
    k, filled = np.arange(len(y)), y.copy()
    for i, there in enumerate(valid.T):
        if there.any():
            filled[~there, i] = np.interp(k[~there], k[there], y[there, i])
    return filled


def measured_signals(record: Record) -> Array:
    """Inputs, masks of the outputs and valid outputs (T, nu + 2 ny); 0 for outputs not valid."""
    valid = record.is_valid
    return np.hstack([record.u, valid.astype(np.float64), np.where(valid, record.y, 0.0)])


def signals(record: Record) -> str:
    """Name the channels of a record: u -> y."""

    def listed(channels: Sequence[Channel]) -> str:
        return ", ".join([*map(str, channels[:4]), *["..."] * (len(channels) > 4)])

    return f"{listed(record.inputs)} -> {listed(record.outputs)}"


def with_past_outputs(record: Record) -> Record:
    """Return the record of a one-step predictor: its inputs are u, then y, and its output is y.

    A record in steady state has an estimated start: its noise does not repeat.
    """
    record.require_all_valid(PAST_OUTPUTS)
    return replace(
        record,
        u=np.hstack([record.u, record.y]),
        inputs=(*record.inputs, *record.outputs),
        start="estimated" if record.start == "periodic" else record.start,
        period=None,
        line_weight=None,
        reference=None,
    )


def as_records(records: Record | Sequence[Record]) -> list[Record]:
    """List one record or several; refuse different channels and sampling frequencies."""
    if not isinstance(records, Record | Iterable):
        raise _no_record(records)
    found = [records] if isinstance(records, Record) else list(records)
    if not found:
        raise InputError("no record given; at least one is needed.")
    for record in found:
        if not isinstance(record, Record):
            raise _no_record(record)
    first = found[0]
    for record in found[1:]:
        same = record.u.shape[1] == first.u.shape[1] and record.y.shape[1] == first.y.shape[1]
        if not same:
            raise InputError(
                f"records '{first.name}' and '{record.name}' differ in channels: "
                f"{first.u.shape[1]} inputs and {first.y.shape[1]} outputs against "
                f"{record.u.shape[1]} and {record.y.shape[1]}; give records of the same channels."
            )
        if not np.isclose(record.fs, first.fs):
            raise InputError(
                f"records '{first.name}' and '{record.name}' are sampled at {first.fs} and "
                f"{record.fs} Hz; resample them to one rate."
            )
    return found


def _no_record(given: object) -> ValueError:
    return InputError(
        f"the data hold a {type(given).__name__} where a record is expected; "
        "make one of the signals: lfrtorch.Record(u, y, fs=...)."
    )


def without_coordinates(record: Record) -> Record:
    """Replace a given start state, in the coordinates of one model, by an estimated one."""
    return replace(record, start="estimated", x0=None) if record.start == "given" else record


@dataclass(frozen=True, eq=False)
class NormalisedRecord:
    """The signals of a record in the units of a model.

    Args:
        u, y: normalised input (T, nu) and output (T, ny); a predictor's input has y as well.
        record: the record itself, with its start and weights.
        limits: smallest and largest output (2, ny), normalised.
    """

    u: Array
    y: Array
    record: Record
    limits: Array | None = None


@dataclass(frozen=True, eq=False)
class Scaler:
    """Offsets and scales between physical and normalised signals: (physical - offset) / scale.

    Args:
        delay: whole samples by which each input of a record acts later; empty for none.

    Shape:
        u_offset, u_scale: (nu,), y_offset, y_scale: (ny,); physical units.

    Example:
        >>> scaler = lfrtorch.Scaler(*(np.array([value]) for value in (0.0, 2.0, 1.0, 10.0)))
        >>> scaler.normalise_y(np.array([[21.0]]))
        array([[2.]])
        >>> scaler.restore_y(np.array([[2.0]]))
        array([[21.]])
    """

    u_offset: Array
    u_scale: Array
    y_offset: Array
    y_scale: Array
    delay: tuple[int, ...] = ()

    @classmethod
    def of(cls, records: Sequence[Record], *, offset: bool = True) -> Scaler:
        """Scaler from the means of the records (0 without ``offset``), and the rms about these."""
        us, ys = [r.u for r in records], [r.y for r in records]

        def centre(signals: list[Array]) -> Array:
            together = np.concatenate(signals)
            first = together[0]  # subtracted, so that the mean of a constant has no rounding errors
            return first + (together - first).mean(axis=0) if offset else np.zeros_like(first)

        u_offset, y_offset = centre(us), centre(ys)
        return cls(u_offset, rms_scale(us, u_offset), y_offset, rms_scale(ys, y_offset))

    def normalise(self, record: Record, start: Start | None = None) -> NormalisedRecord:
        """Normalise a record in physical units, with its inputs as they act after their delay."""
        record = record.delayed(self.delay, self.u_offset, start)
        limits = None if record.limits is None else self.normalise_y(np.asarray(record.limits))
        return NormalisedRecord(
            self.normalise_u(record.u), self.normalise_y(record.y), record, limits
        )

    def normalise_u(self, u: Array) -> Array:
        """Normalise an input (T, nu) in physical units."""
        return (u - self.u_offset) / self.u_scale

    def normalise_y(self, y: Array) -> Array:
        """Normalise an output (T, ny) in physical units."""
        return (y - self.y_offset) / self.y_scale

    def restore_y(self, y: Array) -> Array:
        """Restore the physical units of an output (T, ny); infinite where it is too large."""
        with np.errstate(over="ignore"):  # a simulation may diverge
            return y * self.y_scale + self.y_offset


def check_start(start: str, what: str) -> None:
    """Refuse an unknown kind of start with a ValueError."""
    if not isinstance(start, str) or start not in get_args(Start):
        raise InputError(
            f"{what}: start is {start!r}; use 'zero', 'given', 'estimated', 'measured' or "
            "'periodic'."
        )


def rms_scale(signals: Sequence[Array], offset: Array) -> NDArray:
    """Root mean square (n,) of signals (T, n) about ``offset``; 1 if a channel is constant."""
    scale = np.sqrt(np.mean((np.concatenate(signals) - offset) ** 2, axis=0))
    return np.where(scale > 0, scale, 1.0)


def _side(
    given: tuple[Channel, ...], signal: ArrayLike, letter: str, what: str
) -> tuple[tuple[Channel, ...], Array]:
    """Channels and samples of the inputs or the outputs of a record."""
    array = reals(what, signal)
    width = array.shape[1] if array.ndim == 2 else 1
    given = _channels(given, what)
    if given and len(given) != width:
        raise InputError(
            f"{letter} has {width} column(s) but {len(given)} channel name(s) were given; "
            "name every column once."
        )
    default = (Channel(letter if width == 1 else f"{letter}{i + 1}") for i in range(width))
    channels = given or tuple(default)
    array = as_signal(array, channels, what)
    for channel, largest in zip(channels, np.abs(array).max(axis=0), strict=True):
        check_largest(f"{what} '{channel.name}'", largest)
    return channels, array


def check_largest(what: str, largest: float) -> None:
    """Refuse a signal whose largest value has a square that overflows or vanishes."""
    if largest > _LARGEST or 0 < largest < _SMALLEST:
        raise InputError(
            f"{what} goes up to {largest:g}; give it in a unit that brings it between "
            f"{_SMALLEST:g} and {_LARGEST:g}."
        )


def check_rate(what: str, fs: float) -> None:
    """Refuse a sampling frequency in Hz outside of the same limits."""
    number(what, fs, positive=True)
    if not _SMALLEST <= fs <= _LARGEST:
        raise InputError(f"{what} is {fs} Hz; give one between {_SMALLEST:g} and {_LARGEST:g} Hz.")


def _channels(given: Any, what: str) -> tuple[Channel, ...]:
    """Channels from channels, or from names alone."""
    listed = isinstance(given, list | tuple)
    pairs = [(c,) if isinstance(c, str) else c for c in given] if listed else []
    known = [
        isinstance(c, list | tuple) and all(isinstance(text, str) for text in c) for c in pairs
    ]
    if not listed or not all(known) or any(len(pair) not in (1, 2) for pair in pairs):
        raise InputError(
            f"{what}: the channels are {brief(repr(given), 80)}; give a name for each column, or a "
            "name and a unit: [('force', 'N')]."
        )
    return tuple(Channel(*pair) for pair in pairs)


def as_signal(x: ArrayLike, channels: tuple[Channel, ...], what: str, *, first: int = 0) -> Array:
    """Return a signal (T, channels), not writeable, of finite real numbers; (T,) is one channel.

    Messages call it ``what`` and its first sample number ``first``.
    """
    array = np.array(reals(what, x), order="C")  # a copy: it is frozen below
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise InputError(
            f"{what} has shape {array.shape}; give (T,) for one channel or (T, channels)."
        )
    if array.size == 0:
        raise InputError(f"{what} is empty (shape {array.shape}); give at least one sample.")
    if array.shape[0] < array.shape[1] and array.shape[1] > 16:  # most likely transposed
        raise InputError(
            f"{what} has shape {array.shape}: more channels than samples. "
            "Time runs along the first axis; transpose the array."
        )
    if array.shape[1] != len(channels):
        names = ", ".join(channel.name for channel in channels)
        raise InputError(
            f"{what} has {array.shape[1]} column(s) and {len(channels)} channel(s) are expected "
            f"({names}); give a column for each."
        )
    bad = ~np.isfinite(array)
    if bad.any():
        k, channel = np.argwhere(bad)[0]
        raise InputError(
            f"{what} '{channels[channel].name}' has {bad.sum()} NaN, infinite or masked sample(s), "
            f"the first at index {first + k}; cut the record there or interpolate the gap"
            f"{', or leave these samples out: valid=np.isfinite(y)' * what.endswith('output')}."
        )
    array.flags.writeable = False
    return array
