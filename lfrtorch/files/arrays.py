"""A file of named arrays as a table: MATLAB, numpy and HDF5."""

from __future__ import annotations

import io
import math
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.memory import check_memory
from lfrtorch._support.optional import imported
from lfrtorch._support.types import Array
from lfrtorch.files.matlab_elements import Variable, variables_in
from lfrtorch.files.table import BLOCK, Clock, Table

_REAL, _TIMES = "biuf", "M"


_FREQUENCY = re.compile(
    r"f_?s(amp|ampling|ample)?|s_?rate|sampl(e|ing)[ _-]?(rate|freq|frequency)", re.IGNORECASE
)
_INTERVAL = re.compile(
    r"t_?s(amp|ampling|ample)?|d_?t|delta_?t|sampl(e|ing)[ _-]?(time|period|interval)",
    re.IGNORECASE,
)

_IS_OBJECT = "is an object (a table, timetable or iddata, for example); store its arrays"

_UNREADABLE = (
    OSError,
    EOFError,
    MemoryError,
    ValueError,
    LookupError,
    RuntimeError,  # encrypted, or packed in an unknown way
    OverflowError,
    struct.error,
    tokenize.TokenError,  # the header of an array
    zipfile.BadZipFile,
    zlib.error,
)
"""Errors of a damaged file of numpy; its header may declare more than there is memory for."""

Stored = Callable[[Path], AbstractContextManager[Any]]
"""Opens a file: its arrays by name."""


class _Packing(NamedTuple):
    """Numbers stored as (number - offset) / scale, see NetCDF CF Conventions 1.11, 8.1."""

    scale: float
    offset: float
    fill: float

    def unpacked(self, stored: NDArray[Any]) -> Array:
        """The numbers, NaN for missing ones."""
        numbers = stored.astype(np.float64)
        numbers[stored == self.fill] = np.nan
        return numbers * self.scale + self.offset


@dataclass(frozen=True)
class Signal:
    """An array of the file."""

    shape: tuple[int, ...]  # as it is in the file
    dtype: np.dtype
    unit: str = ""
    reverse: bool = False  # the file stores the axes in the reverse of the user's order
    values: NDArray[Any] | None = None  # if it is in memory; a lone number always is
    packing: _Packing | None = None  # how numbers are packed; None if they are stored as they are

    @property
    def shown(self) -> str:
        """Its shape for a user."""
        return " × ".join(map(str, self.shape[::-1] if self.reverse else self.shape)) or "1"

    @property
    def vector(self) -> bool:
        """Tell if an array has the samples of one channel."""
        return max(self.shape, default=1) == np.prod(self.shape) > 1

    def refusal(self) -> str:
        """Why the array is not a signal; empty if it is one."""
        kind = self.dtype.kind
        if kind == "c":
            return f"is complex ({self.dtype}); store real and imaginary part apart"
        if kind not in _REAL + _TIMES:
            return f"has no numbers (its type is {self.dtype}); store an array of real numbers"
        if np.prod(self.shape) <= 1:
            return "has one number or none, and is not a signal"
        if len(self.shape) > 2:
            return f"is {self.shown}; give samples × channels"
        if len(set(self.shape)) < len(self.shape):
            return (
                f"is {self.shown}, and time may run along either axis; store its channels one by "
                "one"
            )
        return ""


