"""Files of every format as tables of channels: layouts, missing values, memory and refusals."""

import gzip
import io
import os
import struct
import sys
import tracemalloc
import zipfile
import zlib
from datetime import datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
import scipy.sparse

from lfrtorch.data.records import Channel
from lfrtorch.files.formats import open_table
from lfrtorch.files.load import load_records

T = 40
SIGNALS = np.random.default_rng(3).normal(size=(T, 3))
U, Y = SIGNALS[:, :2], SIGNALS[:, 2]


def text(table=SIGNALS, delimiter=",", comma=False) -> str:
    lines = [delimiter.join(repr(float(value)) for value in row) for row in table]
    return ("\n".join(lines) + "\n").replace(".", "," if comma else ".")


def table_of(tmp_path: Path, content: str | bytes, name="a.csv"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return open_table(path)


def names(table) -> list[str]:
    return [column.name for column in table.columns]


def whole(table, wanted: str | int | list[str | int]):
    return table.read(table.find(wanted, "inputs"))


# --- text -----------------------------------------------------------------------------------


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|", " ", "  ", ", "])
@pytest.mark.parametrize("header", [True, False])
def test_delimiters(tmp_path, delimiter, header):
    head = delimiter.join(["u1", "u2", "y"]) + "\n" if header else ""
    table = table_of(tmp_path, head + text(delimiter=delimiter))
    assert names(table) == (["u1", "u2", "y"] if header else ["column 0", "column 1", "column 2"])
    assert np.array_equal(whole(table, [2, 0]), SIGNALS[:, [2, 0]])


@pytest.mark.parametrize("name", ["a.csv", "a.TXT", "a.tsv", "a.dat", "a.lvm"])
def test_extensions_of_text(tmp_path, name):
    assert np.array_equal(table_of(tmp_path, text(), name).read([0, 1, 2]), SIGNALS)


@pytest.mark.parametrize("delimiter", [";", "\t", "|", " "])
def test_decimal_comma(tmp_path, delimiter):
    head = f"u1{delimiter}u2{delimiter}y\n"
    table = table_of(tmp_path, head + text(delimiter=delimiter, comma=True))
    assert np.array_equal(whole(table, ["u1", "u2", "y"]), SIGNALS)
    mixed = table_of(tmp_path, head + text(np.round(SIGNALS * 9), delimiter, comma=True), "b.csv")
    assert np.array_equal(whole(mixed, "y")[:, 0], np.round(Y * 9))


def test_a_comma_is_decimal_if_the_columns_say_so(tmp_path):
    """It was if one cell had it: then 5,189 was 5.189 beside points, and all else was no number."""
    rows = [f"0.0{k};{5100 + k:,d};1,2" for k in range(10, 40)]
    table = table_of(tmp_path, "\n".join(["t;u;flags", *rows]))
    assert whole(table, "t")[0, 0] == 0.01
    with pytest.raises(ValueError, match="line 2: '5,110' in column 'u' is not a number"):
        whole(table, "u")
    rows = [f"0,{k};{k},25;1.5" for k in range(10, 40)]
    table = table_of(tmp_path, "\n".join(["t;u;version", *rows]))
    assert np.array_equal(whole(table, ["t", "u"])[0], [0.1, 10.25])


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-16-le", "utf-16-be", "cp1252"]
)
def test_encodings(tmp_path, encoding):
    content = "Zeit/s;Weg in µm;Größe (°C)\r\n" + text(delimiter=";").replace("\n", "\r\n")
    table = table_of(tmp_path, content.encode(encoding))
    assert table.columns == (Channel("Zeit", "s"), Channel("Weg in µm"), Channel("Größe", "°C"))
    assert np.array_equal(whole(table, ["Zeit", "Weg in µm", "Größe (°C)"]), SIGNALS)


def test_compressed_text(tmp_path):
    content = gzip.compress(("u1,u2,y\n" + text()).encode())
    assert np.array_equal(whole(table_of(tmp_path, content, "a.csv.gz"), "y")[:, 0], Y)
    for damaged in (content[:100], b"no gzip at all"):
        with pytest.raises(ValueError, match=r"a\.csv\.gz' is damaged"):
            table_of(tmp_path, damaged, "a.csv.gz")


def test_preamble_units_and_comments(tmp_path):
    lines = text().splitlines(keepends=True)
    content = (
        "Logger 7,serial 123\nSample rate,1000\nOperator:\tme\n\n"
        "# calibrated\ntime,force,disp\ns,N,[mm]\n"
        + "".join(lines[:20])
        + "# the rig was touched, 1, 2\n"
        + "".join(lines[20:])
    )
    table = table_of(tmp_path, content)
    assert table.columns == (Channel("time", "s"), Channel("force", "N"), Channel("disp", "mm"))
    assert np.array_equal(table.read([0, 1, 2]), SIGNALS)
    assert table.where(0) == "line 8"
    assert table.where(20) == "line 29"


def test_labview_measurement(tmp_path):
    content = (
        "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n"
        "***End_of_Header***\t\n\t\nChannels\t2\t\t\nSamples\t40\t40\t\n"
        "X0\t0.0E+0\t0.0E+0\t\nDelta_X\t1.0E-3\t1.0E-3\t\n***End_of_Header***\t\t\t\n"
        "X_Value\tVoltage\tVoltage_0\tComment\n" + text(delimiter="\t")
    )
    table = table_of(tmp_path, content, "a.lvm")
    assert names(table) == ["X_Value", "Voltage", "Voltage_0", "Comment"]
    assert np.array_equal(whole(table, ["X_Value", "Voltage", "Voltage_0"]), SIGNALS)


