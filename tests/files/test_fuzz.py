"""Damaged files of every format: each is read or refused in a short message, and none crashes."""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from lfrtorch._support.errors import LONGEST, InputError
from lfrtorch.files.load import load_records

pytestmark = pytest.mark.filterwarnings("ignore:Reading `.npy` or `.npz`:UserWarning")  # numpy's

SIGNALS = np.random.default_rng(0).normal(size=(40, 2)).round(3)
LINES = "\n".join(["u,y", *(f"{u},{y}" for u, y in SIGNALS)]).encode()


def saved(write: Callable[[io.BytesIO], None]) -> bytes:
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def matlab(*, packed: bool) -> bytes:
    named = {"u": SIGNALS[:, 0], "rig": {"y": SIGNALS[:, 1]}, "cells": np.array([1, "a"], object)}
    return saved(lambda file: scipy.io.savemat(file, named, do_compression=packed))


def hdf5() -> bytes:
    h5py = pytest.importorskip("h5py")

    def write(stream: io.BytesIO) -> None:
        with h5py.File(stream, "w") as file:
            file["u"], file["y"] = SIGNALS.T

    return saved(write)


FORMATS: dict[str, Callable[[], bytes]] = {
    "a.csv": lambda: LINES,
    "a.npy": lambda: saved(lambda file: np.save(file, SIGNALS)),
    "a.npz": lambda: saved(lambda file: np.savez(file, u=SIGNALS[:, 0], y=SIGNALS[:, 1])),
    "a.mat": lambda: matlab(packed=False),
    "packed.mat": lambda: matlab(packed=True),
    "a.h5": hdf5,
}
COLUMNS = {"a.npy": ("a[0]", "a[1]"), "a.mat": ("u", "rig.y"), "packed.mat": ("u", "rig.y")}

Change = tuple[int, int, bytes]
"""From where, how many bytes, and what stands there in their place."""

changes = st.lists(
    st.tuples(
        st.one_of(st.integers(0, 255), st.integers(0, 2**16)),  # headers stand at the beginning
        st.sampled_from([0, 1, 1, 1, 4, 50, 2**20]),
        st.one_of(st.binary(max_size=4), st.sampled_from([b"\0", b"\xff", b"(", b"\n", b"1e999"])),
    ),
    min_size=1,
    max_size=6,
)


def damaged(valid: bytes, spots: list[Change]) -> bytes:
    content = bytearray(valid)
    for start, length, put in spots:
        at = start % max(len(content), 1)
        content[at : at + length] = put
    return bytes(content)


def tried(path: Path, content: bytes) -> None:
    """Read it; what refuses it says so in a few lines."""
    path.write_bytes(content)
    u, y = COLUMNS.get(path.name, ("u", "y"))
    try:
        with np.errstate(over="ignore"):  # a damaged exponent may be 1e300
            data = load_records(path, inputs=u, outputs=y, fs=100.0, start="zero")
    except InputError as error:
        message = str(error)
    else:
        for record in data.train + data.validation + data.tests:
            assert np.isfinite(record.u).all()
            assert np.isfinite(record.y).all()
        return
    assert len(message) < len(str(path)) + 4 * LONGEST
    assert message.count("\n") <= 2


def fuzzed(max_examples: int) -> Callable:
    return settings(
        max_examples=max_examples, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )


@pytest.mark.parametrize("name", FORMATS)
@given(spots=changes)
@example(spots=[(70, 1, b"(")])  # .npy: its header had no end, and that was a TokenError
@example(spots=[(128, 4, b"\x0f\x00\x00\x00")])  # .mat: packed, as it said
@example(spots=[(176, 1, b"\x0a")])  # .mat: kinds of elements that there are not were a crash
@example(spots=[(0, 50, b"\0\0\0\0"), (0, 50, b"\x01")])  # .mat: a name of 900 characters
@example(spots=[(70, 0, b"\n")])  # .npy: numpy warns of Python 2
@example(spots=[(27, 1, b"\x02")])  # .npz: a name of 517 bytes, which the message showed
@fuzzed(30)
def test_a_damaged_file(tmp_path: Path, name: str, spots: list[Change]):
    tried(tmp_path / name, damaged(FORMATS[name](), spots))


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
@given(spots=changes)
@fuzzed(2000)
def test_a_damaged_file_of_many(tmp_path: Path, name: str, spots: list[Change]):
    tried(tmp_path / name, damaged(FORMATS[name](), spots))


@pytest.mark.parametrize("kind", [0, 8, 10, 11, 14, 19, 4000])
def test_elements_of_no_kind_in_a_matlab_file(tmp_path: Path, kind: int):
    content = bytearray(saved(lambda file: scipy.io.savemat(file, {"u": SIGNALS, "y": SIGNALS})))
    numbers = content.index(SIGNALS[:, 0].tobytes())
    content[numbers - 8 : numbers - 4] = kind.to_bytes(4, "little")
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(InputError, match=f"no element of kind {kind} here"):
        load_records(tmp_path / "a.mat", inputs="u", outputs="y", fs=1.0)


@given(
    table=st.lists(
        st.lists(
            st.one_of(
                st.floats(-1e6, 1e6).map(repr),
                st.sampled_from(
                    ["", "nan", "-", "x", '"', "inf", "2020-01-01", "1,5", "#", "1e400"]
                ),
            ),
            max_size=4,
        ),
        max_size=30,
    ),
    delimiter=st.sampled_from([",", ";", "\t", " ", "|"]),
)
@fuzzed(60)
def test_any_table_of_text(tmp_path: Path, table: list[list[str]], delimiter: str):
    text = "\n".join(delimiter.join(cells) for cells in [["u", "y"], *table])
    tried(tmp_path / "a.csv", text.encode())