class ArrayTable(Table):
    """Arrays by name; arrays of a table that are read together have one length.

    Time runs along the axis of an array that is as long as a vector of the file. If two axes are,
    or none, it runs along the longer one. An array u of k channels has the columns u1 .. uk, an
    array of one channel the column u. A lone number with the name of a sampling frequency or time
    is a rate.
    """

    def __init__(self, path: Path, found: Mapping[str, Signal | str], stored: Stored) -> None:
        self._stored = stored
        self._signals: list[tuple[str, int]] = []  # array and channel of each column
        self._axes: dict[str, int] = {}  # axis of time of each array
        self._packing = {
            name: s.packing for name, s in found.items() if isinstance(s, Signal) and s.packing
        }
        self.contents = contents = []
        signals = {name: s for name, s in found.items() if isinstance(s, Signal)}
        vectors = {max(s.shape) for s in signals.values() if s.vector and not s.refusal()}
        # Shorter vectors may be gains.
        vectors = {T for T in vectors if T >= 32}
        headers, units, arrays, refused, rates = [], {}, {}, {}, {}
        lengths: list[int] = []
        for name, signal in found.items():
            shown = "" if isinstance(signal, str) else signal.shown
            rate = None if isinstance(signal, str) else _sampling_rate(name, signal)
            reason = signal if isinstance(signal, str) else signal.refusal()
            if rate is not None:
                rates[name] = rate
                contents.append((name, shown, f"sampling frequency, {rate:g} Hz"))
            if isinstance(signal, str) or reason:
                refused[name] = reason
                if rate is None:
                    contents.append((name, shown, f"nothing: it {reason}"))
                continue
            fits = [axis for axis, n in enumerate(signal.shape) if n in vectors]
            axis = fits[0] if len(fits) == 1 else int(np.argmax(signal.shape))
            T, width = signal.shape[axis], int(np.prod(signal.shape)) // signal.shape[axis]
            names = [name] if width == 1 else [f"{name}{i + 1}" for i in range(width)]
            if width > 1:
                arrays[name] = tuple(range(len(headers), len(headers) + width))
            headers += names
            lengths += [T] * width
            units |= dict.fromkeys(names, "s" if signal.dtype.kind in _TIMES else signal.unit)
            self._signals += [(name, i) for i in range(width)]
            self._axes[name] = axis
            channels = "signal" if width == 1 else f"signals {names[0]} .. {names[-1]}"
            contents.append((name, shown, channels))
        super().__init__(
            path, headers, units=units, arrays=arrays, refused=refused, rates=rates, lengths=lengths
        )
        objects = [repr(name) for name, reason in refused.items() if reason == _IS_OBJECT]
        if objects:
            self.notes = (f"left out: {', '.join(objects)}, as objects are not read",)

    def blocks(self, columns: Sequence[int], samples: int = BLOCK) -> Iterator[Array]:
        """See :meth:`Table.blocks`."""
        chosen = [self._signals[column] for column in columns]
        lengths = {self._signals[column][0]: self.lengths[column] for column in columns}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{name!r} has {length}" for name, length in lengths.items())
            raise InputError(f"'{self.path}': {listed} samples; give arrays of one length.")
        T = next(iter(lengths.values()))
        clocks = {name: Clock() for name in lengths}
        rows = min(samples, T)
        for name in lengths:  # a block has all channels of an array
            self.check_memory(rows * sum(own == name for own, _ in self._signals))
        with self._stored(self.path) as stored:
            for start in range(0, T, samples):
                stop = min(start + samples, T)
                parts = {}
                for name in lengths:
                    array, last = stored[name], self._axes[name] == 1
                    try:
                        part = array[:, start:stop] if last else array[start:stop]
                    except OSError as error:
                        raise _damaged(self.path, error) from error
                    part = np.asarray(part.T if last else part)
                    if part.dtype.kind in _TIMES:
                        part = clocks[name](part)
                    if name in self._packing:
                        part = self._packing[name].unpacked(part)
                    parts[name] = part.reshape(stop - start, -1)
                yield np.stack([parts[name][:, i] for name, i in chosen], axis=1, dtype=np.float64)


