"""Measurement files of any format as tables of channels."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from pathlib import Path

from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import expanded
from lfrtorch.files import arrays as array_table
from lfrtorch.files.excel import EXTENSIONS, ExcelTable, workbook
from lfrtorch.files.frame import parquet
from lfrtorch.files.loggers import READERS
from lfrtorch.files.table import BLOCK, Table, rate_behind
from lfrtorch.files.text import TextTable

__all__ = ["BLOCK", "FORMATS", "Table", "open_table"]

FORMATS: dict[str, Callable[[Path], Table]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".lvm"), TextTable),
    ".mat": array_table.mat,
    ".npz": array_table.npz,
    ".npy": array_table.npy,
    **dict.fromkeys((".h5", ".hdf5"), array_table.hdf5),
    ".parquet": parquet,
    **dict.fromkeys(EXTENSIONS, ExcelTable),
    **READERS,
}
"""Readers by extension; a text file may be compressed (.csv.gz)."""

_SHOWN = 8
_INSTEAD = {
    ".xls": "save it as .xlsx",
    ".ods": "save it as .xlsx",
}


def open_table(path: str | Path) -> Table:
    """Open the table of a file, of a sheet (``rig.xlsx#Run 2``), or at a rate (``x.csv#50Hz``)."""
    path = expanded(path)
    if path.is_dir():
        inside = sorted(p.name for p in path.iterdir() if extension(p) in FORMATS)
        raise InputError(
            f"'{path}' is a folder; name a file"
            + (f": {', '.join(inside[:_SHOWN])}." if inside else ", it has none of a known format.")
        )
    file, behind = workbook(path)
    if file.exists() and not file.is_file():
        raise InputError(f"'{file}' is a pipe or a device; give a file with what comes from it.")
    if not file.is_file():
        raise FileNotFoundError(f"there is no file '{file}'{similar(file)}.")
    kind = extension(file)
    if kind not in FORMATS:
        instead = _INSTEAD.get(path.suffix.lower(), "convert it")
        raise InputError(
            f"'{path}' has the unknown extension '{path.suffix}'; {instead}, or rename it if it "
            f"is one of these: {', '.join(FORMATS)}."
        )
    if file.stat().st_size == 0:
        raise InputError(f"'{path}' is empty; give a file with data.")
    if not behind or kind in (*EXTENSIONS, *READERS):
        return FORMATS[kind](path)
    table = FORMATS[kind](file)
    table.asked = rate_behind(behind)
    return table


def extension(path: Path) -> str:
    """The extension in lower case; for a compressed text file, the extension of the text."""
    kind = path.suffix.lower()
    if kind != ".gz":
        return kind
    text = Path(path.stem).suffix.lower()
    return text if FORMATS.get(text) is TextTable else kind


def similar(path: Path) -> str:
    """Suggest files in place of a missing one, as the end of a message."""
    folder = path.parent
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    if folder != path.parent:
        return f", and no folder '{path.parent}'"
    names = [p.name for p in folder.iterdir() if p.is_file()]
    known = {name.lower(): name for name in names}
    close = difflib.get_close_matches(path.name.lower(), known, n=_SHOWN, cutoff=0.6)
    close = [known[name] for name in close]
    if close:
        return f"; there is {', '.join(map(repr, close))} in its folder"
    usable = sorted(name for name in names if extension(Path(name)) in FORMATS)
    if usable:
        return f"; its folder has {', '.join(map(repr, usable[:_SHOWN]))}"
    return " in its folder, and none of a known format"
