"""Runs of a study as tasks of Ray, on this machine or a cluster that runs: ``hydra/launcher=ray``.

Hydra looks for launchers in the namespace package ``hydra_plugins`` alone, hence the place of this
module. Its own plugin for Ray asks for a version of cloudpickle before 3.

References:
    Moritz et al., "Ray: a distributed framework for emerging AI applications", OSDI 2018.
"""

import logging
import os
import signal
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from lfrtorch._support.errors import InputError, brief

LOCAL: dict[str, Any] = {"include_dashboard": False, "object_store_memory": 80 * 2**20}
"""A cluster of this machine; what goes through its store are settings."""

SURROUNDINGS = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
"""Ray reports nothing to its makers, and runs are as urgent as they are without it."""

RETRIES = 3
"""How often a run begins again whose worker or machine was lost."""

REACHED = 10.0
"""Seconds in which the machine of an address answers. Ray alone would try for a quarter of an hour.
"""

GRACE = 60.0
"""Seconds in which runs may end their iteration and write what they found."""


@dataclass
class RayLauncherConf:
    """What ``hydra.launcher.NAME=VALUE`` sets.

    Args:
        address: of a cluster that runs, as ``HOST:6379`` or ``auto``; None: Ray begins one of this
            machine, which ends with the study.
        num_cpus: cores of the cluster that begins; None: all.
        cpus_per_task: cores of a run, and its threads.
    """

    _target_: str = "hydra_plugins.lfrtorch_ray.RayLauncher"
    address: str | None = None
    num_cpus: int | None = None
    cpus_per_task: int = 1


class RayLauncher(Launcher):
    """Each run is a task; one whose worker is killed goes on in another."""

    def __init__(self, address: str | None, num_cpus: int | None, cpus_per_task: int) -> None:
        self._address, self._cores, self._each = address, num_cpus, cpus_per_task

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """What Hydra gives every launcher."""
        self._context, self._work, self._config = hydra_context, task_function, config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """All runs, each with words of its own; what they say is printed as they end."""
        import ray

        if self._each < 1:
            raise InputError(
                f"hydra.launcher.cpus_per_task is {self._each}; give a whole number of at least 1."
            )
        setup_globals()
        with self._cluster():
            task = ray.remote(num_cpus=self._each, max_retries=RETRIES)(_run)
            shared = ray.put((self._context, self._config, self._work, Singleton.get_state()))
            tasks = [
                task.remote(os.getcwd(), initial_job_idx + i, list(words), shared)
                for i, words in enumerate(job_overrides)
            ]
            waiting = tasks
            try:
                while waiting:
                    ended, waiting = ray.wait(waiting)
                    print(ray.get(ended[0])[1], end="", flush=True)
            except BaseException as error:
                for left in waiting:
                    ray.cancel(left)
                if waiting:
                    ray.wait(waiting, num_returns=len(waiting), timeout=GRACE)
                if isinstance(error, SystemError) and error.__cause__:  # of SIGTERM's handler
                    raise error.__cause__ from None
                raise
            return [found for found, _ in ray.get(tasks)]

    @contextmanager
    def _cluster(self) -> Iterator[None]:
        """Connected to the cluster inside."""
        import ray

        if self._address is not None and ":" in self._address:
            _reach(self._address)
        for name, value in SURROUNDINGS.items():
            os.environ.setdefault(name, value)
        own = {**LOCAL, "num_cpus": self._cores} if self._address is None else {}
        ours = signal.getsignal(signal.SIGTERM)
        address = self._address or "local"
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
        except (ConnectionError, ValueError, AssertionError) as error:
            raise InputError(
                f"Ray did not start with hydra.launcher.address={self._address} and "
                f"hydra.launcher.num_cpus={self._cores}: {brief(error)}"
            ) from error
        signal.signal(signal.SIGTERM, ours)  # Ray's would end the study at once
        cores = ray.cluster_resources().get("CPU", 0)
        try:
            if self._address is None and self._each > cores:
                raise InputError(
                    f"hydra.launcher.cpus_per_task is {self._each}, and the cluster has "
                    f"{cores:.0f} cores; no run could begin."
                )
            yield
        finally:
            ray.shutdown()


def _reach(address: str) -> None:
    """Refuse an address where nothing answers."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), REACHED).close()
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(
            f"hydra.launcher.address is {address}, where no cluster of Ray answers "
            f"({brief(error)}); give HOST:PORT of its head, or auto for this machine's."
        ) from None


def _run(
    directory: str,
    number: int,
    words: list[str],
    shared: tuple[HydraContext, DictConfig, TaskFunction, dict[Any, Any]],
) -> tuple[JobReturn, str]:
    """A run, in a worker: what Hydra is told of it, and what it printed."""
    from lfrtorch.cli.interrupts import TerminatedError, handled

    def asked_to_end(*_: object) -> None:
        raise TerminatedError("the study was ended")

    context, config, work, state = shared
    os.chdir(directory)
    setup_globals()
    Singleton.set_state(state)
    own = context.config_loader.load_sweep_config(config, words)
    with open_dict(own):
        own.hydra.job.id, own.hydra.job.num = f"{own.hydra.job.name}_{number}", number
    HydraConfig.instance().set_config(own)
    with redirect_stdout(StringIO()) as said, handled(asked_to_end):
        found = run_job(
            hydra_context=context,
            task_function=work,
            config=own,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )
    return found, said.getvalue()
