"""What comes in from outside, damaged or without sense: files, checkpoints and command lines.

Each case is a name and a piece of work for a process of its own, which ends well, with finite
numbers, or in one message.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import random
import shutil
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import openpyxl
import pandas as pd
import scipy.io
from safetensors.numpy import load_file, save_file

import lfrtorch
from lfrtorch._support.errors import InputError
from lfrtorch.cli import command
from lfrtorch.cli.errors import user_errors

Case = tuple[str, Callable[[], Any]]

SIGNALS = np.random.default_rng(0).normal(size=(60, 2)).round(3)
LINES = "\n".join(["u,y", *(f"{u},{y}" for u, y in SIGNALS)]).encode()

# --- files ---


def saved(write: Callable[[io.BytesIO], Any]) -> bytes:
    """What is written to a stream."""
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def hdf5(*, matlab: bool) -> bytes:
    """Two data sets, as HDF5 or as MATLAB 7.3 has them."""
    stream = io.BytesIO()
    with h5py.File(stream, "w", userblock_size=512 if matlab else 0) as file:
        for name, values in zip("uy", SIGNALS.T, strict=True):
            file[name] = values[None] if matlab else values
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" if matlab else b""
    return head + stream.getvalue()[len(head) :]


def excel() -> bytes:
    """A sheet."""
    book = openpyxl.Workbook()
    for row in [["u", "y"], *SIGNALS.tolist()]:
        book.worksheets[0].append(row)
    return saved(book.save)


def formats() -> dict[str, bytes]:
    """A file of each."""
    named = dict(zip("uy", SIGNALS.T, strict=True))
    return {
        "a.csv": LINES,
        "wide.csv": LINES.decode().encode("utf-16"),
        "a.csv.gz": gzip.compress(LINES, mtime=0),
        "a.npy": saved(lambda file: np.save(file, SIGNALS)),
        "a.npz": saved(lambda file: np.savez(file, **named)),
        "a.mat": saved(lambda file: scipy.io.savemat(file, named)),
        "packed.mat": saved(lambda file: scipy.io.savemat(file, named, do_compression=True)),
        "old.mat": saved(lambda file: scipy.io.savemat(file, named, format="4")),
        "new.mat": hdf5(matlab=True),
        "a.h5": hdf5(matlab=False),
        "a.xlsx": excel(),
        "a.parquet": saved(lambda file: pd.DataFrame(named).to_parquet(file)),
    }


def damaged(content: bytes, rng: random.Random) -> bytes:
    """With some bytes changed, left out or put in, or cut off."""
    found = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 4])):
        n = max(len(found), 1)
        at = rng.choice([rng.randrange(min(n, 256)), rng.randrange(n)])
        huge = (10**12).to_bytes(8, "little")
        put = rng.choice([b"\0", b"\xff", rng.randbytes(1), rng.randbytes(8), huge, b"\xff" * 8])
        found[at : at + rng.choice([0, 1, len(put), n])] = put
    return bytes(found)


def within(archive: bytes, rng: random.Random) -> bytes:
    """A zip archive of which one part is damaged, with the checksum of the damaged one."""
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    chosen = rng.choice(list(parts))
    parts[chosen] = damaged(parts[chosen], rng)
    return zipped(parts)


def zipped(parts: dict[str, bytes]) -> bytes:
    """A zip archive."""

    def write(stream: io.BytesIO) -> None:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
            for name, content in parts.items():
                file.writestr(name, content)

    return saved(write)


def header(shape: tuple[int, ...], kind: str = "<f8") -> bytes:
    """Of a .npy file."""
    layout = {"descr": kind, "fortran_order": False, "shape": shape}
    return saved(lambda file: np.lib.format.write_array_header_1_0(file, layout))


def odd() -> dict[str, bytes]:
    """Files that are whole, and strange."""
    rows = LINES.decode().partition("\n")[2]
    huge = header((10**12,)) + SIGNALS.tobytes()
    lol = '<!DOCTYPE x [<!ENTITY a "1">' + "".join(
        f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">' for i in range(9)
    )
    book = excel()
    with zipfile.ZipFile(io.BytesIO(book)) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    sheet = "xl/worksheets/sheet1.xml"
    bomb = parts | {sheet: b"<row/>" * (2 * 10**7)}
    named = {
        "markup.csv": f"<script>alert(1)</script>,\x1b[31my\n{rows}",
        "twice.csv": f"u,y,y\n{rows}", "bom.csv": f"\ufeff\ufeffu,y\n{rows}",
        "page.csv": f"remark\x0c\x85\nu,y\n{rows}", "digits.csv": f"u,y\n{'9' * 10**6}x,1\n{rows}",
        "blanks.csv": f"u{' ' * 10**5}x,y\n{rows}", "quote.csv": f'u,y\n{rows}"1,2',
        "days.csv": "u,y\n" + "2020-02-30,1\n" * 60, "other.csv": "u,y\n" + "１,２\n" * 60,
        "inf.csv": f"u,y\n1e999,1\n{rows}", "nan.csv": "u,y\n" + "nan,nan\n" * 60,
        "long.csv": "u" * 10**6 + f",y\n{rows}", "n" * 250 + ".csv": rows,
        "<script>alert(1)</script>.csv".replace("/", "_"): f"u,y\n{rows}",
        "nul.csv": "\0" * 5000, "empty.csv": "", "a.exe": rows,
    }  # fmt: skip
    return {name: text.encode() for name, text in named.items()} | {
        "gzip in gzip.csv.gz": gzip.compress(gzip.compress(LINES)),
        "bomb.csv.gz": gzip.compress(b" " * 2**26),
        "huge.npy": huge,
        "huge.npz": zipped({"u.npy": huge, "y.npy": huge}),
        "zeros.npz": zipped({"u.npy": header((2**28,)) + bytes(2**28), "y.npy": huge}),
        "code.npy": b"\x80\x04cos\nsystem\n(S'touch sprung'\ntR.",
        "rows.xlsx": zipped(parts | {sheet: parts[sheet].replace(b'r="30"', b'r="2000000000"')}),
        "bomb.xlsx": zipped(bomb),
        "entities.xlsx": zipped(
            parts | {sheet: f"{lol}]>".encode() + parts[sheet].replace(b"<v>", b"<v>&j;", 9)}
        ),
    }


def files(folder: Path, count: int, seed: int) -> Iterator[Case]:
    """Damaged files of each format, strange ones, and what is no file."""
    for name, content in formats().items():
        rng = random.Random(f"{seed}{name}")
        for number in range(count):
            archive = name.endswith((".xlsx", ".npz")) and rng.random() < 0.7
            made = (within if archive else damaged)(content, rng)
            yield f"{name} damaged ({number})", partial(read, written(folder / name, made))
    for name, content in odd().items():
        yield name[:40], partial(read, written(folder / name, content))
    for ending in (".csv", ".csv.gz", ".mat", ".npy", ".npz", ".h5", ".xlsx", ".parquet"):
        for kind, path in nothings(folder, ending):
            yield f"{kind}{ending}", partial(read, path)
    for name in ("n" * 300 + ".csv", "~nobody-of-that-name/a.csv", "", "a" * 5000, "/a/b.csv"):
        yield f"path {name[:20]!r}", partial(read, name)


def nothings(folder: Path, ending: str) -> Iterator[tuple[str, Path]]:
    """A pipe, a folder, links to nothing, to themselves and to devices."""
    for kind in ("pipe", "folder", "circle", "nowhere", "zero"):
        path = folder / f"{kind}{ending}"
        with suppress(FileExistsError):
            if kind == "pipe":
                os.mkfifo(path)
            elif kind == "folder":
                path.mkdir()
            else:
                path.symlink_to({"circle": path, "zero": "/dev/zero"}.get(kind, "/no/where"))
        yield kind, path


def written(path: Path, content: bytes) -> Path:
    """The file."""
    path.write_bytes(content)
    return path


def read(path: Path | str) -> None:
    """As a fit reads it."""
    name = Path(path).stem
    columns: tuple[Any, Any] = (0, 1) if str(path).endswith("npy") or "<" in name else ("u", "y")
    with warnings.catch_warnings(), np.errstate(over="ignore"):
        warnings.simplefilter("ignore")
        data = lfrtorch.load_records(path, inputs=columns[0], outputs=columns[1], fs=1.0)
    for record in data.train + data.validation + data.tests:
        assert np.isfinite(np.c_[record.u, record.y]).all(), "not finite"


# --- checkpoints ---

STRANGE: list[Any] = [
    None, True, -1, 0, 3, 0.5, 1e300, float("nan"), "", "<script>", [], {}, [1], {"a": 1}, 10**12,
    2**70, "../../etc/passwd", {"_target_": "os.system", "_args_": ["touch sprung"]},
]  # fmt: skip


def checkpoints(run: Path, folder: Path, count: int, seed: int) -> Iterator[Case]:
    """Damaged checkpoints and runs, each through one of the doors that take it in turn."""
    rng = random.Random(seed)
    doors = [
        loaded,
        partial(typed, ["simulate", f"data.path={run / 'x.csv'}", "out=y.csv"], "checkpoint"),
        partial(typed, ["export", "to=c"], "checkpoint"),
        partial(typed, ["evaluate", *from_file(run / "x.csv")], "checkpoint"),
        partial(typed, [*fit_words(run), "hydra.run.dir=run"], "init_from"),
    ]
    made = [*damages(rng, count)]
    for number, (what, damage) in enumerate(made):
        copy = copied(run, folder / str(number))
        damage(copy / "model")
        yield what, partial(doors[number % len(doors)], copy)
    parts = ("resume/0.safetensors", "resume/rounds.json", ".hydra/overrides.yaml", "config.yaml")
    for number in range(count):
        part = parts[number % len(parts)]
        copy = copied(run, folder / f"resume {number}")
        written(copy / part, damaged((copy / part).read_bytes(), rng))
        yield f"{part} ({number})", partial(typed, ["fit", "trainer.max_iter=5"], "resume", copy)


def damages(rng: random.Random, count: int) -> Iterator[tuple[str, Callable[[Path], Any]]]:
    """What is done to the folder of a model."""
    for number in range(count):
        for name in ("model.json", "weights.safetensors"):
            seed = rng.random()
            yield f"{name} damaged ({number})", partial(spoil, name=name, seed=seed)
    for key in ("sizes", "static", "dtype", "fs", "inputs", "outputs", "version", "format", "new"):
        for value in STRANGE:
            yield f"{key}: {value!r:.30}", partial(describe, key=key, value=value)
    for name in ("A", "Bu", "Cy", "static.Wz", "scaler.u_scale", "extra"):
        for value in (np.nan, np.inf, 1e300, 1e-320, np.zeros(0), np.zeros((9, 9)), None):
            yield f"{name}: {value!r:.20}", partial(weigh, name=name, value=value)
    for name in ("model.json", "weights.safetensors"):
        for kind in ("pipe", "folder", "circle", "nowhere", "zero"):
            yield f"{name} is a {kind}", partial(replace, name=name, kind=kind)
        yield f"{name} of 80 GB", partial(lengthen, name=name)


def spoil(model: Path, name: str, seed: float) -> None:
    """Change bytes of a file."""
    written(model / name, damaged((model / name).read_bytes(), random.Random(seed)))


def describe(model: Path, key: str, value: Any) -> None:
    """Change an entry of the description."""
    found = json.loads((model / "model.json").read_text()) | {key: value}
    (model / "model.json").write_text(json.dumps(found))


def weigh(model: Path, name: str, value: Any) -> None:
    """Change weights, without a digest."""
    weights = load_file(model / "weights.safetensors")
    before = weights.pop(name, np.zeros(3))
    if value is not None:
        weights[name] = value if isinstance(value, np.ndarray) else np.full_like(before, value)
    save_file(weights, model / "weights.safetensors")


def replace(model: Path, name: str, kind: str) -> None:
    """Have something else in the place of a file."""
    (model / name).unlink()
    for found, path in nothings(model.parent, ""):
        if found == kind:
            path.rename(model / name)


def lengthen(model: Path, name: str) -> None:
    """Have the file as long as no memory is."""
    os.truncate(model / name, 8 * 10**10)


def copied(run: Path, folder: Path) -> Path:
    """Of a run."""
    shutil.rmtree(folder, ignore_errors=True)
    return Path(shutil.copytree(run, folder))


def loaded(folder: Path) -> None:
    """Load the model of a run, and simulate it."""
    model = lfrtorch.load(folder)
    try:
        y_hat = next(iter(lfrtorch.simulate_blocks(model, [SIGNALS[:, :1]])))
    except InputError:  # it diverges, and says so
        return
    assert np.isfinite(y_hat).all(), "not finite"


# --- command lines ---


def from_file(csv: Path) -> list[str]:
    """The words that choose a file of u and y."""
    return f"data=file data.path={csv} data.inputs=[u] data.outputs=[y] data.fs=10".split()


def fit_words(run: Path) -> list[str]:
    """Of a short fit."""
    short = "figures=false nx=2 nn=3 trainer.max_iter=2 bla.max_iter=1 threads=1"
    return ["fit", *from_file(run / "x.csv"), *short.split()]


def commands(run: Path, values: Sequence[str]) -> Iterator[Case]:
    """Each setting of the words other than fit with values that few take, and wrong words."""
    csv, made = run / "x.csv", f"checkpoint={run}"
    given = from_file(csv)
    data = [f"data.{name}" for name in DATA.split()]
    linear = "nx nx_max threads bla.refine bla.offset bla.feedthrough bla.integrators bla.max_iter "
    linear += "bla.coordinates frf.method noise"
    words = {
        "simulate": ([made, f"data.path={csv}", "out=y.csv"], SIMULATE.split()),
        "export": ([made, "to=c"], EXPORT.split()),
        "evaluate": ([made, *given], ["checkpoint", "out", "overwrite", *data]),
        "linear": ([*given, "nx=1", "threads=1", "hydra.run.dir=r"], [*linear.split(), *data]),
        "preview": ([str(csv)], data),
    }
    for word, (base, names) in words.items():
        lines = [[*base, f"{name}={value}"] for name in names for value in values]
        lines = [line for line in lines if line[-1] not in ENDLESS]
        lines += [base[:i] + base[i + 1 :] for i in range(len(base))]
        lines += [[*base, wrong] for wrong in WRONG] + [[]]
        for line in lines:
            yield f"{word} {' '.join(line[-1:])}", partial(typed, [word, *line])
    for line in ([], ["fitt"], ["-x"], [""], ["simulat", "x"]):
        yield f"{line}", partial(typed, line)


EXPORT = "checkpoint to out name overwrite observer Q R"
DATA = "path inputs outputs fs time units validation test start period skip gaps reference limits"
SIMULATE = "checkpoint data data.path data.inputs data.outputs data.time data.fs start x0 estimate "
SIMULATE += "skip out format overwrite"
WRONG = ["wrong=1", "wrong", "=1", "a=b=c", "~nx", "data.pth=1", "--wrong", "out=/proc/x.csv",
         "out=/etc/passwd/x.json", "data.path=[a", "seed=1,2", "+x={_target_: os.getcwd}",
         "nx=${nowhere}", "name=<script>"]  # fmt: skip
ENDLESS = {f"{name}={'9' * 20}" for name in ("trials", "workers")}
"""What is taken, and takes long."""


def typed(words: Sequence[str], last: str = "", folder: Path | None = None) -> None:
    """A command line, in a folder of its own."""
    here = Path("here")
    shutil.rmtree(here, ignore_errors=True)
    here.mkdir()
    os.chdir(here)
    sys.argv = ["lfrtorch", *words, *([f"{last}={folder}"] if last else [])]
    command.main()


def tried(work: Callable[[], Any], folder: Path) -> None:
    """In a process of its own: the work, errors of users as the command line shows them."""
    os.chdir(folder)
    with user_errors():
        work()
