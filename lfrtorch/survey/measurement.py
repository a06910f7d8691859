"""A measurement before any fit: the numbers of its signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import Cell, engineering, number, table
from lfrtorch._support.types import Array
from lfrtorch.data.periods import find_period
from lfrtorch.data.records import Channel
from lfrtorch.survey.signal import SignalSurvey, longest_run, survey_signal


@dataclass(frozen=True)
class Survey:
    """The numbers of each signal of a measurement."""

    inputs: tuple[SignalSurvey, ...]
    outputs: tuple[SignalSurvey, ...]
    fs: float | None  # Hz; without it frequencies are in cycles per sample
    whole: slice  # the longest part without missing samples

    @property
    def signals(self) -> tuple[SignalSurvey, ...]:
        """Inputs, then outputs."""
        return self.inputs + self.outputs

    def table(self) -> tuple[list[str], list[list[Cell]]]:
        """Head and rows, a row a signal."""
        unit = "1/sample" if self.fs is None else "Hz"
        head = ["signal", "use", "samples", "missing", "mean", "rms", "min", "max", "% at min"]
        head += ["% at max", "run", f"from {unit}", f"to {unit}", "period", "periods", "noise"]
        rows = []
        for one in self.signals:
            use = "" if not self.inputs else "input" if one in self.inputs else "output"
            ends = one.minimum, one.maximum
            factor, unit = engineering([one.rms], one.channel.unit)
            noise = None if one.noise is None else number(factor * one.noise, 4)
            rows.append(
                [
                    str(one.channel._replace(unit=unit)),
                    use,
                    one.samples,
                    one.missing,
                    factor * one.mean,
                    factor * one.rms,
                    *(factor * end.value for end in ends),
                    *(100 * end.samples / one.samples for end in ends),
                    max(end.run for end in ends),
                    *(one.band or (None, None)),
                    one.period,
                    None if one.period is None else one.samples / one.period,
                    f"~ {noise}" if one.method == "spectrum" else noise,
                ]
            )
        return head, rows

    def __str__(self) -> str:
        legend = [
            "rms: without the mean; run: most samples in a row at an extreme; from, to: band with "
            "99 % of the power."
        ]
        methods = {one.method for one in self.signals}
        if "periods" in methods:
            legend.append("Noise: the scatter from period to period.")
        if "spectrum" in methods:
            follows = " that follows no input" if self.inputs else ""
            legend.append(f"Noise ~: a guess from the quietest part of the spectrum{follows}.")
        return f"{table(*self.table(), digits=4)}\n{' '.join(legend)}"


def survey_measurement(
    u: ArrayLike,
    y: ArrayLike,
    fs: float | None = None,
    *,
    inputs: Sequence[Channel] = (),
    outputs: Sequence[Channel] = (),
    period: int | None = None,
) -> Survey:
    """Return the numbers of each signal (T,) or (T, channels), NaN for missing samples."""
    # ``u`` has no channel if it is not known which signals are inputs. Without ``fs`` frequencies
    # are in cycles per sample; without ``period`` that of the inputs is searched for.
    u, y = _columns("u", u), _columns("y", y)
    if len(u) != len(y):
        raise InputError(
            f"the inputs have {len(u)} samples and the outputs {len(y)}; "
            "give the signals of one record."
        )
    named = [*_named(inputs, u, "u"), *_named(outputs, y, "y")]
    signals = np.hstack([u, y])
    first, length = longest_run(np.asarray(np.isfinite(signals).all(axis=1)))
    whole, nu = slice(first, first + length), u.shape[1]
    if period is None and nu and length:
        period = find_period(u[whole])
    surveys = []
    for i, (signal, channel) in enumerate(zip(signals.T, named, strict=True)):
        own = period if nu or not length else find_period(signal[whole])
        followed = u if i >= nu > 0 else None
        surveys.append(
            survey_signal(signal, whole, channel, fs=fs or 1.0, period=own, inputs=followed)
        )
    return Survey(tuple(surveys[:nu]), tuple(surveys[nu:]), fs, whole)


def _columns(name: str, signals: ArrayLike) -> Array:
    array = reals(name, signals)
    return array[:, None] if array.ndim == 1 else array


def _named(given: Sequence[Channel], signals: Array, prefix: str) -> tuple[Channel, ...]:
    count = signals.shape[1]
    if given and len(given) != count:
        raise InputError(f"{len(given)} names are given for {count} channels; name each of them.")
    return tuple(given) or tuple(Channel(f"{prefix}{i + 1}") for i in range(count))
