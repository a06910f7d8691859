"""Compiled kernels on several threads, as many as torch uses."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch


def workers() -> int:
    """Threads that kernels are spread over."""
    return torch.get_num_threads()


def spread(kernel: Callable[..., None], jobs: int, *arguments: object) -> None:
    """Call ``kernel(job, *arguments)`` for every job, on ``torch.get_num_threads()`` threads.

    The kernel must release the interpreter's lock (``njit(nogil=True)``). numba's own parallel
    loops bring a second OpenMP beside torch's; where another process shares the cores the two wait
    for each other spinning, and an iteration of 0.03 s took 0.8 s.
    """
    threads = min(jobs, torch.get_num_threads())
    if threads == 1:
        for job in range(jobs):
            kernel(job, *arguments)
        return

    def share(thread: int) -> None:
        for job in range(thread, jobs, threads):
            kernel(job, *arguments)

    others = [_pool().submit(share, thread) for thread in range(1, threads)]
    share(0)
    for other in others:
        other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="lfrtorch")


if hasattr(os, "register_at_fork"):  # a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
