"""Files that declare, or unpack to, more than there is memory for."""

import gzip
import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from lfrtorch._support.headers import names_and_units
from lfrtorch.files.load import load_records
from lfrtorch.files.text import _LONGEST


def refused(path: Path, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_records(path, inputs="u", outputs="y", fs=100.0)


def test_a_packed_line_without_end(tmp_path: Path):
    path = tmp_path / "blanks.csv.gz"
    with gzip.open(path, "wb", compresslevel=1) as stream:
        stream.write(b"u,y\n1,2\n3,4\n")
        for _ in range(_LONGEST // 2**20 + 1):
            stream.write(b" " * 2**20)
    refused(path, "has a line of more than")


@pytest.mark.parametrize("shape", [(10**14,), (10**9, 10**5)])
def test_a_data_set_that_no_machine_holds(tmp_path: Path, shape: tuple[int, ...]):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "empty.h5"
    with h5py.File(path, "w") as file:
        chunk = (2**16, 1)[: len(shape)]
        file.create_dataset("u", shape=shape, dtype="f8", chunks=chunk)
        file.create_dataset("y", shape=shape[:1], dtype="f8", chunks=chunk[:1])
    refused(path, "takes .* of memory, and there are .*; give a part of it")


def test_an_archive_whose_header_declares_too_much(tmp_path: Path):
    header = BytesIO()
    layout = {"descr": "<f8", "fortran_order": False, "shape": (10**15,)}
    np.lib.format.write_array_header_1_0(header, layout)
    path = tmp_path / "short.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("u.npy", header.getvalue() + b"0" * 80)
    refused(path, "is not a readable .npz file")


def test_a_part_of_a_workbook_that_no_program_packs(tmp_path: Path):
    path = tmp_path / "bomb.xlsx"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("xl/worksheets/sheet1.xml", "w") as part,
    ):
        for _ in range(101):
            part.write(bytes(10**6))
    refused(path, "takes 101 MB unpacked, over 100 times what it takes packed")


def test_names_of_many_columns_are_told_apart():
    found = names_and_units(["a (N)", "a (V)", *map(str, range(20_000))], {})
    assert [found[0][0], found[1][0], len(found)] == ["a (N)", "a (V)", 20_002]
