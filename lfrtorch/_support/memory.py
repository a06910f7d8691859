"""Memory that a computation needs, compared with the memory of the machine."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from lfrtorch._support.errors import InputError

if TYPE_CHECKING:
    import torch

_UNITS = ("kB", "MB", "GB", "TB", "PB", "EB")


def check_memory(needed: float, what: str, remedy: str, device: torch.device | None = None) -> None:
    """Refuse a computation that needs more bytes than a device (default: the CPU) has."""
    there = memory_of(device)
    if needed > there:
        raise InputError(
            f"{what} takes {in_bytes(needed)} of memory, and there are {in_bytes(there)}; {remedy}."
        )


def memory_of(device: torch.device | None = None) -> float:
    """Return the bytes of a device, or the limit of a container or process; inf if unknown."""
    if device is not None and device.type == "cuda":
        import torch

        return float(torch.cuda.get_device_properties(device).total_memory)
    try:
        machine = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not on every system
        machine = math.inf
    grouped = limit_of(Path("/proc/self/cgroup"), Path("/sys/fs/cgroup"))
    return min(machine, grouped, _own_limit())


def _own_limit() -> float:
    """Return the limit ``ulimit -v`` of this process, as batch systems set it."""
    try:
        import resource
    except ImportError:  # not on Windows
        return math.inf
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return math.inf if limit == resource.RLIM_INFINITY else float(limit)


def limit_of(listed: Path, mounted: Path) -> float:
    """Return the smallest memory limit of the control groups of a process, inf if there is none."""
    # ``listed`` has a line for each group, ``mounted`` the limits; a group limits those inside it.
    # Linux kernel documentation, "Control Group v2", and its v1 with "memory.limit_in_bytes".
    try:
        groups = [line.split(":", 2)[1:] for line in listed.read_text().splitlines()]
    except OSError:
        return math.inf
    limits = [math.inf]
    for controllers, path in groups:
        if not controllers:
            root, name = mounted, "memory.max"
        elif "memory" in controllers.split(","):
            root, name = mounted / "memory", "memory.limit_in_bytes"
        else:
            continue
        own = root / path.lstrip("/")
        for folder in (own, *own.parents):
            if folder.is_relative_to(root):
                limits.append(_number(folder / name))
    return min(limits)


def _number(file: Path) -> float:
    """Return the number in a file, inf if there is none or "max"."""
    try:
        return float(int(file.read_text()))
    except (OSError, ValueError):
        return math.inf


def in_bytes(count: float) -> str:
    """Write bytes with a unit, 8.1 TB for example."""
    power = min(max(int(math.log10(max(count, 1.0)) // 3), 1), len(_UNITS))
    return f"{count / 1000**power:.3g} {_UNITS[power - 1]}"
