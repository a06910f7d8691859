"""A file of named arrays as a table: MATLAB, numpy and HDF5."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.files.table import BLOCK, Clock, Table

_REAL, _TIMES = "biuf", "M"

Stored = Callable[[Path], AbstractContextManager[Any]]
"""Opens a file: its arrays by name."""


@dataclass(frozen=True)
class Signal:
    """An array of the file as samples (T, channels).

    Args:
        shape: as it is in the file.
        dtype: of its numbers.
        unit: empty if the file does not say it.
        transposed: time runs along the last axis.
        values: the array, if it is in memory.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    unit: str = ""
    transposed: bool = False
    values: NDArray[Any] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """T and channels."""
        rows, columns = self.shape if len(self.shape) == 2 else (*self.shape, 1)
        return (columns, rows) if self.transposed else (rows, columns)

    def refusal(self) -> str:
        """Why it is no signal; nothing if it is one."""
        kind = self.dtype.kind
        if kind == "c":
            return f"is complex ({self.dtype}); store real and imaginary part apart"
        if kind not in _REAL + _TIMES:
            return f"has no numbers (its type is {self.dtype}); store an array of real numbers"
        if np.prod(self.shape) <= 1:
            return "has one number or none, and is no signal"
        if len(self.shape) > 2:
            return f"has shape {self.shape}; give (samples,) or (samples, channels)"
        T, channels = self.size
        if channels > T:
            return (
                f"has {T} row(s) and {channels} columns; time must run along the rows: transpose it"
            )
        return ""


class ArrayTable(Table):
    """Arrays by name; those of a table that are read together have one length.

    An array (T, k) named u has the columns u1 .. uk, one (T,), (T, 1) or (1, T) the column u.

    Args:
        path: the file.
        found: signals by name, or why something is none.
        stored: opens the file.
    """

    def __init__(self, path: Path, found: Mapping[str, Signal | str], stored: Stored) -> None:
        self._stored = stored
        self._signals: list[tuple[str, int]] = []  # of each column
        self._found: dict[str, Signal] = {}
        headers, units, arrays, refused = [], {}, {}, {}
        for name, given in found.items():
            signal = given
            if isinstance(signal, Signal) and len(signal.shape) == 2 and signal.size[0] == 1:
                signal = replace(signal, transposed=not signal.transposed)
            reason = signal if isinstance(signal, str) else signal.refusal()
            if isinstance(signal, str) or reason:
                refused[name] = reason
                continue
            width = signal.size[1]
            names = [name] if width == 1 else [f"{name}{i + 1}" for i in range(width)]
            if width > 1:
                arrays[name] = tuple(range(len(headers), len(headers) + width))
            headers += names
            units |= dict.fromkeys(names, signal.unit)
            self._signals += [(name, i) for i in range(width)]
            self._found[name] = signal
        super().__init__(path, headers, units=units, arrays=arrays, refused=refused)

    def blocks(self, columns: Sequence[int], samples: int = BLOCK) -> Iterator[Array]:
        """See :meth:`Table.blocks`."""
        chosen = [self._signals[column] for column in columns]
        lengths = {name: self._found[name].size[0] for name, _ in chosen}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{name!r} has {length}" for name, length in lengths.items())
            raise InputError(f"'{self.path}': {listed} samples; give arrays of one length.")
        T = next(iter(lengths.values()))
        clocks = {name: Clock() for name in lengths}
        with self._stored(self.path) as stored:
            for start in range(0, T, samples):
                stop = min(start + samples, T)
                parts = {}
                for name in lengths:
                    signal, array = self._found[name], stored[name]
                    try:
                        part = array[..., start:stop] if signal.transposed else array[start:stop]
                    except OSError as error:
                        raise _damaged(self.path, error) from error
                    part = np.asarray(part.T if signal.transposed else part)
                    if part.dtype.kind in _TIMES:
                        part = clocks[name](part)
                    parts[name] = part.reshape(stop - start, -1)
                yield np.stack([parts[name][:, i] for name, i in chosen], axis=1, dtype=np.float64)


def _in_memory(path: Path, found: Mapping[str, Signal | str]) -> ArrayTable:
    """A table of arrays that were read."""
    arrays = {name: signal.values for name, signal in found.items() if isinstance(signal, Signal)}
    return ArrayTable(path, found, lambda _: nullcontext(arrays))


def _signal(array: NDArray[Any]) -> Signal:
    return Signal(array.shape, array.dtype, values=array)


def npz(path: Path) -> ArrayTable:
    """The arrays that numpy.savez wrote."""
    found: dict[str, Signal | str] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.namelist():
                name = member.removesuffix(".npy")
                content = io.BytesIO(archive.read(member))
                try:
                    found[name] = _signal(np.lib.format.read_array(content, allow_pickle=False))
                except ValueError as error:  # an array of objects
                    if "Object arrays" not in str(error):
                        raise
                    found[name] = "is an array of objects; store an array of real numbers"
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f"'{path}' is not a readable .npz file ({error}); write it again with numpy.savez, "
            "arrays of numbers only."
        ) from error
    return _in_memory(path, found)


