"""Known model: equations in physical units, with parameters that a fit may estimate."""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import torch

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer, number, reals
from lfrtorch._support.errors import InputError
from lfrtorch.maps.known_map import METHODS, KnownEquations, KnownModel
from lfrtorch.maps.operations import Formula, UntraceableError


@typed()
@dataclass(frozen=True)
class Parameter:
    """Physical parameter, estimated by a fit.

    Args:
        value: initial value of the fit.
        low, high: bounds that the fit keeps.
        unit: unit, as "kg".
        scale: approximate change of the value in a fit. Default: |value|, or the distance of the
            bounds, or 1.

    Raises:
        ValueError: a value beyond the bounds, or a scale that is not positive.

    Example:
        >>> lfrtorch.Parameter(0.5, low=0.0, unit="kg")
        Parameter(value=0.5, low=0.0, high=inf, unit='kg', scale=None)
    """

    value: float
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    scale: float | None = None

    def __post_init__(self) -> None:
        _finite("value", self.value)
        if not self.low <= self.value <= self.high or self.low == self.high:
            raise InputError(
                f"a parameter has value {self.value} and bounds {self.low}, {self.high}; give low "
                "<= value <= high with low < high, or write a known value into the equations."
            )
        if self.scale is not None:
            number("scale", self.scale, positive=True)

    @property
    def size(self) -> float:
        """The scale."""
        between = self.high - self.low
        return self.scale or abs(self.value) or (between if math.isfinite(between) else 1.0)


@typed()
@dataclass(frozen=True)
class State:
    """State with its unit.

    Args:
        name: name in the equations.
        unit: unit, as "rad/s".
        rest: value at rest, and at the beginning of a record with ``start="zero"``.
        scale: approximate rms about ``rest``. Default: rms in a simulation of the training records.

    Example:
        >>> lfrtorch.State("speed", unit="m/s")
        State(name='speed', unit='m/s', rest=0.0, scale=None)
    """

    name: str
    unit: str = ""
    rest: float = 0.0
    scale: float | None = None

    def __post_init__(self) -> None:
        _finite("rest", self.rest)
        if self.scale is not None:
            number("scale", self.scale, positive=True)


