"""Even grids of time: the grid of time stamps, or a grid for interpolation."""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Booleans, Integers

_GAP = 1.5  # steps between two stamps, from which on samples are missing
_OFTEN = 0.1  # with more gaps than this part of the samples, the stamps are rounded
_ROUNDED = 1.01  # largest distance of a rounded stamp from the grid, in units of its last digit
_HOLE = 5.0  # longer stretches without a sample, in steps, are not interpolated
_SAME = 1e-3  # largest relative difference of sampling frequencies that agree
_USUAL = 0.1  # the same if the stamps are uneven


class Sampling(NamedTuple):
    """An even grid of samples."""

    fs: float  # Hz
    uncertainty: float  # relative error of fs, from the digits of the stamps
    gaps: Integers  # samples that follow a gap
    missing: Integers  # number of samples of each gap
    unit: str = ""  # unit of the stamps, if their column does not name it

    def __str__(self) -> str:
        """Interpretation of a column: its unit, the frequency and its uncertainty."""
        unit = f" in {self.unit}" if self.unit else ""
        # The uncertainty is only printed if it is larger than the rounding of the frequency.
        off = f" ± {100 * self.uncertainty:.1g} %" if self.uncertainty > 1e-3 else ""
        return f"the time{unit}, {self.fs:.6g} Hz{off}"


class UnevenError(InputError):
    """Error of a column that is not an even time: its fault, the sample, and a remedy."""

    def __init__(
        self, message: str, sample: int, remedy: str = "resample the signals to an even grid"
    ) -> None:
        super().__init__(message)
        self.sample, self.remedy = sample, remedy


class Piece(NamedTuple):
    """Samples without a hole between them, by their positions on an even grid."""

    rows: Integers  # (n,), positions among the time stamps
    places: Array  # (n,), in steps from the first one
    start: float  # steps from the first time stamp
    usual: float  # step between samples, in steps of the grid, at least 1

    @classmethod
    def of(cls, first: int, end: int) -> Piece:
        """Piece of all samples, as they come."""
        rows = np.arange(first, end)
        return cls(rows, (rows - first).astype(np.float64), 0.0, 1.0)

    def on_grid(self, values: Array) -> Array:
        """Values (rows of the file, columns) on the grid, straight lines between samples."""
        first, n = int(self.rows[0]) if len(self.rows) else 0, len(self.rows)
        whole = not n or self.rows[-1] - first + 1 == n
        found = values[first : first + n] if whole else values[self.rows]
        k = self._grid()
        if np.array_equal(k, self.places):
            return found
        lines = [np.interp(k, self.places, column) for column in found.T]
        return np.column_stack(lines) if lines else np.empty((len(k), 0))

    def missing(self) -> Booleans:
        """Tell if there is no sample at or next to a point of the grid."""
        k = self._grid()
        if len(self.places) < 2:
            return np.zeros(len(k), bool)
        after = np.clip(np.searchsorted(self.places, k - 1e-6), 1, len(self.places) - 1)
        before, behind = self.places[after - 1], self.places[after]
        wide = behind - before > _GAP * self.usual
        return wide & (k - before > 1e-6) & (behind - k > 1e-6)

    def _grid(self) -> Integers:
        return np.arange(int(self.places[-1] + 1e-6) + 1 if len(self.places) else 0)


class EvenTimes(NamedTuple):
    """Samples on an even grid, in pieces between holes, with a note on uneven stamps."""

    grid: Sampling
    pieces: list[Piece]
    uneven: UnevenError | None = None

    @property
    def interpolated(self) -> bool:
        """Tell if samples were changed, apart from missing and omitted ones."""
        return any((np.rint(piece.places) != piece.places).any() for piece in self.pieces)

    @property
    def tolerance(self) -> float:
        """Relative uncertainty of the rate of the time stamps."""
        return _USUAL if self.uneven else max(_SAME, self.grid.uncertainty)


