"""Export to functions of CasADi, made of its own expressions."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from functools import reduce
from typing import Any

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.optional import imported
from lfrtorch._support.types import Array
from lfrtorch.export.equations import equations, observer_equations
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.operations import Formula
from lfrtorch.model.extended_kalman_filter import NoiseCovariance
from lfrtorch.model.model import Model


def casadi_function(model: Model | LinearModel, name: str = "model") -> Any:
    """Export one sample of a model as a ``casadi.Function`` (x, u) -> (x_next, y), physical units.

    It is a graph of scalars (SX) without calls of Python. So CasADi has its derivatives of any
    order and can print it as C, and solvers may run it in threads. CasADi expands a number that is
    given in place of a vector, and refuses other sizes.

    Args:
        model: the model to export.
        name: name of the function.

    Shape:
        x: (nx,), u: (nu,) -> x_next: (nx,), y: (ny,).

    Raises:
        ValueError: casadi is not installed, a static map without equations, or a name that is
            not an identifier.

    Example:
        >>> f = lfrtorch.export.casadi_function(model, "actuator")
        >>> f
        Function(actuator:(x,u)->(x_next,y) SXFunction)
        >>> x_next, y = f(0, 0.5)
        >>> bool(abs(float(y) - model.simulate([0.5])[0, 0]) < 1e-12)
        True
    """
    ca = imported("casadi", "casadi")
    e = equations(model, name)
    x = ca.SX.sym("x", e.sizes["nx"])
    u = ca.vertcat(*(ca.SX.sym(channel.name) for channel in e.inputs))
    made = e.sample(_Expressions(ca, e.arrays), x, u)
    return ca.Function(name, [x, u], made, ["x", "u"], ["x_next", "y"])


def casadi_reach(model: Model, name: str = "model") -> Any:
    """Distance of an operating point from the data of the fit, as a ``casadi.Function``.

    ``NAME_reach`` is (x, u) -> (reach), the square of the surprise index: 99 % of the data are
    within 1; beyond 1 the model extrapolates. So ``reach <= 1`` is a smooth constraint.

    Args:
        model: result of ``lfrtorch.identify`` or ``Model.reaching``.
        name: first part of the function's name.

    Raises:
        ValueError: a linear model, a model without known reach, or as for ``casadi_function``.

    Example:
        >>> reach = lfrtorch.export.casadi_reach(model.reaching(record), "plant")
        >>> bool(reach(0, 0) < 1)
        True
    """
    ca = imported("casadi", "casadi")
    e = equations(model, name)
    if e.distance is None:
        raise InputError(
            "the reach of the data is not known; give model.reaching(records), of an NL-LFR."
        )
    x, u = ca.SX.sym("x", e.sizes["nx"]), ca.SX.sym("u", e.sizes["nu"])
    (T, t), language = e.distance, _Expressions(ca, e.arrays)
    z = language.total("z", {"Cz": x, "Dzu": language.deviation(u)})
    square = ca.sumsqr(ca.mtimes(T, z) - t)
    return ca.Function(f"{name}_reach", [x, u], [square], ["x", "u"], ["reach"])


def casadi_observer(
    model: Model | LinearModel, name: str = "model", *, observer: bool | NoiseCovariance = True
) -> tuple[Any, Any, Any]:
    """Observer of a model as three ``casadi.Function``, physical units.

    ``NAME_predict`` is (x, u) -> (y_hat). ``NAME_update`` is (x, u, y, missing) -> (x_next) with
    the gain K, and (x, u, y, missing, P) -> (x_next, P_next) of an extended Kalman filter.
    ``NAME_correct`` takes the same and gives the state and P updated by the output of this sample,
    from which a controller chooses u; ``update`` then takes the earlier x and P. A constant gain K
    leaves the state unchanged. The u of ``correct`` does not matter without feedthrough.

    An output is ignored if its ``missing`` is 1; by default all are used. If P is omitted or NaN,
    it is the covariance of the states over the training data, with which a filter begins. The
    covariance is updated in Joseph's form.

    Args:
        model: the model to export.
        name: first part of the functions' names.
        observer: ``True`` for an observer with the model's gain K, noise covariances for an
            extended Kalman filter.

    Shape:
        x: (nx,), P: (nx, nx), u: (nu,), y, missing: (ny,).

    Raises:
        ValueError: as for ``casadi_function``, or an observer that the model does not have.

    Example:
        >>> noise = lfrtorch.NoiseCovariance(Q=1e-4, R=1e-2)
        >>> made = lfrtorch.export.casadi_observer(model, "plant", observer=noise)
        >>> predict, correct, update = made
        >>> update
        Function(plant_update:(x,u,y,missing,P)->(x_next,P_next) SXFunction)
        >>> after = update(x=0, u=0.5, y=0.2, P=model.state_covariance)
        >>> online = model.observer(noise=noise)
        >>> y_hat = online.predict(0.5)
        >>> e = online.update(0.2)
        >>> bool(abs(float(after["x_next"]) - online.state[0]) < 1e-12)
        True
        >>> bool(abs(float(after["P_next"]) - online.covariance[0, 0]) < 1e-12)
        True
    """
    ca = imported("casadi", "casadi")
    found, step = observer_equations(model, observer).covariances, casadi_function(model, name)
    nx, ny = step.size1_in("x"), step.size1_out("y")
    x, u = step.sx_in()
    y, missing = ca.SX.sym("y", ny), ca.SX.sym("missing", ny)
    x_next, y_hat = step(x, u)
    predict = ca.Function(f"{name}_predict", [x, u], [y_hat], ["x", "u"], ["y_hat"])
    e = ca.if_else(missing, 0.0, y - y_hat)
    given, names = [x, u, y, missing], ["x", "u", "y", "missing"]

    def function(kind: str, made: list[Any], named: list[str]) -> Any:
        default = [0.0] * 4 + [np.nan]
        options = {"default_in": default[: len(given)]}
        return ca.Function(f"{name}_{kind}", given, made, names, named, options)

    if "K" in found:
        made = [x_next + ca.mtimes(found["K"], e)]
        return predict, function("correct", [x], ["x_known"]), function("update", made, ["x_next"])
    given.append(ca.SX.sym("P", nx, nx))
    Q, S, R, P0 = found.values()
    P = ca.if_else(given[-1] < np.inf, given[-1], P0)
    # A missing output has a row of zeros in H, and no noise but its own.
    known = ca.diag(1.0 - missing)
    H, R, S = (
        ca.mtimes(known, ca.jacobian(y_hat, x)),
        ca.mtimes([known, R, known]) + ca.diag(missing),
        ca.mtimes(S, known),
    )
    HP = ca.mtimes(H, P)
    both = ca.solve(ca.mtimes(HP, H.T) + R, ca.horzcat(HP, S.T)).T
    L, from_e = both[:nx, :], both[nx:, :]
    corrected = x + ca.mtimes(L, e)
    x_next = step(corrected, u)[0] + ca.mtimes(from_e, e)
    F = ca.substitute(ca.jacobian(step(x, u)[0], x), x, corrected)
    I_LH = ca.DM.eye(nx) - ca.mtimes(L, H)
    P_known = ca.mtimes([I_LH, P, I_LH.T]) + ca.mtimes([L, R, L.T])
    across = ca.mtimes([F, L, S.T])
    P_next = ca.mtimes([F, P_known, F.T]) + Q - ca.mtimes(from_e, S.T) - across - across.T
    names.append("P")
    update = function("update", [x_next, 0.5 * (P_next + P_next.T)], ["x_next", "P_next"])
    return predict, function("correct", [corrected, P_known], ["x_known", "P_known"]), update


class _Expressions:
    """Columns of CasADi, and the arrays that act on them."""

    def __init__(self, ca: Any, arrays: Mapping[str, Array]) -> None:
        self.ca, self.arrays, self.operations = ca, arrays, _operations(ca)

    def deviation(self, u: Any) -> Any:
        """u - u_offset."""
        return u - self.arrays["u_offset"]

    def total(self, to: str, terms: Mapping[str, Any], offset: str = "") -> Any:
        """Sum of matrices times signals and perhaps an offset."""
        products = (self.ca.mtimes(self.arrays[M], signal) for M, signal in terms.items())
        found = reduce(operator.add, products)
        return found + self.arrays[offset] if offset else found

    def affine(self, W: str, v: Any, b: str = "") -> Any:
        """W v + b."""
        return self.total("", {W: v}, b)

    def each(self, sigma: Formula, v: Any) -> Any:
        """Apply a scalar function to every entry of v."""
        return sigma.evaluated([v], self.operations, self.ca.SX)[0]

    def table(self, formula: Formula, v: Any) -> Any:
        """Apply a table of operations to the entries of v."""
        entries = self.ca.vertsplit(v)
        return self.ca.vertcat(*formula.evaluated(entries, self.operations, self.ca.SX))


def _operations(ca: Any) -> dict[str, Any]:
    """Operations of formulas, for scalar expressions or columns."""
    same = "sqrt exp log sin cos tan asin acos atan atan2 sinh cosh tanh sign"
    return {name: getattr(ca, name) for name in same.split()} | {
        "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
        "neg": operator.neg, "pow": ca.power,
        "sigmoid": lambda v: 0.5 + 0.5 * ca.tanh(0.5 * v),  # its derivatives do not overflow either
        "relu": lambda v: ca.fmax(v, 0.0), "abs": ca.fabs, "where": ca.if_else,
        "softplus": lambda v: ca.fmax(v, 0.0) + ca.log1p(ca.exp(-ca.fabs(v))),
        "maximum": ca.fmax, "minimum": ca.fmin, "lt": ca.lt, "le": ca.le, "gt": ca.gt, "ge": ca.ge,
        "and": ca.logic_and, "or": ca.logic_or, "not": ca.logic_not,
    }  # fmt: skip