def _sampling_rate(name: str, signal: Signal) -> float | None:
    """Return the sampling frequency from a lone number that is named as a frequency or interval."""
    own = re.split(r"[./]", name)[-1]
    frequency, interval = _FREQUENCY.fullmatch(own), _INTERVAL.fullmatch(own)
    value = signal.values
    if value is None or value.size != 1 or value.dtype.kind not in _REAL:
        return None
    number = float(value.reshape(-1)[0])
    if not (frequency or interval) or not np.isfinite(number) or number <= 0:
        return None
    return number if frequency else 1 / number


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
            size = sum(member.file_size for member in archive.infolist())
            check_memory(size, f"'{path}', unpacked,", "give a part of it")
            for member in archive.namelist():
                name = member.removesuffix(".npy")
                if name in found:
                    raise ValueError(f"it has {name!r} twice")
                content = io.BytesIO(archive.read(member))
                try:
                    found[name] = _signal(np.lib.format.read_array(content, allow_pickle=False))
                except ValueError as error:  # an array of objects
                    if "Object arrays" not in str(error):
                        raise
                    found[name] = "is an array of objects; store an array of real numbers"
    except InputError:
        raise
    except _UNREADABLE as error:
        raise InputError(
            f"'{path}' is not a readable .npz file ({brief(error)}); write it again with "
            "numpy.savez, arrays of numbers only."
        ) from error
    return _in_memory(path, found)