def even_times(t: Array, fs: float | None = None, *, whole: bool = False) -> EvenTimes:
    """Positions of samples on an even grid of their own rate, or of ``fs`` in Hz.

    Samples with even stamps stay as they are. Others are interpolated linearly at their usual rate.
    The first sample counts where a stamp stands twice. If more than one stamp in ten does, the
    clock is coarse, and samples share its ticks evenly.

    Args:
        t: time stamps in seconds (T,).
        fs: rate of the grid in Hz. Default: the rate of the stamps.
        whole: every missing sample is a hole; otherwise five steps without a sample are one.

    Raises:
        UnevenError: stamps that do not rise.
    """
    rows, uneven = np.arange(len(t)), None
    try:
        grid = sampling(t)
    except UnevenError as error:
        if len(t) < 2 or (np.diff(t) < 0).any() or t[-1] == t[0]:
            raise
        uneven = error
        rows, grid = _without_odd(t)
    if grid is not None:
        places = np.arange(len(rows), dtype=np.float64)
        for gap, missing in zip(grid.gaps, grid.missing, strict=True):
            places[gap:] += missing
        if fs is None or abs(fs / grid.fs - 1) <= max(_SAME, grid.uncertainty):
            return EvenTimes(grid, _pieces(rows, places, 1.0, whole=whole), uneven)
        seconds = places / grid.fs
    else:
        rows, seconds = _rising(t)
    usual = _usual(np.diff(seconds))
    fs = float(f"{1 / usual:.2g}") if fs is None else fs  # any rate will do, so a round one
    none = np.array([], np.int64)
    grid = Sampling(fs, 0.0, none, none)
    return EvenTimes(grid, _pieces(rows, seconds * fs, max(1.0, usual * fs), whole=whole), uneven)


def _usual(steps: Array) -> float:
    """Step of at least half of all samples, or else the mean step without holes."""
    median = float(np.median(steps))
    if np.count_nonzero(np.abs(steps - median) <= 0.01 * median) > len(steps) / 2:
        return median
    return float(steps[steps < _HOLE * median].mean())


def _pieces(rows: Integers, places: Array, usual: float, *, whole: bool) -> list[Piece]:
    """Pieces of samples between holes."""
    hole = _GAP if whole else _HOLE
    cuts = np.flatnonzero(np.diff(places) > hole * usual - 1e-6) + 1
    if cuts.size and cuts[0] == 1:  # a sample from before the measurement
        rows, places, cuts = rows[1:], places[1:], cuts[1:] - 1
    ends = [0, *map(int, cuts), len(rows)]
    return [
        Piece(rows[a:b], places[a:b] - places[a], float(places[a]), usual)
        for a, b in pairwise(ends)
    ]


def _without_odd(t: Array) -> tuple[Integers, Sampling | None]:
    """Grid of all samples but the first, or but some whose stamps stand twice."""
    alone = np.flatnonzero(np.diff(t, prepend=-np.inf) > 0)
    for rows in (np.arange(1, len(t)), alone):
        if len(t) - len(rows) <= _OFTEN * len(t):
            with suppress(UnevenError):
                return rows, sampling(t[rows])
    return np.arange(len(t)), None


def _rising(t: Array) -> tuple[Integers, Array]:
    """Samples, and times that rise from 0, from stamps of which some stand twice."""
    first = np.flatnonzero(np.diff(t, prepend=-np.inf) > 0)
    if len(t) - len(first) <= _OFTEN * len(t):
        return first, t[first] - t[0]
    # Time continues behind the last tick as before it.
    k, ticks = np.append(first, len(t)), np.append(t[first], t[-1])
    ticks[-1] += (len(t) - first[-1]) * (t[-1] - t[0]) / first[-1]
    rows = np.arange(len(t))
    return rows, np.interp(rows, k, ticks) - t[0]


def sampling(t: Array) -> Sampling:
    """Even grid of time stamps (s), up to rounding; refuse uneven stamps."""
    if len(t) < 2:
        raise UnevenError("has one sample", 0)
    digit, steps = _last_digit(t), np.diff(t)
    if np.count_nonzero(steps == 0) > _OFTEN * len(t) and steps.max() > 0:
        digit = max(digit, float(np.median(steps[steps > 0])))  # a clock of ticks
    if _rounded(t, digit):
        return _grid(t, digit, np.array([], np.int64))
    usual = float(np.median(steps))
    found = np.flatnonzero(steps > _GAP * usual) + 1
    if len(found) < _OFTEN * len(t):
        return _grid(t, 0.0, found)
    return _grid(t, digit, np.flatnonzero(steps > _GAP * usual + _ROUNDED * digit) + 1)


