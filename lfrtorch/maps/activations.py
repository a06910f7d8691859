"""Activations of a network: a row of the table has all that the package knows of an activation.

A new activation needs a row here, and a function of value and slope in ``activation_kernel``.
Compiled code is not part of the row, since its cache only notices changes of its own file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lfrtorch._support.types import Array
from lfrtorch.maps import activation_kernel as compiled
from lfrtorch.maps.operations import Formula

FAR = 1e100
"""Number in place of infinity: its products are finite, and every bounded σ has its limit there."""


@dataclass(frozen=True)
class Activation:
    """Activation h = σ(v).

    Args:
        code: the number of its machine code.
        value: σ(v).
        slope: σ'(v) from v and h.
        mean_slope: (σ(v + d) - σ(v)) / d without cancellation, or σ'(v) if d = 0; v and d are
            arrays of the same shape.
        extremes, slope_extremes: points v of the extremes of σ and of σ'.
        c: σ(v[i]) and σ'(v[i]) in C, from v and h; NaN must stay NaN.
        matlab: σ(v) and σ'(v) in MATLAB, from v and h.
        matlab_mean_slope: lines that compute s = (σ(a) - σ(v)) / d with a = v + d; ``over(a, d)``
            is a / d, and 1 for d = 0.
        of_number: σ(v) of one number, composed of ``OPERATIONS``. Default: ``value``.
        meaning: σ as an equation, if its name does not define it.
    """

    code: int
    value: Callable[[Tensor], Tensor]
    slope: Callable[[Tensor, Tensor], Tensor]
    mean_slope: Callable[[Array, Array], Array]
    c: tuple[str, str]
    matlab: tuple[str, str]
    matlab_mean_slope: tuple[str, ...]
    extremes: tuple[float, ...] = ()
    slope_extremes: tuple[float, ...] = ()
    of_number: Callable[[Any], Any] | None = None
    meaning: str = ""

    @property
    def formula(self) -> Formula:
        """Table of operations of σ."""
        return Formula.traced(lambda v: [(self.of_number or self.value)(v)], 1)

    def values(self, v: Array) -> Array:
        """Values σ(v)."""
        return self.value(torch.as_tensor(v)).numpy()

    def slopes(self, v: Array) -> Array:
        """Slopes σ'(v)."""
        given = torch.as_tensor(v)
        return self.slope(given, self.value(given)).numpy()

    @property
    def bounded(self) -> bool:
        """True if σ is bounded."""
        return bool(np.abs(self.values(np.array([-FAR, FAR]))).max() < FAR)

    @property
    def slope_bounds(self) -> tuple[float, float]:
        """Least and largest slope, which also bound mean slopes."""
        found = self.slopes(np.array([-FAR, *self.slope_extremes, FAR]))
        return float(found.min()), float(found.max())


def _quotient(a: Array, d: Array) -> Array:
    """Quotient a / d, and 1 for d = 0."""
    return np.divide(a, d, out=np.ones_like(d), where=d != 0)


def _mean_tanh(v: Array, d: Array) -> Array:
    # tanh a - tanh v = tanh(a - v) (1 - tanh a tanh v)
    return _quotient(np.tanh(d), d) * (1.0 - np.tanh(v + d) * np.tanh(v))


def _mean_relu(v: Array, d: Array) -> Array:
    a = v + d
    part = _quotient(np.maximum(a, 0.0) - np.maximum(v, 0.0), d)
    return np.where((a > 0) & (v > 0), 1.0, np.where((a > 0) | (v > 0), part, 0.0))


def _mean_rbf(v: Array, d: Array) -> Array:
    # e^-a² - e^-v² = e^-min (e^-|q| - 1) with the sign of q = a² - v² = d (v + a)
    a = v + d
    q = np.abs(d * (v + a))
    return -(v + a) * np.exp(-np.minimum(a**2, v**2)) * _quotient(-np.expm1(-q), q)


