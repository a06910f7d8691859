"""Official measurements: search or download, reading, and cuts in time."""

from __future__ import annotations

import csv
import hashlib
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import scipy
from numpy.typing import NDArray

from lfrtorch._support.checks import number, true_or_false
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.dataset import Published
from lfrtorch.data.records import Channel, Record, Start

Shape = tuple[int | None, ...]
"""Shape of an array in a file; None for an axis of any length."""

BOARD = "leaderboard of nonlinearbenchmark.org"
"""Citation of a published score on nonlinearbenchmark.org."""

LEGACY = f"{BOARD}, before it fixed its splits"
"""Citation of such a score if its estimation or test samples differ from the site's of today."""


def cache() -> Path:
    """Folder in which the package nonlinear_benchmarks keeps its downloads."""
    if sys.platform == "win32":
        folder = os.environ.get("LOCALAPPDATA", "~/AppData/Local") + "/nonlinear_benchmarks"
    elif sys.platform == "darwin":
        folder = "~/Library/Application Support/nonlinear_benchmarks"
    else:
        folder = "~/.nonlinear_benchmarks"
    return Path(os.path.expanduser(folder))


def folder(root: str | Path | None) -> Path:
    """Folder of the benchmarks: ``root``, or the cache folder if it is None."""
    return cache() if root is None else Path(root).expanduser()


def find(
    root: str | Path | None,
    file: str,
    loader: str,
    *,
    others: Sequence[str] = (),
    download: bool = False,
) -> Path:
    """Path of the file ``root / file`` of a benchmark, or of the first of ``others`` that exists.

    The function ``loader`` of nonlinear_benchmarks fetches a missing file, if ``download``.
    """
    true_or_false("download", download)
    below = folder(root)
    path = _present(below, (file, *others))
    if path is None and download:
        _download(below, file, loader)
        path = _present(below, (file, *others))
        if path is None:
            raise FileNotFoundError(
                f"nonlinear_benchmarks.{loader}() left no '{file}' in '{below}'; if an archive is "
                f"there, even an empty one, remove that from '{below / file.partition('/')[0]}' "
                "and try again."
            )
    if path is None:
        raise FileNotFoundError(
            f"there is no '{file}' in '{below}'.\nGive the folder that holds "
            f"'{file.partition('/')[0]}' with root=DIR, or have it downloaded: pip install "
            f"'lfrtorch[bench]', then download=True (nonlinear_benchmarks.{loader}())."
        )
    return path


