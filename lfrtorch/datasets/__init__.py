"""Public benchmarks: one file a benchmark, and ``official``, which reads their files."""

from lfrtorch.datasets import (
    boucwen,
    cascaded_tanks,
    ced,
    emps,
    f16,
    fine_steering_mirror,
    parwh,
    silverbox,
    wh_process_noise,
    wiener_hammerstein,
)

__all__ = [
    "boucwen",
    "cascaded_tanks",
    "ced",
    "emps",
    "f16",
    "fine_steering_mirror",
    "parwh",
    "silverbox",
    "wh_process_noise",
    "wiener_hammerstein",
]
