"""Export to a system of python-control, and to the Python code that makes one."""

from __future__ import annotations

from typing import Any

from lfrtorch._support.optional import imported
from lfrtorch.export.equations import equations
from lfrtorch.linear.control import control_labels
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.formula_code import PYTHON
from lfrtorch.model.model import Model

_NUMPY = {
    name: text.replace("math.a", "np.arc").replace("math.", "np.") for name, text in PYTHON.items()
} | {
    "sigmoid": "0.5 + 0.5 * np.tanh(0.5 * {0})", "relu": "np.maximum({0}, 0.0)",
    "softplus": "np.logaddexp({0}, 0.0)", "sign": "np.sign({0})",
    "where": "np.where({0}, {1}, {2})", "maximum": "np.maximum({0}, {1})",
    "minimum": "np.minimum({0}, {1})", "and": "np.logical_and({0}, {1})",
    "or": "np.logical_or({0}, {1})", "not": "np.logical_not({0})",
}  # fmt: skip
"""Operations of formulas in numpy, on numbers or arrays, which may be infinite."""


def control_system(model: Model | LinearModel, name: str = "model") -> Any:
    """Export a model as a ``control.NonlinearIOSystem`` in discrete time, physical units.

    Dots in channel names, which that package does not allow, become underscores. If two names
    become the same, the second one gets another underscore.

    Args:
        model: the model to export.
        name: name of the system.

    Raises:
        ValueError: control is not installed, a static map without equations, or a name that
            is not an identifier.

    Example:
        >>> import control
        >>> system = lfrtorch.export.control_system(model, "actuator")
        >>> system.dt, system.input_labels, system.output_labels
        (0.01, ['u'], ['y'])
        >>> u = record.u[:50].T
        >>> y = control.input_output_response(system, np.arange(50) / 100.0, u).outputs
        >>> np.allclose(y, model.simulate(record.u[:50])[:, 0])
        True
    """
    imported("control", "control")
    names: dict[str, Any] = {}
    exec(python_source(model, name), names)
    return names["system"]()


def python_source(model: Model | LinearModel, name: str = "model") -> str:
    """Python code that needs numpy alone: ``step(x, u)``, and ``system()`` for control.

    Args:
        model: the model to export.
        name: name of the system.

    Raises:
        ValueError: a static map without equations, or a name that is not an identifier.

    Example:
        >>> made = {}
        >>> exec(lfrtorch.export.python_source(model), made)
        >>> x_next, y = made["step"](np.zeros(1), np.ones(1))
        >>> np.allclose(y, model.simulate([1.0])[0])
        True
    """
    e = equations(model, name)
    labels = {side: control_labels(getattr(e, side)) for side in ("inputs", "outputs")}
    known = {"about": e.about(), "fs": float(e.fs), "labels": labels}
    return e.rendered("model_py.txt", _NUMPY, **known, repr=repr)
