"""What an iteration, a gradient and a first call cost, against what is required of them.

    python benchmarks/engine.py [--peers DIR] [--quick]

Every case runs in a process of its own, pinned to one or two cores, from an empty numba cache. With
--peers, freq-statespace fits the same records on the same core in the same call. Machines and loads
differ: compare the numbers of one run. Writes results.json and scaling.png beside this file.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
import peers
import problems
import scaling

HERE = Path(__file__).resolve().parent
RUNS, SHARED = 4, 0.05
"""Most processes of a case, and the part of its time that one may wait for cores that others have.

Seconds on one core are those that the process had the core. What threads wait for each other cannot
be taken off: a case is repeated until it hardly waited, and the one that waited least counts."""
ONE_RECORD = f"{problems.MIRROR}, one record"
PERIODS = 128
"""Periods of 8192 samples in the long record: 1,048,576 samples."""


class Row(NamedTuple):
    """A line of the table: a measured value and the limit that it must keep."""

    what: str
    value: float | None
    unit: str
    limit: float | None = None
    at_least: bool = False

    @property
    def met(self) -> bool | None:
        """Whether the limit is kept; None if there is none, or no value."""
        if self.value is None or self.limit is None:
            return None
        return self.value >= self.limit if self.at_least else self.value <= self.limit


def main() -> int:
    """Measure, print the table, write the record and the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peers", type=Path, help="folder of freq-statespace, see README.md")
    parser.add_argument("--quick", action="store_true", help="no long records and no scaling")
    parser.add_argument("--out", type=Path, default=HERE, help="folder of what is written")
    options = parser.parse_args()
    folder, why = options.peers, "no folder given"
    if folder is not None:
        folder = folder.resolve()
        why = peers.prepared(folder)
    if why:
        print(f"freq-statespace is left out: {why}.")
        folder = None
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        measured = measure(Path(scratch), folder, quick=options.quick)
    rows = table(measured)
    show(rows)
    for name, case in measured.items():
        if case.get("waited", 0.0) > SHARED:
            print(f"\n{name}: waited {case['waited']:.0%} of its time for cores that others had.")
    about = {
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
        "seconds": time.perf_counter() - begin,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    required = [{**row._asdict(), "met": row.met} for row in rows]
    record = {**about, "table": required, "measured": measured}
    (options.out / "results.json").write_text(json.dumps(rounded(record), indent=1) + "\n")
    if "scaling" in measured:
        scaling.figure(measured["scaling"], options.out / "scaling.png")
    return 0


def measure(scratch: Path, folder: Path | None, *, quick: bool) -> dict:
    """All cases, by name."""
    cores = available_cores()
    found: dict = {}

    def case(name: str, threads: int = 1, /, **settings: object) -> dict:
        words = [f"{key}={json.dumps(value)}" for key, value in settings.items()]
        print(f"  {name} {' '.join(words)}", file=sys.stderr, flush=True)
        command = [sys.executable, str(HERE / "cases.py"), name, str(scratch)]
        command += ["--threads", str(threads), "--set", *words]
        with pinned(cores[:threads]):
            done = subprocess.run(
                [*command, "--begun", repr(time.time())],
                env=os.environ | {"NUMBA_CACHE_DIR": str(scratch / "numba")},
                capture_output=True,
                text=True,
                check=False,
            )
        if done.returncode:
            sys.exit(f"{name} failed:\n{done.stderr}")
        return json.loads(done.stdout.strip().rpartition("\n")[2])

    def undisturbed(name: str, threads: int = 1, /, **settings: object) -> dict:
        runs = [case(name, threads, **settings)]
        while runs[-1]["waited"] > SHARED and len(runs) < RUNS:
            runs.append(case(name, threads, **settings))
        return min(runs, key=lambda run: run["waited"])

    def peer(name: str) -> None:
        runs: list[dict] = []
        while folder is not None and len(runs) < RUNS:
            print(f"  freq-statespace {name}", file=sys.stderr, flush=True)
            with pinned(cores[:1]):
                runs.append(peers.iteration(folder, name))
            if "failed" in runs[-1]:
                print(f"freq-statespace is left out of {name}: {runs[-1]['failed']}.")
                return
            if runs[-1]["share_of_core"] > 1 - SHARED:
                break
        if runs:
            found[f"freq-statespace {name}"] = max(runs, key=lambda run: run["share_of_core"])

    case("prepare", peers=None if folder is None else str(folder))
    (scratch / "numba").rename(scratch / "numba of prepare")
    found["first call, empty cache"] = case("first_call")
    found["first call, cached"] = case("first_call")
    for warm_up in ("boucwen", "parallel_wh"):
        case("iteration", name=warm_up, count=2)
    found["boucwen"] = undisturbed("iteration", name="boucwen", count=30)
    peer("boucwen")
    found["boucwen parts"] = undisturbed("parts", name="boucwen")
    found["gradient"] = undisturbed("gradient")
    found["parallel_wh"] = undisturbed("iteration", name="parallel_wh", count=6)
    peer("parallel_wh")
    if len(cores) > 1:
        found["parallel_wh, two cores"] = undisturbed("iteration", 2, name="parallel_wh", count=6)
    found["parallel_wh parts"] = undisturbed("parts", name="parallel_wh", repetitions=5)
    for large in problems.LARGE:
        found[large] = undisturbed("iteration", name=large, count=3)
    if folder is not None:
        found[ONE_RECORD] = undisturbed("iteration", name=problems.MIRROR, count=3, records=1)
        peers.write_mirror(scratch)
        print("  freq-statespace mirror size", file=sys.stderr, flush=True)
        with pinned(cores[:1]):
            recipe, found[f"freq-statespace {ONE_RECORD}"] = peers.mirror(folder, scratch)
        found[f"freq-statespace {ONE_RECORD}, its recipe"] = recipe
    if not quick:
        for start in ("zero", "periodic"):
            found[f"long, {start}"] = undisturbed("long", start=start, periods=PERIODS)
        found["scaling"] = {
            name: case("scaling", axis=name, values=axis.values, sizes=axis.sizes)["points"]
            for name, axis in scaling.AXES.items()
        }
    return found


def table(found: dict) -> list[Row]:
    """What is required and what was measured."""
    rows = []

    def ms(seconds: float) -> float:
        return 1e3 * seconds

    bw, parts, gradient = found["boucwen"], found["boucwen parts"]["parts_s"], found["gradient"]
    rows += [
        Row("Bouc-Wen iteration, one core", ms(bw["s"]), "ms", 15.0),
        Row("- with one accepted trial", ms(bw["one_trial_s"]), "ms"),
        Row("- trials an iteration", bw["trials"], ""),
        Row("- a trial: all seconds over all trials", ms(bw["trial_s"]), "ms"),
        *[Row(f"- {name}", ms(seconds), "ms") for name, seconds in parts.items()],
    ]
    peer = found.get("freq-statespace boucwen")
    if peer:
        each = [("an iteration", "s", 8.0), ("iterations with one trial", "one_trial_s", None)]
        each.append(("a trial, which is its iteration", "trial_s", None))
        rows.append(Row("- freq-statespace, an iteration", ms(peer["s"]), "ms"))
        rows += [
            Row(f"- freq-statespace / lfrtorch, {what}", peer["s"] / bw[key], "times", limit, True)
            for what, key, limit in each
        ]
    one, two = found["parallel_wh"], found.get("parallel_wh, two cores")
    rows += [
        Row("Parallel WH iteration, one core", one["s"], "s"),
        Row("- with one accepted trial", one["one_trial_s"], "s"),
        Row("- trials an iteration", one["trials"], ""),
    ]
    if two:
        rows += [
            Row("Parallel WH iteration, two cores", two["s"], "s", 0.9),
            Row("- with one accepted trial", two["one_trial_s"], "s"),
            Row("- trials an iteration", two["trials"], ""),
        ]
    peer = found.get("freq-statespace parallel_wh")
    if peer:
        rows.append(Row("- freq-statespace, one core", peer["s"], "s"))
        ratios = [("one core each", one), ("lfrtorch on two cores, it on one", two)]
        rows += [
            Row(f"- freq-statespace / lfrtorch, {cores}", peer["s"] / own["s"], "times", 6.0, True)
            for cores, own in ratios
            if own
        ]
    memory = (two or one)["memory_mb"]
    rows.append(Row("Parallel WH, peak memory over idle", memory, "MB", 500.0))
    if peer:
        whole = peer["whole_process_peak_mb"]
        rows.append(Row("- freq-statespace, whole process", whole, "MB"))
    for large in problems.LARGE:
        rows += [
            Row(f"{large.capitalize()} iteration, one core", found[large]["s"], "s"),
            Row("- with one accepted trial", found[large]["one_trial_s"], "s"),
            Row("- peak memory over idle", found[large]["memory_mb"], "MB", 600.0),
        ]
    rows += of_mirror(found)
    for start in ("zero", "periodic"):
        case = found.get(f"long, {start}")
        if case:
            rows += [
                Row(f"1,048,576 samples, {start} start", case["s"], "s"),
                Row("- time a sample over that of 8192 samples", case["ratio"], "times", 1.3),
                Row("- peak memory over idle", case["memory_mb"], "MB", 500.0),
            ]
    if "scaling" in found:
        few, many = found["scaling"]["samples"][-2:]
        ratio = many["s"] / many["samples"] / (few["s"] / few["samples"])
        rows += [
            Row(f"{many['samples']:,} samples, 3 inputs, 3 outputs", many["s"], "s"),
            Row(f"- time a sample over that of {few['samples']:,}", ratio, "times", 1.3),
            Row("- peak memory over idle", many["memory_mb"], "MB", 600.0),
        ]
    loop = gradient["python_loop_s"]
    rows += [
        Row("Gradient (one Adam step), periodic", ms(gradient["s"]), "ms", 30.0),
        Row("- from rest", ms(gradient["from_rest_s"]), "ms"),
        Row("- from rest, autograd through a Python loop", loop, "s"),
        Row("- loop / lfrtorch", loop / gradient["from_rest_s"], "times", 50.0, at_least=True),
    ]
    for name, limit in (("empty cache", 15.0), ("cached", 2.0)):
        case = found[f"first call, {name}"]
        first, again = (sum(case[key].values()) for key in ("first_s", "again_s"))
        rows += [
            Row(
                f"First iteration, {name}: since the process began", case["imports_s"] + first, "s"
            ),
            Row("- over the same calls again", first - again, "s", limit),
            Row("- imports, in the first of these", case["imports_s"], "s"),
        ]
    return rows


def of_mirror(found: dict) -> list[Row]:
    """One record of the mirror's size beside freq-statespace."""
    own, peer = found.get(ONE_RECORD), found.get(f"freq-statespace {ONE_RECORD}")
    if own is None or peer is None:
        return []
    recipe = found[f"freq-statespace {ONE_RECORD}, its recipe"]
    rows = [Row(f"{ONE_RECORD.capitalize()}, iteration", own["s"], "s")]
    if "failed" in recipe:
        print(f"\nThe recipe of freq-statespace for the mirror fails: {recipe['failed']}")
    if "failed" in peer:
        print(f"\nfreq-statespace is left out of {ONE_RECORD}: {peer['failed']}")
        return rows
    ratio, memory = peer["s"] / own["s"], peer["whole_process_peak_mb"]
    return [
        *rows,
        Row("- freq-statespace, from its subspace model", peer["s"], "s"),
        Row("- freq-statespace / lfrtorch", ratio, "times", 10.0, at_least=True),
        Row("- freq-statespace, whole process", memory, "MB"),
    ]


def show(rows: list[Row]) -> None:
    """Print the table, as it stands in README.md."""
    print("\n| measured | value | required | |\n|---|---|---|---|")
    for row in rows:
        value = "not measured" if row.value is None else f"{row.value:.3g} {row.unit}".strip()
        sign = "≥" if row.at_least else "≤"
        limit = "" if row.limit is None else f"{sign} {row.limit:g} {row.unit}"
        met = {True: "met", False: "**not met**", None: ""}[row.met]
        print(f"| {row.what} | {value} | {limit} | {met} |")
    if any(row.unit == "MB" and row.value is None for row in rows):
        print("\nMemory is measured if there is /proc.")


def available_cores() -> list[int]:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


@contextmanager
def pinned(cores: list[int]) -> Iterator[None]:
    """Processes that are started inside run on these cores, if the system can do that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def machine() -> dict:
    """Kind of machine and versions, no names."""
    model = platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                model = f"{model}, {line.partition(':')[2].strip()}"
                break
    packages = ("lfrtorch", "torch", "numpy", "scipy", "numba")
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        **{package: version(package) for package in packages},
    }


def rounded(value: object) -> object:
    """The same with four digits, for a record that can be read."""
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    if isinstance(value, float) and np.isfinite(value):
        return float(f"{value:.4g}")
    return value


if __name__ == "__main__":
    sys.exit(main())
