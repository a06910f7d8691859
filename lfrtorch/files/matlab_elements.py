"""Whether the elements of a MATLAB file are whole, before a library in C trusts their tags."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import IO

_HEADER = 128  # bytes
_PIECE = 1 << 20  # bytes that are in memory at once

_NUMBERS = frozenset((1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18))  # kinds of elements
_MATRIX, _PACKED = 14, 15
_FLAT = frozenset(range(4, 16))  # classes of arrays that hold no other arrays
_DEEPEST = 32


def check_elements(path: Path) -> None:
    """Refuse a MATLAB 5 file whose elements do not lie in one another as the format says."""
    # Source: MATLAB, "MAT-File Format", version 5.
    with path.open("rb") as stream:
        header = stream.read(_HEADER)
        order = "<" if header[126:] == b"IM" else ">"
        _walk(stream, path.stat().st_size - _HEADER, order, frozenset((_MATRIX, _PACKED)), 0)


class _Unpacked(io.RawIOBase):
    """What was packed in the next bytes of a stream."""

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
) -> None:
    """Check the elements in the next bytes of a stream, or up to its end."""
    if depth > _DEEPEST:
        raise ValueError(f"arrays lie more than {_DEEPEST} deep in one another")
    left, first = size, True
    while left is None or left > 0:
        tag = stream.read(8)
        if not tag and size is None:
            return
        if len(tag) < 8:
            raise ValueError("it is cut off")
        kind, length = struct.unpack(f"{order}II", tag)
        content = b""
        if kind >> 16:  # a small one, in its tag
            if kind >> 16 > 4:
                raise ValueError(f"a small element has {kind >> 16} bytes")
            kind, length, padded, content = kind & 0xFFFF, 0, 0, tag[4:]
        else:
            padded = length if kind == _PACKED else -(-length // 8) * 8
        if kind not in allowed:
            raise ValueError(f"there is no element of kind {kind} here")
        if left is not None and (left := left - 8 - length) < 0:
            raise ValueError("an element is longer than what holds it")
        if kind == _MATRIX:
            _walk(stream, length, order, _NUMBERS | {_MATRIX}, depth + 1)
        elif kind == _PACKED:
            end = stream.tell() + length
            unpacked = io.BufferedReader(_Unpacked(stream, length))
            _walk(unpacked, None, order, frozenset((_MATRIX,)), depth + 1)
            stream.seek(end)
        else:
            content = _skip(stream, padded) or content
        left = left if left is None else left - (padded - length)
        if first and depth and kind != _MATRIX:
            flags = struct.unpack(f"{order}I", content[:4])[0] if len(content) >= 4 else 0
            if flags & 0xFF in _FLAT:
                allowed = _NUMBERS
        first = False


def _skip(stream: IO[bytes], size: int) -> bytes:
    """Read over some bytes; the first of them."""
    start = b""
    while size > 0:
        piece = stream.read(min(size, _PIECE))
        if not piece:
            raise ValueError("it is cut off")
        start, size = start or piece[:8], size - len(piece)
    return start
