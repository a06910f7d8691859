"""What is written in blocks is read back as one table, to the bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lfrtorch.files.formats import open_table
from lfrtorch.files.writer import FORMATS, table_writer

SAMPLES = np.random.default_rng(0).normal(size=(100, 3)) * [1.0, 1e-9, 1e12]
NAMES = ["y", "file", 'b, "c"']  # one that numpy.savez takes for its own, one to be quoted


@pytest.mark.parametrize("extension", FORMATS)
def test_blocks_are_read_back_to_the_bit(extension: str, tmp_path: Path):
    path = tmp_path / f"x{extension}"
    with table_writer(path) as write:
        for block in np.split(SAMPLES, [10, 11]):
            write(dict(zip(NAMES, block.T, strict=True)))
    table = open_table(path)
    assert [column.name for column in table.columns] == NAMES
    assert np.array_equal(table.read(range(3)), SAMPLES)


@pytest.mark.parametrize("extension", FORMATS)
def test_missing_values_and_whole_numbers(extension: str, tmp_path: Path):
    path = tmp_path / f"x{extension}"
    with table_writer(path) as write:
        write({"k": np.arange(3), "y": np.array([1.0, np.nan, 3.0])})
    found = open_table(path).read([0, 1])
    assert np.array_equal(found, [[0, 1.0], [1, np.nan], [2, 3.0]], equal_nan=True)


def test_a_block_is_a_row_group(tmp_path: Path):
    parquet = pytest.importorskip("pyarrow.parquet")
    with table_writer(tmp_path / "x.parquet") as write:
        for _ in range(3):
            write({"y": np.ones(5)})
    assert parquet.ParquetFile(tmp_path / "x.parquet").num_row_groups == 3


def test_csv_is_plain(tmp_path: Path):
    with table_writer(tmp_path / "x.csv") as write:
        write({"k": np.arange(2), "y": np.array([0.1, np.nan])})
        write({"k": np.array([2]), "y": np.array([1e-7])})
    assert (tmp_path / "x.csv").read_bytes() == b"k,y\n0,0.1\n1,\n2,1e-07\n"