@pytest.mark.parametrize("point", [".", ","])
@pytest.mark.parametrize("first", ["", "X_Value"])
def test_labview_without_times(tmp_path, point, first):
    """The preamble's row of counts was the first sample, and the interval was not read."""
    rows = "".join(f"\t{u!r}\t{y!r}\t\n" for u, y in SIGNALS[:, 1:].tolist())
    content = (
        "LabVIEW Measurement\t\nX_Columns\tNo\n***End_of_Header***\t\n\t\n"
        "Channels\t2\t\t\nSamples\t40\t40\t\nX_Dimension\tTime\tTime\t\nX0\t0.0\t0.0\t\n"
        "Delta_X\t0.010000\t0.010000\t\n***End_of_Header***\t\t\t\n"
        f"{first}\tu\ty\tComment\n{rows}"
    )
    table = table_of(tmp_path, content.replace(".", point), "a.lvm")
    assert names(table) == [first or "column 0", "u", "y", "Comment"]
    assert np.array_equal(whole(table, ["u", "y"]), SIGNALS[:, 1:])
    assert table.rates == {"Delta_X": 100.0}


NUMBERED = "is taken for the names of the columns"


@pytest.mark.parametrize(
    ("header", "index", "known"),
    [
        ("0,1", 0, True),  # as pandas writes them
        (",0,1", 1, True),
        ("1,2", 0, None),
        ("2023,2024", 0, True),
        ("t,101,7", 1, True),
        (",101,102", 1, True),
        ("2,1", 0, None),  # a sample of whole numbers, perhaps
        ("0,0", 0, False),  # at rest
        ("0.5,1", 0, False),
    ],
)
def test_headers_of_numbers(tmp_path, header, index, known):
    """The first three samples were four, without a word."""
    signals = np.round(U, 4) + 1e-5
    rows = [[*[str(k)] * index, *map(str, row)] for k, row in enumerate(signals)]
    table = table_of(tmp_path, "\n".join([header, *map(",".join, rows)]))
    assert len(table.read([index])) == T + (not known)
    assert bool(table.notes) == (known is not False)
    if known:
        assert table.headers[index:] == tuple(header.split(",")[index:])
        assert NUMBERED in table.notes[0]
        assert np.array_equal(table.read([index, index + 1]), signals)
    elif known is None:
        assert "is read as a sample; if it is a header" in table.notes[0]


def test_odd_cells_in_the_first_lines_are_no_fault(tmp_path):
    for first, cell in (("9" * 5000, "1e999"), ("1", "inf"), ("0", "9" * 400)):
        rows = [f"0.5,{cell if k == 5 else k + 0.5}" for k in range(T)]
        table = table_of(tmp_path, "\n".join([f"{first},1", *rows]))
        assert len(table.read([1])) >= T
    for step in ("no", "0", "1e-320", "0.1\t0.2"):
        table = table_of(tmp_path, f"Delta_X\t{step}\n\tu\n" + "\t0.5\n" * T)
        assert table.rates == {}


@pytest.mark.parametrize(
    "t", [np.arange(1, T + 1), np.arange(1, T + 1) / 100, np.round(np.arange(1, T + 1) / 750, 3)]
)
def test_a_first_sample_that_a_time_runs_on_from_is_no_header(tmp_path, t):
    rows = [f"{time:g},{1 + k % 2},{y:.4f}" for k, (time, y) in enumerate(zip(t, Y, strict=True))]
    table = table_of(tmp_path, "\n".join(["0,2,1", *rows]))
    assert len(table.read([0])) == T + 1
    assert table.notes == ()


def test_headers_of_counted_numbers_above_whole_numbers(tmp_path):
    counts = np.random.default_rng(0).integers(0, 4096, (T, 3))
    rows = [",".join(map(str, row)) for row in counts]
    assert np.array_equal(table_of(tmp_path, "\n".join(["0,1,2", *rows])).read([0, 1, 2]), counts)
    table = table_of(tmp_path, "\n".join(["0,1", *(row.rsplit(",", 1)[0] for row in rows)]))
    assert len(table.read([0])) == T + 1
    assert "is read as a sample" in table.notes[0]


@pytest.mark.parametrize(
    "end", ["End of data", "mean,0.1,0.2\nstd,1,2", "*** end ***,,\n\n", "max"]
)
def test_words_below_the_samples_are_left_out(tmp_path, end):
    """They made the first column text, or samples of what stands beside them."""
    rows = [f"{k / 100},{u},{y}" for k, (u, y) in enumerate(SIGNALS[:, 1:])]
    table = table_of(tmp_path, "\n".join(["t,u,y", *rows, end]))
    for columns in ([0, 1, 2], [1, 2]):
        assert len(table.read(columns)) == T
    (note,) = table.notes
    assert note == f"the end of the file, from {end.splitlines()[0].strip()!r} on, has no samples"
    table = table_of(tmp_path, "\n".join(["t,u,y", *rows, end.splitlines()[0], *rows]))
    with pytest.raises(ValueError, match=r"line 42: '.*' in column 't' is not a number"):
        table.read([0])
    table = table_of(tmp_path, "\n".join(["t,u,y", *rows, "nan,1,2"]))
    assert len(table.read([1])) == T + 1
    assert table.notes == ()


@pytest.mark.parametrize(
    ("head", "columns"),
    [
        ('"Time","Load"\n"(sec)","(N)"\n', [("Time", "sec"), ("Load", "N")]),  # testing machine
        ("Time,Channel A\n(ms),(V)\n\n", [("Time", "ms"), ("Channel A", "V")]),  # oscilloscopes
        ("X,CH1,\nVolt,Volt,\n", [("X", ""), ("CH1", "")]),
        (
            "LECROYWS,123,Waveform\nSegments,1\n#1,01-Jan,0\nTime,Ampl\n",
            [("Time", ""), ("Ampl", "")],
        ),
        (",y\n", [("column 0", ""), ("y", "")]),  # an index without a name
    ],
)
def test_heads_of_instruments(tmp_path, head, columns):
    table = table_of(tmp_path, head + text(U))
    assert [tuple(column) for column in table.columns] == columns
    assert np.array_equal(table.read([0, 1]), U)


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_blanks_and_line_ends(tmp_path, newline):
    rows = ["  u , y", " 1.5 , +2 ", '"3e2" ,-.5', "Infinity,Null", "0x1,1"]
    table = table_of(tmp_path, newline.join(rows[:4]) + newline)
    assert names(table) == ["u", "y"]
    expected = [[1.5, 2], [300, -0.5], [np.inf, np.nan]]
    assert np.array_equal(table.read([0, 1]), expected, equal_nan=True)
    with pytest.raises(ValueError, match="line 5: '0x1' in column 'u' is not a number"):
        table_of(tmp_path, newline.join(rows)).read([0])


