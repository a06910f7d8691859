"""Exports by their names on the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

from lfrtorch._support import checkpoint
from lfrtorch._support.arguments import typed
from lfrtorch._support.atomic import refuse_existing, whole_file
from lfrtorch._support.errors import InputError
from lfrtorch.export.c_source import c_source
from lfrtorch.export.casadi_function import casadi_function, casadi_observer, casadi_reach
from lfrtorch.export.control_system import python_source
from lfrtorch.export.equations import check_name, equations
from lfrtorch.export.fmu import write_fmu
from lfrtorch.export.matlab_function import matlab_function
from lfrtorch.export.onnx_graph import onnx_models
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.extended_kalman_filter import NoiseCovariance
from lfrtorch.model.model import Disturbance, Model


class Target(NamedTuple):
    """One kind of export.

    Args:
        endings: of the files NAME.h, ..
        write: model, name and paths -> files there.
        use: a line of a program that uses it, with {name} and the {path} of the first file.
        observer: endings of further files with an observer; None if there is no observer.
            ``write`` then takes one.
        follow: what ``use`` is with an observer; {path} is the last file.
        reach: endings of further files of a model that knows the reach of its data.
    """

    endings: tuple[str, ...]
    write: Callable[..., object]
    use: str
    observer: tuple[str, ...] | None = None
    follow: str = ""
    reach: tuple[str, ...] = ()

    def usage(self, name: str, paths: list[Path], observer: bool | NoiseCovariance) -> str:
        """The line of a program that uses the files, the observer's if there is one."""
        if observer is False:
            return self.use.format(name=name, path=paths[0])
        P = ", P=P" if isinstance(observer, NoiseCovariance) else ""
        return self.follow.format(name=name, path=paths[-1], P=P)


def _c(
    model: Model | LinearModel,
    name: str,
    paths: list[Path],
    observer: bool | NoiseCovariance,
    single: bool = False,
) -> None:
    texts = c_source(model, name, observer=observer, single=single)
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text, encoding="utf-8")


def _casadi(
    model: Model | LinearModel, name: str, paths: list[Path], observer: bool | NoiseCovariance
) -> None:
    functions = [casadi_function(model, name)]
    if isinstance(model, Model) and knows_reach(model):
        functions.append(casadi_reach(model, name))
    if observer is not False:
        functions += casadi_observer(model, name, observer=observer)
    for function, path in zip(functions, [paths[0], *paths[2:]], strict=True):
        function.save(str(path))
    paths[1].write_text(json.dumps(equations(model).description(name), indent=2) + "\n")


def knows_reach(model: Model | LinearModel) -> bool:
    """Whether a model tells how far the data of its fit went in its static map."""
    return isinstance(model, Model) and model.reach is not None and model.lfr.cell.nz > 0


def _onnx(model: Model | LinearModel, name: str, paths: list[Path]) -> None:
    for path, graph in zip(paths, onnx_models(model, name), strict=True):
        path.write_bytes(graph.SerializeToString())


def _matlab(
    model: Model | LinearModel, name: str, paths: list[Path], observer: bool | NoiseCovariance
) -> None:
    from scipy.io import savemat

    texts, variables = matlab_function(model, name, observer=observer)
    savemat(paths[1], variables)
    for path, text in zip([paths[0], *paths[2:]], texts.values(), strict=True):
        path.write_text(text, encoding="utf-8")


