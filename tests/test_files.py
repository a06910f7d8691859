"""A user's own file as records: what is read, how it is cut, and what is refused."""

from collections import UserList

import numpy as np
import pytest

from lfrtorch.datasets import files

SAMPLES = 200
USE = {"inputs": ["u1", "u2"], "outputs": "y", "fs": 50.0}


@pytest.fixture
def signals():
    """Columns u1, u2 and y: (200, 3)."""
    return np.random.default_rng(3).normal(size=(SAMPLES, 3))


def write(path, table, header: str | None = "u1,u2,y", delimiter=","):
    lines = [header] if header else []
    lines += [delimiter.join(repr(float(value)) for value in row) for row in table]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def joined(data):
    """The file again: the test record begins where it begins and ends where it ends."""
    (record,) = data.tests
    return np.hstack([record.u, record.y])


def refused(match, path, error: type[Exception] = ValueError, **options):
    with pytest.raises(error, match=match) as refusal:
        files.load(path, **{**USE, **options})
    return str(refusal.value)


# --- what is read ---------------------------------------------------------------------------


def test_parts_are_cut_in_time_order(tmp_path, signals):
    path = write(tmp_path / "motor.csv", signals)
    data = files.load(path, **USE, validation=0.25, test=0.1, skip=7)
    train, validation, test = *data.train, *data.validation, *data.tests
    assert [r.samples for r in (train, validation, test)] == [130, 180, 200]
    assert [r.name for r in (train, validation, test)] == ["train", "validation", "test"]
    assert np.array_equal(train.u, signals[:130, :2])
    assert [r.skip for r in (train, validation, test)] == [7, 130, 180]
    assert np.array_equal(validation.y, signals[:180, 2:])
    assert np.array_equal(test.u, signals[:, :2])
    for record in (train, validation, test):
        assert (record.fs, record.start, record.source) == (50.0, "zero", "file")
        assert [c.name for c in record.inputs] == ["u1", "u2"]
        assert [c.name for c in record.outputs] == ["y"]
    assert (data.name, data.noise_rms, data.published) == ("motor", None, ())


def test_five_percent_warm_up_unless_told(tmp_path, signals):
    data = files.load(write(tmp_path / "a.csv", signals), **USE)
    records = (*data.train, *data.validation, *data.tests)
    assert [(r.skip, r.samples) for r in records] == [(10, 120), (120, 160), (160, 200)]


@pytest.mark.parametrize("samples", [51, 53, 97])
@pytest.mark.parametrize("skip", [0, 3])
def test_every_sample_after_the_first_warm_up_is_scored_once(tmp_path, signals, samples, skip):
    path = write(tmp_path / "a.csv", signals[:samples])
    data = files.load(path, **USE, skip=skip)
    records = [*data.train, *data.validation, *data.tests]
    scored = np.concatenate([np.hstack([r.u, r.y])[r.skip :] for r in records])
    assert np.array_equal(scored, signals[skip:samples])
    assert [len(r.y) - r.skip for r in records[1:]] == [round(samples / 5)] * 2


@pytest.mark.parametrize(
    ("delimiter", "name"), [(",", "a.csv"), (";", "a.CSV"), ("\t", "a.tsv"), ("\t", "a.txt")]
)
def test_delimiters(tmp_path, signals, delimiter, name):
    path = write(
        tmp_path / name, signals, header=f"u1{delimiter} u2{delimiter}y", delimiter=delimiter
    )
    assert np.array_equal(joined(files.load(path, **USE)), signals)


def test_header_with_a_comma_in_a_name(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals, header="u1;u2;y, mm", delimiter=";")
    data = files.load(path, **{**USE, "outputs": "y, mm"})
    assert data.train[0].outputs[0].name == "y, mm"


def test_columns_by_number_with_and_without_a_header(tmp_path, signals):
    headed = files.load(write(tmp_path / "a.csv", signals), inputs=[0, 1], outputs=2, fs=1.0)
    bare = files.load(
        write(tmp_path / "b.csv", signals, header=None), inputs=[0, 1], outputs=2, fs=1.0
    )
    assert np.array_equal(joined(headed), signals)
    assert np.array_equal(joined(bare), signals)
    assert [c.name for c in headed.train[0].inputs] == ["u1", "u2"]
    assert [c.name for c in bare.train[0].inputs] == ["column 0", "column 1"]