@pytest.mark.parametrize("mark", ["# ", "%", "#\t"])
def test_header_in_a_comment(tmp_path, mark):
    content = f"{mark}made by a program\n{mark}u1,u2,y\n" + text()
    assert names(table_of(tmp_path, content)) == ["u1", "u2", "y"]
    np.savetxt(tmp_path / "a.txt", SIGNALS, header="u1 u2 y", fmt="%.17g")
    table = open_table(tmp_path / "a.txt")
    assert names(table) == ["u1", "u2", "y"]
    assert np.array_equal(table.read([0, 1, 2]), SIGNALS)


def test_quotes_and_trailing_delimiters(tmp_path):
    rows = "".join(f'"{u}","{y}",\n' for u, _, y in SIGNALS)
    for header in ('"force, left (N)","y"\n', '"force, left (N)","y",\n'):
        table = table_of(tmp_path, header + rows)
        assert table.columns == (Channel("force, left", "N"), Channel("y"))
        assert np.array_equal(table.read([0, 1]), SIGNALS[:, [0, 2]])


def test_units_in_headers(tmp_path):
    headers = {
        "force (N)": ("force", "N"),
        "acc [m/s^2]": ("acc", "m/s^2"),
        "disp/mm": ("disp", "mm"),
        "T(°C)": ("T", "°C"),
        "y(k)": ("y(k)", ""),
        "u/y": ("u/y", ""),
        "x (raw)": ("x (raw)", ""),
        "x (mm)": ("x (mm)", ""),
        "torque [a b]": ("torque", "a b"),
    }
    row = ";".join("1" * len(headers))
    table = table_of(tmp_path, ";".join(headers) + f"\n{row}\n{row}\n")
    assert [tuple(column) for column in table.columns] == list(headers.values())
    for i, (header, (name, _)) in enumerate(headers.items()):
        assert table.find(header, "inputs") == table.find(name, "inputs") == (i,)


def test_missing_values(tmp_path):
    content = "u,y\n1,2\n,NA\nnan,4\n5\n#N/A,6\n\n7,-NaN\n"
    values = table_of(tmp_path, content).read([0, 1])
    expected = [[1, 2], [np.nan] * 2, [np.nan, 4], [5, np.nan], [np.nan, 6], [7, np.nan]]
    assert np.array_equal(values, expected, equal_nan=True)


@pytest.mark.numeric
def test_date_times_are_seconds(tmp_path):
    stamps = np.datetime64("2024-02-28T23:59:59.5") + np.arange(T) * np.timedelta64(250, "ms")
    for form in (str, lambda t: str(t).replace("T", " "), lambda t: f"{t}+01:00"):
        rows = "".join(f"{form(t)};{y}\n" for t, y in zip(stamps, Y, strict=True))
        rows = rows.replace(form(stamps[0]), "", 1)  # a time that is missing
        table = table_of(tmp_path, "when;y\n" + rows)
        parts = list(table.blocks([1, 0], samples=7))
        assert [len(part) for part in parts] == [7] * 5 + [5]
        expected = np.append(np.nan, np.arange(T - 1) / 4)
        assert np.allclose(np.concatenate(parts)[:, 1], expected, atol=1e-12, equal_nan=True)


def test_lines_count_comments_and_blanks(tmp_path):
    table = table_of(tmp_path, "u,y\n1,2\n\n# a\n3,4\n  \n5,six\n")
    assert [table.where(k) for k in range(3)] == ["line 2", "line 5", "line 7"]
    with pytest.raises(ValueError, match=r"a\.csv', line 7: 'six' in column 'y' is not a number"):
        table.read([0, 1])
    assert np.array_equal(table.read([0]), [[1], [3], [5]])


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("", "is empty"),
        ("\n \n", "is empty"),
        ("u1,u2,y\n", "has no samples.*'u1,u2,y'"),
        ("hello\nworld\n", "has no samples.*'hello'"),
        ("u1,u2,y\n1,2,3\n1,two,3\n", "line 3: 'two' in column 'u2' is not a number"),
        ("1,two,3\n" + "1,2,3\n" * 9, "line 1: 'two' in column 'column 1'"),
        ("u1,u2,y\n1,2,3\n\n1,2,3,4\n", "line 4: 4 cells, where there are 3 columns"),
        ("u1,u2,y\n1,2,3\n1,5,2,3\n", r"line 3: 4 cells.*decimal point"),
        ('u1,u2,y\n1,2,3\n"1,5",2,3\n', "line 3: '1,5' in column 'u1'"),
        ("t,u,y\n2024-01-01,2,3\nnoon,2,3\n", "line 3: 'noon' in column 't' is not a date-time"),
        ("t,u,y\n2024-02-29,2,3\n2024-02-30,2,3\n", "line 3: '2024-02-30' in column 't' is not a"),
        ("u,v,y\n1,2,3\n１,2,3\n", "line 3: '１' in column 'u' is not a number"),
        (b"\x89PNG\r\n\xff\x00\x00\x01" * 20, "is not text"),
    ],
)
def test_refused_text(tmp_path, content, match):
    with pytest.raises(ValueError, match=match):
        table_of(tmp_path, content).read([0, 1, 2])


def test_a_bad_cell_late_in_the_file(tmp_path):
    table = table_of(tmp_path, "u,y\n" + "1,2\n" * 2500 + "1,x\n")
    with pytest.raises(ValueError, match="line 2502: 'x' in column 'y'"):
        list(table.blocks([1], samples=1000))