def _mean_softplus(v: Array, d: Array) -> Array:
    # ln(1 + s (e^d - 1)), s = sigmoid(v); a plain difference if d is large
    s, near = 0.5 + 0.5 * np.tanh(v / 2), np.clip(d, -1.0, 1.0)
    close = np.log1p(s * np.expm1(near))
    part = np.where(np.abs(d) < 1.0, close, np.logaddexp(v + d, 0.0) - np.logaddexp(v, 0.0))
    return np.where(d == 0, s, _quotient(part, d))


ACTIVATIONS = {
    "tanh": Activation(
        code=compiled.TANH,
        value=torch.tanh,
        slope=lambda v, h: torch.addcmul(h.new_ones(()), h, h, value=-1.0),
        slope_extremes=(0.0,),
        mean_slope=_mean_tanh,
        c=("tanh(v[i])", "1.0 - h[i] * h[i]"),
        matlab=("tanh(v)", "1 - h .^ 2"),
        matlab_mean_slope=("s = (1 - tanh(a) .* tanh(v)) .* over(tanh(d), d);",),
    ),
    "sigmoid": Activation(
        code=compiled.SIGMOID,
        value=torch.sigmoid,
        slope=lambda v, h: h * (1.0 - h),
        slope_extremes=(0.0,),
        mean_slope=lambda v, d: _mean_tanh(v / 2, d / 2) / 4,  # (1 + tanh(v / 2)) / 2
        c=("1.0 / (1.0 + exp(-v[i]))", "h[i] * (1.0 - h[i])"),
        matlab=("1 ./ (1 + exp(-v))", "h .* (1 - h)"),
        matlab_mean_slope=(
            "s = (1 - tanh(a / 2) .* tanh(v / 2)) .* over(tanh(d / 2), d / 2) / 4;",
        ),
    ),
    "relu": Activation(
        code=compiled.RELU,
        value=torch.relu,
        slope=lambda v, h: (v > 0).to(v.dtype),
        mean_slope=_mean_relu,
        c=("v[i] < 0.0 ? 0.0 : v[i]", "v[i] > 0.0 ? 1.0 : 0.0"),
        matlab=("max(v, 0)", "double(v > 0)"),
        matlab_mean_slope=(
            "s = over(max(a, 0) - max(v, 0), d);",
            "s(a > 0 & v > 0) = 1;",
            "s(a <= 0 & v <= 0) = 0;",
        ),
    ),
    "rbf": Activation(
        code=compiled.RBF,
        value=lambda v: torch.exp(-v.square()),
        slope=lambda v, h: -2.0 * v * h,
        extremes=(0.0,),
        slope_extremes=(-math.sqrt(0.5), math.sqrt(0.5)),
        mean_slope=_mean_rbf,
        c=("exp(-v[i] * v[i])", "-2.0 * v[i] * h[i]"),
        matlab=("exp(-v .^ 2)", "-2 * v .* h"),
        matlab_mean_slope=(
            "q = abs(d .* (v + a));",
            "s = -(v + a) .* exp(-min(a .^ 2, v .^ 2)) .* over(-expm1(-q), q);",
        ),
        meaning="rbf(v) = exp(-v^2)",
    ),
    "softplus": Activation(
        code=compiled.SOFTPLUS,
        value=lambda v: torch.logaddexp(v, v.new_zeros(())),  # F.softplus cuts off at v = 20
        slope=lambda v, h: torch.sigmoid(v),
        mean_slope=_mean_softplus,
        c=("(v[i] < 0.0 ? 0.0 : v[i]) + log1p(exp(-fabs(v[i])))", "1.0 / (1.0 + exp(-v[i]))"),
        matlab=("max(v, 0) + log1p(exp(-abs(v)))", "1 ./ (1 + exp(-v))"),
        matlab_mean_slope=(
            "s = 1 ./ (1 + exp(-v));",
            "near = abs(d) < 1 & d ~= 0;",
            "s(near) = log1p(s(near) .* expm1(d(near))) ./ d(near);",
            "far = abs(d) >= 1;",
            "value = @(v) max(v, 0) + log1p(exp(-abs(v)));",
            "s(far) = (value(a(far)) - value(v(far))) ./ d(far);",
        ),
        of_number=torch.nn.functional.softplus,
        meaning="softplus(v) = log(1 + exp(v))",
    ),
}
"""Activations by name."""
