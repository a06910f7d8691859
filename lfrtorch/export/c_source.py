"""Export to C99 that needs nothing but math.h."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from lfrtorch._support.types import Array
from lfrtorch.export.equations import equations, observer_equations
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.formula_code import PYTHON, with_slopes
from lfrtorch.maps.operations import Formula
from lfrtorch.model.extended_kalman_filter import NoiseCovariance
from lfrtorch.model.model import Model

_LINE = 96
"""Largest number of characters in a line of numbers."""


def c_source(
    model: Model | LinearModel,
    name: str = "model",
    *,
    observer: bool | NoiseCovariance = False,
    single: bool = False,
) -> tuple[str, str]:
    """Write a model as C99: one step, its Jacobians, and the states to start from.

    ``NAME_step`` is one sample in physical units, ``NAME_jacobians`` the matrices of the model
    linearised at a state and an input. ``NAME_reset`` writes the state 0, and ``NAME_rest`` the
    state at rest with the inputs at their operating point, if there is one. If the model knows its
    reach, ``NAME_reach`` is a squared distance from the data of the fit, at most 1 for 99 % of
    them. Sizes and the sampling time are macros, as ``NAME_NX`` and ``NAME_TS``. The code
    allocates nothing and keeps no state of its own.

    An observer adds ``NAME_observer_reset``, ``NAME_observer_predict`` and
    ``NAME_observer_update``, on a struct ``NAME_observer`` of the caller. A controller that
    measures y before it chooses u calls ``NAME_observer_correct`` and ``NAME_observer_advance``
    instead.

    Args:
        model: the model to export.
        name: beginning of all names of the code.
        observer: ``True`` for an observer with the model's gain K, noise covariances for an
            extended Kalman filter.
        single: compute in single precision, ``float``, for a processor without double.

    Returns:
        The texts of ``NAME.h`` and ``NAME.c``.

    Raises:
        ValueError: a static map without equations, a name that is not an identifier, or an
            observer that the model does not have.

    Example:
        >>> header, source = lfrtorch.export.c_source(model, "actuator")
        >>> [line for line in header.splitlines() if line.startswith("#define ACTUATOR_T")]
        ['#define ACTUATOR_TS 0.01 /* sampling time, s */']
        >>> [line for line in source.splitlines() if line.startswith("#include")]
        ['#include "actuator.h"', '#include <math.h>']
    """
    e = equations(model, name)
    known: dict[str, Any] = {"ts": repr(1.0 / e.fs), "about": [*map(_plain, e.about())]}
    known |= {"constant": _constant, "pairs": _pairs, "slopes": _slopes}
    known["roots"] = observer_equations(model, observer).roots
    header, source = (e.rendered(file, _C, **known) for file in ("model.h", "model.c"))
    return (_single(header), _single(source)) if single else (header, source)


_C = {
    name: text.replace("math.", "").replace("abs(", "fabs(") for name, text in PYTHON.items()
} | {
    "pow": "pow({0}, {1})", "relu": "{0} < 0.0 ? 0.0 : {0}", "where": "{0} ? {1} : {2}",
    "softplus": "({0} > 0.0 ? {0} : 0.0) + log(1.0 + exp(-fabs({0})))",
    "sign": "{0} > 0.0 ? 1.0 : ({0} < 0.0 ? -1.0 : 0.0)", "maximum": "{0} >= {1} ? {0} : {1}",
    "minimum": "{0} <= {1} ? {0} : {1}", "and": "{0} && {1}", "or": "{0} || {1}", "not": "!{0}",
}  # fmt: skip
"""Operations of formulas in C; true is 1.0."""


def _slopes(f: Formula) -> Formula:
    """Only the derivatives of the results, without the results, row by row."""
    both = with_slopes(f)
    return both._replace(results=both.results[len(f.results) :]).pruned()


def _single(text: str) -> str:
    """Convert C of double precision to single precision; comments stay."""
    # The functions of tgmath.h (exp, sqrt, ..) have the type of their argument.
    text = text.replace("#include <math.h>", "#include <tgmath.h>")
    parts = re.split(r"(/\*.*?\*/)", text, flags=re.DOTALL)
    for i in range(0, len(parts), 2):
        parts[i] = re.sub(r"\bdouble\b", "float", parts[i])
        number = r"(?<![\w.])(\d+\.\d+(?:e[+-]?\d+)?|\d+e[+-]?\d+)"
        parts[i] = re.sub(number, r"\1f", parts[i])
    return "".join(parts)


def _constant(name: str, size: str, value: Array) -> str:
    """Definition of a vector or a matrix, row by row."""
    rows = [[repr(float(number)) for number in row] for row in np.atleast_2d(value)]
    return f"static const double {name}[{size}] = {_braces(rows)};"


def _pairs(rows: Array) -> str:
    """Rows of integers in braces."""
    return _braces([[f"{{{', '.join(map(str, row))}}}" for row in rows.tolist()]])


def _braces(rows: Sequence[Sequence[str]]) -> str:
    """Numbers in braces, a line or more for each row; reading them back gives the same bits."""
    lines = []
    for row in rows:
        line = "   "
        for number in row:
            if len(line) + len(number) + 2 > _LINE:
                lines.append(line)
                line = "   "
            line += f" {number},"
        lines.append(line)
    return "\n".join(["{", *lines, "}"])


def _plain(text: str) -> str:
    """Change a text so that it neither ends nor begins a comment of C."""
    for pair in ("*/", "/*", "??"):
        text = text.replace(pair, " ".join(pair))
    return text