@pytest.mark.parametrize("mark", ["\x0b", "\x0c", "\x1c", "\x85", "\u2028"])
def test_a_mark_of_a_page_ends_no_line(tmp_path, mark):
    table = table_of(tmp_path, f"page 1{mark}page 2\nu,y\n1,2\n3,4\n")
    assert np.array_equal(table.read([0, 1]), [[1, 2], [3, 4]])  # the first one was left out


def test_long_cells_are_told_in_no_time(tmp_path):
    """A million digits, and as many blanks in a header, took hours."""
    with pytest.raises(ValueError, match="has no samples"):
        table_of(tmp_path, "9" * 200_000 + "x\n")
    header = f"u{' ' * 50_000}x"
    assert names(table_of(tmp_path, f"{header},y\n1,2\n3,4\n")) == [header, "y"]


def test_text_is_read_in_blocks(tmp_path):
    path = tmp_path / "a.csv"
    line = ",".join(["0.123456789012"] * 8) + "\n"
    path.write_text("a,b,c,d,e,f,g,h\n" + line * 40_000)  # 4.8 MB, 2.6 MB as numbers
    table = open_table(path)
    next(table.blocks([0], samples=100))  # imports
    tracemalloc.start()
    try:
        count = sum(len(block) for block in table.blocks([1, 2], samples=1000))
        assert tracemalloc.get_traced_memory()[1] < 1.25e6  # measured: 0.9e6, in one block 1.6e6
        assert count == 40_000
    finally:
        tracemalloc.stop()


# --- arrays ---------------------------------------------------------------------------------


def check(table):
    """The table of u (T, 2) and y (T,)."""
    assert names(table) == ["u1", "u2", "y"]
    assert table.find("u", "inputs") == (0, 1)
    assert np.array_equal(whole(table, ["y", "u"]), SIGNALS[:, [2, 0, 1]])
    blocks = list(table.blocks([2, 1], samples=15))
    assert [block.shape for block in blocks] == [(15, 2), (15, 2), (10, 2)]
    assert np.array_equal(np.concatenate(blocks), SIGNALS[:, [2, 1]])


def refused(table, name, match):
    with pytest.raises(ValueError, match=match) as refusal:
        table.find(name, "inputs")
    assert str(table.path) in str(refusal.value)


@pytest.mark.parametrize("y", [Y, Y[:, None], Y[None, :]])
def test_npz(tmp_path, y):
    np.savez(tmp_path / "a.npz", u=U, y=y, fs=1000.0, notes=np.array({"by": "me"}))
    table = open_table(tmp_path / "a.npz")
    check(table)
    refused(table, "fs", "'fs', named in inputs, has one number")
    refused(table, "notes", "is an array of objects")


def test_npy(tmp_path):
    np.save(tmp_path / "rig.npy", U.astype(np.float32))
    table = open_table(tmp_path / "rig.npy")
    assert names(table) == ["rig1", "rig2"]
    assert np.array_equal(whole(table, "rig"), U.astype(np.float32))
    np.savez(tmp_path / "a.npz", u=U)
    (tmp_path / "a.npz").rename(tmp_path / "a.npy")
    with pytest.raises(ValueError, match=r"a\.npy' holds several arrays; give it the extension"):
        open_table(tmp_path / "a.npy")


def test_times_of_numpy_are_seconds(tmp_path):
    stamps = np.datetime64("2024-01-01T10:00") + np.arange(4) * np.timedelta64(2, "ms")
    np.savez(tmp_path / "a.npz", t=stamps)
    assert np.allclose(open_table(tmp_path / "a.npz").read([0])[:, 0], np.arange(4) * 2e-3)


@pytest.mark.parametrize("extra", [{}, {"do_compression": True}, {"format": "4"}])
def test_mat_5_and_4(tmp_path, extra):
    scipy.io.savemat(tmp_path / "a.mat", {"u": U, "y": Y}, **extra)  # y is stored as (1, T)
    check(open_table(tmp_path / "a.mat"))


def test_structs_and_cells_of_mat_5(tmp_path):
    cell, cells = np.empty((1, 1), object), np.empty((1, 2), object)
    cell[0, 0], cells[0, 0], cells[0, 1] = {"force": Y}, U, U
    variables = {
        "exp": {"u": U, "deep": {"y": Y[:, None]}, "one": cell},
        "both": cells,
        "runs": np.array([(1.0,), (2.0,)], dtype=[("y", float)]),
        "eye": scipy.sparse.eye(3, format="csc"),
        "z": Y + 1j,
        "name": "rig",
        "wide": U.T,
        "square": np.eye(T),
    }
    scipy.io.savemat(tmp_path / "a.mat", variables)
    table = open_table(tmp_path / "a.mat")
    assert names(table) == ["exp.u1", "exp.u2", "exp.deep.y", "exp.one.force", "wide1", "wide2"]
    assert np.array_equal(whole(table, ["exp.u", "exp.deep.y"]), SIGNALS)
    assert np.array_equal(whole(table, "exp.one.force")[:, 0], Y)
    refused(table, "both", "is an array of 2 cells")
    refused(table, "runs", "is an array of 2 structs")
    refused(table, "eye", "is sparse")
    refused(table, "z", "is complex")
    refused(table, "name", "has no numbers")
    assert np.array_equal(whole(table, "wide"), U)
    refused(table, "square", "is 40 × 40, and time may run along either axis; store its channels")