@typed()
class Known:
    """Model of the physics: dx/dt = f(x, u, p), y = h(x, u, p), or x(k+1) = f(x, u, p).

    All signals and parameters are in physical units. ``f`` and ``outputs`` are composed of torch's
    functions: x and p have the states and parameters by name, u the inputs in their order. They are
    called once, and their operations are recorded: a model does not need them afterwards.

    Args:
        f: the rates, or the next states with ``method="discrete"``: a tuple, one for each state.
        states: names, or a :class:`State` each.
        parameters: parameters to estimate, by name: a :class:`Parameter`, or an initial value.
        outputs: y, a tuple. Default: the states with the names of the data's outputs; if there are
            as many states as outputs, the remaining ones follow in their order.
        method: integration over a sample: ``"rk4"``, the classical method of Runge and Kutta,
            ``"euler"``, or ``"discrete"``.
        substeps: steps of the method in a sample (in half a sample with ``"bl"``).
        intersample: the inputs between samples: ``"zoh"``, held until the next, as a converter
            does, or ``"bl"``, samples of a band-limited signal. The latter are held from half a
            sample before to half a sample after each, so that x is the state half a sample before.
        sees: inputs of a learned part beside the model: states by name, and ``"u"`` for the
            inputs. Default: all.
        acts_on: states by name, and ``"y"`` for the outputs, that the learned part acts on.
            Default: all. For example, the rate of a position is exactly the speed, so an unknown
            effect acts on the speed alone.

    Raises:
        ValueError: names that are not Python names, that are repeated or that are unknown; once
            the data are known, functions other than of scalars and torch's elementary functions.

    Example:
        >>> def pendulum(x, u, p):
        ...     return x.speed, u[0] - p.damping * x.speed - p.gravity * torch.sin(x.angle)
        >>> known = lfrtorch.Known(
        ...     pendulum,
        ...     states=["angle", lfrtorch.State("speed", unit="rad/s")],
        ...     parameters={"damping": lfrtorch.Parameter(0.1, low=0.0), "gravity": 9.81},
        ... )
        >>> known
        Known(pendulum: angle, speed; damping, gravity)
    """

    def __init__(
        self,
        f: Callable[..., Any],
        *,
        states: Sequence[str] | Sequence[State] | Sequence[str | State],
        parameters: Mapping[str, Any] | None = None,
        outputs: Callable[..., Any] | None = None,
        method: Literal["rk4", "euler", "discrete"] = "rk4",
        substeps: int = 1,
        intersample: Literal["zoh", "bl"] = "zoh",
        sees: Sequence[str] | None = None,
        acts_on: Sequence[str] | None = None,
    ) -> None:
        self.f, self.outputs, self.method, self.substeps = f, outputs, method, substeps
        self.states = tuple(s if isinstance(s, State) else State(s) for s in states)
        self.parameters = {
            name: value if isinstance(value, Parameter) else Parameter(value)
            for name, value in (parameters or {}).items()
        }
        integer("substeps", substeps, 1)
        if method not in METHODS or (method == "discrete" and substeps > 1):
            raise InputError(
                f"method is {method!r} and substeps {substeps}; give one of {', '.join(METHODS)}, "
                "and substeps=1 with 'discrete'."
            )
        self.centred = intersample == "bl"
        if self.centred and method == "discrete":
            raise InputError(
                "intersample is 'bl', but a discrete model has nothing between samples."
            )
        if not self.states:
            raise InputError("states is empty; name at least one.")
        try:
            self._x = namedtuple("x", [state.name for state in self.states])
            self._p = namedtuple("p", self.parameters)
        except (ValueError, TypeError) as error:
            raise InputError(f"a state or a parameter has an invalid name: {error}.") from None
        self.sees, self.acts_on = (
            self._among("sees", sees, "u"),
            self._among("acts_on", acts_on, "y"),
        )

    def _among(self, argument: str, given: Sequence[str] | None, signal: str) -> tuple[str, ...]:
        """Names of states and of a signal; all if none are given."""
        names = (*self._x._fields, signal)
        unknown = [name for name in given or () if name not in names]
        if unknown or (given is not None and not given):
            raise InputError(f"{argument} is {given!r}; give some of {', '.join(names)}.")
        return names if given is None else tuple(given)

    def __repr__(self) -> str:
        name = getattr(self.f, "__name__", type(self.f).__name__)
        return f"Known({name}: {', '.join(self._x._fields)}; {', '.join(self.parameters)})"

    def observed(self, outputs: Sequence[str]) -> tuple[str, ...]:
        """States that are the outputs of the data, by name, if ``outputs`` is not given.

        Raises:
            ValueError: outputs without the name of a state, whose number differs from that of the
                remaining states.
        """
        names = self._x._fields
        others = [name for name in outputs if name not in names]
        left = [name for name in names if name not in outputs]
        if others and len(others) != len(left):
            raise InputError(
                f"the known model has {len(names)} state(s), {', '.join(names)}, and the data have "
                f"{len(outputs)} output(s), {', '.join(outputs)};\nname outputs by the states that "
                "they are, or give outputs=, a function of (x, u, p) that returns a value for each "
                f"output, for instance lambda x, u, p: (x.{names[0]},)."
            )
        found = dict(zip(others, left, strict=False))
        return tuple(found.get(name, name) for name in outputs)

    def equations(self, nu: int, outputs: Sequence[str]) -> KnownEquations:
        """Tables of operations of the equations, for ``inputs`` inputs and outputs of these names.

        Raises:
            ValueError: functions that have no table, or return other numbers of values.
        """
        nx, count = len(self.states), len(self.parameters)

        def traced(function: Callable[..., Any], what: str, results: int) -> Formula:
            def of_scalars(*v: Any) -> Any:
                x, u, p = v[:nx], v[nx : nx + nu], v[nx + nu :]
                return function(self._x(*x), tuple(u), self._p(*p))

            try:
                found = Formula.traced(of_scalars, nx + nu + count)
            except UntraceableError as error:
                raise InputError(f"{what} of the known model: {error}") from None
            except (AttributeError, IndexError, TypeError, ValueError) as error:
                raise InputError(
                    f"{what} of the known model fails: {error}. It is called as {what}(x, u, p) "
                    f"with {nx} states, {nu} input(s) and {count} parameters, single numbers each."
                ) from None
            if len(found.results) != results:
                raise InputError(
                    f"{what} of the known model returns {len(found.results)} values; give "
                    f"{results}, one for each {'state' if what == 'f' else 'output of the data'}."
                )
            return found

        f = traced(self.f, "f", nx)
        y = self.outputs or partial(_some_states, self.observed(outputs))
        h = traced(y, "outputs", len(outputs))
        names = tuple(self._x._fields), tuple(self.parameters)
        units = tuple(parameter.unit for parameter in self.parameters.values())
        how = self.method, self.substeps, self.centred
        return KnownEquations(f, h, *names, units, nu, *how)

    def map(self, nu: int, outputs: Sequence[str], fs: float) -> KnownModel:
        """Equations as a static map of an LFR, for signals in physical units, in float64."""
        found = KnownModel(self.equations(nu, outputs), 1.0 / fs, dtype=torch.float64)
        with torch.no_grad():
            for i, parameter in enumerate(self.parameters.values()):
                found.p_scale[i] = parameter.size
                found.p[i] = parameter.value / parameter.size
                found.bounds[i] = torch.tensor([parameter.low, parameter.high], dtype=torch.float64)
            for i, state in enumerate(self.states):
                scale = 1.0 if state.scale is None else state.scale
                ends = torch.tensor([state.rest, scale], dtype=torch.float64)
                found.of_z[i] = found.of_w[i] = ends
        return found


def _finite(name: str, value: Any) -> None:
    if not np.isfinite(reals(name, value)).all() or np.ndim(value):
        raise InputError(f"{name} is {value!r}; give a finite number.")


def _some_states(names: Sequence[str], x: Any, u: Any, p: Any) -> tuple[Any, ...]:
    """Outputs that are states."""
    return tuple(getattr(x, name) for name in names)
