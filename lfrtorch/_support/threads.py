"""Parallel work on threads without OpenMP, and conversion of tensors for compiled code."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController
from torch import Tensor

Item = TypeVar("Item")
Result = TypeVar("Result")

_workers: ContextVar[int | None] = ContextVar("workers", default=None)


def workers() -> int:
    """Number of threads that work is spread over."""
    return _workers.get() or torch.get_num_threads()


@contextmanager
def spread_by_hand() -> Iterator[None]:
    """Context in which torch works on one thread, and ``spread`` on as many as torch had.

    torch's own threads (OpenMP) spin while they wait for each other. The spinning costs more than
    it gains where small operations follow each other, or another process shares the cores: on two
    cores a Jacobian of 3 ms took 73 ms, and an iteration of 27 ms up to 630 ms. The same holds for
    the linear algebra of numpy and scipy: a decomposition of 15 ms took 80 ms.
    """
    count = workers()
    token = _workers.set(count)
    torch.set_num_threads(1)
    try:
        with _one_blas_thread():
            yield
    finally:
        _workers.reset(token)
        if _workers.get() is None:
            torch.set_num_threads(count)


_changing, _limited, _inside = threading.Lock(), ExitStack(), set[object]()


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Keep BLAS, which all threads share, on one thread until the last context ends."""
    own = object()
    with _changing:
        if not _inside:
            _limited.enter_context(_blas().limit(limits=1, user_api="blas"))
        _inside.add(own)
    try:
        yield
    finally:
        with _changing:
            _inside.remove(own)
            if not _inside:
                _limited.close()


def spread(kernel: Callable[..., None], jobs: int, *arguments: object) -> None:
    """Call ``kernel(job, *arguments)`` for every job, on ``workers()`` threads.

    The kernel must release the interpreter's lock (``njit(nogil=True)``, or torch's operations).
    numba's own parallel loops bring a second OpenMP in addition to torch's: if another process
    shares the cores, an iteration of 0.03 s took 0.8 s with them.
    """
    threads = min(jobs, workers())
    if threads == 1:
        for job in range(jobs):
            kernel(job, *arguments)
        return

    def share(thread: int) -> None:
        for job in range(thread, jobs, threads):
            kernel(job, *arguments)

    with spread_by_hand():
        others = [_pool().submit(share, thread) for thread in range(1, threads)]
        share(0)
        for other in others:
            other.result()


def spread_loop(kernel: Callable[..., None], jobs: int, *arguments: object) -> None:
    """Spread a kernel that loops over its jobs: ``kernel(first, jobs, step, *arguments)``.

    One call of compiled code costs as much time as 50 samples of its work.
    """
    threads = min(jobs, workers())
    if threads <= 1:
        kernel(0, jobs, 1, *arguments)
    else:
        spread(lambda first, *own: kernel(first, jobs, threads, *own), threads, *arguments)


def worth_threads(samples: int, parameters: int = 70) -> bool:
    """Tell if fits of this size gain from a thread each.

    Threads of smaller fits wait for the interpreter: starts of 200 to 4000 samples and some 70
    parameters took 1.0 to 1.6 times as long on two cores as on one.
    """
    return samples * parameters**2 >= 4e7


def each_alone(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    stop: Callable[[], None] = lambda: None,
    *,
    threads: bool = True,
) -> list[Result]:
    """Apply ``work`` to each item in its own thread; if one fails, or at Ctrl-C, call ``stop``.

    Items follow one another without ``threads``, or if there is one thread only.
    """

    def alone(item: Item) -> Result:
        token = _workers.set(1)
        try:
            return work(item)
        finally:
            _workers.reset(token)

    if not threads or min(len(items), workers()) <= 1:
        with spread_by_hand():
            return [alone(item) for item in items]
    with spread_by_hand(), ThreadPoolExecutor(workers(), "lfrtorch-alone", _one_thread) as pool:
        begun = [pool.submit(alone, item) for item in items]
        try:
            return [each.result() for each in begun]
        except BaseException:
            stop()
            pool.shutdown(cancel_futures=True)
            raise


def _one_thread() -> None:
    torch.set_num_threads(1)


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), "lfrtorch", _one_thread)


if hasattr(os, "register_at_fork"):  # a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


SLOW_PATHS = "LFRTORCH_SLOW_PATHS"
"""Environment variable that turns all quick ways off, to check their results by the plain ones."""

COMPILED_ON = {"cpu"}
"""Devices with compiled kernels; others run in torch, parallel in time."""


def fast_paths() -> bool:
    """Tell if fast paths are on: machine code, a search from nearby states, kept results."""
    return not os.environ.get(SLOW_PATHS)


def has_kernels(tensor: Tensor) -> bool:
    """Tell if the tensor's device has compiled kernels."""
    return tensor.device.type in COMPILED_ON and fast_paths()


def to_numpy(tensor: Tensor) -> NDArray:
    """Convert a CPU tensor to a contiguous array for compiled code."""
    return tensor.detach().contiguous().numpy()


def to_float64(tensor: Tensor) -> NDArray[np.float64]:
    """Convert a tensor of any device to a contiguous array of float64."""
    return tensor.detach().cpu().double().contiguous().numpy()