def find_tests(
    root: str | Path | None,
    files: Mapping[str, str],
    loader: str,
    *,
    others: Sequence[str] = (),
    download: bool = False,
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Paths of the existing test files, by test, and a note on the missing ones."""
    below, found = folder(root), {}
    for test, file in files.items():
        if download or _present(below, (file, *others)):
            found[test] = find(root, file, loader, others=others, download=download)
    missing = [test for test in files if test not in found]
    lost = [Path(files[test]).name for test in missing]
    more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
    why = f"{lost[0]}{more} not found (download=True fetches them)" if lost else ""
    return found, without_tests(missing, why, partly=bool(found))


def archive_note(archive: Path, md5: str, file: str) -> str:
    """Note on the checksum of the archive from which ``file`` was unpacked."""
    if not _there(archive):
        return f"no {archive.name} beside {file}: its checksum is unknown"
    with archive.open("rb") as content:
        found = hashlib.file_digest(content, lambda: hashlib.md5(usedforsecurity=False)).hexdigest()
    if found == md5:
        return f"{archive.name} is the known file (md5 {md5})"
    return (
        f"{archive.name} is not the known file: md5 {found}, expected {md5}; scores may not compare"
    )


def read_arrays(path: Path, shapes: Mapping[str, Shape], member: str = "") -> dict[str, Array]:
    """Read arrays of a .mat file, or of the ``member`` of a zip archive, by name.

    Signals that are a row or a column of the file have the shape (samples,).
    """
    content = _unpacked(path, member) if path.suffix == ".zip" else path
    found: dict[str, Array] = {}
    for name, shape in shapes.items():
        signal = len(shape) == 1
        allowed = ((1, *shape), (*shape, 1)) if signal else (shape,)
        with readable(path, f"'{name}'"):
            array = np.asarray(scipy.io.loadmat(content, variable_names=[name])[name])
        array = _numbers(path, name, array, allowed)
        found[name] = array.ravel() if signal else array
    return found


def read_struct(path: Path, name: str, fields: Sequence[str]) -> list[Array]:
    """Read matrices (samples, records) of one shape from a struct of a .mat file, in this order."""
    with readable(path, f"struct '{name}' with {' and '.join(fields)}"):
        (struct,) = scipy.io.loadmat(path, variable_names=[name])[name].ravel()
        matrices = [np.asarray(struct[field]) for field in fields]
    shape = matrices[0].shape
    if len(shape) != 2 or 0 in shape:
        raise InputError(
            f"'{path}': '{name}.{fields[0]}' has shape {shape}; expected (samples, records); "
            f"{again(path)}"
        )
    return [
        _numbers(path, f"{name}.{field}", matrix, (shape,))
        for field, matrix in zip(fields, matrices, strict=True)
    ]


def read_npz(path: Path) -> dict[str, Array]:
    """Read all arrays of a .npz file by name; refuse NaN, and anything but numbers."""
    with readable(path, "arrays"), path.open("rb") as content, np.load(content) as file:
        found = {name: file[name] for name in file.files}
    return {name: _numbers(path, name, array, (array.shape,)) for name, array in found.items()}


def without_tests(missing: Sequence[str], why: str, *, partly: bool) -> tuple[str, ...]:
    """Note on missing tests; ``partly`` if others exist."""
    names = f" {', '.join(missing)}" if partly else ""
    return (f"no test records{names}: {why}",) if missing else ()


def held_out(samples: int, validation: float, least: int = 1) -> int:
    """Number of estimation samples that validate; ``least`` must be left for training."""
    number("validation", validation, positive=True)
    count = round(samples * min(validation, 1))
    if not 0 < count <= samples - least:
        raise InputError(
            f"validation is {validation}, which leaves {samples - count} of the {samples} "
            f"estimation samples for training, and {count} to validate on; it needs {least} and 1 "
            "at least:\ngive a fraction like 0.2."
        )
    return count


def part(
    whole: Record, first: int, last: int, *, warm_up: int, name: str, start: Start = "zero"
) -> Record:
    """Cut samples ``first`` to ``last`` out, with ``warm_up`` unscored samples before them.

    The transient from zero state falls into the warm-up. An estimated start state is fitted to the
    warm-up, and never to outputs that are scored.
    """
    return replace(whole[first - warm_up : last], name=name, skip=warm_up, start=start)


def record(
    u: Array, y: Array, inputs: Mapping[str, str], outputs: Mapping[str, str], **settings: Any
) -> Record:
    """Make a record of channels with these names and units; by default its source is official."""
    given = {"source": "official", **settings}
    for use, channels in (("inputs", inputs), ("outputs", outputs)):
        given[use] = tuple(Channel(name, unit) for name, unit in channels.items())
    return Record(u, y, **given)


def published(benchmark: str) -> tuple[Published, ...]:
    """Return the published results of a benchmark, rows of ``published.csv``, in SI units."""
    with (Path(__file__).parent / "published.csv").open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["benchmark"] == benchmark]
    found: list[Published] = []
    for row in rows:
        scale = {"mV": 1e-3, "mm": 1e-3, "µm": 1e-6}.get(row["unit"], 1.0)
        errors = (test.rpartition(" ") for test in row["errors"].split("; "))
        scores = {test: scale * float(error) for test, _, error in errors}
        sizes = (int(row["nz"]), int(row["nw"])) if row["nz"] else None
        found.append(Published(row["result"], scores, row["source"], sizes, row["unit"]))
    return tuple(found)


def chosen_levels(levels: Sequence[int], known: Sequence[int]) -> list[int]:
    """Return amplitudes (mV rms) as plain integers; refuse unknown ones, repetitions and none."""
    try:
        chosen = [known[known.index(level)] for level in levels]
    except (TypeError, ValueError):
        chosen = []
    if not chosen or len(set(chosen)) < len(chosen):
        raise InputError(
            f"levels is {levels}; give one or more of {', '.join(map(str, known))} (mV rms), each "
            f"once, for example [{known[0]}, {known[-1]}]."
        )
    return chosen


def _there(path: Path) -> bool:
    """Tell if a file exists and is not an empty archive."""
    return path.is_file() and (path.suffix != ".zip" or path.stat().st_size > 0)


def _present(below: Path, files: Sequence[str]) -> Path | None:
    return next((below / file for file in files if _there(below / file)), None)


def _download(below: Path, file: str, loader: str) -> None:
    """Have nonlinear_benchmarks fetch and unpack the archive; none of its data is used."""
    module, _, function = f"nonlinear_benchmarks.{loader}".rpartition(".")
    try:
        package = import_module(module)
    except ImportError as error:
        raise FileNotFoundError(
            f"there is no '{file}' in '{below}', and the package that downloads it cannot be "
            f"imported ({error}):\npip install 'lfrtorch[bench]'. Or give the folder that holds "
            f"'{file.partition('/')[0]}' with root=DIR."
        ) from error
    below.mkdir(parents=True, exist_ok=True)
    try:
        getattr(package, function)(data_file_locations=True, dir_placement=below)
    except Exception as error:  # it may raise plain Exceptions
        raise OSError(
            f"nonlinear_benchmarks.{loader}() failed ({error!r}); remove what it left in "
            f"'{below / file.partition('/')[0]}' and try again, or give the folder that holds "
            f"'{file.partition('/')[0]}' with root=DIR."
        ) from error


def _unpacked(path: Path, member: str) -> BytesIO:
    """The content of a file in a zip archive."""
    with readable(path, f"'{member}'"), ZipFile(path) as archive:
        (name,) = (n for n in archive.namelist() if n.rpartition("/")[2] == member)
        return BytesIO(archive.read(name))


def _numbers(path: Path, name: str, found: NDArray[Any], shapes: Sequence[Shape]) -> Array:
    """Check that a variable has one of the shapes and is real and finite."""
    fits = any(
        len(shape) == found.ndim
        and all(n in (None, own) for n, own in zip(shape, found.shape, strict=True))
        for shape in shapes
    )
    if found.dtype.kind not in "iuf" or not fits or not np.isfinite(found).all():
        expected = " or ".join(map(str, shapes)).replace("None", "any")
        raise InputError(
            f"'{path}': '{name}' has shape {found.shape} and type {found.dtype}; expected "
            f"{expected} and real numbers without NaN; "
            f"{again(path)}"
        )
    return found.astype(np.float64)


@contextmanager
def readable(path: Path, what: str) -> Iterator[None]:
    """Name the file in errors of reading it, of which readers have many kinds."""
    try:
        yield
    except Exception as error:
        raise InputError(f"'{path}' holds no readable {what} ({error!r}); {again(path)}") from error


def again(path: Path) -> str:
    """Advice on a file that cannot be used."""
    return f"remove '{path.name}' and any archive beside it, and download them again."