def npy(path: Path) -> ArrayTable:
    """The array that numpy.save wrote, by the file's name; its samples are read when needed."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except _UNREADABLE as error:
        raise InputError(
            f"'{path}' is not a readable .npy file ({brief(error)}); write it again with "
            "numpy.save, an array of numbers."
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
        if scipy_io.matlab.matfile_version(path)[0] == 1:
            listed = variables_in(path)
        else:
            listed = [Variable(n, math.prod(shape)) for n, shape, _ in scipy_io.whosmat(path)]
        numbers = sum(each.numbers for each in listed)
        check_memory(8.0 * numbers, f"'{path}', of {numbers:g} numbers,", "give a part of it")
        names = [each.name for each in listed if each.name and not each.is_object]
        variables = scipy_io.loadmat(path, chars_as_strings=False, variable_names=names)
    except InputError:
        raise
    except Exception as error:  # a damaged file raises any of a dozen kinds
        raise InputError(
            f"'{path}' is not a readable MATLAB file ({brief(error)}); write it again with save."
        ) from error
    found: dict[str, Signal | str] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            _variable(name, value, found)
    return _in_memory(path, found | {each.name: _IS_OBJECT for each in listed if each.is_object})


def _variable(name: str, value: Any, found: dict[str, Signal | str]) -> None:
    """Note the signals of a MATLAB variable under their dotted names."""
    if not isinstance(value, np.ndarray):
        kind = "sparse; store full(x)" if hasattr(value, "toarray") else type(value).__name__
        found[name] = f"is {kind}"
    elif type(value).__name__ in ("MatlabOpaque", "MatlabFunction"):
        found[name] = _IS_OBJECT
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


def hdf5(path: Path, *, matlab: bool = False) -> ArrayTable:
    """The datasets of an HDF5 file by their paths, or by dotted names if MATLAB wrote it."""
    h5py = optional("h5py")
    found: dict[str, Signal | str] = {}
    names: dict[str, str] = {}
    try:
        with h5py.File(path) as file:
            _group(file, "", matlab, found, names)
    except (OSError, RuntimeError, LookupError, TypeError, ValueError) as error:
        raise _damaged(path, error) from error

    @contextmanager
    def stored(path: Path) -> Iterator[Any]:
        with h5py.File(path) as file:
            yield {name: file[place] for name, place in names.items()}

    return ArrayTable(path, found, stored)


def _group(
    group: Any,
    prefix: str,
    matlab: bool,
    found: dict[str, Signal | str],
    names: dict[str, str],
    above: frozenset[int] = frozenset(),
) -> None:
    """Note the signals of an HDF5 group, and where each is; ``above`` are the groups around it."""
    h5py = optional("h5py")
    above |= {h5py.h5o.get_info(group.id).addr}
    if not matlab:
        attributes = {f"{prefix}{key}": np.asarray(value) for key, value in group.attrs.items()}
        given = {name: _signal(value) for name, value in attributes.items()}
        found |= {name: one for name, one in given.items() if _sampling_rate(name, one)}
    for key in group:
        if matlab and key.startswith("#"):
            continue
        name = f"{prefix}{key}"
        item: Any = _linked(group, key)
        if matlab and _is_cell(item) and item.size == 1:
            item = item.file[item[()].reshape(-1)[0]]
        if isinstance(item, str):
            found[name] = item
        elif reason := _refusal(item, above, matlab):
            found[name] = reason
        elif isinstance(item, h5py.Group):
            _group(item, f"{name}{'.' if matlab else '/'}", matlab, found, names, above)
        else:
            unit = item.attrs.get("units", item.attrs.get("unit", ""))
            unit = unit.decode(errors="replace") if isinstance(unit, bytes) else unit
            unit = unit if isinstance(unit, str) else ""
            number = np.asarray(item[()]) if item.size == 1 else None
            found[name] = Signal(item.shape, item.dtype, unit, matlab, number, _packing(item))
            names[name] = item.name


def _is_cell(item: Any) -> bool:
    kind = getattr(getattr(item, "dtype", None), "kind", "")
    return kind == "O" and item.attrs.get("MATLAB_class") == b"cell"


def _refusal(item: Any, above: frozenset[int], matlab: bool) -> str:
    """Why an HDF5 object is not read; empty if it may hold signals."""
    h5py = optional("h5py")
    if isinstance(item, h5py.Group):
        if "MATLAB_sparse" in item.attrs:
            return "is sparse; store full(x)"
        inside = h5py.h5o.get_info(item.id).addr in above
        return "is a group inside itself; leave it out" if inside else ""
    if matlab and item.dtype.kind == "O":
        what = "cells" if _is_cell(item) else "structs"
        return f"is an array of {item.size} {what}; store the arrays of one"
    if matlab and item.attrs.get("MATLAB_class") in (b"char", b"string"):
        return "is text; store an array of real numbers"
    # MATLAB_object_decode marks an object: the dataset only says where its parts are stored.
    if matlab and item.attrs.get("MATLAB_object_decode", 0) == 3:
        return _IS_OBJECT
    if item.shape is None or (matlab and "MATLAB_empty" in item.attrs):
        return "is empty"
    if item.dtype.names and set(item.dtype.names) == {"real", "imag"}:
        return "is complex; store real and imaginary part apart"
    if item.dtype.names:
        return f"is compound ({', '.join(item.dtype.names)}); store one array a field"
    return ""


def _packing(item: Any) -> _Packing | None:
    """Return how a dataset's numbers are packed, from its attributes."""
    given = [
        np.asarray(item.attrs.get(key)) for key in ("scale_factor", "add_offset", "_FillValue")
    ]
    lone = [one.size == 1 and one.dtype.kind in _REAL for one in given]
    if not any(lone):
        return None
    scale, offset, fill = (
        float(one.reshape(-1)[0]) if known else default
        for one, known, default in zip(given, lone, (1.0, 0.0, np.nan), strict=True)
    )
    return _Packing(scale, offset, fill)


def _linked(group: Any, key: str) -> Any:
    """Return a member of a group, or why its link is refused: no file may open another file."""
    h5py = optional("h5py")
    link = group.get(key, getlink=True)
    if isinstance(link, h5py.ExternalLink):
        return f"lies in another file, {link.filename!r}; give that file"
    try:
        item = group[key]
    except (KeyError, OSError, RuntimeError) as error:
        if not isinstance(link, h5py.SoftLink):
            raise
        return f"is a link that leads nowhere ({brief(error)}); store the array"
    if isinstance(item, h5py.Dataset) and (item.external or item.is_virtual):
        return "has its numbers in other files; store them in this one"
    return item


def optional(package: str) -> Any:
    """Import a package of the extra ``files``."""
    return imported(package, "files", ", or store the file as .csv or .npz")


def _damaged(path: Path, error: Exception) -> ValueError:
    return InputError(f"'{path}' is not a readable HDF5 file ({brief(error)}); write it again.")
