"""What happens to runs that are killed, and to input that makes no sense? A page says it.

    python tests/torture.py [--only ROWS ...] [--kills N] [--signals N] [--seed N] [--out PAGE.md]

A run is killed, or asked to end, at random moments, and goes on: it must end in the bits of a run
that was left alone. Each setting of the command line gets values that make no sense, and so do the
arrays of Python; files and checkpoints are damaged: each case must end in one message, or in
numbers that are finite. With --only the other rows of the page stay as they are.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import doors
import nonsense
import numpy as np
import torch
import yaml
from nonsense import Case
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from safetensors.numpy import load_file

from lfrtorch.cli import fit
from lfrtorch.cli.claim import tidy
from lfrtorch.cli.composition import check_words, composed

PROCESSES = multiprocessing.get_context("forkserver")
LOADED = ["lfrtorch.cli.fit", "lfrtorch._public", "pandas", "scipy.signal", "doors"]
LOADED += [f"lfrtorch.cli.{word}" for word in ("simulate", "evaluate", "export", "preview")]
SHORT = ["nx=2", "nn=5", "trainer.max_iter=12", "bla.max_iter=3", "threads=1"]
ROWS = ["runs", "surroundings", "settings", "arguments", "files", "checkpoints", "commands"]
LIMIT = 60.0
"""Seconds after which a case is taken to hang."""
MEMORY = 4e9
"""Bytes that a case may take beyond what is loaded."""


class Ended(NamedTuple):
    """How a process ended: its exit code (None: it was ended), and what it printed."""

    code: int | None
    text: str
    seconds: float


class Row(NamedTuple):
    """A line of the page."""

    what: str
    cases: int
    outcome: str
    faults: list[str]


def main() -> int:
    """Try all, write the page."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--signals", type=int, default=40)
    parser.add_argument("--values", type=int, default=len(VALUES), help="of each setting")
    parser.add_argument("--damaged", type=int, default=40, help="files of each format")
    parser.add_argument("--only", nargs="+", choices=ROWS, default=ROWS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/torture.md"))
    asked = parser.parse_args()
    PROCESSES.set_forkserver_preload(LOADED)
    rows = []
    with tempfile.TemporaryDirectory() as top:
        folder = Path(top)
        csv = measured(folder)
        for starts in (1, 4) if "runs" in asked.only else ():
            words = [*file_words(csv), *SHORT, f"starts={starts}"]
            for number, name, count in (
                (signal.SIGKILL, "killed (kill -9)", asked.kills // 2),
                (signal.SIGTERM, "terminated (SIGTERM)", asked.signals // 4),
                (signal.SIGINT, "interrupted (Ctrl-C)", asked.signals // 4),
            ):
                row = stopped(words, folder / f"{name}{starts}", number, count, asked.seed)
                rows.append(row._replace(what=f"a fit of {starts} start(s), {name}"))
                print(rows[-1], flush=True)
        if "surroundings" in asked.only:
            rows += surroundings([*file_words(csv), *SHORT], folder)
            print(*rows[-3:], sep="\n", flush=True)
        if "settings" in asked.only:
            rows.append(nonsense_settings(file_words(csv), folder, asked.values))
            print(rows[-1], flush=True)
        for what, cases in nonsense.CASES.items() if "arguments" in asked.only else ():
            rows.append(nonsense_arguments(what, cases(folder)))
            print(rows[-1], flush=True)
        for name in ("files", "checkpoints", "commands"):
            if name in asked.only:
                rows.append(door(name, folder / name, asked.damaged, asked.values, asked.seed))
                print(rows[-1], flush=True)
    before = [] if asked.only == ROWS else kept(asked.out, rows)
    asked.out.write_text(page([*before, *rows]), encoding="utf-8")
    return int(any(row.faults for row in rows))


def kept(path: Path, rows: Sequence[Row]) -> list[Row]:
    """The rows of a page that are not among those, without what their faults were."""
    found: list[Row] = []
    if not path.is_file():
        return found
    for line in path.read_text(encoding="utf-8").splitlines():
        cells = line.strip("| ").split(" | ")
        if len(cells) == 4 and cells[1].isdecimal() and cells[0] not in [r.what for r in rows]:
            found.append(Row(cells[0], int(cells[1]), cells[2], ["of before"] * int(cells[3])))
    return found


def page(rows: Sequence[Row]) -> str:
    """What was tried, how often, and what happened."""
    shown = [[row.what, row.cases, row.outcome, len(row.faults)] for row in rows]
    head = ["what was tried", "cases", "what happened", "faults"]
    lines = [head, ["---"] * len(head), *shown]
    faults = [f"- {row.what}: {fault}" for row in rows for fault in row.faults]
    return "\n".join([
        "# Tried: kills, signals, damage and input that makes no sense",
        "",
        "Written by `make torture`. Killed runs went on with `resume=`; their end was compared bit",
        "by bit with that of a run that was left alone, and every file was read.",
        "",
        *(f"| {' | '.join(map(str, line))} |" for line in lines),
        "",
        *faults,
        f"The rows that were tried last: Python {platform.python_version()}, "
        f"torch {torch.__version__}, {processor()}.",
        "",
    ])  # fmt: skip


def processor() -> str:
    """What the system calls its processor."""
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        named = [line.split(":")[1].strip() for line in file if line.startswith("model name")]
    return named[0] if named else platform.machine()


def measured(folder: Path) -> Path:
    """A record of a saturating system of second order."""
    rng = np.random.default_rng(0)
    u, x = rng.standard_normal(800), np.zeros(2)
    y = []
    for value in u:
        y.append(np.tanh(x[0]) + 0.01 * rng.standard_normal())
        x = np.array([0.6 * x[0] + 0.3 * x[1] + value, -0.3 * x[0] + 0.8 * x[1]])
    path = folder / "x.csv"
    table_of = np.stack([u, y], axis=1)
    np.savetxt(path, table_of, delimiter=",", header="u,y", comments="")
    return path


def file_words(path: Path) -> list[str]:
    """The words that choose a file of u and y."""
    data = f"data.path={path} data.inputs=[u] data.outputs=[y] data.fs=10"
    return ["data=file", *data.split(), "figures=false"]


def configuration(words: Sequence[str]) -> DictConfig:
    """As the command line makes it."""
    return composed("config", list(words))


# --- runs that end early ---


def stopped(words: Sequence[str], top: Path, number: int, count: int, seed: int) -> Row:
    """Runs that get a signal at random moments and go on."""
    top.mkdir()
    cfg = configuration(words)
    ended(partial(begin, cfg, top / "first"))  # which may compile
    whole = ended(partial(begin, cfg, top / "alone"))
    expected = weights(top / "alone")
    rng, faults, amid = random.Random(seed), [], 0
    for case in range(count):
        folder = top / str(case)
        moment = rng.uniform(0.0, 1.05 * whole.seconds)
        first = ended(partial(begin, cfg, folder), number, moment)
        amid += first.code != 0
        faults += [f"case {case}: {fault}" for fault in damaged(folder)]
        if number != signal.SIGKILL and first.code not in (0, 128 + number):
            faults.append(f"case {case}: exit code {first.code}: {first.text[-200:]}")
        if "Traceback" in first.text:
            faults.append(f"case {case}: traceback: {first.text[-200:]}")
        again = configuration([*words, f"resume='{folder}'"] if first.code else words)
        if first.code and not (folder / "resume").is_dir():
            again = configuration(words)  # it had not begun
        last = ended(partial(begin, again, folder)) if first.code else first
        if last.code != 0:
            faults.append(f"case {case}: went on to exit code {last.code}: {last.text[-200:]}")
        elif not same(weights(folder), expected):
            faults.append(f"case {case}: other bits")
        shutil.rmtree(folder, ignore_errors=True)
    outcome = f"{amid} amid the run, the others after it; the end is the same bits"
    return Row("", count, outcome if not faults else "see below", faults)


def begin(cfg: DictConfig, folder: Path) -> None:
    """A run, as the command line begins it."""
    folder.mkdir(parents=True, exist_ok=True)
    tidy(folder)
    fit.launched(cfg, folder, "torture")


def weights(folder: Path) -> dict[str, np.ndarray]:
    """Of the model in a run's folder."""
    (path,) = (folder / "model").glob("*.safetensors")
    return load_file(path)


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    """Whether all bits are."""
    return one.keys() == other.keys() and all(one[k].tobytes() == other[k].tobytes() for k in one)


def damaged(folder: Path) -> Iterator[str]:
    """Files that cannot be read, other than those that begin as unfinished ones do."""
    readers: dict[str, Callable[[Path], Any]] = {
        ".json": lambda path: json.loads(path.read_text(encoding="utf-8")),
        ".yaml": lambda path: yaml.safe_load(path.read_text(encoding="utf-8")),
        ".safetensors": load_file,
        ".png": lambda path: Image.open(path).verify(),
    }
    for path in folder.rglob("*"):
        unfinished = any(part.startswith(".lfrtorch-") for part in path.parts)
        if unfinished or path.suffix not in readers:
            continue
        try:
            readers[path.suffix](path)
        except Exception as error:
            yield f"{path.name} is damaged: {error}"


def ended(work: Callable[[], None], number: int = 0, moment: float = LIMIT) -> Ended:
    """Do it in a process of its own, which gets a signal at a moment in seconds."""
    ours, theirs = PROCESSES.Pipe(duplex=False)
    process = PROCESSES.Process(target=logged, args=(work, theirs))
    begun = time.monotonic()
    process.start()
    theirs.close()
    said = bytearray()
    reader = threading.Thread(target=read_all, args=(ours, said))
    reader.start()
    process.join(moment)
    if process.is_alive():
        os.kill(process.pid or 0, number or signal.SIGKILL)
        process.join(LIMIT)
    hangs = process.is_alive()
    if hangs:
        process.kill()
        process.join()
    took = time.monotonic() - begun
    reader.join()
    hangs |= number == 0 and took >= LIMIT
    return Ended(None if hangs else process.exitcode, said.decode(errors="replace"), took)


def read_all(pipe: Connection, into: bytearray) -> None:
    """What comes from the process until it ends."""
    while found := os.read(pipe.fileno(), 1 << 16):
        into += found
    pipe.close()


def logged(work: Callable[[], None], pipe: Connection) -> None:
    """In that process: what is printed goes into a pipe."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
    for number in (1, 2):
        os.dup2(pipe.fileno(), number)
    pipe.close()
    work()


# --- what surrounds a run fails ---


def surroundings(words: Sequence[str], top: Path) -> list[Row]:
    """Runs whose disk is full, whose TensorBoard fails, and whose clock jumps."""
    cfg = configuration([*words, "figures=true"])
    ended(partial(begin, cfg, top / "usual"))
    expected = weights(top / "usual")
    rows = []
    for what, breaks, values in (
        ("a disk that is full after 0 to 300 000 bytes of a file", shortened, SIZES),
        ("TensorBoard cannot write from an iteration on", without_board, range(0, 13, 2)),
        ("a clock that jumps by 1e5 to 1e9 s, back or forth", jumping, (-1e9, -1e5, 1e5, 1e9)),
    ):
        faults, refused = [], 0
        for value in values:
            folder = top / f"{breaks.__name__}{value}"
            found = ended(partial(broken, breaks, value, cfg, folder))
            refused += found.code == 1
            faults += [f"{value}: {fault}" for fault in damaged(folder)]
            said = [line for line in found.text.splitlines() if line.startswith("error: ")]
            if found.code is None or "Traceback" in found.text:
                faults.append(f"{value}: {found.text[-300:]}")
            elif found.code != 0 and not said:
                faults.append(f"{value}: exit code {found.code}: {found.text[-300:]}")
            if found.code != 0 and (folder / "resume").is_dir():
                again = configuration([*words, f"resume='{folder}'"])
                found = ended(partial(begin, again, folder))
            if found.code == 0 and not same(weights(folder), expected):
                faults.append(f"{value}: other bits")
            elif found.code != 0 and (folder / "resume").is_dir():
                faults.append(f"{value}: did not go on: {found.text[-300:]}")
            shutil.rmtree(folder, ignore_errors=True)
        done = "none ended early; the end is the same bits"
        if refused:
            done = (
                f"{refused} ended in a message, and those that had begun went on to the same bits"
            )
        rows.append(Row(what, len(values), done, faults))
    return rows


SIZES = [0, 100, 1000, 3000, 10_000, 20_000, 50_000, 100_000, 300_000]


def broken(breaks: Callable[[float], None], value: float, cfg: DictConfig, folder: Path) -> None:
    """A run in such surroundings."""
    breaks(value)
    begin(cfg, folder)


def shortened(length: float) -> None:
    """As a full disk ends files."""
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (int(length), int(length)))


def without_board(iteration: float) -> None:
    """TensorBoard's files cannot be written to."""
    from torch.utils.tensorboard import SummaryWriter

    usual = SummaryWriter.add_scalar

    def add_scalar(self: Any, name: str, value: Any, step: int, *more: Any) -> None:
        if step >= iteration:
            raise OSError(28, "No space left on device")
        usual(self, name, value, step, *more)

    setattr(SummaryWriter, "add_scalar", add_scalar)  # noqa: B010


def jumping(seconds: float) -> None:
    """The time of day is another at each second call."""
    usual, calls = time.time, [0]

    def jumped() -> float:
        calls[0] += 1
        return usual() + seconds * (calls[0] % 2)

    time.time = jumped


# --- input that makes no sense ---

VALUES = ["-1", "0", "0.5", "nan", "1e300", "1e-320", "wrong", "[]", "[1,2]", "{a: 1}", "null"]
VALUES.append("9" * 20)  # no integer of 64 bits


def nonsense_settings(words: Sequence[str], folder: Path, count: int) -> Row:
    """Each setting of a fit with each of the values that few take."""
    cfg = configuration([*words, "nx=1"])
    names = [*leaves(cfg)]
    short = [*words, "nx=1", "nn=2", "trainer.max_iter=1", "bla.max_iter=1", "threads=1"]
    faults, refused, taken = [], 0, 0
    cases = [(name, value) for name in names for value in VALUES[:count] if name not in LEFT_OUT]
    for number, (name, value) in enumerate(cases):
        run = folder / f"case {number}"
        found = ended(partial(begin_with, [*short, f"{name}={value}"], run))
        problem = judged(found, run)
        refused += found.code == 1
        taken += found.code == 0
        if problem:
            faults.append(f"{name}={value}: {problem}")
        shutil.rmtree(run, ignore_errors=True)
    outcome = f"{refused} refused in a message, {taken} taken with a finite model"
    return Row("settings of the command line", len(cases), outcome, faults)


LEFT_OUT = ("data.path", "name", "resume", "init_from", "device", "data.root")
"""Files, and what no value harms."""


def leaves(cfg: DictConfig, prefix: str = "") -> Iterator[str]:
    """The names of all settings."""
    for key in cfg:
        if key in ("_target_", "_partial_", "_convert_"):
            continue
        node = OmegaConf.select(cfg, str(key))
        if isinstance(node, DictConfig) and node:
            yield from leaves(node, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def limited() -> None:
    """This process may not take more memory."""
    import resource

    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (int(used + MEMORY), int(used + MEMORY)))


def begin_with(words: Sequence[str], folder: Path) -> None:
    """A run of a command line, which Hydra may refuse."""
    from lfrtorch.cli.errors import user_errors

    limited()
    with user_errors():
        check_words("config", list(words))
        begin(configuration(words), folder)


def judged(found: Ended, folder: Path) -> str:
    """What is wrong with the end of a case, "" for nothing."""
    if found.code is None:
        return "hangs"
    if "Traceback" in found.text:
        return f"traceback: {found.text.strip().splitlines()[-1][:200]}"
    if found.code == 0:
        bad = [name for name, w in weights(folder).items() if not np.isfinite(w).all()]
        return f"{', '.join(bad)} not finite" if bad else ""
    said = [line for line in found.text.splitlines() if line.startswith("error: ")]
    if found.code != 1 or not said:
        return f"exit code {found.code}: {found.text[-200:]}"
    return ""


def door(name: str, folder: Path, damaged: int, values: int, seed: int) -> Row:
    """Files, checkpoints or command lines that are damaged or make no sense."""
    folder.mkdir()
    run = folder / "run"
    words = [*doors.fit_words(run), f"hydra.run.dir={run}"]
    if name != "files":
        run.mkdir()
        shutil.copy(measured(folder), run)
        made = ended(partial(doors.tried, partial(doors.typed, words), folder))
        assert made.code == 0, made.text
    what, cases = {
        "files": ("damaged and strange files", doors.files(folder, damaged, seed)),
        "checkpoints": ("damaged models and runs", doors.checkpoints(run, folder, damaged, seed)),
        "commands": ("words of the other commands", doors.commands(run, VALUES[:values])),
    }[name]
    faults, count, refused = [], 0, 0
    for case, work in cases:
        found = ended(partial(at_the_door, work, folder))
        problem = ended_well(found)
        count += 1
        refused += found.code != 0
        faults += [f"{case}: {problem}"] if problem else []
        if (folder / "sprung").exists() or (folder / "here" / "sprung").exists():
            faults.append(f"{case}: ran code")
    outcome = f"{refused} refused in a message, {count - refused} taken, records and models finite"
    return Row(what, count, outcome, faults)


def at_the_door(work: Callable[[], Any], folder: Path) -> None:
    """In a process of its own, of little memory."""
    limited()
    doors.tried(work, folder)


def ended_well(found: Ended) -> str:
    """What is wrong with the end of a case, "" for nothing."""
    if found.code is None:
        return "hangs"
    if "Traceback" in found.text or "HYDRA_FULL_ERROR" in found.text:
        return f"traceback: {found.text.strip().splitlines()[-1][:200]}"
    _, error, said = found.text.partition("error:")
    if found.code and not error:
        return f"exit code {found.code}: {found.text[-200:]}"
    return f"{len(said)} characters: {said[:200]}" if len(said) > 1500 else ""


def nonsense_arguments(what: str, cases: Sequence[Case]) -> Row:
    """Calls of Python with arguments of all kinds."""
    faults, refused = [], 0
    for name, call in cases:
        found = nonsense.tried(call)
        refused += found.refused
        faults += [f"{name}: {found.fault}"] if found.fault else []
    taken = len(cases) - refused - len(faults)
    outcome = f"{refused} refused in a message, {taken} taken, records and models finite"
    return Row(what, len(cases), outcome, faults)


if __name__ == "__main__":
    sys.exit(main())
