"""A Parquet file as a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.types import Array
from lfrtorch.files.arrays import optional
from lfrtorch.files.table import BLOCK, Clock, Table


class ParquetTable(Table):
    """Columns of numbers and of times, read by batches of row groups; nulls are missing values."""

    def __init__(self, path: Path) -> None:
        pa, pq = optional("pyarrow"), optional("pyarrow.parquet")
        try:
            schema = pq.read_schema(path)
        except (pa.ArrowException, OSError) as error:
            raise _damaged(path, error) from error
        kinds = pa.types
        usable = (
            kinds.is_integer,
            kinds.is_floating,
            kinds.is_boolean,
            kinds.is_decimal,
            kinds.is_timestamp,
        )
        fields = [f for f in schema if any(check(f.type) for check in usable)]
        headers = [f.name for f in fields]
        clocks = {i for i, f in enumerate(fields) if kinds.is_timestamp(f.type)}
        refused = {
            f.name: f"has no numbers (its type is {f.type}); store it as numbers"
            for f in schema
            if f.name not in headers
        }
        super().__init__(path, headers, refused=refused, clocks=clocks)

    def blocks(self, columns: Sequence[int], samples: int = BLOCK) -> Iterator[Array]:
        """See :meth:`Table.blocks`."""
        pa, pq = optional("pyarrow"), optional("pyarrow.parquet")
        names = [self.headers[column] for column in columns]
        clocks = {name: Clock() for name in names}
        try:
            # Read ahead, the whole file would come to be in memory.
            with pq.ParquetFile(self.path, pre_buffer=False) as file:
                for batch in file.iter_batches(samples, columns=list(dict.fromkeys(names))):
                    found = np.empty((batch.num_rows, len(names)))
                    for i, name in enumerate(names):
                        values = batch.column(batch.schema.get_field_index(name))
                        if pa.types.is_timestamp(values.type):
                            times = values.cast(pa.timestamp("ns")).to_numpy(zero_copy_only=False)
                            found[:, i] = clocks[name](times)
                        else:
                            numbers = values.cast(pa.float64(), safe=False)
                            found[:, i] = numbers.to_numpy(zero_copy_only=False)
                    yield found
        except (pa.ArrowException, OSError) as error:
            raise _damaged(self.path, error) from error


def _damaged(path: Path, error: Exception) -> ValueError:
    return InputError(f"'{path}' is not a readable Parquet file ({brief(error)}); write it again.")
