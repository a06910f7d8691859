"""A model as a functional mock-up unit, FMI 2.0 or 3.0 for co-simulation, compiled from its C."""

from __future__ import annotations

import platform
import shutil
import subprocess
import tempfile
import uuid
from pathlib import Path
from xml.etree import ElementTree
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch.export.c_source import c_source
from lfrtorch.export.equations import Equations, equations, printable
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model

_OTHERS = {
    2: ["Integer", "Boolean", "String"],
    3: ["Float32", *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)),
        "Boolean", "String", "Binary", "Clock"],
}  # fmt: skip
"""Types of variables that there are none of, by the version of FMI."""

_UNSUPPORTED = {
    2: [
        "CancelStep",
        *(f"Get{kind}Status" for kind in ("", "Real", "Integer", "Boolean", "String")),
        "SetRealInputDerivatives", "GetRealOutputDerivatives",
    ],
    3: [
        "GetNumberOfVariableDependencies", "GetVariableDependencies", "GetAdjointDerivative",
        "EnterConfigurationMode", "ExitConfigurationMode", "EnterEventMode", "EnterStepMode",
        *(f"{way}{what}{form}" for way in ("Get", "Set") for what in ("Interval", "Shift")
          for form in ("Decimal", "Fraction")),
        "EvaluateDiscreteStates", "UpdateDiscreteStates", "EnterContinuousTimeMode",
        "CompletedIntegratorStep", "SetTime", "SetContinuousStates",
        "GetContinuousStateDerivatives", "GetEventIndicators", "GetContinuousStates",
        "GetNominalsOfContinuousStates", "GetNumberOfEventIndicators",
        "GetNumberOfContinuousStates", "GetOutputDerivatives", "ActivateModelPartition",
    ],
}  # fmt: skip
"""Functions that a version has and no unit for co-simulation of a sampled model needs."""


