"""A model as a function of MATLAB and Octave with its matrices in a file."""

from __future__ import annotations

from typing import Any

import numpy as np

from lfrtorch.export.equations import Layers, Monomials, check_name, equations
from lfrtorch.export.rendering import rendered
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import Model

ACTIVATIONS = {
    "tanh": ("tanh(v#)", "1 - h# .^ 2"),
    "sigmoid": ("1 ./ (1 + exp(-v#))", "h# .* (1 - h#)"),
    "relu": ("max(v#, 0)", "double(v# > 0)"),
    "rbf": ("exp(-v# .^ 2)", "-2 * v# .* h#"),
    "softplus": ("max(v#, 0) + log1p(exp(-abs(v#)))", "1 ./ (1 + exp(-v#))"),
}
"""h = σ(v) and σ'(v); # stands for the number of the layer."""


def matlab_function(model: Model | LinearModel, name: str = "model") -> tuple[str, dict[str, Any]]:
    """A model as a function of MATLAB and Octave, ``[x_next, y, A, B, C, D] = NAME(x, u)``.

    It is one sample in physical units; A, B, C and D are the matrices of the model linearised
    there. The function loads what ``scipy.io.savemat`` writes to ``NAME.mat`` beside it: all
    matrices of the model, offsets, names and units of the channels, and fs.

    Args:
        model: what is exported.
        name: of the function.

    Returns:
        The text of ``NAME.m``, and the variables of ``NAME.mat``.

    Raises:
        ValueError: a static map of the user's own class, or a name that is no identifier.

    Example:
        >>> text, variables = lfrtorch.export.matlab_function(model, "actuator")
        >>> text.splitlines()[0]
        'function [x_next, y, A, B, C, D] = actuator(x, u)'
        >>> variables["fs"], variables["A"].shape
        (100.0, (1, 1))
    """
    check_name(name)
    e = equations(model)
    found: dict[str, Any] = {letters: getattr(e, letters) for letters in MATRICES}
    found |= {"u_offset": e.u_offset[:, None], "y_offset": e.y_offset[:, None], "fs": e.fs}
    for side, channels in (("input", e.inputs), ("output", e.outputs)):
        found[f"{side}_names"] = np.array([c.name for c in channels], dtype=object)[:, None]
        found[f"{side}_units"] = np.array([c.unit for c in channels], dtype=object)[:, None]
    known = {
        "name": name,
        "NAME": name.upper(),
        "about": e.about(name, "{0}({2})"),
        "static": e.static,
    }
    match e.static:
        case Layers():
            known["value"], known["slope"] = ACTIVATIONS[e.static.activation]
            known["layers"] = e.static.names[:-1]
            for (W, b), weight, bias in zip(e.static.names, e.static.W, e.static.b, strict=True):
                found |= {W: weight, b: bias[:, None]}
        case Monomials():
            known["monomials"] = e.static.C.shape[1]
            # Numbers of monomials and of z count from 1.
            growth = [(m + 1.0, j + 1.0) for m, j in e.static.growth]
            slopes = [
                (n + 1.0, j + 1.0, float(times), m + 1.0) for n, j, times, m in e.static.slopes
            ]
            found |= {"C": e.static.C, "growth": np.array(growth), "slopes": np.array(slopes)}
    return rendered("model.m", **known, **e.sizes), found


MATRICES = ("A", "Bu", "Bw", "Cz", "Dzu", "Cy", "Dyu", "Dyw")
"""Of the linear block."""