def test_objects_in_mat_5_leave_the_arrays_beside_them(tmp_path):
    def element(kind: int, content: bytes) -> bytes:
        return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)

    def named(name: str) -> bytes:  # as MATLAB writes a timetable: its parts lie elsewhere
        parts = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 2, 1))
        parts += element(1, b"") + element(6, struct.pack("<II", 0xDD000000, 2))
        words = b"".join(element(1, word) for word in (name.encode(), b"MCOS", b"timetable"))
        return element(14, element(6, struct.pack("<II", 17, 0)) + words + element(14, parts))

    stream = io.BytesIO()
    scipy.io.savemat(stream, {"u": U, "exp": {"y": Y}})
    packed = zlib.compress(named("model"))
    packed = struct.pack("<II", 15, len(packed)) + packed
    stream.seek(0)
    header, arrays = stream.read(128), stream.read()
    (tmp_path / "a.mat").write_bytes(header + named("runs") + arrays + packed)
    table = open_table(tmp_path / "a.mat")
    assert np.array_equal(whole(table, ["u", "exp.y"]), SIGNALS)
    refused(table, "runs", "is an object")
    refused(table, "model", "is an object")
    assert table.notes == ("left out: 'runs', 'model', as objects are not read",)


def test_a_large_sparse_matrix_in_mat_5_takes_no_memory_of_a_full_one(tmp_path):
    sparse = scipy.sparse.csc_matrix(([1.0], ([0], [0])), shape=(10**7, 10**5))
    scipy.io.savemat(tmp_path / "a.mat", {"rig": {"K": sparse}, "K": sparse, "u": U, "y": Y})
    assert np.array_equal(whole(open_table(tmp_path / "a.mat"), ["u", "y"]), SIGNALS)


