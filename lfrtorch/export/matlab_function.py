"""A model as functions of MATLAB and Octave with its matrices in a file."""

from __future__ import annotations

from typing import Any

import numpy as np

from lfrtorch.analysis.lpv_form import gauss_legendre, lpv
from lfrtorch.engine.nonlinearity import Network, Polynomial
from lfrtorch.export.equations import check_name, equations, rendered
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import Model


def matlab_function(
    model: Model | LinearModel, name: str = "model"
) -> tuple[str, str, dict[str, Any]]:
    """A model as functions of MATLAB and Octave.

    ``[x_next, y, A, B, C, D] = NAME(x, u)`` is one sample in physical units; A, B, C and D are the
    matrices of the model linearised there. ``[A, B, C, D, p] = NAME_lpv(x, u)`` has those of the
    exact LPV form, ``lfrtorch.analysis.lpv(model)``. Both load what ``scipy.io.savemat`` writes to
    ``NAME.mat`` beside them: all matrices of the model, offsets, names and units of the channels,
    fs, the state ``x_rest`` at rest under the inputs' offsets (empty if there is none), and in
    ``lpv`` the matrices of the LPV form (the third index counts them) and its bounds.

    Args:
        model: what is exported.
        name: of the function.

    Returns:
        The texts of ``NAME.m`` and ``NAME_lpv.m``, and the variables of ``NAME.mat``.

    Raises:
        ValueError: a static map of the user's own class, or a name that is no identifier.

    Example:
        >>> text, lpv_text, variables = lfrtorch.export.matlab_function(model, "actuator")
        >>> text.splitlines()[0]
        'function [x_next, y, A, B, C, D] = actuator(x, u)'
        >>> lpv_text.splitlines()[0]
        'function [A, B, C, D, p] = actuator_lpv(x, u)'
        >>> variables["fs"], variables["A"].shape
        (100.0, (1, 1))
    """
    check_name(name)
    model = model.to_model() if isinstance(model, LinearModel) else model
    e, form = equations(model), lpv(model)
    found: dict[str, Any] = {n: w if w.ndim == 2 else w[:, None] for n, w in e.arrays.items()}
    found["fs"] = e.fs
    for side, channels in (("input", e.inputs), ("output", e.outputs)):
        found[f"{side}_names"] = np.array([c.name for c in channels], dtype=object)[:, None]
        found[f"{side}_units"] = np.array([c.unit for c in channels], dtype=object)[:, None]
    known = {
        "name": name,
        "NAME": name.upper(),
        "about": e.about(name, "{0}({2})"),
        "static": e.static,
        "rest": e.x_rest.size,
    }
    match e.static:
        case Network():
            known["value"], known["slope"] = e.static.sigma.matlab
            known["mean_slope"] = e.static.sigma.matlab_mean_slope
        case Polynomial():
            known["monomials"] = e.static.C.shape[1]
            # Numbers of monomials and of z count from 1.
            growth = [(m + 1.0, j + 1.0) for m, j in e.static.growth]
            slopes = [
                (n + 1.0, j + 1.0, float(times), m + 1.0) for n, j, times, m in e.static.slopes
            ]
            found |= {"growth": np.array(growth), "slopes": np.array(slopes)}
    found["lpv"] = {letter: np.moveaxis(getattr(form, letter), 0, -1) for letter in "ABCD"}
    points = {"x0": form.x0, "u0": form.u0, "x_next0": form.x_next0, "y0": form.y0}
    found["lpv"] |= {letters: value[:, None] for letters, value in points.items()}
    found["lpv"] |= {"Cz": form.Cz, "Dzu": form.Dzu, "bounds": form.bounds}
    if isinstance(e.static, Polynomial):
        nodes = gauss_legendre(e.static)
        found["lpv"] |= dict(zip(("nodes", "weights"), nodes, strict=True))
    known["schedule"] = form.schedule
    known |= e.sizes
    return rendered("model.m", **known), rendered("model_lpv.m", **known), found
