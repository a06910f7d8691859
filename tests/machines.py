"""Do the results hold on other processors? The numeric tests run as if on each of them.

    python tests/machines.py [NAME ...] [--list] [-- ARGS of pytest]

Another processor means other kernels of torch (ATen and MKL), OpenBLAS and numpy, other code from
numba, and so other last digits. Each library can be told by the environment to pass over features
that this CPU has; one that this CPU lacks cannot be had, and what needs it is skipped and named.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from llvmlite.binding import get_host_cpu_features

ROOT = Path(__file__).resolve().parents[1]
PARALLEL = ["-n", "auto", "--maxprocesses", "4", "--dist", "loadfile"]
PYTEST = ["-m", "pytest", "-q", "--no-header", "-m", "numeric and not slow", *PARALLEL]
NOTHING_SELECTED = 5  # pytest's exit code

ATEN, MKL, MKL_AT_MOST = "ATEN_CPU_CAPABILITY", "MKL_CBWR", "MKL_ENABLE_INSTRUCTIONS"
OPENBLAS, NUMPY_WITHOUT = "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES"
NUMBA, NUMBA_FEATURES, THREADS = "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "LFRTORCH_TEST_THREADS"

LOOPS = " ".join(np.show_config(mode="dicts").get("SIMD Extensions", {}).get("found", []))
"""The vector loops that numpy has for this CPU beyond its baseline."""

OLD_NUMBA = {NUMBA: "generic", NUMBA_FEATURES: ""}
OLD = {ATEN: "default", MKL: "COMPATIBLE", OPENBLAS: "Prescott", NUMPY_WITHOUT: LOOPS}
MACHINES: dict[str, dict[str, str]] = {
    "aten-default": {ATEN: "default"},
    "aten-avx2": {ATEN: "avx2"},
    "aten-avx512": {ATEN: "avx512"},
    "mkl-compatible": {MKL: "COMPATIBLE"},
    "mkl-avx2": {MKL_AT_MOST: "AVX2"},
    "openblas-haswell": {OPENBLAS: "Haswell"},
    "openblas-skylakex": {OPENBLAS: "SkylakeX"},
    "openblas-prescott": {OPENBLAS: "Prescott"},
    "openblas-zen": {OPENBLAS: "Zen"},
    "numpy-baseline": {NUMPY_WITHOUT: LOOPS},
    "numba-generic": OLD_NUMBA,
    "one-thread": {THREADS: "1"},
    "two-threads": {THREADS: "2"},
    "oldest": OLD | OLD_NUMBA | {THREADS: "1"},
    "newest": {ATEN: "avx512", OPENBLAS: "SkylakeX", THREADS: "2"},
}
NEXT_BEST = {(ATEN, "avx512"): "avx2", (OPENBLAS, "SkylakeX"): "Haswell"}

AVX2 = ["avx2", "fma"]
AVX512 = [*AVX2, "avx512bw", "avx512dq", "avx512f", "avx512vl"]
NEEDS = {
    (ATEN, "avx2"): AVX2,
    (ATEN, "avx512"): AVX512,
    (MKL_AT_MOST, "AVX2"): AVX2,
    (OPENBLAS, "Haswell"): AVX2,
    (OPENBLAS, "Zen"): AVX2,
    (OPENBLAS, "SkylakeX"): AVX512,
}
"""Features of the CPU that a setting needs."""


class Outcome(NamedTuple):
    """What pytest found on a machine."""

    failed: list[str]
    passed: int
    skipped: int
    seconds: float


def lacking(name: str, value: str) -> str:
    """What this CPU lacks for a setting, "" for nothing."""
    if name in (MKL, MKL_AT_MOST, OPENBLAS) and platform.machine() not in ("x86_64", "AMD64"):
        return f"{name}={value} needs x86-64, this is {platform.machine()}"
    if name == NUMPY_WITHOUT and not value:
        return "numpy has no vector loops beyond its baseline here"
    features = get_host_cpu_features()
    missing = [f for f in NEEDS.get((name, value), []) if not features.get(f)]
    return f"{name}={value} needs {', '.join(missing)}" if missing else ""


def possible(settings: dict[str, str]) -> tuple[dict[str, str], list[str]]:
    """The settings that this CPU can follow, and what it lacks for the others."""
    kept, left_out = {}, []
    for name, asked in settings.items():
        value = asked
        reason = lacking(name, value)
        if reason and (name, value) in NEXT_BEST:
            left_out.append(reason)
            value = NEXT_BEST[name, value]
            reason = lacking(name, value)
        if reason:
            left_out.append(reason)
        else:
            kept[name] = value
    return kept, left_out


def run(settings: dict[str, str], arguments: list[str]) -> Outcome:
    """The numeric tests with these settings alone."""
    ours = {name for machine in MACHINES.values() for name in machine}
    clean = {name: value for name, value in os.environ.items() if name not in ours}
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.xml")
        command = [sys.executable, *PYTEST, f"--junitxml={report}", *arguments]
        code = subprocess.run(command, cwd=ROOT, env=clean | settings, check=False).returncode
        cases = list(ElementTree.parse(report).iter("testcase")) if report.is_file() else []
    bad = [case for case in cases if {"failure", "error"} & {found.tag for found in case}]
    failed = sorted({f"{case.get('classname')}::{case.get('name')}" for case in bad})
    if code and not failed and not (code == NOTHING_SELECTED and arguments):
        failed = [f"pytest ended with exit code {code}"]
    skipped = sum(case.find("skipped") is not None for case in cases)
    return Outcome(failed, len(cases) - len(bad) - skipped, skipped, time.monotonic() - begun)


def main(given: list[str]) -> int:
    """Every machine in sequence, then a table."""
    arguments = given[given.index("--") + 1 :] if "--" in given else []
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(MACHINES))
    parser.add_argument("--list", action="store_true", help="the machines and their settings")
    asked = parser.parse_args(given[: given.index("--")] if "--" in given else given)
    if unknown := sorted(set(asked.names) - set(MACHINES)):
        parser.error(f"no machine {', '.join(unknown)}; there are {', '.join(MACHINES)}")

    names = list(dict.fromkeys(asked.names)) or list(MACHINES)
    table, failed = [], False
    for number, name in enumerate(names, start=1):
        settings, left_out = possible(MACHINES[name])
        title = f"{name}: {' '.join(f'{k}={v!r}' for k, v in settings.items())}"
        title += "".join(f"\n    left out: {reason}" for reason in left_out)
        print(f"machine {number} of {len(names)}, {title}", flush=True)
        if asked.list:
            continue
        if not settings:
            table.append(f"{name:18} skipped: {'; '.join(left_out)}")
            continue
        outcome = run(settings, arguments)
        row = f"{name:18} {len(outcome.failed):3} failed {outcome.passed:5} passed"
        row += f" {outcome.skipped:3} skipped {outcome.seconds:5.0f} s"
        print(row, flush=True)
        table.append("\n    ".join([row, *left_out, *(f"FAILED {f}" for f in outcome.failed)]))
        failed |= bool(outcome.failed)
    print(*table, sep="\n")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