TARGETS = {
    "c": Target(
        (".h", ".c"),
        _c,
        "{name}_step(x, u, x_next, y);",
        (),
        "{name}_observer_correct(&observer, u, y); {name}_observer_advance(&observer, u);",
    ),
    "c_float": Target(
        (".h", ".c"),
        partial(_c, single=True),
        "{name}_step(x, u, x_next, y);",
        (),
        "{name}_observer_correct(&observer, u, y); {name}_observer_advance(&observer, u);",
    ),
    "casadi": Target(
        (".casadi", "_channels.json"),
        _casadi,
        "x_next, y = casadi.Function.load('{path}')(x, u)",
        ("_predict.casadi", "_correct.casadi", "_update.casadi"),
        "after = casadi.Function.load('{path}')(x=x, u=u, y=y{P})",
        ("_reach.casadi",),
    ),
    "onnx": Target(
        (".onnx", "_simulate.onnx"),
        _onnx,
        "x_next, y = onnxruntime.InferenceSession('{path}').run(None, {{'x': x, 'u': u}})",
    ),
    "matlab": Target(
        (".m", ".mat", "_lpv.m", "_numbers.m"),
        _matlab,
        "[x_next, y] = {name}(x, u)",
        ("_start.m", "_correct.m", "_advance.m"),
        "s = {name}_correct(s, u, y); s = {name}_advance(s, u);",
    ),
    "control": Target(
        (".py",),
        lambda model, name, paths: paths[0].write_text(python_source(model, name), "utf-8"),
        "from {name} import system",
    ),
    "fmu": Target(
        (".fmu",),
        lambda model, name, paths: write_fmu(model, paths[0], name),
        "found = fmpy.simulate_fmu('{path}')",
    ),
    "fmu3": Target(
        (".fmu",),
        lambda model, name, paths: write_fmu(model, paths[0], name, version=3),
        "found = fmpy.simulate_fmu('{path}')",
    ),
}
"""All kinds of export."""


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
        model: what is exported.
        to: ``"c"``: ``NAME.h`` and ``NAME.c``, or ``"c_float"`` in single precision;
            ``"casadi"``: ``NAME.casadi``, which ``casadi.Function.load`` reads, and
            ``NAME_channels.json`` with channels and rate;
            ``"onnx"``: ``NAME.onnx`` for a sample and ``NAME_simulate.onnx``; ``"matlab"``:
            ``NAME.m``, ``NAME_numbers.m`` and ``NAME_lpv.m`` with ``NAME.mat``; ``"control"``:
            ``NAME.py``, whose ``system()`` is a ``control.NonlinearIOSystem``; ``"fmu"`` and
            ``"fmu3"``: ``NAME.fmu``, FMI 2.0 or 3.0.
        folder: where to; it is made if need be.
        name: of the files, and in them.
        overwrite: whether files that exist may be replaced.
        observer: of C, CasADi and MATLAB, ``True`` for the observer with the model's gain K as
            well, or noise for an extended Kalman filter.
        disturbance: constant disturbances are the last states, and the filter finds them, see
            ``Model.with_disturbance``.

    Returns:
        The files.

    Raises:
        ValueError: an unknown target, one whose package is not installed, a name that is no
            identifier, a file that exists, the folder of a checkpoint, a static map
            without equations, an observer that the target or the model has not, or a disturbance
            without noise for the filter.

    Example:
        >>> [path.name for path in lfrtorch.export.write(model, "c", "made", name="actuator")]
        ['actuator.h', 'actuator.c']
    """
    if to not in TARGETS:
        raise InputError(f"to is {to!r}; give one of {', '.join(TARGETS)}.")
    check_name(name)
    if disturbance is not None:
        if not isinstance(observer, NoiseCovariance):
            raise InputError(
                "a disturbance is estimated by a Kalman filter: give observer=noise, too "
                "(observer=true Q=... R=... on the command line)."
            )
        model = model.to_model()
        model, observer = model.with_disturbance(disturbance, observer)
    target, given = TARGETS[to], {}
    endings = target.endings + (target.reach if knows_reach(model) else ())
    if target.observer is not None:
        given = {"observer": observer}
        endings += () if observer is False else target.observer
    elif observer is not False:
        known = ", ".join(name for name, each in TARGETS.items() if each.observer is not None)
        raise InputError(f"there is no observer for to={to!r}; give one of {known}.")
    if (Path(folder) / checkpoint.DESCRIPTION).is_file():
        raise InputError(
            f"'{folder}' is a checkpoint, which holds nothing else; give another folder."
        )
    paths = [Path(folder) / f"{name}{ending}" for ending in endings]
    if not overwrite:
        for path in paths:
            refuse_existing(path, "overwrite=True")
    with ExitStack() as all_or_none:
        whole = [all_or_none.enter_context(whole_file(p)) for p in paths]
        target.write(model, name, whole, **given)
    return paths