def matlab_file(path: Path, write) -> None:
    """A file as MATLAB's save -v7.3 writes it: arrays in its order, so transposed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        write(file)
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")


def test_mat_7_3(tmp_path):
    def write(file):
        file["u"], file["y"] = U.T, Y[:, None]  # (T, 2) and (1, T) in MATLAB
        file["exp/deep/y"] = Y[None, :]
        references = file.create_dataset("#refs#/b", data=Y[None, :])
        for name, size, kind in (("one", 1, b"cell"), ("two", 2, b"cell"), ("runs", 2, None)):
            cell = file.create_dataset(name, (1, size), dtype=h5py.ref_dtype)
            cell[...] = references.ref
            if kind:
                cell.attrs["MATLAB_class"] = np.bytes_(kind)
        file["name"] = np.frombuffer(b"rig", np.uint8)[:, None].astype(np.uint16)
        file["name"].attrs["MATLAB_class"] = np.bytes_(b"char")
        file["sparse/data"] = Y
        file["sparse"].attrs["MATLAB_sparse"] = 3
        file["z"] = np.zeros((1, T), [("real", float), ("imag", float)])
        file["none"] = np.zeros(2, np.uint64)
        file["none"].attrs["MATLAB_empty"] = 1
        file["wide"] = U

    matlab_file(tmp_path / "a.mat", write)
    table = open_table(tmp_path / "a.mat")
    assert set(names(table)) == {"u1", "u2", "y", "exp.deep.y", "one", "wide1", "wide2"}
    assert ("wide", "2 × 40", "signals wide1 .. wide2") in table.contents
    assert np.array_equal(whole(table, ["u", "y"]), SIGNALS)
    assert np.array_equal(whole(table, ["one", "exp.deep.y"]), np.stack([Y, Y], axis=1))
    refused(table, "two", "is an array of 2 cells")
    refused(table, "runs", "is an array of 2 structs")
    refused(table, "name", "is text")
    refused(table, "sparse", "is sparse")
    refused(table, "z", "is complex")
    refused(table, "none", "is empty")
    assert np.array_equal(whole(table, "wide"), U)


def test_objects_of_mat_7_3(tmp_path):
    """They were signals of six numbers."""

    def write(file):
        file["u"] = U.T
        for name in ("iddata", "timetable", "string"):
            parts = np.array([[3707764736, 2, 1, 1, 1, 1]], np.uint32)
            file[name] = parts
            file[name].attrs["MATLAB_class"] = np.bytes_(name.encode())
            file[name].attrs["MATLAB_object_decode"] = np.int32(3)

    matlab_file(tmp_path / "a.mat", write)
    table = open_table(tmp_path / "a.mat")
    assert names(table) == ["u1", "u2"]
    refused(table, "iddata", "is an object .*store its arrays")
    refused(table, "timetable", "is an object")
    refused(table, "string", "is text")


def test_packed_numbers_of_hdf5(tmp_path):
    """Volts were millivolts, and the mark of a missing value was one."""
    stored = np.rint(1000 * SIGNALS).astype(np.int16)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["u"] = stored[:, 0]
        file["u"].attrs.update(units="V", scale_factor=1e-3)
        file["y"] = np.where(np.arange(T) == 7, -32768, stored[:, 2] + 200).astype(np.int16)
        file["y"].attrs.update(scale_factor=[1e-3], add_offset=-0.2, _FillValue=np.int16(-32768))
        file["plain"] = stored[:, 1]
        file["plain"].attrs.update(scale_factor="none")
    table = open_table(tmp_path / "a.h5")
    expected = np.column_stack([stored[:, 0] / 1000, stored[:, 2] / 1000, stored[:, 1]])
    expected[7, 1] = np.nan
    found = whole(table, ["u", "y", "plain"])
    assert np.allclose(found, expected, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("name", ["a.h5", "a.HDF5"])
def test_hdf5(tmp_path, name):
    with h5py.File(tmp_path / name, "w") as file:
        file["u"], file["y"] = U, Y
        file["u"].attrs["units"] = np.bytes_(b"\xff")  # no text
        file["wide/u"] = U.T
        file["pairs"] = np.zeros(T, [("a", float), ("b", float)])
        file["words"] = ["a", "b"]
        file["y"].attrs["units"] = "mm"
        file["nothing"] = h5py.Empty("f")
    table = open_table(tmp_path / name)
    assert names(table) == ["u1", "u2", "wide/u1", "wide/u2", "y"]
    assert np.array_equal(whole(table, ["u", "y"]), SIGNALS)
    assert np.array_equal(whole(table, "wide/u"), U)
    assert table.columns[4] == Channel("y", "mm")
    refused(table, "pairs", r"is compound \(a, b\)")
    refused(table, "words", "has no numbers")
    refused(table, "nothing", "is empty")


def test_parquet(tmp_path):
    stamps = np.datetime64("2024-01-01T10:00") + np.arange(T) * np.timedelta64(2, "ms")
    y = pa.array([None if k == 5 else v for k, v in enumerate(Y)], pa.float64())
    columns = {"u (N)": U[:, 0], "n": np.arange(T), "y": y, "t": stamps, "word": ["a"] * T}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet", row_group_size=15)
    table = open_table(tmp_path / "a.parquet")
    assert table.columns[0] == Channel("u", "N")
    expected = np.stack([U[:, 0], np.arange(T), Y, np.arange(T) * 2e-3], axis=1)
    expected[5, 2] = np.nan
    assert np.allclose(whole(table, ["u", "n", "y", "t"]), expected, atol=1e-12, equal_nan=True)
    assert sum(len(block) for block in table.blocks([0], samples=7)) == T
    refused(table, "word", r"has no numbers \(its type is string\)")


def aircraft(tmp_path, kind: str):
    """A force and three accelerations along rows, as the F-16 data are published."""
    arrays = {"Force": Y[None, :], "Acceleration": SIGNALS.T, "Fs": np.array([[400.0]])}
    path = tmp_path / f"a.{kind}"
    if kind == "npz":
        np.savez(path, **arrays)
    elif kind == "mat":
        scipy.io.savemat(path, arrays)
    else:
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file[name] = array
    return open_table(path)


@pytest.mark.parametrize("kind", ["mat", "npz", "h5"])
def test_arrays_of_one_file_have_time_along_their_common_length(tmp_path, kind):
    table = aircraft(tmp_path, kind)
    assert np.array_equal(whole(table, ["Force", "Acceleration"]), np.c_[Y, SIGNALS])
    assert np.array_equal(whole(table, ["Acceleration[2]", "Acceleration1"]), SIGNALS[:, [2, 0]])
    refused(table, "Acceleration[3]", r"are Acceleration\[0\] \.\. Acceleration\[2\]")
    assert table.rates == {"Fs": 400.0}
    assert sorted(table.contents) == [
        ("Acceleration", "3 × 40", "signals Acceleration1 .. Acceleration3"),
        ("Force", "1 × 40", "signal"),
        ("Fs", "1 × 1", "sampling frequency, 400 Hz"),
    ]


def test_the_length_of_a_vector_tells_the_axis_of_time(tmp_path):
    np.savez(tmp_path / "a.npz", y=Y, runs=np.outer(Y, np.arange(50)))  # more runs than samples
    assert np.array_equal(whole(open_table(tmp_path / "a.npz"), ["y", "runs[1]"]), np.c_[Y, Y])
    np.savez(tmp_path / "b.npz", gains=np.ones(3), y=SIGNALS.T)
    assert np.array_equal(whole(open_table(tmp_path / "b.npz"), "y"), SIGNALS)


@pytest.mark.parametrize(
    ("name", "value", "fs"),
    [
        ("fs", 750.0, 750.0),
        ("FS", 750, 750.0),
        ("rig.Fs", [[750.0]], 750.0),
        ("sampling_rate", 750.0, 750.0),
        ("Ts", 4.0, 0.25),
        ("dt", np.float32(0.5), 2.0),
        ("sample time", 0.5, 2.0),
        ("fs", -1.0, None),
        ("fs", [1.0, 2.0], None),
        ("gain", 3.0, None),
    ],
)
def test_lone_numbers_that_say_the_rate(tmp_path, name, value, fs):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["y"], file[name] = Y, value
        file["run/y"] = Y
        file["run"].attrs["fs"] = 75
        file.attrs["author"] = "me"
    found = {"run/fs": 75.0} | ({} if fs is None else {name: fs})
    assert open_table(tmp_path / "a.h5").rates == found


def test_arrays_of_different_lengths(tmp_path):
    np.savez(tmp_path / "a.npz", u=Y[1:], y=Y)
    table = open_table(tmp_path / "a.npz")
    with pytest.raises(ValueError, match="'u' has 39, 'y' has 40 samples"):
        table.read([0, 1])
    assert len(table.read([1])) == T


def book(path: Path, **sheets: list[list]) -> Path:
    """A workbook of sheets of rows."""
    made = openpyxl.Workbook()
    made.remove(made.worksheets[0])
    for name, rows in sheets.items():
        sheet = made.create_sheet(name)
        for row in rows:
            sheet.append(row)
    made.save(path)
    return path


def rows_of(*columns) -> list[list]:
    return [list(row) for row in zip(*(list(column) for column in columns), strict=True)]


@pytest.mark.parametrize("name", ["a.xlsx", "a.XLSM"])
def test_excel(tmp_path, name):
    rows = rows_of(*SIGNALS.T.tolist())
    rows[3][1], rows[4][2], rows[6][0] = None, "n/a", "1,5"
    rows.insert(10, [None] * 3)  # an empty row is no sample
    head = [["Rig 7", "measured by me"], [], ["Förderstrom", "Druck", "Füllstand (mm)"]]
    table = open_table(book(tmp_path / name, Run=[*head, ["l/min", "bar", None], *rows]))
    assert table.notes == ()
    assert [*map(str, table.columns)] == ["Förderstrom (l/min)", "Druck (bar)", "Füllstand (mm)"]
    same = {"rtol": 1e-14, "equal_nan": True}  # 16 digits are in the file
    expected = SIGNALS.copy()
    expected[3, 1] = expected[4, 2] = np.nan
    expected[6, 0] = 1.5
    assert np.allclose(whole(table, [0, "Druck", "Füllstand"]), expected, **same)
    blocks = list(table.blocks([2, 0], samples=15))
    assert [len(block) for block in blocks] == [14, 15, 11]  # a block has 15 rows, one empty
    assert np.allclose(np.concatenate(blocks), expected[:, [2, 0]], **same)
    assert table.where(10) == "row 16 of sheet 'Run'"


def test_sheets_and_cells_of_excel(tmp_path):
    numbers, words = [["u", "y"], *rows_of(Y.tolist(), U[:, 0].tolist())], [["by me"], ["today"]]
    path = book(tmp_path / "a.xlsx", Cover=words, Run1=numbers, Run2=numbers[:9], Notes=words)
    table = open_table(path)
    assert len(table.read([0])) == T
    assert table.notes == (
        "the sheet 'Run1' is read, the first of 2 with samples; 'a.xlsx#Run2' is the next",
    )
    assert len(open_table(f"{path}#Run2").read([0])) == 8
    with pytest.raises(ValueError, match="has no sheet 'Run3'; it has 'Cover', 'Run1', 'Run2'"):
        open_table(f"{path}#Run3")
    with pytest.raises(ValueError, match="has no samples"):
        open_table(f"{path}#Notes")
    with pytest.raises(FileNotFoundError, match=r"no file '.*b\.xlsx'; there is 'a\.xlsx'"):
        open_table(tmp_path / "b.xlsx#Run1")
    start = datetime(2024, 2, 28, 23, 59, 59)
    stamps = [start + timedelta(milliseconds=250 * k) for k in range(T)]
    rows = rows_of(stamps, [timedelta(seconds=k) for k in range(T)], Y.tolist())
    # A table need not begin in the first cell.
    rows = [[None] * 3, [None, "when", "since", "y"], *([None, *row] for row in rows)]
    table = open_table(book(tmp_path / "b.xlsx", Run=rows))
    assert names(table) == ["when", "since", "y"]
    k = np.arange(T)
    assert np.allclose(whole(table, ["when", "since", "y"]), np.c_[k / 4, k, Y], atol=1e-9)
    rows[20][3] = "broken"
    table = open_table(book(tmp_path / "c.xlsx", Run=rows))
    with pytest.raises(ValueError, match="row 21 of sheet 'Run': 'broken' in column 'y' is not a"):
        table.read([2])


def test_text_in_cells_of_excel(tmp_path):
    """Zones of text dates were lost, 5,189 was 5.189, and a row of means was a sample."""
    start = datetime(2024, 3, 31, 1, 59, 59)
    stamps = [start + timedelta(milliseconds=250 * k) for k in range(T)]
    texts = [
        f"{s.isoformat()}+01:00" if s.hour < 2 else f"{(s + timedelta(hours=1)).isoformat()}+02:00"
        for s in stamps
    ]
    rows = rows_of(texts, Y.tolist(), [f"{5100 + k:,d}" for k in range(T)])
    mean = ["mean", float(Y.mean()), 5120]
    table = open_table(book(tmp_path / "a.xlsx", Run=[["t (UTC)", "y", "n"], *rows, mean]))
    assert table.columns[0] == Channel("t", "s")
    assert np.allclose(whole(table, "t")[:, 0], np.arange(T) / 4)
    assert np.allclose(whole(table, "y")[:, 0], Y)
    assert table.notes == ("the end of the file, from 'mean' on, has no samples",)
    with pytest.raises(ValueError, match="row 2 of sheet 'Run': '5,100' in column 'n' is not a nu"):
        whole(table, "n")
    commas = [[f"{v:.3f}".replace(".", ",") for v in row] for row in SIGNALS]
    table = open_table(book(tmp_path / "b.xlsx", Run=[["a", "b", "c"], *commas]))
    assert np.allclose(table.read([0, 1, 2]), np.round(SIGNALS, 3))


def edited(path: Path, old: str, new: str) -> Path:
    """A workbook whose sheet has another text once."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    sheet = "xl/worksheets/sheet1.xml"
    assert old in parts[sheet].decode()
    parts[sheet] = parts[sheet].replace(old.encode(), new.encode(), 1)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('r="A30"', 'r="ZZZZZZ30"', "not a valid column name"),
        ('r="30"', 'r="many"', "could not convert"),
        ('r="30"', 'r="2000000000"', "has more than 1000 rows"),  # was read for an hour
        ("</sheetData>", "<row>", "mismatched tag"),
        ("<v>", "<v>0.1x", "could not convert string to float: '0.1x"),
    ],
)
def test_damaged_rows_of_excel(tmp_path, monkeypatch, old, new, reason):
    monkeypatch.setattr("lfrtorch.files.excel._MOST_ROWS", 1000)
    rows = [["u"], *rows_of(Y.tolist())]
    path = edited(book(tmp_path / "a.xlsx", Run=rows), old, new)
    with pytest.raises(ValueError, match=rf"a\.xlsx' is not a readable Excel file \(.*{reason}"):
        open_table(path).read([0])


