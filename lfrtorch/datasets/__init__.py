"""Public benchmarks: one file a benchmark, and ``official``, which reads their files.

Each has a ``load``, which raises a ValueError if an argument is out of range or a file cannot be
used, a FileNotFoundError if a file is missing, and an OSError if its download fails. By default
``root`` is the folder where the package nonlinear_benchmarks keeps its downloads, and that package
downloads missing files with ``download=True``.

Example:
    >>> lfrtorch.datasets.silverbox.load(root="elsewhere")
    Traceback (most recent call last):
    FileNotFoundError: there is no '...' in 'elsewhere'. Give the folder that holds ...
"""

from lfrtorch.datasets import (
    boucwen,
    cascaded_tanks,
    ced,
    emps,
    f16,
    fine_steering_mirror,
    nanodrone,
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
    "nanodrone",
    "parwh",
    "silverbox",
    "wh_process_noise",
    "wiener_hammerstein",
]