def npy(path: Path) -> ArrayTable:
    """The array that numpy.save wrote, by the file's name; it is read as it is needed."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, EOFError, ValueError) as error:
        raise InputError(
            f"'{path}' is not a readable .npy file ({error}); write it again with numpy.save, "
            "an array of numbers."
        ) from error
    if not isinstance(array, np.ndarray):
        raise InputError(f"'{path}' holds several arrays; give it the extension .npz.")
    return _in_memory(path, {path.stem: _signal(array)})


def mat(path: Path) -> ArrayTable:
    """The variables of a MATLAB file; fields of structs have dotted names."""
    with path.open("rb") as stream:
        start = stream.read(520)
    if start.startswith(b"MATLAB 7.3") or start[512:].startswith(b"\x89HDF"):
        return hdf5(path, matlab=True)
    from scipy import io as scipy_io

    try:
        variables = scipy_io.loadmat(path, chars_as_strings=False)
    except Exception as error:  # a damaged file raises any of a dozen kinds
        raise InputError(
            f"'{path}' is not a readable MATLAB file ({error}); write it again with save."
        ) from error
    found: dict[str, Signal | str] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            _variable(name, value, found)
    return _in_memory(path, found)


def _variable(name: str, value: Any, found: dict[str, Signal | str]) -> None:
    """Note the signals of a MATLAB variable under their dotted names."""
    if not isinstance(value, np.ndarray):
        kind = "sparse; store full(x)" if hasattr(value, "toarray") else type(value).__name__
        found[name] = f"is {kind}"
    elif type(value).__name__ in ("MatlabOpaque", "MatlabFunction"):
        found[name] = "is an object (a table or timetable, for example); store its arrays"
    elif value.dtype.names and value.size == 1:
        for field in value.dtype.names:
            _variable(f"{name}.{field}", value.reshape(-1)[0][field], found)
    elif value.dtype.names:
        found[name] = f"is an array of {value.size} structs; store the arrays of one"
    elif value.dtype.kind == "O" and value.size == 1:
        _variable(name, value.reshape(-1)[0], found)
    elif value.dtype.kind == "O":
        found[name] = f"is an array of {value.size} cells; store cell2mat(x) or one of them"
    else:
        found[name] = _signal(value)


class _HDF5(AbstractContextManager):
    """Datasets of an open HDF5 file, by path or by dotted name."""

    def __init__(self, path: Path, names: Mapping[str, str]) -> None:
        self._file, self._names = optional("h5py").File(path), names

    def __getitem__(self, name: str) -> Any:
        return self._file[self._names[name]]

    def __exit__(self, *_: object) -> None:
        self._file.close()


def hdf5(path: Path, *, matlab: bool = False) -> ArrayTable:
    """The datasets of an HDF5 file by their paths, or of one by MATLAB by dotted names."""
    h5py = optional("h5py")
    found: dict[str, Signal | str] = {}
    names: dict[str, str] = {}
    try:
        with h5py.File(path) as file:
            _group(file, "", matlab, found, names)
    except (OSError, RuntimeError, KeyError) as error:
        raise _damaged(path, error) from error
    return ArrayTable(path, found, lambda path: _HDF5(path, names))


def _group(
    group: Any, prefix: str, matlab: bool, found: dict[str, Signal | str], names: dict[str, str]
) -> None:
    """Note the signals of an HDF5 group, and where each is."""
    h5py = optional("h5py")
    for key in group:
        if matlab and key.startswith("#"):
            continue
        name, item = f"{prefix}{key}", group[key]
        if matlab and isinstance(item, h5py.Dataset):
            cells = item.dtype.kind == "O" and item.attrs.get("MATLAB_class") == b"cell"
            if cells and item.size == 1:
                item = item.file[item[()].reshape(-1)[0]]
            elif item.dtype.kind == "O":
                what = "cells" if cells else "structs"
                found[name] = f"is an array of {item.size} {what}; store the arrays of one"
                continue
            elif item.attrs.get("MATLAB_class") in (b"char", b"string"):
                found[name] = "is text; store an array of real numbers"
                continue
            elif "MATLAB_empty" in item.attrs:
                found[name] = "is empty"
                continue
        if isinstance(item, h5py.Group):
            if "MATLAB_sparse" in item.attrs:
                found[name] = "is sparse; store full(x)"
            else:
                _group(item, f"{name}{'.' if matlab else '/'}", matlab, found, names)
        elif item.dtype.names:
            complex_ = set(item.dtype.names) == {"real", "imag"}
            found[name] = (
                "is complex; store real and imaginary part apart"
                if complex_
                else f"is compound ({', '.join(item.dtype.names)}); store one array a field"
            )
        elif item.shape is None:
            found[name] = "is empty"
        else:
            unit = item.attrs.get("units", item.attrs.get("unit", ""))
            unit = unit.decode() if isinstance(unit, bytes) else unit
            found[name] = Signal(
                item.shape, item.dtype, unit if isinstance(unit, str) else "", matlab
            )
            names[name] = item.name


def optional(package: str) -> ModuleType:
    """A package of the extra ``files``.

    Raises:
        ValueError: it is not installed.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise InputError(
            f"files of this format need {package}, which is not installed: "
            "pip install 'lfrtorch[files]', or store them as .csv or .npz."
        ) from error


def _damaged(path: Path, error: Exception) -> ValueError:
    return InputError(f"'{path}' is not a readable HDF5 file ({error}); write it again.")
