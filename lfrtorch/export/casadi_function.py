"""A model as a function of CasADi, made of its own expressions."""

from __future__ import annotations

from typing import Any

from lfrtorch._support.optional import imported
from lfrtorch.export.equations import Layers, Monomials, check_name, equations
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import Model


def casadi_function(model: Model | LinearModel, name: str = "model") -> Any:
    """One sample of a model as a ``casadi.Function`` (x, u) -> (x_next, y), physical units.

    It is a graph of scalars (SX) without calls of Python, so that CasADi has derivatives of any
    order, can print it as C, and solvers may run it in threads.

    Args:
        model: what is exported.
        name: of the function.

    Shape:
        x: (nx,), u: (nu,) -> x_next: (nx,), y: (ny,).

    Raises:
        ValueError: casadi is not installed, a static map of the user's own class, or a name that is
            no identifier.

    Example:
        >>> f = lfrtorch.export.casadi_function(model, "actuator")
        >>> f
        Function(actuator:(x,u)->(x_next,y) SXFunction)
        >>> x_next, y = f(0, 0.5)
        >>> bool(abs(float(y) - model.simulate([0.5])[0, 0]) < 1e-12)
        True
    """
    ca = imported("casadi", "casadi")
    check_name(name)
    e = equations(model)
    x = ca.SX.sym("x", e.sizes["nx"])
    u = ca.vertcat(*(ca.SX.sym(channel.name) for channel in e.inputs))
    v = u - e.u_offset
    x_next, y = ca.mtimes(e.A, x) + ca.mtimes(e.Bu, v), ca.mtimes(e.Cy, x) + ca.mtimes(e.Dyu, v)
    if e.static:
        w = _static(ca, e.static, ca.mtimes(e.Cz, x) + ca.mtimes(e.Dzu, v))
        x_next, y = x_next + ca.mtimes(e.Bw, w), y + ca.mtimes(e.Dyw, w)
    return ca.Function(name, [x, u], [x_next, y + e.y_offset], ["x", "u"], ["x_next", "y"])


def _static(ca: Any, static: Layers | Monomials, z: Any) -> Any:
    """w = f(z)."""
    if isinstance(static, Monomials):
        m = [ca.SX(1.0)]
        for before, j in static.growth:
            m.append(m[before] * z[j])
        return ca.mtimes(static.C, ca.vertcat(*m))
    *layers, (W, b) = zip(static.W, static.b, strict=True)
    for W_h, b_h in layers:
        v = ca.mtimes(W_h, z) + b_h
        match static.activation:
            case "tanh":
                z = ca.tanh(v)
            case "sigmoid":
                z = 0.5 + 0.5 * ca.tanh(0.5 * v)  # no overflow, in derivatives neither
            case "relu":
                z = ca.fmax(v, 0.0)
            case "rbf":
                z = ca.exp(-v * v)
            case _:
                z = ca.fmax(v, 0.0) + ca.log1p(ca.exp(-ca.fabs(v)))  # softplus
    return ca.mtimes(W, z) + b
