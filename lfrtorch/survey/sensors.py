"""Sensor faults: values that mark a missing sample, and values at which a sensor froze.

A mark, such as -9999 or 999.9, is one value that occurs several times and lies far from all others.
A frozen sensor repeats one value exactly while the inputs move, and changes at each sample before
and after. A slow signal in coarse steps is not frozen: near its turning points several values are
repeated.
"""

from __future__ import annotations

import re

import numpy as np

from lfrtorch._support.types import Array, Booleans
from lfrtorch.survey.signal import moves, runs

_LEVELS = 16  # a signal of at most so many values consists of levels

# A mark occurs MARKS times or more, in at most SOME of the record, and its distance to the nearest
# other value is FAR times the range of the others. An input may be a pulse: there only CODES count.
_MARKS, _SOME, _FAR = 3, 0.1, 3.0
_NINES = re.compile(r"9[.9]*9")
_CODES = (32767, 32768, 65535, 2147483647, 2147483648)

# A value is frozen if it is repeated FROZEN times or more, and LONGER times as often as any value
# in as many samples (at least AROUND) before and after. At most REPEATED of these samples equal the
# one before. More than FEW places half as long are by design: play, a dead zone, dry friction.
_FROZEN, _LONGER, _AROUND, _REPEATED, _FEW = 10, 8, 30, 0.1, 3
_JUMP = 0.05  # smallest jump to or from it, over the usual change; a motion that stops has less


def marked(x: Array, *, of_input: bool = False) -> Booleans:
    """Return the samples (T,) of a signal whose value is a mark."""
    values, counts = np.unique(x[np.isfinite(x)], return_counts=True)
    found = np.zeros(len(x), bool)
    if len(values) <= _LEVELS:
        return found
    for value, count, (near, far) in (
        (values[0], counts[0], values[[1, -2]]),
        (values[-1], counts[-1], values[[-2, 1]]),
    ):
        at = x == value
        rare = _MARKS <= count <= _SOME * len(x)
        begins = at[0] and np.count_nonzero(np.diff(at)) == 1  # at rest before a step
        known = not of_input or _NINES.fullmatch(f"{abs(value):g}") or abs(value) in _CODES
        if rare and not begins and known and abs(value - near) > _FAR * abs(near - far):
            found |= at
    return found


def frozen(y: Array, u: Array) -> list[slice]:
    """Return where an output (T,) is frozen while an input (T, nu) moves."""
    change = np.abs(np.diff(y))
    places = runs(change == 0)
    if np.count_nonzero(2 * (places[:, 1] + 1) >= _FROZEN) > _FEW:
        return []
    found = list[slice]()
    for first, length in places[places[:, 1] + 1 >= _FROZEN]:
        last, span = first + length, max(length, _AROUND)
        before, after = change[max(0, first - span) : first], change[last : last + span]
        around, count = np.concatenate([before, after]), length + 1
        if len(before) < _FROZEN or not any(moves(u, np.array([[first, last + 1]]))):
            continue
        repeated = [np.mean(side == 0) for side in (before, after) if side.size]
        longest = runs(around == 0)[:, 1].max(initial=0) + 1
        jumps = [before[-1], *after[:1]]
        if y[first] in (np.nanmin(y), np.nanmax(y)):  # clipped, unless it leaps there and back
            leaps = min(jumps) > np.nanmax(np.concatenate([before[:-1], after[1:]]))
        else:
            leaps = max(jumps) > _JUMP * max(np.nanmedian(around), np.nanmedian(change))
        if max(repeated) <= _REPEATED and count >= _LONGER * longest and leaps:
            found.append(slice(int(first), int(last + 1)))
    return found
