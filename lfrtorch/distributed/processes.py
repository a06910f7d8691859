"""Several processes that share the starts or the records of one fit, by ``torch.distributed``.

    torchrun --nproc-per-node 2 script.py

The script contains ``with connect(): fit(...)``. CPUs exchange data by gloo, GPUs by NCCL. Inside
the context, ``current()`` returns the processes. ``Ranks.sharing_records`` decides whether starts
or records are shared.

All processes take the same steps: every decision uses a sum over all processes, or the number of
the first process. Rounding errors differ between processors, and a search would let them grow.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Self, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from lfrtorch._support.checks import number
from lfrtorch._support.errors import LfrtorchError
from lfrtorch._support.reasons import Reason, told

Shared = TypeVar("Shared")

_AXES = 8  # largest number of axes of a tensor that is sent


class ProcessLostError(LfrtorchError, RuntimeError):
    """Another process ended, or did not answer in time."""

    def __init__(self, detail: str) -> None:
        super().__init__(told(Reason.PROCESS_LOST, detail))
        self.detail = detail


class Ranks:
    """A single process that holds all records; the subclass ``ProcessGroup`` is several processes.

    Example:
        >>> ranks = lfrtorch.distributed.Ranks()
        >>> ranks.share(["first", "second"]), ranks.sum(torch.ones(2))
        (['first', 'second'], tensor([1., 1.]))
    """

    rank, world = 0, 1

    def share(self, items: list[Shared]) -> list[Shared]:
        """Items of this process: every ``world``-th item, from its rank on."""
        return items[self.rank :: self.world]

    def sharing_records(self, starts: int) -> Ranks:
        """Processes that share the records of each start: this one alone if starts are shared."""
        return Ranks() if 1 < self.world <= starts else self

    def enough_for(self, items: int) -> Ranks:
        """Processes that share items: all, or this one alone if there are fewer items."""
        return self if items >= self.world else Ranks()

    def sum(self, part: Tensor) -> Tensor:
        """Sum of the parts of all processes, on each process."""
        return part

    def stack(self, part: Tensor) -> Tensor:
        """Rows of the parts of all processes, on each process; the parts may differ in length."""
        return part

    def first(self, part: Tensor) -> Tensor:
        """Part of the first process, of any shape, on each process."""
        return part

    def close(self) -> None:
        """Leave the other processes; their next exchange raises a ``ProcessLostError``."""

    def __enter__(self) -> Self:
        _CURRENT.append(self)
        return self

    def __exit__(self, *error: object) -> None:
        _CURRENT.pop()
        self.close()


_CURRENT = [Ranks()]
"""Stack of groups of processes: the last group works now, the groups before it wait."""


def current() -> Ranks:
    """Processes that work together now: those of ``connect`` or ``using``, or this one alone.

    Example:
        >>> lfrtorch.distributed.current().world
        1
    """
    return _CURRENT[-1]


@contextmanager
def using(ranks: Ranks | None) -> Iterator[Ranks]:
    """Make ``ranks`` the processes that work together in a context; None changes nothing.

    Example:
        >>> with lfrtorch.distributed.using(lfrtorch.distributed.Ranks()) as alone:
        ...     alone is lfrtorch.distributed.current()
        True
    """
    _CURRENT.append(current() if ranks is None else ranks)
    try:
        yield current()
    finally:
        _CURRENT.pop()


def agreed(part: Tensor) -> Tensor:
    """Numbers of the first process, on all processes that work together.

    Example:
        >>> lfrtorch.distributed.agreed(torch.ones(2))
        tensor([1., 1.])
    """
    return current().first(part)


def connect(device: str | torch.device = "cpu", timeout: float = 600.0) -> Ranks:
    """Context of the processes that torchrun started, or of a single process.

    Args:
        device: device of the model: ``"cpu"``, or ``"cuda"``, where each process has its own GPU.
        timeout: seconds after which a process that does not answer counts as lost. It should be
            much longer than the slowest share of an iteration.

    Raises:
        ValueError: a timeout that is not positive.
        ProcessLostError: other processes did not connect in time.

    Example:
        >>> with lfrtorch.distributed.connect() as ranks:  # alone: no torchrun
        ...     trainer = lfrtorch.LevenbergMarquardt(max_iter=2)
        ...     result = lfrtorch.fit(model, record, trainer=trainer)
        >>> ranks.rank, ranks.world
        (0, 1)
    """
    number("timeout", timeout, positive=True)
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return Ranks()
    gpu = None
    if torch.device(device).type == "cuda":
        # A failed collective then raises an exception; NCCL's own watchdog would abort.
        os.environ.setdefault("TORCH_NCCL_BLOCKING_WAIT", "1")
        gpu = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(gpu)
    try:
        dist.init_process_group(
            "nccl" if gpu else "gloo", timeout=timedelta(seconds=timeout), device_id=gpu
        )
    except RuntimeError as error:
        raise ProcessLostError(f"the processes did not meet ({_gist(error)})") from error
    return ProcessGroup(gpu or "cpu")


class ProcessGroup(Ranks):
    """Processes of torch's default group.

    Args:
        device: device of the group's backend.

    Raises:
        ProcessLostError: in any method, if a process ended or did not answer in time.
    """

    def __init__(self, device: str | torch.device = "cpu") -> None:
        self.rank, self.world = dist.get_rank(), dist.get_world_size()
        self._device = torch.device(device)

    def sum(self, part: Tensor) -> Tensor:
        """Sum of all parts."""
        total = self._sent(part).clone()
        self._call(lambda: dist.all_reduce(total))
        return total.to(part.device)

    def stack(self, part: Tensor) -> Tensor:
        """Rows of all parts."""
        count = torch.tensor([len(part)], device=self._device)
        counts = [torch.empty_like(count) for _ in range(self.world)]
        self._call(lambda: dist.all_gather(counts, count))
        lengths = [int(n) for n in counts]
        rows = self._sent(part)
        padded = rows.new_zeros(max(lengths), *rows.shape[1:])
        padded[: len(rows)] = rows
        parts = [torch.empty_like(padded) for _ in lengths]
        self._call(lambda: dist.all_gather(parts, padded))
        cut = [rows[:n] for rows, n in zip(parts, lengths, strict=True)]
        return torch.cat(cut).to(part.device)

    def first(self, part: Tensor) -> Tensor:
        """Part of the first process."""
        shape = [part.ndim, *part.shape, *[0] * (_AXES - part.ndim)]
        known = torch.tensor(shape, device=self._device)
        self._call(lambda: dist.broadcast(known, 0))
        axes, *sizes = known.tolist()
        sent = self._sent(part)
        if self.rank:
            sent = sent.new_empty(sizes[:axes])
        self._call(lambda: dist.broadcast(sent, 0))
        return sent.to(part.device)

    def close(self) -> None:
        """Leave the other processes."""
        if dist.is_initialized():
            dist.destroy_process_group()

    def _sent(self, part: Tensor) -> Tensor:
        return part.detach().to(self._device).contiguous()

    def _call(self, collective: Callable[[], object]) -> None:
        try:
            collective()
        except RuntimeError as error:  # the backends raise many kinds of errors
            other = f"rank {1 - self.rank}" if self.world == 2 else "one of the others"
            seen = f"rank {self.rank} of {self.world} has no answer from {other}"
            raise ProcessLostError(f"{seen} ({_gist(error)})") from error


def _gist(error: Exception) -> str:
    """Message of a backend, without the source file and the advice in it."""
    text = re.sub(r"^\[[^]]*\]\s*", "", str(error))
    return text.split(". ")[0]
