"""Memory that a computation takes, against what the machine has."""

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
    """Refuse what takes more bytes than a device has with a ValueError, before it is asked for.

    Args:
        needed: bytes.
        what: takes them, for the message.
        remedy: what to do.
        device: which one. Default: the CPU.

    Example:
        >>> from lfrtorch._support.memory import check_memory
        >>> try:
        ...     check_memory(8e18, "'x.h5', 1e18 samples,", "save a part of it")
        ... except lfrtorch.InputError as error:
        ...     print(str(error).split(",")[1])
         1e18 samples
    """
    there = memory_of(device)
    if needed > there:
        raise InputError(
            f"{what} takes {in_bytes(needed)} of memory, and there are {in_bytes(there)}; {remedy}."
        )


def memory_of(device: torch.device | None = None) -> float:
    """Bytes of memory of a device, or what a container or a process may take.

    Infinite if that is not known.
    """
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
    """What ``ulimit -v`` leaves this process, as batch systems set it."""
    try:
        import resource
    except ImportError:  # not on Windows
        return math.inf
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return math.inf if limit == resource.RLIM_INFINITY else float(limit)


def limit_of(listed: Path, mounted: Path) -> float:
    """Bytes that the control groups of a process leave it, as those of containers and batch jobs.

    Args:
        listed: file of the groups, a line each.
        mounted: folder of what the groups may take; groups above limit those in them.

    Returns:
        The smallest limit, infinite if there is none.

    References:
        Linux kernel documentation, "Control Group v2", and its v1 with "memory.limit_in_bytes".

    Example:
        >>> from pathlib import Path
        >>> from lfrtorch._support.memory import limit_of
        >>> limit_of(Path("none"), Path("none"))
        inf
    """
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
    """What the file says, infinite if that is "max" or nothing."""
    try:
        return float(int(file.read_text()))
    except (OSError, ValueError):
        return math.inf


def in_bytes(count: float) -> str:
    """Bytes with a unit.

    Example:
        >>> from lfrtorch._support.memory import in_bytes
        >>> in_bytes(8.1e12)
        '8.1 TB'
    """
    power = min(max(int(math.log10(max(count, 1.0)) // 3), 1), len(_UNITS))
    return f"{count / 1000**power:.3g} {_UNITS[power - 1]}"
