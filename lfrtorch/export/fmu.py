"""Export to a functional mock-up unit for co-simulation, FMI 2.0 or 3.0, compiled from C code."""

from __future__ import annotations

import io
import platform
import shutil
import subprocess
import tempfile
import uuid
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch.export.c_source import c_source
from lfrtorch.export.equations import Equations, equations, printable
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model


def write_fmu(
    model: Model | LinearModel, path: str | Path, name: str = "model", *, version: int = 2
) -> None:
    """Write a model as an FMU for co-simulation: a binary for Linux x86_64 and its sources.

    Inputs, outputs and states are real variables with the channels' names and units; the states can
    be set before the simulation starts. The model samples its inputs every 1 / fs seconds and holds
    its outputs in between, so that a communication step may have any size. An output at a sample
    follows from the state and from the inputs at the time when it is read. The whole state can be
    saved, restored and serialized. Outputs have directional derivatives with inputs and states, and
    the description lists the inputs of each output.

    Args:
        model: the model to export.
        path: the file.
        name: name of the model in it.
        version: version of FMI, 2 or 3.

    Raises:
        ValueError: no C compiler, a machine other than Linux on x86_64, a static map without
            equations, or a name that is not an identifier.

    Example:
        >>> lfrtorch.export.write_fmu(model, "actuator.fmu", "actuator")
    """
    Path(path).write_bytes(fmu(model, name, version))


def fmu(model: Model | LinearModel, name: str, version: int) -> bytes:
    """The bytes of the FMU, a zip archive."""
    header, source = c_source(model, name)
    e = equations(model, name)
    known: dict[str, Any] = {"version": version, "u_start": e.u_offset.tolist()}
    known["guid"] = str(uuid.uuid5(uuid.NAMESPACE_OID, header + source))
    known |= {"title": " ".join(e.about()[:2]), "ts": repr(1.0 / e.fs)}
    known["variables"] = _variables(e) if version == 3 else _variables(e)[:-1]  # FMI 3 has the time
    known["units"] = list(dict.fromkeys(unit for _, unit, *_ in known["variables"] if unit))
    # The inputs that each output depends on, and at the beginning also the states.
    M, nu, ny, first = e.matrices, len(e.inputs), len(e.outputs), int(version == 2)
    by_w = (M.Dyw != 0).any(axis=1)[:, None] & (M.Dzu != 0).any(axis=0)
    by_u = (M.Dyu != 0) | by_w
    known["depends"] = [(first + np.flatnonzero(row)).tolist() for row in by_u]
    known["states"] = [first + nu + ny + i for i in range(e.sizes["nx"])]
    files = {f"{name}.h": header, f"{name}.c": source}
    files[f"{name}_fmu.c"] = e.rendered("fmu.c", **known)
    machine, binary = "linux64" if version == 2 else "x86_64-linux", _compiled(files, name)
    with ZipFile(archive := io.BytesIO(), "w", ZIP_DEFLATED) as made:
        made.writestr("modelDescription.xml", e.rendered("fmu.xml", **known))
        if version == 3:
            made.writestr("sources/buildDescription.xml", e.rendered("fmu_build.xml"))
        made.writestr(f"binaries/{machine}/{name}.so", binary)
        for file, text in files.items():
            made.writestr(f"sources/{file}", text)
    return archive.getvalue()


def _compiled(files: dict[str, str], name: str) -> bytes:
    """Compile the sources to a shared library."""
    machine = platform.system(), platform.machine()
    if machine != ("Linux", "x86_64"):
        raise InputError(
            f"this machine is {' '.join(machine)}, and an FMU is compiled on Linux x86_64 alone; "
            "compile what to=c writes for your tool."
        )
    compiler = next(filter(None, map(shutil.which, ("gcc", "cc", "clang"))), None)
    if compiler is None:
        raise InputError("an FMU needs a C compiler; install gcc, or export with to=c.")
    with tempfile.TemporaryDirectory() as folder:
        for file, text in files.items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        # -Bsymbolic: functions of the same name in other libraries do not replace these.
        options = ["-std=c99", "-O2", "-fPIC", "-shared", "-Wl,-Bsymbolic"]
        sources = [file for file in files if file.endswith(".c")]
        command = [compiler, *options, "-o", "made.so", *sources, "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"{compiler} cannot compile the FMU; it says:\n{done.stderr}")
        return (Path(folder) / "made.so").read_bytes()


def _variables(e: Equations) -> list[tuple[str, str, str, float | None]]:
    """Name, unit, causality and start of each variable, by value reference; the time is last."""
    starts = e.u_offset.tolist()
    found: list[tuple[str, str, str, float | None]] = [
        *((c.name, c.unit, "input", start) for c, start in zip(e.inputs, starts, strict=True)),
        *((c.name, c.unit, "output", None) for c in e.outputs),
        *((f"x[{i + 1}]", "", "local", 0.0) for i in range(e.sizes["nx"])),
        ("time", "", "independent", None),
    ]
    named: dict[str, tuple[str, str, str, float | None]] = {}
    for label, symbol, causality, start in found:
        only = printable(label)
        while only in named:  # an output may have the name of an input
            only += "_"
        named[only] = only, printable(symbol), causality, start
    return list(named.values())