def test_column_order_is_the_users(tmp_path, signals):
    data = files.load(write(tmp_path / "a.csv", signals), inputs=["y", 0], outputs=["u2"], fs=1.0)
    assert np.array_equal(joined(data), signals[:, [2, 0, 1]])


def test_any_sequence_of_columns(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)  # a Hydra ListConfig is a Sequence and no list
    data = files.load(path, inputs=UserList(["u1", "u2"]), outputs=UserList([2]), fs=1.0)
    assert np.array_equal(joined(data), signals)


def test_other_columns_may_hold_text(tmp_path):
    rows = "".join(f"{i},12:00:{i:02d},{2 * i}\r\n" for i in range(60))
    path = tmp_path / "a.csv"
    path.write_bytes(f"\ufeffu,time,y\r\n{rows}\r\n".encode())  # as Excel saves it
    data = files.load(path, inputs="u", outputs="y", fs=1.0)
    assert np.array_equal(joined(data), np.arange(60.0)[:, None] * [1, 2])
    bare = tmp_path / "b.csv"
    bare.write_text(rows)
    assert np.array_equal(joined(files.load(bare, inputs=0, outputs=2, fs=1.0)), joined(data))


def test_as_numpy_writes_a_table(tmp_path, signals):
    path = tmp_path / "a.csv"
    np.savetxt(path, signals, delimiter=",", header="u1,u2,y", fmt="%.17g")
    assert np.array_equal(joined(files.load(path, **USE)), signals)


def test_npz(tmp_path, signals):
    path = tmp_path / "rig.npz"
    np.savez(path, force=signals[:, :2], y=signals[:, 2], notes=np.array({"by": "me"}))
    data = files.load(path, inputs="force", outputs="y", fs=50.0)
    assert np.array_equal(joined(data), signals)
    assert data.name == "rig"
    assert [c.name for c in data.train[0].inputs] == ["force1", "force2"]
    assert [c.name for c in data.train[0].outputs] == ["y"]


def test_npz_of_integers(tmp_path):
    path = tmp_path / "counts.npz"
    np.savez(path, u=np.arange(60), y=np.arange(60, dtype=np.float32)[:, None])
    data = files.load(path, inputs="u", outputs="y", fs=1.0)
    assert np.array_equal(joined(data), np.arange(60.0)[:, None] * [1, 1])


# --- what is refused ------------------------------------------------------------------------


def test_refused_arguments(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)
    refused(r"data\.inputs", path, inputs=None)
    refused(r"data\.outputs", path, outputs=[])
    refused(r"names or numbers", path, inputs=[1.5])
    refused(r"data\.fs", path, fs=None)
    refused("sampling frequency is 0", path, fs=0)
    refused("'u2' stands twice", path, outputs=["y", "u2"])
    refused("'u1' stands twice", path, inputs=["u1", 0])
    refused("no column 'v'.*'u1', 'u2', 'y'", path, inputs="v")
    refused("no column number 3.*3 columns.*'u1', 'u2', 'y'", path, inputs=3)
    refused("no column number -1", path, inputs=-1)
    refused("data.skip is -1", path, skip=-1)


@pytest.mark.parametrize(
    ("validation", "test"), [(0, 0.2), (0.2, 0.0), (0.5, 0.5), (-0.1, 0.2), (20, 20), (np.nan, 0.2)]
)
def test_refused_fractions(tmp_path, signals, validation, test):
    path = write(tmp_path / "a.csv", signals)
    refused(
        "fractions are validation=|is (-0.1|nan); give a number",
        path,
        validation=validation,
        test=test,
    )


def test_refused_short_parts(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)
    refused("the test part has 8 scored samples of 200", path, test=0.04)
    refused("the validation part has 8 scored", path, validation=0.04)
    refused("the train part has 4 scored", path, validation=0.49, test=0.49, skip=0)
    refused("the train part has 9 scored samples of 200, with skip=111", path, skip=111)
    files.load(path, **USE, skip=110)  # exactly the ten samples that are needed


