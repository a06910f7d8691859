"""freq-statespace on the same records: its own scripts, in a folder with its own environment."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import problems

SCRIPT, GENERATORS = "run_fss.py", {"boucwen.npz": "gen_boucwen.py", "pwh_synth.npz": "gen_pwh.py"}
ARGUMENTS = {
    "boucwen": "--nl nn --max-iter 30 --x64",
    "parallel_wh": "--x64 --data pwh_synth.npz --R 5 --nx 12 --nz 2 --nw 2 --max-iter 3"
    " --bla-iter 3",
}
MIRROR, MIRROR_ITERATIONS = "run_fss_mirror.py", 4
"""Its recipe at the sizes of the fine steering mirror, with Levenberg-Marquardt in both fits."""
LONGEST, LARGEST = 1800.0, 14_000.0
"""Seconds and MB. On several cores it was seen to wait for itself for ever, so it gets one."""


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
    result, about = _run(folder, SCRIPT, *ARGUMENTS[name].split())
    if "failed" in about:
        return about
    fit = result["stages"]["nl_opt"]
    return about | {
        "s": about["share_of_core"] * fit["s_per_iter"],
        "wall_s": fit["s_per_iter"],
        "iterations": fit["iters"],
        "compile_s": fit["compile_s"],
        "cost_first": fit["loss0"],
        "cost_last": fit["loss1"],
        "parameters": fit["n_par"],
        "versions": result["versions"],
    }


def write_mirror(folder: Path) -> None:
    """Write the records of the size of the mirror as its scripts read them."""
    with np.load(folder / f"{problems.MIRROR}.npz") as file:
        u, y = (np.moveaxis(file[signal], 0, -1)[..., None] for signal in "uy")
        sizes = {size: file[size] for size in ("fs", "nx", "nz", "nw", "nn")}
    u, y = np.repeat(u, 2, axis=-1), np.repeat(y, 2, axis=-1)  # two equal periods
    np.savez(folder / "mirror.npz", u_300mV_train=u, y_300mV_train=y)
    one = {"u": u[:, :, :1], "y": y[:, :, :1], "lines": problems.LINES}
    np.savez(folder / "mirror of one record.npz", **one, **sizes)


def mirror(folder: Path, data: Path) -> tuple[dict, dict]:
    """The same for one record of the size of the mirror: its recipe, and its iteration alone.

    Args:
        folder: of the peer.
        data: of what ``write_mirror`` wrote.
    """
    arguments = ("--data", str(data / "mirror.npz"), "--realisations", "1", "--solver", "lm")
    result, recipe = _run(folder, MIRROR, *arguments)
    if "failed" not in recipe:
        recipe["s"] = recipe["share_of_core"] * result["nl"]["s_per_iter"]
    script = str(Path(__file__).resolve().parent / "peer_lm.py")
    one = str(data / "mirror of one record.npz")
    result, about = _run(folder, script, one, str(MIRROR_ITERATIONS))
    if "failed" not in about:
        about |= {
            "s": about["share_of_core"] * result["s_per_iter"],
            "iterations": result["iters"],
            "costs": result["losses"],
            "parameters": result["n_par"],
        }
    return recipe, about


def _run(folder: Path, script: str, *arguments: str) -> tuple[dict, dict]:
    """What a script prints, and its share of the core and memory, or why it failed."""
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.Popen(
        [str(_python(folder)), script, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONHASHSEED": "0", "PYTHONPATH": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    watch = _Watch(process)
    watch.start()
    out, errors = process.communicate()
    watch.join()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    about: dict = {
        "share_of_core": min(1.0, seconds / (time.perf_counter() - begin)),
        "whole_process_peak_mb": watch.peak,
    }
    if watch.why:
        return {}, about | {"failed": watch.why}
    last = out.strip().rpartition("\n")[2]
    if process.returncode or not last.startswith("JSON "):
        return {}, about | {"failed": (errors.strip() or "no result").splitlines()[-1]}
    return json.loads(last.removeprefix("JSON ")), about


class _Watch(threading.Thread):
    """Ends a process that takes too long or too much memory, and says why."""

    def __init__(self, process: subprocess.Popen) -> None:
        super().__init__(daemon=True)
        self.process, self.peak, self.why = process, 0.0, ""

    def run(self) -> None:
        """Look ten times a second."""
        status, begin = Path(f"/proc/{self.process.pid}/status"), time.perf_counter()
        while self.process.poll() is None and not self.why:
            with suppress(OSError):
                entries = status.read_text().partition("VmHWM:")[2].split()  # none at the end
                self.peak = max(self.peak, *(int(entry) / 1024 for entry in entries[:1]), 0.0)
            if self.peak > LARGEST:
                self.why = f"it took more than {LARGEST:.0f} MB"
            if time.perf_counter() - begin > LONGEST:
                self.why = f"no result within {LONGEST:.0f} s"
            time.sleep(0.1)
        if self.why:
            self.process.kill()


def _python(folder: Path) -> Path:
    return folder / "venv" / "bin" / "python"
