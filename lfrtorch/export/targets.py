"""Targets of exports by their names on the command line."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from lfrtorch._support import checkpoint
from lfrtorch._support.arguments import typed
from lfrtorch._support.atomic import refuse_existing, whole_file
from lfrtorch._support.errors import InputError
from lfrtorch.export.c_source import c_source
from lfrtorch.export.casadi_function import casadi_function, casadi_observer, casadi_reach
from lfrtorch.export.control_system import python_source
from lfrtorch.export.equations import equations
from lfrtorch.export.fmu import fmu
from lfrtorch.export.matlab_function import matlab_function
from lfrtorch.export.onnx_graph import onnx_models
from lfrtorch.export.torch_program import torch_files
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.extended_kalman_filter import NoiseCovariance
from lfrtorch.model.model import Disturbance, Model


class Target(NamedTuple):
    """Target of an export.

    Args:
        files: function of model and name: text or bytes of each file by its name, in their order.
        use: a line of a program that uses the files, with {name} and the {path} of the first file.
        follow: such a line for the observer, with the {path} of the last file; empty if the target
            has no observer. ``files`` takes the observer as an argument, too.
    """

    files: Callable[..., Mapping[str, str | bytes]]
    use: str
    follow: str = ""

    def usage(self, name: str, paths: list[Path], observer: bool | NoiseCovariance) -> str:
        """Return the line of a program that uses the files, or their observer if there is one."""
        if observer is False:
            return self.use.format(name=name, path=paths[0])
        P = ", P=P" if isinstance(observer, NoiseCovariance) else ""
        return self.follow.format(name=name, path=paths[-1], P=P)


def _c(model: Model | LinearModel, name: str, **options: Any) -> dict[str, str | bytes]:
    return dict(zip((f"{name}.h", f"{name}.c"), c_source(model, name, **options), strict=True))


def _casadi(
    model: Model | LinearModel, name: str, observer: bool | NoiseCovariance
) -> dict[str, str | bytes]:
    e = equations(model, name)
    found: dict[str, Any] = {".casadi": casadi_function(model, name)}
    found["_channels.json"] = json.dumps(e.description(), indent=2) + "\n"
    if e.distance is not None:
        found["_reach.casadi"] = casadi_reach(model.to_model(), name)
    if observer is not False:
        names = "_predict.casadi", "_correct.casadi", "_update.casadi"
        found |= zip(names, casadi_observer(model, name, observer=observer), strict=True)
    return {f"{name}{end}": _saved(each) for end, each in found.items()}


def _saved(function: Any) -> str | bytes:
    """Serialise a function as CasADi saves it; a text stays unchanged."""
    if isinstance(function, str):
        return function
    with tempfile.TemporaryDirectory() as folder:
        function.save(str(path := Path(folder) / "saved"))
        return path.read_bytes()


def _onnx(model: Model | LinearModel, name: str) -> dict[str, str | bytes]:
    sample, simulation = (graph.SerializeToString() for graph in onnx_models(model, name))
    return {f"{name}.onnx": sample, f"{name}_simulate.onnx": simulation}


def _matlab(
    model: Model | LinearModel, name: str, observer: bool | NoiseCovariance
) -> dict[str, str | bytes]:
    from scipy.io import savemat

    texts, variables = matlab_function(model, name, observer=observer)
    savemat(file := io.BytesIO(), variables)
    first = f"{name}.m"
    return {first: texts.pop(first), f"{name}.mat": file.getvalue(), **texts}


def _fmu(model: Model | LinearModel, name: str, version: int) -> dict[str, str | bytes]:
    return {f"{name}.fmu": fmu(model, name, version)}


_IN_C = (
    "{name}_step(x, u, x_next, y);",
    "{name}_observer_correct(&observer, u, y); {name}_observer_advance(&observer, u);",
)

TARGETS = {
    "c": Target(_c, *_IN_C),
    "c_float": Target(partial(_c, single=True), *_IN_C),
    "casadi": Target(
        _casadi,
        "x_next, y = casadi.Function.load('{path}')(x, u)",
        "after = casadi.Function.load('{path}')(x=x, u=u, y=y{P})",
    ),
    "onnx": Target(
        _onnx,
        "x_next, y = onnxruntime.InferenceSession('{path}').run(None, {{'x': x, 'u': u}})",
    ),
    "matlab": Target(
        _matlab,
        "[x_next, y] = {name}(x, u)",
        "s = {name}_correct(s, u, y); s = {name}_advance(s, u);",
    ),
    "control": Target(
        lambda model, name: {f"{name}.py": python_source(model, name)},
        "from {name} import system",
    ),
    "fmu": Target(partial(_fmu, version=2), "found = fmpy.simulate_fmu('{path}')"),
    "fmu3": Target(partial(_fmu, version=3), "found = fmpy.simulate_fmu('{path}')"),
    "torch": Target(torch_files, "x_next, y = torch.jit.load('{path}')(x, u)"),
}
"""Targets by name."""


@typed()
def write(
    model: Model | LinearModel,
    to: str,
    folder: str | Path = ".",
    *,
    name: str = "model",
    overwrite: bool = False,
    observer: bool | NoiseCovariance = False,
    disturbance: Disturbance | None = None,
) -> list[Path]:
    """Write a model as files of another tool.

    Args:
        model: the model to export.
        to: ``"c"``: ``NAME.h`` and ``NAME.c``, or ``"c_float"`` in single precision;
            ``"casadi"``: ``NAME.casadi``, which ``casadi.Function.load`` reads, and
            ``NAME_channels.json`` with channels and rate;
            ``"onnx"``: ``NAME.onnx`` for a sample and ``NAME_simulate.onnx``; ``"matlab"``:
            ``NAME.m``, ``NAME_numbers.m`` and ``NAME_lpv.m`` with ``NAME.mat``; ``"control"``:
            ``NAME.py``, whose ``system()`` is a ``control.NonlinearIOSystem``; ``"fmu"`` and
            ``"fmu3"``: ``NAME.fmu``, FMI 2.0 or 3.0; ``"torch"``: ``NAME.pt``, TorchScript in
            float32, and ``NAME.pt2`` and ``NAME_simulate.pt2``, programs of ``torch.export``.
        folder: folder of the files; it is created if needed.
        name: name of the files and of the model in them.
        overwrite: replace files that exist.
        observer: for C, CasADi and MATLAB, ``True`` adds the observer with the model's gain K,
            noise covariances an extended Kalman filter.
        disturbance: where constant disturbances act; they become the last states, which the
            filter estimates, see ``Model.with_disturbance``.

    Returns:
        The files.

    Raises:
        ValueError: an unknown target, a target whose package is not installed, a name that is not
            an identifier, a file that exists, the folder of a checkpoint, a static map without
            equations, an observer that the target or the model does not have, or a disturbance
            without noise for the filter.

    Example:
        >>> [path.name for path in lfrtorch.export.write(model, "c", "made", name="actuator")]
        ['actuator.h', 'actuator.c']
    """
    if to not in TARGETS:
        raise InputError(f"to is {to!r}; give one of {', '.join(TARGETS)}.")
    if disturbance is not None:
        if not isinstance(observer, NoiseCovariance):
            raise InputError(
                "a disturbance is estimated by a Kalman filter: give observer=noise, too "
                "(observer=true Q=... R=... on the command line)."
            )
        model = model.to_model()
        model, observer = model.with_disturbance(disturbance, observer)
    target = TARGETS[to]
    if not target.follow and observer is not False:
        known = ", ".join(name for name, each in TARGETS.items() if each.follow)
        raise InputError(f"there is no observer for to={to!r}; give one of {known}.")
    if (Path(folder) / checkpoint.DESCRIPTION).is_file():
        raise InputError(
            f"'{folder}' is a checkpoint, which holds nothing else; give another folder."
        )
    files = target.files(model, name, **({"observer": observer} if target.follow else {}))
    paths = [Path(folder) / file for file in files]
    if not overwrite:
        for path in paths:
            refuse_existing(path, "overwrite=True")
    with ExitStack() as all_or_none:
        whole = [all_or_none.enter_context(whole_file(path)) for path in paths]
        for path, content in zip(whole, files.values(), strict=True):
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return paths