def test_refused_paths(tmp_path):
    message = refused("no file", tmp_path / "absent.csv", FileNotFoundError)
    assert "absent.csv" in message
    refused("no file", tmp_path, FileNotFoundError)
    (tmp_path / "a.mat").write_bytes(b"MATLAB")
    refused(r"unknown extension '\.mat'.*\.csv.*\.npz", tmp_path / "a.mat")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "is empty"),
        ("\n \n", "is empty"),
        ("u1,u2,y\n", "no samples"),
        ("u1,u2,y\n1,2,3\n\n1,2\n", r"line 4: 2 column\(s\), where line 1 has 3"),
        ("u1,u2,y\n1,2,3,\n", r"line 2: 4 column\(s\)"),
        ("u1,u2,y\n1,2,3\n1,two,3\n", "line 3: 'two' in column 'u2' is not a finite number"),
        ("u1,u2,y\n1,2,3\n1,,3\n", "line 3: '' in column 'u2'"),
        ("u1,u2,y\n1,2,3\n,,\n", "line 3: '' in column 'u1'"),
        ("u1,u2,y\n1,2,nan\n", "line 2: 'nan' in column 'y'"),
        ("u1,u2,y\n1,2,-inf\n", "line 2: '-inf' in column 'y'"),
        ("u1;u2;y\n1,5;2;3\n", "line 2: '1,5' in column 'u1'.*decimal point"),
        ("u1,u1,y\n1,2,3\n", "2 columns 'u1'.*'u1', 'u1', 'y'"),
        ("0.1,0.2,0.3\n0.4,0.5,0.6\n", "no column 'u1'.*'0.1', '0.2', '0.3'"),
        ("u1 u2 y\n1 2 3\n", "no column 'u1'.*'u1 u2 y'"),
    ],
)
def test_refused_tables(tmp_path, text, match):
    path = tmp_path / "table.csv"
    path.write_text(text)
    assert "table.csv" in refused(match, path)


def test_a_bad_number_in_the_first_line_is_no_header(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("1,two\n" + "1,2\n" * 60)
    refused("line 1: 'two' in column 'column 1'", path, inputs=0, outputs=1)


def test_doubled_names_go_by_number(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals, header="v,v,")
    refused("2 columns 'v'", path, inputs="v", outputs=2)
    data = files.load(path, inputs=[0, 1], outputs=2, fs=1.0)
    assert np.array_equal(joined(data), signals)


@pytest.mark.parametrize("content", ["u1,u2,y\n1,2,3\n".encode("utf-16"), b"\x89PNG\r\n\xff\x00"])
def test_refused_binary_tables(tmp_path, content):
    path = tmp_path / "table.csv"
    path.write_bytes(content)
    refused("table.csv' is not a readable table.*UTF-8", path)


def test_refused_arrays(tmp_path, signals):
    path = tmp_path / "a.npz"
    y = signals[:, 2]

    def npz(match, inputs: str | int = "u", **arrays):
        np.savez(path, **arrays)
        assert str(path) in refused(match, path, inputs=inputs)

    npz("no array 'u': it has 'v', 'y'", v=y, y=y)
    npz("no array 0: it has 'u', 'y'", inputs=0, u=y, y=y)
    npz("no array 'u': it has none")
    npz("'u' has 199, 'y' has 200 samples", u=y[1:], y=y)
    npz(r"'u' has shape \(1, 200\)", u=y[None], y=y)
    npz(r"'u' has shape \(\)", u=np.array(1.0), y=y)
    npz(r"'u' has shape \(200, 1, 1\)", u=y[:, None, None], y=y)
    npz("type complex128", u=y + 1j, y=y)
    npz("type <U1", u=np.full(200, "a"), y=y)
    npz(
        "2 sample.*the first at index 5",
        u=np.where(np.isin(np.arange(200), [5, 9]), np.nan, y),
        y=y,
    )
    npz("not a readable .npz file.*Object arrays", u=np.array([None] * 200), y=y)


def test_refused_archives(tmp_path, signals):
    path = tmp_path / "a.npz"
    np.savez(path, u=signals[:, 0], y=signals[:, 2])
    whole = path.read_bytes()
    start = whole.index(b"NUMPY") + 200  # inside the samples
    flipped = whole[:start] + bytes(255 - b for b in whole[start : start + 8]) + whole[start + 8 :]
    for content in (b"", b"no archive", whole[: len(whole) // 2], flipped):
        path.write_bytes(content)
        refused("a.npz' is not a readable .npz file", path, inputs="u")
    with path.open("wb") as stream:
        np.save(stream, signals)
    refused("a.npz' is not a readable .npz file", path, inputs="u")


def test_period_reaches_the_records_that_hold_one(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)
    assert files.load(path, **USE, period=50).train[0].period == 50
    refused("has 200 samples and a period of 201; it must hold at least one", path, period=201)
