"""A model as a functional mock-up unit: FMI 2.0 for co-simulation, compiled from its C."""

from __future__ import annotations

import platform
import shutil
import subprocess
import tempfile
import uuid
from pathlib import Path
from xml.etree import ElementTree
from zipfile import ZIP_DEFLATED, ZipFile

from lfrtorch._support.errors import InputError
from lfrtorch.export.c_source import c_source
from lfrtorch.export.equations import Equations, equations, printable, rendered
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import Model


def write_fmu(model: Model | LinearModel, path: str | Path, name: str = "model") -> None:
    """Write a model as an FMU 2.0 for co-simulation: a binary for Linux x86_64 and its sources.

    Inputs, outputs and states are real variables with the channels' names and units; the states can
    be set before the simulation starts. An output is that of the state and the inputs at the time
    when it is read. A communication step is a whole number of samples, with the inputs held.

    Args:
        model: what is exported.
        path: the file.
        name: of the model in it.

    Raises:
        ValueError: no C compiler, another machine than Linux on x86_64, a static map of the user's
            own class, or a name that is no identifier.

    Example:
        >>> lfrtorch.export.write_fmu(model, "actuator.fmu", "actuator")
    """
    header, source = c_source(model, name)
    e = equations(model)
    guid = str(uuid.uuid5(uuid.NAMESPACE_OID, header + source))
    known = {"name": name, "NAME": name.upper(), "guid": guid, "ts": repr(1.0 / e.fs)}
    known["u_start"] = e.u_offset.tolist()
    files = {
        f"{name}.h": header,
        f"{name}.c": source,
        f"{name}_fmu.c": rendered("fmu.c", **known),
    }
    binary = _compiled(files, name)
    with ZipFile(path, "w", ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", _description(e, name, guid))
        archive.writestr(f"binaries/linux64/{name}.so", binary)
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


def _description(e: Equations, name: str, guid: str) -> bytes:
    """modelDescription.xml."""
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="2.0", modelName=name, guid=guid, description=" ".join(e.about(name)[:2]),
        generationTool="lfrtorch", variableNamingConvention="flat",
    )  # fmt: skip
    unit = ElementTree.SubElement(
        root, "CoSimulation",
        modelIdentifier=name, canHandleVariableCommunicationStepSize="true",
    )  # fmt: skip
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
        variable = ElementTree.SubElement(
            listed, "ScalarVariable", name=label, valueReference=str(number), causality=causality
        )
        if causality == "local":
            variable.set("initial", "exact")
        known = {"start": None if start is None else repr(start), "unit": symbol or None}
        known = {key: value for key, value in known.items() if value is not None}
        ElementTree.SubElement(variable, "Real", known)
    structure = ElementTree.SubElement(root, "ModelStructure")
    nu = len(e.inputs)
    for part in ("Outputs", "InitialUnknowns"):
        listed = ElementTree.SubElement(structure, part)
        for output in range(len(e.outputs)):
            ElementTree.SubElement(listed, "Unknown", index=str(nu + output + 1))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


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
