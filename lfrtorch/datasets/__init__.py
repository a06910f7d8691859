"""Benchmarks and users' files as records: one file a benchmark, ``files`` for one's own data."""

from lfrtorch.datasets.dataset import Dataset, Published  # first: the others import it from here

from lfrtorch.datasets import boucwen, files, parwh, silverbox, wiener_hammerstein  # isort: skip

__all__ = ["Dataset", "Published", "boucwen", "files", "parwh", "silverbox", "wiener_hammerstein"]
