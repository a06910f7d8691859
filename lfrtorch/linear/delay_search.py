"""Delays of the inputs, in whole samples, by the errors of linear models.

A plant that begins to act d samples after its input, 0 < d <= 1 beyond a whole number m - 1, has
after its sampling with a held input the response of a model of the same order with feedthrough,
whose input is m samples later. So whole delays are enough: the fraction is in the feedthrough (see
``lfrtorch.analysis.dead_times``). A smaller delay leaves a model that needs more states, a larger
one leaves out the beginning of the response.

References:
    Franklin, Powell and Workman, "Digital Control of Dynamic Systems", 1998, section 4.3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lfrtorch.data.delayed_records import Delay, delayed_records, resting_level
from lfrtorch.data.records import Record
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.order_scan import scan_orders
from lfrtorch.survey.causality import dead_time, two_sided_response

_NEAR = 2
"""Delays at least so far from the best are compared."""

_ORDERS = range(1, 4)
"""Orders among which that of the search is chosen."""

_ITERATIONS = 15
"""Iterations for each of these orders."""

_LEAST = 2
"""Least order of the search: one lag with a delay stands for several lags, with a smaller one."""

_LARGEST = 1 / 4
"""Largest delay, relative to the shortest record."""

_ALIKE = 4.0
"""Delays are as good as the best if the squared errors, over their variance, add up to so much
more: two standard deviations of one parameter. The largest of these is taken."""


def find_delay(
    records: Sequence[Record],
    nx: int | None,
    *,
    watch: Callable[[str], None] = lambda _: None,
    **options: Any,
) -> Delay:
    """Whole samples by which each input acts later, as the errors of linear models tell.

    The search begins where past inputs begin to explain the outputs. For several inputs, each in
    turn gets its best delay.

    Args:
        records: records as they were measured.
        nx: order of the linear models. None: chosen.
        watch: called with a line on the result.
        options: arguments of ``estimate_bla``.
    """
    nu = len(records[0].inputs)
    most = int(_LARGEST * min(record.samples for record in records))

    def acting(delay: Delay) -> list[Record]:
        level = np.zeros(nu)
        if options.get("offset", True):
            level = resting_level(records, delay)
        return delayed_records(records, delay, level)

    seen = [[d for d in _seen(records, j) if d <= most] or [most] for j in range(nu)]
    delay = tuple(min(own) for own in seen)
    if nx is None:
        few = {**options, "max_iter": _ITERATIONS}
        nx = scan_orders(acting(delay), _ORDERS, **few).chosen
    errors: dict[tuple[int, Delay], float] = {}

    def error(delay: Delay, order: int = max(nx, _LEAST)) -> float:
        """Error of the linear model, normalised."""
        if (order, delay) not in errors:
            fit = estimate_bla(acting(delay), order, **options).fit
            errors[order, delay] = math.inf if fit is None else fit.rmse
        return errors[order, delay]

    rows = sum(record.y.size for record in records)
    for j in range(nu):
        delay = _best(delay, j, seen[j], most, error, rows)
        if nx < _LEAST:  # the state that the search has more may stand for one sample
            later = (*delay[:j], min(delay[j] + 1, most), *delay[j + 1 :])
            delay = min(delay, later, key=lambda d: error(d, nx))
    names = [channel.name for channel in records[0].inputs]
    told = ", ".join(f"{name} {d}" for name, d in zip(names, delay, strict=True))
    watch(f"delay in samples: {told}, by linear models of order {max(nx, _LEAST)}")
    return delay


def _best(
    delay: Delay,
    j: int,
    seen: Sequence[int],
    most: int,
    error: Callable[[Delay], float],
    rows: int,
) -> Delay:
    """The delay with the best value of input j: the largest that is as good as the best found."""

    def at(d: int) -> Delay:
        return (*delay[:j], d, *delay[j + 1 :])

    tried = {d: error(at(d)) for d in seen}
    while True:
        best = min(tried, key=lambda d: tried[d])
        near = range(max(0, best - _NEAR), min(most, best + _NEAR) + 1)
        new = [d for d in near if d not in tried]
        if not new:
            break
        tried |= {d: error(at(d)) for d in new}
    limit = tried[best] * math.sqrt(1.0 + _ALIKE / rows)
    return at(max(d for d in near if tried[d] <= limit))


def _seen(records: Sequence[Record], j: int) -> list[int]:
    """Dead times of an input to compare: that which past inputs show, or those by the response."""
    record = max(records, key=lambda one: one.samples)
    u, clear, unclear = record.u[:, j], [], {0}
    for y in record.y.T:
        response = two_sided_response(u, y)
        if response is not None:
            clear.append(dead_time(u, y, response.peak))
            unclear |= {response.peak // 2, response.peak}
    least = min((one for one in clear if one), default=0)
    return [least] if least else sorted(unclear)
