"""freq-statespace on the same records: its own script, in a folder with its own environment."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import time
from pathlib import Path

SCRIPT, GENERATORS = "run_fss.py", {"boucwen.npz": "gen_boucwen.py", "pwh_synth.npz": "gen_pwh.py"}
ARGUMENTS = {
    "boucwen": "--nl nn --max-iter 30 --x64",
    "parallel_wh": "--x64 --data pwh_synth.npz --R 5 --nx 12 --nz 2 --nw 2 --max-iter 3"
    " --bla-iter 3",
}
LONGEST = 300.0
"""Seconds; on several cores it was seen to wait for itself for ever, so it gets one."""


def prepared(folder: Path) -> str:
    """Make the records that are missing; why the peers cannot run, empty if they can."""
    python = _python(folder)
    for needed in (python, folder / SCRIPT):
        if not needed.is_file():
            return f"'{needed.relative_to(folder)}' is missing there"
    for data, script in GENERATORS.items():
        if not (folder / data).is_file():
            done = subprocess.run([python, script], cwd=folder, capture_output=True, check=False)
            if done.returncode or not (folder / data).is_file():
                return f"{script} does not make {data}"
    return ""


def iteration(folder: Path, name: str) -> dict:
    """Seconds and memory of its Levenberg-Marquardt iteration, on the core of this process.

    Its iteration is one trial without acceleration. The seconds are those it had the core.
    """
    command = [str(_python(folder)), SCRIPT, *ARGUMENTS[name].split()]
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=os.environ | {"PYTHONHASHSEED": "0"},
            capture_output=True,
            text=True,
            timeout=LONGEST,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"no result within {LONGEST:.0f} s"}
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    share = min(1.0, seconds / (time.perf_counter() - begin))
    last = done.stdout.strip().rpartition("\n")[2]
    if done.returncode or not last.startswith("JSON "):
        return {"failed": (done.stderr.strip() or "no result").splitlines()[-1]}
    result = json.loads(last.removeprefix("JSON "))
    fit = result["stages"]["nl_opt"]
    return {
        "s": share * fit["s_per_iter"],
        "share_of_core": share,
        "wall_s": fit["s_per_iter"],
        "iterations": fit["iters"],
        "compile_s": fit["compile_s"],
        "cost_first": fit["loss0"],
        "cost_last": fit["loss1"],
        "parameters": fit["n_par"],
        "whole_process_peak_mb": fit["peak_mb"],
        "versions": result["versions"],
    }


def _python(folder: Path) -> Path:
    return folder / "venv" / "bin" / "python"
