"""Variables of a MATLAB file, checked for damage before a C library relies on their tags."""

from __future__ import annotations

import io
import math
import struct
import zlib
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

_HEADER = 128  # bytes
_PIECE = 1 << 20  # bytes in memory at once

_NUMBERS = frozenset((1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18))  # kinds of elements
_MATRIX, _PACKED = 14, 15
_FLAT = frozenset(range(4, 16))  # classes of arrays that hold no other arrays
_SPARSE = 5  # the class of arrays that have fewer numbers than their shape
_OBJECT = 17  # the class of an object: its name comes next, and no shape
_HEAD = 128  # bytes kept of an element: shapes have at most 32 sizes, names 63 letters
_DEEPEST = 32


class Variable(NamedTuple):
    """An array or object, and how many numbers are in it and in the arrays that it holds."""

    name: str
    numbers: int
    is_object: bool = False


def variables_in(path: Path) -> list[Variable]:
    """The variables of a MATLAB 5 file; refuse a file whose elements break the format."""
    # Source: MATLAB, "MAT-File Format", version 5.
    with path.open("rb") as stream:
        header = stream.read(_HEADER)
        order = "<" if header[126:] == b"IM" else ">"
        top = frozenset((_MATRIX, _PACKED))
        return _walk(stream, path.stat().st_size - _HEADER, order, top, 0)[1]


class _Unpacked(io.RawIOBase):
    """Unpack the next bytes of a stream."""

    def __init__(self, stream: IO[bytes], size: int) -> None:
        self._stream, self._left, self._zlib = stream, size, zlib.decompressobj()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview, /) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        while not self._zlib.eof:
            packed = self._zlib.unconsumed_tail
            if not packed:
                packed = self._stream.read(min(self._left, _PIECE))
                self._left -= len(packed)
            found = self._zlib.decompress(packed, len(buffer))
            if found or not packed:
                buffer[: len(found)] = found
                return len(found)
        return 0


def _walk(
    stream: IO[bytes], size: int | None, order: str, allowed: frozenset[int], depth: int
) -> tuple[list[bytes], list[Variable]]:
    """Return the first elements of a stream's next bytes (or of the rest), and the arrays there."""
    if depth > _DEEPEST:
        raise ValueError(f"arrays lie more than {_DEEPEST} deep in one another")
    left = size
    heads, arrays = list[bytes](), list[Variable]()
    while left is None or left > 0:
        tag = stream.read(8)
        if not tag and size is None:
            break
        if len(tag) < 8:
            raise ValueError("it is cut off")
        kind, length = struct.unpack(f"{order}II", tag)
        content = b""
        if kind >> 16:  # a small element, whose value is in its tag
            if kind >> 16 > 4:
                raise ValueError(f"a small element has {kind >> 16} bytes")
            kind, length, padded, content = kind & 0xFFFF, 0, 0, tag[4 : 4 + (kind >> 16)]
        else:
            padded = length if kind == _PACKED else -(-length // 8) * 8
        if kind not in allowed:
            raise ValueError(f"there is no element of kind {kind} here")
        if left is not None and (left := left - 8 - length) < 0:
            raise ValueError("an element is longer than what holds it")
        if kind == _MATRIX:
            inside = _walk(stream, length, order, _NUMBERS | {_MATRIX}, depth + 1)
            arrays.append(_variable(*inside, order, length))
        elif kind == _PACKED:
            end = stream.tell() + length
            unpacked = io.BufferedReader(_Unpacked(stream, length))
            arrays += _walk(unpacked, None, order, frozenset((_MATRIX,)), depth + 1)[1]
            stream.seek(end)
        else:
            content = _skip(stream, padded)[:length] or content
        left = left if left is None else left - (padded - length)
        if not heads and depth and kind != _MATRIX and _class(content, order) in _FLAT:
            allowed = _NUMBERS
        if len(heads) < 3:
            heads.append(content)
    return heads, arrays


def _class(flags: bytes, order: str) -> int:
    """The class of an array, by its first element."""
    return struct.unpack(f"{order}I", flags[:4])[0] & 0xFF if len(flags) >= 4 else 0


def _variable(heads: list[bytes], inside: list[Variable], order: str, length: int) -> Variable:
    """An array by its first elements: flags, shape and name."""
    flags, shape, name = (*heads, b"", b"", b"")[:3]
    kind = _class(flags, order)
    if kind == _OBJECT:
        return Variable(shape.decode("latin-1"), 0, is_object=True)
    sizes = np.frombuffer(shape[: len(shape) // 4 * 4], f"{order}i4").tolist()
    if min(sizes, default=0) < 0:
        raise ValueError("an array of negative size")
    numbers = length // 8 if kind == _SPARSE else math.prod(sizes) if sizes else 0
    return Variable(name.decode("latin-1"), numbers + sum(each.numbers for each in inside))


def _skip(stream: IO[bytes], size: int) -> bytes:
    """Read over some bytes; return the first of them."""
    start = b""
    while size > 0:
        piece = stream.read(min(size, _PIECE))
        if not piece:
            raise ValueError("it is cut off")
        start, size = start or piece[:_HEAD], size - len(piece)
    return start
