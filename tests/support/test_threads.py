"""Jobs spread over threads: each one done once, and errors are not lost."""

import os
import signal
import time
import warnings
from contextlib import nullcontext
from threading import Event, Thread

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from lfrtorch._support.threads import spread, spread_by_hand, workers


def blas_threads() -> set[int]:
    return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}


@pytest.mark.parametrize("threads", [1, 2, 7])
@pytest.mark.parametrize("jobs", [1, 2, 5, 20])
def test_every_job_is_done_once(jobs: int, threads: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    done = torch.zeros(jobs)

    def kernel(job: int, add: int):
        done[job] += add

    spread(kernel, jobs, 3)
    assert done.tolist() == [3] * jobs


@pytest.mark.parametrize("bad", [0, 1])
def test_error_of_any_thread_is_raised(bad: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)

    def kernel(job: int):
        if job == bad:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        spread(kernel, 2)


@pytest.mark.parametrize("by_hand", [False, True])
def test_torch_works_on_one_thread_inside_and_on_as_many_as_before_outside(by_hand: bool):
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    seen: list[int] = []

    def kernel(job: int):
        seen.append(torch.get_num_threads())
        time.sleep(0.01)  # so that each thread gets a job

    try:
        with spread_by_hand() if by_hand else nullcontext():
            assert workers() == 3
            spread(kernel, 3)
            spread(kernel, 1)
        assert seen == [1, 1, 1, 1 if by_hand else 3]
        assert (workers(), torch.get_num_threads()) == (3, 3)
    finally:
        torch.set_num_threads(before)


def test_two_threads_of_a_program_leave_the_linear_algebra_as_it_was():
    """The second begins before the first ends, and ends after it."""
    begun, entered, left = Event(), Event(), Event()

    def first():
        with spread_by_hand():
            begun.set()
            entered.wait(10)

    def second():
        begun.wait(10)
        with spread_by_hand():
            entered.set()
            left.wait(10)

    limits = threadpool_limits(2, user_api="blas")
    try:
        with threadpool_limits(2, user_api="blas"):
            pass  # from here on any thread may set limits
        threads = [Thread(target=first), Thread(target=second)]
        for thread in threads:
            thread.start()
        threads[0].join()
        assert blas_threads() == {1}  # the second is at work
        left.set()
        threads[1].join()
        assert blas_threads() == {2}
    finally:
        limits.restore_original_limits()


def test_threads_are_given_back_after_an_error():
    before = torch.get_num_threads()
    with pytest.raises(ZeroDivisionError), spread_by_hand():
        raise ZeroDivisionError
    assert workers() == torch.get_num_threads() == before


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_forked_process_does_not_wait_for_threads_of_its_parent(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    spread(
        lambda job: None, 2
    )  # the pool now has a thread, which a forked process does not inherit
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads
        child = os.fork()
    if child == 0:
        try:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(20)
            spread(lambda job: None, 2)
            os._exit(7)
        finally:
            os._exit(1)
    end = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert end == 7, "the alarm ended the forked process: it was waiting"


def test_linear_algebra_of_numpy_works_on_one_thread_inside():
    np.linalg.qr(np.eye(3))  # its library is loaded

    with threadpool_limits(limits=2, user_api="blas"):
        before = blas_threads()
        assert before == {2}
        with spread_by_hand():
            assert blas_threads() == {1}
            with spread_by_hand():
                assert blas_threads() == {1}
            assert blas_threads() == {1}
        assert blas_threads() == before
