"""Benchmarks and users' files as records: one file a benchmark, ``files`` for one's own data."""

from lfrtorch.datasets.dataset import Dataset, Published  # first: the others import it from here

from lfrtorch.datasets import (  # isort: skip
    boucwen,
    cascaded_tanks,
    ced,
    emps,
    f16,
    files,
    parwh,
    silverbox,
    wh_process_noise,
    wiener_hammerstein,
)

__all__ = [
    "Dataset",
    "Published",
    "boucwen",
    "cascaded_tanks",
    "ced",
    "emps",
    "f16",
    "files",
    "parwh",
    "silverbox",
    "wh_process_noise",
    "wiener_hammerstein",
]