@pytest.mark.parametrize("matlab", [False, True])
def test_hdf5_opens_no_other_file_and_no_circle(tmp_path, matlab):
    def write(file):
        file["u"] = U[:, :1]
        file["other"] = h5py.ExternalLink("fifo", "/u")  # which was waited for
        file["gone"] = h5py.SoftLink("/nowhere")
        file["itself"] = h5py.SoftLink("/itself")
        file.create_dataset("raw", (T,), "f8", external=[("/etc/passwd", 0, 8 * T)])
        layout = h5py.VirtualLayout((T,), "f8")
        layout[:] = h5py.VirtualSource("missing.h5", "u", (T,))
        file.create_virtual_dataset("virtual", layout)  # was read as zeros
        file.create_group("rig")["loop"] = file["/"]

    path = tmp_path / ("a.mat" if matlab else "a.h5")
    if matlab:
        matlab_file(path, write)
    else:
        with h5py.File(path, "w") as file:
            write(file)
    table = open_table(path)
    assert names(table) == ["u"]
    for name, reason in {
        "other": "lies in another file, 'fifo'", "gone": "leads nowhere", "itself": "leads nowhere",
        "raw": "its numbers in other files", "virtual": "its numbers in other files",
        f"rig{'.' if matlab else '/'}loop": "a group inside itself",
    }.items():  # fmt: skip
        refused(table, name, reason)


