"""Known models of benchmarks, for ``known._target_``."""

from lfrtorch.known_systems.benchmarks import cascaded_tanks, emps, nanodrone

__all__ = ["cascaded_tanks", "emps", "nanodrone"]
