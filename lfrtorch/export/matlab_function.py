"""Export to functions of MATLAB and Octave, with the matrices in a file."""

from __future__ import annotations

from typing import Any

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.analysis.lpv_form import lpv
from lfrtorch.export.equations import equations, observer_equations
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.extended_kalman_filter import NoiseCovariance
from lfrtorch.model.model import Model


def matlab_function(
    model: Model | LinearModel, name: str = "model", *, observer: bool | NoiseCovariance = False
) -> tuple[dict[str, str], dict[str, Any]]:
    """Functions of a model for MATLAB and Octave.

    ``[x_next, y, A, B, C, D] = NAME(x, u)`` is one sample in physical units; A, B, C and D are the
    matrices of the model linearised at x and u. The model's numbers are in ``NAME_numbers.m``. So a
    MATLAB Function block can call NAME, and code can be generated from it.
    ``[A, B, C, D, p] = NAME_lpv(x, u)`` gives the matrices of the exact LPV form,
    ``lfrtorch.analysis.lpv(model)``.

    The variables of ``NAME.mat``, for ``scipy.io.savemat``, are the matrices of the model, offsets,
    names and units of the channels, and fs. ``x_rest`` is the state at rest under the inputs'
    offsets, empty if there is none. ``lpv`` holds the matrices of the LPV form, counted by their
    third index, and the bounds of p.

    An observer adds ``s = NAME_start()``, ``s = NAME_correct(s, u, y)`` and
    ``s = NAME_advance(s, u)``: s.x is its state, and s.P the covariance of its error.

    Args:
        model: the model to export.
        name: name of the function.
        observer: ``True`` for an observer with the model's gain K, noise covariances for an
            extended Kalman filter.

    Returns:
        The texts of the functions by the names of their files, and the variables of ``NAME.mat``.

    Raises:
        ValueError: a static map other than a network or a polynomial, a name that is not an
            identifier, or an observer that the model does not have.

    Example:
        >>> texts, variables = lfrtorch.export.matlab_function(model, "actuator")
        >>> sorted(texts)
        ['actuator.m', 'actuator_lpv.m', 'actuator_numbers.m']
        >>> texts["actuator.m"].splitlines()[0]
        'function [x_next, y, A, B, C, D] = actuator(x, u)'
        >>> variables["fs"], variables["A"].shape
        (100.0, (1, 1))
    """
    model = model.to_model()
    e = equations(model, name)
    if e.map.nw and not e.weights:
        raise InputError(
            "MATLAB export needs a network or a polynomial, whose weights are arrays; export this "
            "static map to c, casadi, control, fmu or onnx."
        )
    form = lpv(model)
    literals = {n: w if w.ndim == 2 else w[:, None] for n, w in e.arrays.items()}
    found: dict[str, Any] = {}
    found["fs"] = e.fs
    for side, channels in (("input", e.inputs), ("output", e.outputs)):
        found[f"{side}_names"] = np.array([c.name for c in channels], dtype=object)[:, None]
        found[f"{side}_units"] = np.array([c.unit for c in channels], dtype=object)[:, None]
    known: dict[str, Any] = {"about": e.about("{0}({2})"), "schedule": form.schedule}
    numbers = observer_equations(model, observer)
    known |= dict.fromkeys(numbers.roots, True)
    literals |= numbers.covariances
    found["lpv"] = {letter: np.moveaxis(getattr(form, letter), 0, -1) for letter in "ABCD"}
    points = {"x0": form.x0, "u0": form.u0, "x_next0": form.x_next0, "y0": form.y0}
    found["lpv"] |= {letters: value[:, None] for letters, value in points.items()}
    found["lpv"] |= {"Cz": form.Cz, "Dzu": form.Dzu, "bounds": form.bounds}
    if e.weights and form.schedule == "map":
        found["lpv"] |= {"nodes": e.map.quadrature.t, "weights": e.map.quadrature.weight}
    known["literals"] = [(n, _literal(w)) for n, w in literals.items()]
    templates = {"": "model.m", "_lpv": "model_lpv.m", "_numbers": "model_numbers.m"}
    texts = {f"{name}{end}.m": e.rendered(file, **known) for end, file in templates.items()}
    for part in ("start", "correct", "advance") if observer is not False else ():
        texts[f"{name}_{part}.m"] = e.rendered("model_observer.m", part=part, **known)
    return texts, found | literals


def _literal(M: Array) -> str:
    """Write a matrix as a literal; reading it back gives the same bits."""
    if not M.size:
        return f"zeros({len(M)}, {M.shape[1]})"
    rows = ("    " + " ".join(repr(float(v)) for v in row) for row in M)
    return "[\n" + "\n".join(rows) + "\n]"