def test_arrays_that_cannot_be(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for name in ("u", "u.npy"):
            with archive.open(name, "w") as stream:
                np.lib.format.write_array(stream, U)
    with pytest.raises(ValueError, match="it has 'u' twice"):
        open_table(tmp_path / "a.npz")
    scipy.io.savemat(tmp_path / "a.mat", {"u": U})
    content = (tmp_path / "a.mat").read_bytes()
    shape = np.array(U.shape, "<i4").tobytes()
    fewer = np.array([-T, U.shape[1]], "<i4").tobytes()
    (tmp_path / "a.mat").write_bytes(content.replace(shape, fewer, 1))
    with pytest.raises(ValueError, match="an array of negative size"):
        open_table(tmp_path / "a.mat")


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "a.mat", "a.h5", "a.parquet", "a.xlsx"])
def test_damaged_files(tmp_path, name):
    path = tmp_path / name
    if name == "a.npz":
        np.savez_compressed(path, u=U, y=Y)
    elif name == "a.npy":
        np.save(path, U)
    elif name == "a.mat":
        scipy.io.savemat(path, {"u": U, "y": Y}, do_compression=True)
    elif name == "a.h5":
        with h5py.File(path, "w") as file:
            file["u"], file["y"] = U, Y
    elif name == "a.xlsx":
        book(path, Run=rows_of(Y.tolist()))
    else:
        pq.write_table(pa.table({"u": Y}), path)
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], b"nothing of the kind" * 40):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"{name}' is not a readable"):
            open_table(path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="is empty"):
        open_table(path)


@pytest.mark.parametrize(
    ("name", "package"), [("a.h5", "h5py"), ("a.parquet", "pyarrow"), ("a.xlsx", "openpyxl")]
)
def test_optional_packages(tmp_path, monkeypatch, name, package):
    (tmp_path / name).write_bytes(b"something")
    monkeypatch.setitem(sys.modules, package, None)
    missing = rf"{package} is not installed: pip install 'lfrtorch\[files\]'"
    with pytest.raises(ValueError, match=missing):
        open_table(tmp_path / name)


# --- files and columns ----------------------------------------------------------------------


def test_refused_paths(tmp_path):
    with pytest.raises(ValueError, match="is a folder; name a file, it has none"):
        open_table(tmp_path)
    with pytest.raises(FileNotFoundError, match="in its folder, and none of a known format"):
        open_table(tmp_path / "absent.csv")
    for name in ("rig_1.csv", "rig_2.csv", "other.mat", "notes.pdf", "book.xls"):
        (tmp_path / name).write_text("u,y\n1,2\n")
    with pytest.raises(FileNotFoundError, match=r"Rig_1\.cvs'; there is 'rig_1\.csv'"):
        open_table(tmp_path / "Rig_1.cvs")
    with pytest.raises(FileNotFoundError, match=r"its folder has 'other\.mat', 'rig_1\.csv'"):
        open_table(tmp_path / "zzz")
    with pytest.raises(FileNotFoundError, match=r"and no folder '.*nowhere'"):
        open_table(tmp_path / "nowhere" / "a.csv")
    with pytest.raises(ValueError, match=r"is a folder; name a file: other\.mat, rig_1\.csv"):
        open_table(tmp_path)
    with pytest.raises(ValueError, match=r"unknown extension '\.pdf'.*\.csv.*\.parquet"):
        open_table(tmp_path / "notes.pdf")
    with pytest.raises(ValueError, match=r"save it as \.xlsx"):
        open_table(tmp_path / "book.xls")
    for name in (f"{'n' * 300}.csv", "~nobody-of-that-name/a.csv", "a\0.csv"):
        with pytest.raises(ValueError, match=r"is not a path \("):
            open_table(name)
    (tmp_path / "circle.csv").symlink_to(tmp_path / "circle.csv")
    with pytest.raises(FileNotFoundError, match=r"no file '.*circle\.csv'"):
        load_records(tmp_path / "circle.csv", inputs="u", outputs="y", fs=1.0)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.csv")
    with pytest.raises(ValueError, match="is a pipe or a device; give a file"):
        open_table(tmp_path / "a.csv")


def test_find(tmp_path):
    table = table_of(tmp_path, "v,v,y (N)\n1,2,3\n1,2,3\n")
    assert table.find("y", "inputs") == table.find(["y (N)"], "inputs") == (2,)
    assert table.find([2, 0], "inputs") == (2, 0)
    refused(table, "v", "2 columns 'v', named in inputs; give the number of one: 0, 1")
    refused(table, "w", r"no column 'w', named in inputs; it has 3 column\(s\): 'v', 'v', 'y")
    refused(table, 3, "no column number 3.*3 column")
    refused(table, -1, "no column number -1")
    for nothing in ([], None, [1.5], True, [True]):
        refused(table, nothing, r"inputs is .*give inputs=\[...\], names of columns.*'v'")
    np.savez(tmp_path / "a.npz", fs=3.0)
    refused(open_table(tmp_path / "a.npz"), "u", r"no columns of numbers \('fs' has one number")


def test_a_name_that_is_nearly_right(tmp_path):
    table = table_of(tmp_path, "exp.force,position,w\n1,2,3\n1,2,3\n")
    refused(table, "force", r"'w'\. Did you mean 'exp\.force'\?$")
    refused(table, "positon", r"Did you mean 'position'\?$")
    refused(table, "voltage", r"'w'\.$")
    table = table_of(tmp_path, "force [N],rig.Level (mm)\n1,2\n1,2\n")
    refused(table, "forse", r"has 2 column\(s\): 'force', 'rig\.Level'\. Did you mean 'force'\?$")
    refused(table, "Force", r"Did you mean 'force'\?$")
    refused(table, "level", r"Did you mean 'rig\.Level'\?$")