def write_fmu(
    model: Model | LinearModel, path: str | Path, name: str = "model", *, version: int = 2
) -> None:
    """Write a model as an FMU for co-simulation: a binary for Linux x86_64 and its sources.

    Inputs, outputs and states are real variables with the channels' names and units; the states can
    be set before the simulation starts. The model samples its inputs every 1 / fs seconds and holds
    its outputs in between: a communication step may have any size. At a sample an output is that of
    the state and the inputs when it is read. The whole state can be saved, restored and serialized,
    outputs have directional derivatives by inputs and states, and the description lists the inputs
    that each output depends on.

    Args:
        model: what is exported.
        path: the file.
        name: of the model in it.
        version: 2 or 3, of FMI.

    Raises:
        ValueError: no C compiler, another machine than Linux on x86_64, a static map
            without equations, or a name that is no identifier.

    Example:
        >>> lfrtorch.export.write_fmu(model, "actuator.fmu", "actuator")
    """
    header, source = c_source(model, name)
    e = equations(model)
    guid = str(uuid.uuid5(uuid.NAMESPACE_OID, header + source))
    known = {"guid": guid, "version": version, "u_start": e.u_offset.tolist()}
    known |= {"others": _OTHERS[version], "unsupported": _UNSUPPORTED[version]}
    files = {
        f"{name}.h": header,
        f"{name}.c": source,
        f"{name}_fmu.c": e.rendered("fmu.c", name, **known),
    }
    binary = _compiled(files, name)
    machine = "linux64" if version == 2 else "x86_64-linux"
    with ZipFile(path, "w", ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", _description(e, name, guid, version))
        if version == 3:
            archive.writestr("sources/buildDescription.xml", _build(name))
        archive.writestr(f"binaries/{machine}/{name}.so", binary)
        for file, text in files.items():
            archive.writestr(f"sources/{file}", text)


def _compiled(files: dict[str, str], name: str) -> bytes:
    """The shared library of the sources."""
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
        # Functions of the same name in other libraries do not take the place of these.
        options = ["-std=c99", "-O2", "-fPIC", "-shared", "-Wl,-Bsymbolic"]
        sources = [file for file in files if file.endswith(".c")]
        command = [compiler, *options, "-o", "made.so", *sources, "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"{compiler} cannot compile the FMU; it says:\n{done.stderr}")
        return (Path(folder) / "made.so").read_bytes()


def _build(name: str) -> bytes:
    """buildDescription.xml of FMI 3.0: how the sources are compiled."""
    root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
    built = ElementTree.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    listed = ElementTree.SubElement(built, "SourceFileSet", language="C99")
    for file in (f"{name}.c", f"{name}_fmu.c"):
        ElementTree.SubElement(listed, "SourceFile", name=file)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _description(e: Equations, name: str, guid: str, version: int) -> bytes:
    """modelDescription.xml."""
    token = "guid" if version == 2 else "instantiationToken"
    State = "FMUstate" if version == 2 else "FMUState"
    root = ElementTree.Element("fmiModelDescription", {
        "fmiVersion": f"{version}.0", "modelName": name, token: guid,
        "description": " ".join(e.about(name)[:2]), "generationTool": "lfrtorch",
        "variableNamingConvention": "flat",
    })  # fmt: skip
    unit = ElementTree.SubElement(root, "CoSimulation", {
        "modelIdentifier": name, "canHandleVariableCommunicationStepSize": "true",
        f"canGetAndSet{State}": "true", f"canSerialize{State}": "true",
        f"providesDirectionalDerivative{'' if version == 2 else 's'}": "true",
    })  # fmt: skip
    if version == 2:
        listed = ElementTree.SubElement(unit, "SourceFiles")
        for file in (f"{name}.c", f"{name}_fmu.c"):
            ElementTree.SubElement(listed, "File", name=file)
    units = list(dict.fromkeys(c.unit for c in (*e.inputs, *e.outputs) if c.unit))
    if units:
        listed = ElementTree.SubElement(root, "UnitDefinitions")
        for one in units:
            ElementTree.SubElement(listed, "Unit", name=printable(one))
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(1.0 / e.fs))
    listed = ElementTree.SubElement(root, "ModelVariables")
    for number, (label, symbol, causality, start) in enumerate(_variables(e)):
        known = {"name": label, "valueReference": str(number), "causality": causality}
        if causality == "local":
            known["initial"] = "exact"
        real = {"start": None if start is None else repr(start), "unit": symbol or None}
        real = {key: value for key, value in real.items() if value is not None}
        if version == 2:
            ElementTree.SubElement(
                ElementTree.SubElement(listed, "ScalarVariable", known), "Real", real
            )
        else:
            ElementTree.SubElement(listed, "Float64", known | real)
    if version == 3:
        known = {"name": _free("time", e), "causality": "independent", "variability": "continuous"}
        ElementTree.SubElement(listed, "Float64", known, valueReference=str(len(_variables(e))))
    _structure(ElementTree.SubElement(root, "ModelStructure"), e, version)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _structure(root: ElementTree.Element, e: Equations, version: int) -> None:
    """Which inputs each output depends on, and at the beginning which states."""
    M, nu, ny = e.matrices, len(e.inputs), len(e.outputs)
    by_w = (M.Dyw != 0).any(axis=1)[:, None] & (M.Dzu != 0).any(axis=0)
    by_u = (M.Dyu != 0) | by_w
    for at_first in (False, True):
        part = "InitialUnknown" if at_first else "Output"
        under = ElementTree.SubElement(root, f"{part}s") if version == 2 else root
        for output in range(ny):
            known = np.flatnonzero(by_u[output]).tolist()
            if at_first:
                known += range(nu + ny, nu + ny + e.sizes["nx"])
            number, first = nu + output, 1 if version == 2 else 0  # FMI 2 counts from 1
            key = "index" if version == 2 else "valueReference"
            depends = {"dependencies": " ".join(str(one + first) for one in known)}
            place = {key: str(number + first)} | depends
            ElementTree.SubElement(under, "Unknown" if version == 2 else part, place)


def _free(name: str, e: Equations) -> str:
    """A name that no variable has."""
    while name in {label for label, *_ in _variables(e)}:
        name += "_"
    return name


def _variables(e: Equations) -> list[tuple[str, str, str, float | None]]:
    """Name, unit, causality and start of each variable, in the order of the value references."""
    starts = e.u_offset.tolist()
    found: list[tuple[str, str, str, float | None]] = [
        *((c.name, c.unit, "input", start) for c, start in zip(e.inputs, starts, strict=True)),
        *((c.name, c.unit, "output", None) for c in e.outputs),
        *((f"x[{i + 1}]", "", "local", 0.0) for i in range(e.sizes["nx"])),
    ]
    named: dict[str, tuple[str, str, str, float | None]] = {}
    for label, symbol, causality, start in found:
        only = printable(label)
        while only in named:  # an output may be called as an input is
            only += "_"
        named[only] = only, printable(symbol), causality, start
    return list(named.values())