def _rounded(t: Array, digit: float) -> bool:
    """Tell if all stamps are on one grid up to rounding of a last digit that most stamps lack."""
    steps, k = np.diff(t), np.arange(len(t)) - (len(t) - 1) / 2
    away = t - t.mean()
    away -= k * (k @ away) / (k @ k)  # the line of least squares is off by digit / sqrt(T)
    shows = np.count_nonzero(np.abs(steps - np.median(steps)) > 0.5 * digit)
    # The last digit is taken to round if it makes some steps unlike the others.
    return bool(shows >= 5 and np.ptp(away) <= (1.1 + 3 / np.sqrt(len(t))) * digit)


def _grid(t: Array, digit: float, gaps: Integers) -> Sampling:
    """Grid of stamps between gaps, each within ``digit`` and the jitter of its position."""
    steps = np.diff(t)
    within = np.delete(steps, gaps - 1)
    mean = float(within.mean()) if within.size else 0.0
    falling = np.flatnonzero(steps < 0)
    if mean <= 0 or falling.size:
        k = int(falling[0]) + 1 if falling.size else 1
        raise UnevenError(
            f"does not rise: {t[k - 1]:.10g} s is followed by {t[k]:.10g} s",
            k,
            "cut the file there",
        )
    starts = np.concatenate([[0], gaps])
    lengths = np.diff(np.append(starts, len(t)))
    place = np.arange(len(t)) - np.repeat(starts, lengths)
    away = t - np.repeat(t[starts], lengths) - place * mean
    away -= np.repeat(np.add.reduceat(away, starts) / lengths, lengths)
    # Jitter: largest distance, in steps, of a stamp from its position in an even grid.
    far = np.abs(away) > 0.1 * mean + _ROUNDED * digit
    if far.any():
        twice = np.flatnonzero(steps == 0) + 1
        if 0 < twice.size <= _OFTEN * len(t):
            raise UnevenError(
                f"has {twice.size} time stamp(s) twice, the first {t[twice[0]]:.10g} s",
                int(twice[0]),
                "leave out one sample of each two",
            )
        odd = np.abs(steps - np.median(steps))
        odd[gaps - 1] = 0.0
        raise UnevenError(
            f"is not evenly spaced: its steps go from {steps.min():.4g} s to {steps.max():.4g} s",
            int(np.argmax(odd)) + 1,
        )
    rounding = 4 * float(np.spacing(np.abs(t).max()))
    if np.ptp(within) > 2 * rounding:  # otherwise the digits represent the step exactly
        rounding = max(rounding, digit or _last_digit(t))
    uncertainty = rounding * len(starts) / float(within.sum())
    missing = np.maximum(np.rint(steps[gaps - 1] / mean).astype(np.int64) - 1, 1)
    return Sampling(_roundest(1 / mean, uncertainty), uncertainty, gaps, missing)


def _last_digit(t: Array) -> float:
    """Unit of the last digit of stamps that were printed, or stored in single precision."""
    largest = float(np.abs(t).max())
    with np.errstate(over="ignore"):  # beyond single precision
        single = t.astype(np.float32)
    if np.array_equal(t, single) and not np.array_equal(t, np.rint(t)):
        return float(np.spacing(np.float32(largest)))
    for digits in range(10):
        scaled = t * 10.0**digits
        if np.abs(scaled - np.rint(scaled)).max() <= 4 * np.spacing(largest * 10.0**digits):
            return 10.0**-digits
    return 0.0


def _roundest(value: float, uncertainty: float) -> float:
    """Number with the fewest digits that is as accurate."""
    for digits in range(16):
        found = float(f"{value:.{digits}e}")
        if abs(found - value) <= uncertainty * value:
            return found
    return value
