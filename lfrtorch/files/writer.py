"""A table that is written in blocks: CSV, Parquet or .npz."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from lfrtorch.files.arrays import optional

Write = Callable[[Mapping[str, NDArray]], None]


def table_writer(path: Path) -> AbstractContextManager[Write]:
    """Open a file for a function that appends arrays (n,) by the names of their columns."""
    return FORMATS[path.suffix.lower()](path)


@contextmanager
def _csv(path: Path) -> Iterator[Write]:
    import pandas as pd  # slow to import

    with path.open("w", encoding="utf-8", newline="") as stream:

        def write(columns: Mapping[str, NDArray]) -> None:
            first = stream.tell() == 0
            pd.DataFrame(columns).to_csv(stream, header=first, index=False, lineterminator="\n")

        yield write


@contextmanager
def _parquet(path: Path) -> Iterator[Write]:
    pa, pq = optional("pyarrow"), optional("pyarrow.parquet")
    with ExitStack() as opened:
        writer = None

        def write(columns: Mapping[str, NDArray]) -> None:
            nonlocal writer
            block = pa.table(dict(columns))
            if writer is None:
                writer = opened.enter_context(pq.ParquetWriter(path, block.schema))
            writer.write_table(block)

        yield write


@contextmanager
def _npz(path: Path) -> Iterator[Write]:
    blocks: list[Mapping[str, NDArray]] = []
    yield blocks.append
    with ZipFile(path, "w") as archive:  # numpy.savez takes some names for options
        for name in blocks[0]:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                whole = np.concatenate([block[name] for block in blocks])
                np.lib.format.write_array(stream, whole, allow_pickle=False)


FORMATS: dict[str, Callable[[Path], AbstractContextManager[Write]]] = {
    ".csv": _csv,
    ".npz": _npz,
    ".parquet": _parquet,
}
"""Writers by extension."""
