"""A user's own files as records by use: what is read, how it is split, and what is refused."""

import csv
from collections import UserList
from pathlib import Path
from typing import Any, Literal

import numpy as np
import openpyxl
import pandas as pd
import pytest
import scipy.io
import scipy.signal

from lfrtorch import LevenbergMarquardt, Settings, identify, load_records
from lfrtorch.data.excitation import multisine
from lfrtorch.data.records import Channel
from lfrtorch.files.formats import open_table
from lfrtorch.files.measurement import look_at
from lfrtorch.files.text import TextTable
from lfrtorch.linear import record_start
from lfrtorch.linear.record_start import StartTrial, decided

SAMPLES = 200
USE: dict[str, Any] = {"inputs": ["u1", "u2"], "outputs": "y", "fs": 50.0, "start": "zero"}
TIMED: dict[str, Any] = {"inputs": "u", "outputs": "y", "time": "t", "start": "zero"}
BARE: dict[str, Any] = {"inputs": "u", "outputs": "y", "start": "zero"}
N = 100  # samples of a period


def begun(use: dict[str, Any], start: str) -> dict[str, Any]:
    return use | {"start": start}


@pytest.fixture
def signals():
    """Columns u1, u2 and y: (200, 3)."""
    return np.random.default_rng(3).normal(size=(SAMPLES, 3))


def write(path, table, header: str | None = "u1,u2,y"):
    lines = [header] if header else []
    lines += [",".join(repr(float(value)) for value in row) for row in table]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def timed(path, t, gap: slice | None = None):
    """A file of the columns t, u and y, with NaN in ``gap`` of y; u and y."""
    u, y = np.random.default_rng(5).normal(size=(2, len(t)))
    if gap:
        y[gap] = np.nan
    write(path, np.stack([t, u, y], axis=1), "t,u,y")
    return np.stack([u, y], axis=1)


def joined(record):
    return np.hstack([record.u, record.y])


def refused(match, path, error: type[Exception] = ValueError, use=USE, **options):
    with pytest.raises(error, match=match) as refusal:
        load_records(path, **{**use, **options})
    return str(refusal.value)


# --- one file -------------------------------------------------------------------------------


def test_parts_are_cut_in_time_order(tmp_path, signals):
    path = write(tmp_path / "motor.csv", signals)
    data = load_records(path, **USE, validation=0.25, test=0.1, skip=7)
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
    assert (data.name, data.noise_rms, data.published, data.notes) == ("motor", None, (), ())


def test_five_percent_warm_up_unless_told(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)
    for skip in (None, "auto"):
        data = load_records(path, **USE, skip=skip)
        records = (*data.train, *data.validation, *data.tests)
        assert [(r.skip, r.samples) for r in records] == [(10, 120), (120, 160), (160, 200)]


def test_start_and_limits_of_the_sensors_are_those_of_all_records(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)
    data = load_records(path, **begun(USE, "estimated"), limits=(None, 1.0))
    for record in (*data.train, *data.validation, *data.tests):
        assert np.array_equal(record.shown(record.y), np.minimum(record.y, 1.0))
        assert record.start == "estimated"


def test_a_reference_is_cut_like_the_inputs(tmp_path, signals):
    path = write(tmp_path / "a.csv", np.hstack([signals, 2 * signals[:, :2]]), "u1,u2,y,r1,r2")
    data = load_records(path, **USE, reference=["r1", "r2"])
    for record in (*data.train, *data.validation, *data.tests):
        assert record.reference is not None
        assert np.array_equal(record.reference, 2 * record.u)
    with pytest.raises(ValueError, match=r"1 column\(s\) for 2 input\(s\); name one for each"):
        load_records(path, **USE, reference="r1")


def test_the_period_is_that_of_the_reference(tmp_path):
    """Noise that a controller feeds back hides that of the input."""
    rng, r = np.random.default_rng(0), np.tile(multisine(50).u[0, :, 0], 4)
    u, y = r + rng.standard_normal((2, 200))
    path = write(tmp_path / "a.csv", np.column_stack([u, y, r]), "u,y,r")
    options: dict[str, Any] = {"inputs": "u", "outputs": "y", "fs": 1.0, "validation": 0, "test": 0}
    data = load_records(path, **begun(options, "periodic"), reference="r", skip=0)
    assert data.train[0].period == 50


@pytest.mark.parametrize("samples", [51, 53, 97])
@pytest.mark.parametrize("skip", [0, 3])
def test_every_sample_after_the_first_warm_up_is_scored_once(tmp_path, signals, samples, skip):
    path = write(tmp_path / "a.csv", signals[:samples])
    data = load_records(path, **USE, skip=skip)
    records = [*data.train, *data.validation, *data.tests]
    scored = np.concatenate([joined(r)[r.skip :] for r in records])
    assert np.array_equal(scored, signals[skip:samples])
    assert [len(r.y) - r.skip for r in records[1:]] == [round(samples / 5)] * 2


@pytest.mark.parametrize("none", [0, 0.0, None])
def test_parts_may_be_left_out(tmp_path, signals, none):
    path = write(tmp_path / "a.csv", signals)
    data = load_records(path, **USE, test=none)
    assert (data.train[0].samples, data.validation[0].samples, data.tests) == (160, 200, [])
    data = load_records(path, **USE, validation=none, test=none)
    assert (data.train[0].samples, data.validation, data.tests) == (200, [], [])


def test_column_order_is_the_users(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)  # a Hydra ListConfig is a Sequence and no list
    data = load_records(
        path, inputs=UserList(["y", 0]), outputs=UserList(["u2"]), fs=1.0, start="zero"
    )
    assert np.array_equal(joined(data.tests[0]), signals[:, [2, 0, 1]])


@pytest.mark.parametrize(
    ("header", "told"),
    [
        ("t,u,y", "inputs=u, outputs=y"),
        ("y2,y1,U (V)", "inputs=U, outputs=y2,y1"),
        ("input_1,input_2,output", "inputs=input_1,input_2, outputs=output"),
        ("uEst,yEst,uVal", "inputs=uEst, outputs=yEst"),
        ("IN,OUT,temperature", "inputs=IN, outputs=OUT"),
    ],
)
def test_names_that_leave_no_doubt_are_taken(tmp_path, signals, header, told):
    path = write(tmp_path / "a.csv", signals, header)
    data = load_records(path, fs=50, start="zero")
    assert f"{told}, by the names of the columns" in data.notes
    u, y = (",".join(c.name for c in getattr(data.train[0], s)) for s in ("inputs", "outputs"))
    assert f"inputs={u}, outputs={y}" == told


@pytest.mark.parametrize(
    "header",
    ["t,force,disp", "u,u1,y", "u,input,y", "u,y,y1", "u,disp,acc", "u,u,y", "u1,u2,u3", "v,w,y"],
)
def test_names_that_leave_a_doubt_are_not(tmp_path, signals, header):
    path = write(tmp_path / "a.csv", signals, header)
    refused(r"inputs is None; give inputs=\[", path, use={"fs": 50.0})


def test_a_side_that_is_given_leaves_the_other_to_the_names(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals, "u,force,y")
    data = load_records(path, inputs="force", fs=50, start="zero")
    assert "outputs=y, by the names of the columns" in data.notes
    assert [channel.name for channel in data.train[0].inputs] == ["force"]
    assert not any("by the names" in note for note in load_records(path, **BARE, fs=50).notes)
    refused("outputs is None", write(path, signals, "u,force,disp"), use={"inputs": "u", "fs": 50})


def test_columns_without_a_header(tmp_path, signals):
    bare = write(tmp_path / "b.csv", signals, header=None)
    data = load_records(bare, inputs=[0, 1], outputs=2, fs=1.0, start="zero")
    assert np.array_equal(joined(data.tests[0]), signals)
    assert [c.name for c in data.train[0].inputs] == ["column 0", "column 1"]


def test_a_header_of_too_few_names_is_said_not_to_be_used(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals, "u1,y")
    data = load_records(path, inputs=[0, 1], outputs=2, fs=50.0, start="zero")
    assert data.notes == (
        "line 1, 'u1,y', has 2 names for 3 columns and is not used: these are called 'column 0' to "
        "'column 2'",
    )


def test_other_columns_may_hold_text(tmp_path):
    rows = "".join(f"{i},12:00:{i:02d},{2 * i}\r\n" for i in range(60))
    path = tmp_path / "a.csv"
    path.write_bytes(f"\ufeffu,time,y\r\n{rows}\r\n".encode())  # as Excel saves it
    data = load_records(path, inputs="u", outputs="y", fs=1.0, start="zero")
    assert np.array_equal(joined(data.tests[0]), np.arange(60.0)[:, None] * [1, 2])
    assert data.notes == ()


def test_arrays(tmp_path, signals):
    np.savez(tmp_path / "rig.npz", force=signals[:, :2], y=signals[:, 2])
    scipy.io.savemat(tmp_path / "rig.mat", {"exp": {"force": signals[:, :2], "y": signals[:, 2]}})
    for name, prefix in (("rig.npz", ""), ("rig.mat", "exp.")):
        data = load_records(
            tmp_path / name, inputs=f"{prefix}force", outputs=f"{prefix}y", fs=50.0, start="zero"
        )
        assert np.array_equal(joined(data.tests[0]), signals)
        assert [c.name for c in data.train[0].inputs] == [f"{prefix}force1", f"{prefix}force2"]
        assert data.name == "rig"


def test_units(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals, header="u1 (V),u2 [A],y/mm")
    data = load_records(path, **USE)
    assert data.train[0].inputs == (Channel("u1", "V"), Channel("u2", "A"))
    data = load_records(path, **USE, units={"u1": "kV", "y/mm": "m"})
    assert data.train[0].inputs[0] == Channel("u1", "kV")
    assert data.train[0].outputs == (Channel("y", "m"),)
    data = load_records(path, **USE, units={0: "V", 2: "m"})
    assert [c.unit for c in (*data.train[0].inputs, *data.train[0].outputs)][::2] == ["V", "m"]
    refused("units names 'v'.*not among the inputs and outputs: u1, u2, y", path, units={"v": ""})


# --- several files --------------------------------------------------------------------------


@pytest.fixture
def runs(tmp_path):
    """Files run1 .. run12 of 60, 61, ... samples."""
    rng = np.random.default_rng(1)
    for i in range(12):
        write(tmp_path / f"run{i + 1}.csv", rng.normal(size=(60 + i, 3)))
    return tmp_path / "run*.csv"


def used(data):
    return tuple(
        [r.name if r.name in ("train", "validation", "test") else r.samples for r in records]
        for records in (data.train, data.validation, data.tests)
    )


def test_a_pattern_is_sorted_as_people_count(runs):
    data = load_records(str(runs), **USE, validation=2, test=1)
    assert used(data) == ([*range(60, 69)], [69, 70], ["test"])
    assert [r.name for r in data.train] == [f"run{i}" for i in range(1, 10)]
    assert (data.tests[0].samples, data.tests[0].skip) == (71, 4)
    assert data.name == "run"


def test_fractions_of_every_record(runs):
    data = load_records([str(runs.parent / f"run{i}.csv") for i in (3, 2)], **USE)
    assert [r.samples for r in data.train] == [38, 37]
    assert [(r.samples, r.name) for r in data.tests] == [(62, "run3"), (61, "run2")]


def test_records_by_name_and_by_file(runs):
    first = [runs.parent / f"run{i}.csv" for i in (1, 2, 3, 4)]
    data = load_records(first, **USE, test="run2", validation=["run1", "run3"])
    assert used(data) == (["train"], [60, 62], ["test"])
    own = str(runs.parent / "run1[012].csv")
    data = load_records(first, **USE, test=own, validation=str(first[1]))
    assert used(data) == ([60, 62, 63], ["validation"], [69, 70, 71])
    assert [r.name for r in data.tests] == ["run10", "run11", "run12"]
    data = load_records(first[0], **USE, test=own, validation=0.5)
    assert [r.samples for r in (*data.train, *data.validation)] == [30, 60]


def test_all_records_are_tests(runs):
    assert used(load_records(str(runs), **USE, test="all")) == ([], [], [*range(60, 72)])


def test_equal_names_get_their_folders(tmp_path, signals):
    paths = [write(tmp_path / folder / "x.csv", signals) for folder in "abc"]
    data = load_records(paths[:2], **USE, test=0)
    assert [r.name for r in data.train] == ["a_x", "b_x"]
    assert data.name == "x"
    data = load_records(paths[:2], **USE, test=[paths[2], paths[1]], validation=0)
    assert [r.name for r in data.tests] == ["x", "b_x"]


def test_files_that_do_not_belong_together(tmp_path, signals):
    a = write(tmp_path / "a.csv", signals)
    t = np.arange(SAMPLES)[:, None]
    for name, table, header, use, match in (
        ("b", signals, "u1,v,y", USE, r"b\.csv' has no column 'u2'.*'.*a\.csv' has it"),
        ("c", signals, "u1 (N),u2,y", USE, r"inputs of .*c\.csv' are u1 \(N\), u2.*a\.csv' u1, u2"),
        ("d", np.hstack([t, signals[:, 1:]]), "t,u,y", TIMED, "sampled at 1 Hz.*at 10 Hz"),
    ):
        if use is TIMED:
            write(a, np.hstack([t / 10, signals[:, 1:]]), "t,u,y")
        refused(match, [a, write(tmp_path / f"{name}.csv", table, header)], use=use)


def test_refused_uses(runs):
    pattern = str(runs.parent / "run[123].csv")
    refused("test=3 takes the last 3 of the 3 record", pattern, test=3)
    refused("validation=2 .* of the 2 record", pattern, test=1, validation=2)
    refused("test is 1.5; give a fraction below 1", pattern, test=1.5)
    refused("'run99'.*neither a file nor one of the records: run1, run2", pattern, test="run99")
    refused("'run3', which has a use already", pattern, test="run3", validation="run3")
    refused("'run3', which has a use already", pattern, test=str(runs.parent / "run3.csv"),
            validation="run3")  # fmt: skip
    refused("leave no record for training", pattern, test=pattern)
    refused("no file '.*run99.csv'; there is", pattern, FileNotFoundError,
            test=str(runs.parent / "run99.csv"))  # fmt: skip


# --- time stamps ----------------------------------------------------------------------------


@pytest.mark.numeric
@pytest.mark.parametrize(
    ("t", "fs"),
    [
        (np.arange(300) / 750, 750.0),
        (np.round(np.arange(3000) / 750, 3), 750.0),
        (5e4 + np.round(np.arange(300) / 1000, 3), 1000.0),
        ((np.arange(300) / 1000).astype(np.float32), 1000.0),
        (np.arange(300) * 2**14 / 1e7, 610.3515625),
        (np.arange(300) * 60.0, 1 / 60),
        (1.7e9 + np.round(np.arange(300) / 128, 4), 128.0),
    ],
)
def test_sampling_frequency_of_time_stamps(tmp_path, t, fs):
    values = timed(tmp_path / "a.csv", t)
    data = load_records(tmp_path / "a.csv", **TIMED)
    assert data.train[0].fs == pytest.approx(fs, rel=1e-12)
    assert np.array_equal(joined(data.tests[0]), values)
    load_records(tmp_path / "a.csv", **TIMED, fs=fs)


@pytest.mark.numeric
def test_dates_and_units_of_time(tmp_path, signals):
    stamps = pd.date_range("2024-12-31T23:59:58", periods=SAMPLES, freq="20ms")
    table = pd.DataFrame(signals, columns=["u1", "u2", "y"])
    table.assign(t=stamps.map(lambda stamp: stamp.isoformat())).to_csv(tmp_path / "a.csv")
    timed = np.hstack([signals, 20 * np.arange(SAMPLES)[:, None]])
    write(tmp_path / "b.csv", timed, "u1,u2,y,t (ms)")
    for name, time in (("a.csv", "t"), ("a.csv", None), ("b.csv", "t")):
        data = load_records(
            tmp_path / name, inputs=["u1", "u2"], outputs="y", time=time, start="zero"
        )
        assert data.train[0].fs == 50.0
        assert np.array_equal(joined(data.tests[0]), signals)


@pytest.mark.numeric
def test_refused_time(tmp_path):
    path = tmp_path / "a.csv"
    even = np.arange(300) / 100
    timed(path, even)
    refused("fs is 1000 Hz and the time column 't' of .* says 100 Hz", path, use=TIMED, fs=1000)
    refused("time is 'u', which|stands twice", path, use=TIMED, time="u")
    refused("no column 'time', named in time", path, use=TIMED, time="time")
    timed(path, np.concatenate([even[:150], even[100:]]))
    message = refused("'t' does not rise: 1.49 s is followed by 1 s, at line 152", path, use=TIMED)
    assert "cut the file there" in message
    timed(path, np.concatenate([even[:150], even[125:] * 2]))
    refused(r"time stamps have 1 gap\(s\) of 49 sample", path, use=TIMED)


def smooth(path, t, *, decimals: int = 9):
    """A file of the columns t, u and y that are slow waves over time, seen at ``t``."""
    u, y = np.sin(t), np.cos(1.3 * t)
    write(path, np.column_stack([np.round(t, decimals), u, y]), "t,u,y")
    return path


@pytest.mark.numeric
@pytest.mark.parametrize("use", [BARE, TIMED, BARE | {"fs": 100.0}, TIMED | {"fs": 100.0}])
def test_uneven_times_are_put_on_an_even_grid(tmp_path, use):
    rng, k = np.random.default_rng(0), np.arange(900)
    for t in (
        (k + rng.uniform(-0.3, 0.3, 900) * (k > 0)) / 100,
        np.delete(k + rng.uniform(-0.2, 0.2, 900) * (k > 0), [300, 301, 500]) / 100,
    ):
        data = load_records(smooth(tmp_path / "a.csv", t), **use, test="all")
        (record,) = data.tests
        assert record.fs == pytest.approx(100.0, rel=2e-3)
        at = np.arange(record.samples) / record.fs
        assert np.abs(joined(record) - np.c_[np.sin(at), np.cos(1.3 * at)]).max() < 2e-3
        (note,) = [note for note in data.notes if "even times of" in note]
        assert "the time column 't' is not evenly spaced: its steps go from" in note
    assert record.valid is not None  # nothing was measured where samples are lost
    assert 3 <= (~record.valid).sum() <= 5


def test_a_rate_behind_the_file_is_that_of_the_record(tmp_path):
    path = smooth(tmp_path / "a.csv", np.arange(900) / 100)
    uses: list[dict[str, Any]] = [BARE, TIMED, BARE | {"fs": 100.0}]
    for use in uses:
        data = load_records(f"{path}#25Hz", **use, test="all")
        assert (data.tests[0].fs, data.tests[0].samples, data.name) == (25.0, 225, "a_25Hz")
        assert np.allclose(joined(data.tests[0]), joined(load_records(path, **use,
                           test="all").tests[0])[::4], atol=1e-12)  # fmt: skip
        assert any("interpolated to even times of 25 Hz" in note for note in data.notes)
    write(path, np.random.default_rng(0).normal(size=(300, 2)), "u,y")
    assert load_records(f"{path}#0.5kHz", **BARE, fs=1e3, test="all").tests[0].samples == 150


def test_rounded_and_odd_stamps_keep_their_samples(tmp_path):
    path, k = tmp_path / "a.csv", np.arange(300)
    for t, fs, rows in (
        (np.floor(k / 4), 4.0, k),
        (np.floor(k * 0.05 / 0.135) * 0.135, 20.0, k),  # ticks of a coarse clock
        (np.r_[0, 0.003 + k[:-1] / 50], 50.0, k[1:]),
        (np.r_[0, 3 + k[:-1] / 50], 50.0, k[1:]),
        (np.sort(np.r_[k[:-1], 100]) / 50, 50.0, np.delete(k, 101)),
    ):
        values = timed(path, t)
        data = load_records(path, **TIMED, test="all")
        assert data.tests[0].fs == pytest.approx(fs, rel=0.01)
        assert np.array_equal(joined(data.tests[0]), values[rows])
        assert len(data.notes) == (len(rows) < 300 and t[1] < 1)


def test_no_sampling_frequency(tmp_path):
    path = tmp_path / "a.csv"
    count = np.arange(300.0)[:, None]
    both = np.hstack([count, count / 20, np.cos(count), np.sin(count)])
    write(path, both, "n,x,u,y")
    data = load_records(path, **BARE)
    assert data.train[0].fs == 20.0
    assert data.notes[0] == "the column 'x' is taken for the time, 20 Hz"
    seen = look_at(open_table(path), "u", "y")  # a first look has the same rule
    assert (seen.fs, seen.notes) == (20.0, ["the column 'x' is taken for the time, 20 Hz"])
    write(path, both[:, [0, 2, 3]], "n,u,y")
    refused(r"is not known; give fs=HZ\.$", path, use=BARE)
    write(path, both[:, [3, 2, 3]], "t,u,y")
    refused(r"give fs=HZ; the column 't' does not rise", path, use=BARE)


def test_a_column_that_is_named_as_time_is_the_time(tmp_path):
    path = tmp_path / "a.csv"
    count = np.arange(300.0)[:, None]
    signals = np.random.default_rng(0).normal(size=(300, 2))
    both = np.hstack([count, count / 7, 50 * count, signals])
    write(path, np.append(both, np.full((20, 5), np.nan), axis=0), "n,v,Time [ms],u,y")
    data = load_records(path, **BARE)
    assert data.train[0].fs == 20.0
    assert data.notes[0] == "the column 'Time' is taken for the time, 20 Hz"
    assert load_records(path, **BARE, fs=20).notes == ()
    write(path, np.delete(both, range(100, 106), axis=0), "n,v,Time [ms],u,y")
    refused(r"1 gap\(s\) of 6 sample\(s\)", path, use=BARE)
    write(path, both[:, [0, 2, 3, 4]], "t,Time [ms],u,y")
    refused("'t' says 1 Hz and the column 'Time' 20 Hz; give the right one", path, use=BARE)
    assert load_records(path, **BARE, time="Time").train[0].fs == 20.0


def test_the_rate_that_an_array_file_says(tmp_path):
    path = tmp_path / "a.mat"
    t, (u, y) = np.arange(300) / 50, np.random.default_rng(0).normal(size=(2, 300))
    scipy.io.savemat(path, {"u": u, "y": y, "Ts": 0.02, "t": np.arange(8.0)})
    data = load_records(path, **BARE)
    assert data.train[0].fs == 50.0
    assert data.notes == ("fs is 50 Hz, as 'Ts' in the file says",)
    (note,) = load_records(path, **BARE, fs=100).notes
    assert note == "fs is 100 Hz and 'Ts' in the file says 50 Hz"
    scipy.io.savemat(path, {"u": u, "y": y, "Ts": 0.02, "t": t})
    assert "'t' is taken for the time, 50 Hz" in load_records(path, **BARE).notes[0]
    scipy.io.savemat(path, {"u": u, "y": y, "Ts": 0.02, "t": 1000 * t})
    refused("the column 't' says 0.05 Hz and 'Ts' 50 Hz; give the right one", path, use=BARE)
    assert load_records(path, **BARE, fs=50).train[0].fs == 50.0


@pytest.mark.data
def test_the_aircraft_as_published(benchmark_root):
    file = benchmark_root / "F16/F16GVT_Files/BenchmarkData/F16Data_FullMSine_Level3.mat"
    if not file.is_file():
        pytest.skip(f"there is no '{file}'")
    for outputs, names in (
        ("Acceleration", ["Acceleration1", "Acceleration2", "Acceleration3"]),
        ("Acceleration[1]", ["Acceleration2"]),
    ):
        data = load_records(file, inputs="Force", outputs=outputs, test=0, start="zero")
        assert [channel.name for channel in data.train[0].outputs] == names
    assert data.train[0].fs == 400.0
    assert data.train[0].period == 8192
    assert data.notes[0] == "fs is 400 Hz, as 'Fs' in the file says"


def test_a_time_column_that_contradicts_is_noted(tmp_path):
    path = tmp_path / "a.csv"
    timed(path, np.arange(300) / 100)
    (note,) = load_records(path, **BARE, fs=1000).notes
    assert note.startswith("fs is 1000 Hz and the column 't' says 100 Hz")
    assert load_records(path, **BARE, fs=100).notes == ()


def lost_and_doubled(path):
    """A whole file at 100 Hz, one of lost rows, one of a doubled row; what they hold."""
    t, k = np.arange(3000) / 100, np.arange(3000)
    values = timed(path / "whole.csv", t)
    lost = np.concatenate([np.arange(a, a + 7) for a in (400, 800, 1200, 1600, 2000, 2400)])
    doubled = np.append(k, 1500)
    for name, kept in (("lost", np.delete(k, lost)), ("doubled", np.sort(doubled))):
        write(path / f"{name}.csv", np.column_stack([t, values])[kept], "t,u,y")
    return values


def test_rows_that_are_lost_are_refused_if_the_rate_is_given_too(tmp_path):
    values = lost_and_doubled(tmp_path)
    use: dict[str, Any] = BARE | {"fs": 100.0, "validation": 0, "test": 0}
    message = refused(r"6 gap\(s\) of 42 sample\(s\) in all", tmp_path / "lost.csv", use=use)
    assert message.endswith("If 't' is not a time, rename it.")
    data = load_records(tmp_path / "lost.csv", **use, gaps="split")
    assert [r.samples for r in data.train] == [400, *[393] * 5, 593]
    assert np.array_equal(joined(data.train[-1]), values[-593:])
    data = load_records(tmp_path / "doubled.csv", **use)
    assert np.array_equal(joined(data.train[0]), values)
    assert "has 1 time stamp(s) twice, the first 15 s, at line 1503" in data.notes[0]
    assert load_records(tmp_path / "whole.csv", **use).notes == ()
    refused(r"6 gap\(s\) of 42", tmp_path / "lost.csv", use=use | {"fs": 1e-1})  # if in ms
    use["fs"] = 77.0
    message = load_records(tmp_path / "lost.csv", **use).notes[0]
    assert message.startswith("fs is 77 Hz and the column 't' says 100 Hz")


def test_a_column_beside_a_rate_that_is_given_may_be_no_time(tmp_path):
    path, t = tmp_path / "a.csv", np.arange(300) / 100
    use: dict[str, Any] = BARE | {"fs": 100.0}
    timed(path, np.random.default_rng(0).normal(size=300))  # some other t
    assert load_records(path, **use).notes == ()
    table = np.column_stack([t, timed(path, t)])
    table[299, 0] = np.nan  # as a row of means has none
    write(path, table, "t,u,y")
    assert load_records(path, **use).notes == ()


def test_a_unit_of_time_that_is_assumed_is_said(tmp_path):
    path = tmp_path / "a.csv"
    values = timed(path, 1.7e12 + 10 * np.arange(300))
    write(path, np.column_stack([1.7e12 + 10 * np.arange(300), values]), "stamp,u,y")
    data = load_records(path, **BARE, time="stamp")
    assert data.train[0].fs == 100.0
    (note,) = data.notes
    assert note.endswith("'stamp' is taken for the time in milliseconds since 1970, 100 Hz")
    write(path, np.column_stack([np.arange(300) / 100, values]), "t [Ms],u,y")
    refused("the column 't .Ms.' has the unit 'Ms', which is not a unit of time", path,
            use=BARE)  # fmt: skip


def test_sheets_are_records(tmp_path, signals):
    path = tmp_path / "rig.xlsx"
    made = openpyxl.Workbook()
    for name in ("Run 1", "Run 2"):
        sheet = made.create_sheet(name)
        for row in [["Zeit (s)", "u1", "u2", "y"], *np.c_[np.arange(200) / 50, signals].tolist()]:
            sheet.append(row)
    made.save(path)
    use: dict[str, Any] = {"inputs": ["u1", "u2"], "outputs": "y", "start": "zero"}
    data = load_records([f"{path}#Run 1", f"{path}#Run 2"], **use, validation=1, test=0)
    assert [record.name for record in (*data.train, *data.validation)] == ["train", "validation"]
    assert np.allclose(joined(data.train[0]), signals, rtol=1e-14)  # 16 digits are in the file
    assert data.train[0].fs == 50.0
    assert any("the sheet 'Run 1' is read" in note for note in load_records(path, **use).notes)


# --- runs in one file -----------------------------------------------------------------------


def runs_of(path, header: str, names: str, *, timed: bool):
    """Runs one below another; inputs and outputs of each."""
    values = [np.random.default_rng(n).normal(size=(n, 2)) for n in (200, 150, 120)]
    lines = [header]
    for name, each in zip(names, values, strict=True):
        for k, (u, y) in enumerate(each.tolist()):
            lines.append(",".join([name, *[repr(k / 50)] * timed, repr(u), repr(y)]))
    path.write_text("\n".join(lines) + "\n")
    return values


@pytest.mark.parametrize(
    ("header", "fs", "names"),
    [
        ("run,t,u,y", None, "123"),
        ("Trial ID,t,u,y", None, "bc2"),
        ("test,u,y", 50.0, "123"),
        ("file,u,y", 50.0, "b.c"),
        ("gear,t,u,y", None, "123"),  # the time tells
    ],
)
def test_runs_in_one_file_are_records(tmp_path, header, fs, names):
    path = tmp_path / "rig.csv"
    values = runs_of(path, header, names, timed=fs is None)
    use: dict[str, Any] = BARE | {"fs": fs}
    data = load_records(path, **use, test="all")
    assert [record.name for record in data.tests] == [f"rig_{name}" for name in names]
    for record, each in zip(data.tests, values, strict=True):
        assert np.array_equal(joined(record), each)
        assert (record.fs, record.start) == (50.0, "zero")
    (note,) = [note for note in data.notes if "runs" in note]
    assert ": a record each" in note
    cut = load_records(path, **use, validation=0.2, test=0.2)
    assert [len(part) for part in (cut.train, cut.validation, cut.tests)] == [3, 3, 3]
    frames = [pd.DataFrame(each, columns=["u", "y"]) for each in values]
    own = load_records(frames, **BARE, fs=50.0, validation=0.2, test=0.2)
    assert [r.samples for r in cut.train] == [r.samples for r in own.train]
    one = load_records(path, **use, test=f"rig_{names[1]}", validation=0)
    assert np.array_equal(joined(one.tests[0]), values[1])


def test_no_runs_are_guessed(tmp_path):
    path = tmp_path / "a.csv"
    u, y = np.random.default_rng(0).normal(size=(2, 400))
    for header, column in (
        ("gear,u,y", np.repeat([1, 2], 200)),  # no name of a run, and no time
        ("run,u,y", np.repeat([1, 2, 1, 2], 100)),  # not in one stretch each
        ("id,u,y", np.arange(400)),
        ("run,u,y", np.ones(400)),
        ("test,u,y", np.repeat(np.random.default_rng(1).normal(size=2), 200)),
    ):
        write(path, np.column_stack([column, u, y]), header)
        assert [r.samples for r in load_records(path, **BARE, fs=1.0, test="all").tests] == [400]
    write(path, np.column_stack([np.repeat([1, 2], 200), u, y]), "run,u,y")
    data = load_records(path, inputs=["run", "u"], outputs="y", fs=1.0, test="all", start="zero")
    assert len(data.tests) == 1


def test_runs_may_have_gaps_and_end_early(tmp_path):
    path, rng = tmp_path / "rig.csv", np.random.default_rng(0)
    t = [np.arange(200) / 50, np.delete(np.arange(300), range(100, 110)) / 50, np.arange(5) / 50]
    table = [np.c_[np.full(len(each), i), each, rng.normal(size=(len(each), 2))]
             for i, each in enumerate(t)]  # fmt: skip
    write(path, np.concatenate(table), "run,t,u,y")
    refused(r"1 gap\(s\) of 10 sample\(s\) in all, the first before line 302", path, use=BARE)
    data = load_records(path, **BARE, gaps="split", test="all")
    assert [r.name for r in data.tests] == ["rig_0", "rig_1_1", "rig_1_2"]
    assert [r.start for r in data.tests] == ["zero", "zero", "estimated"]
    assert "rig_2: left out, as it is too short" in data.notes
    other = np.c_[np.full(100, 3), np.arange(100) / 25, rng.normal(size=(100, 2))]
    write(path, np.concatenate([table[0], other]), "run,t,u,y")
    refused("run 3 is sampled at 25 Hz and the longest at 50 Hz; 'rig.csv#50Hz'", path, use=BARE)
    data = load_records(f"{path}#50Hz", **BARE, test="all")
    assert [r.samples for r in data.tests] == [200, 199]


# --- gaps -----------------------------------------------------------------------------------


def test_gaps_are_refused_with_their_place(tmp_path):
    path = tmp_path / "a.csv"
    timed(path, np.arange(300) / 100, slice(50, 60))
    turned = TIMED | {"inputs": "y", "outputs": "u"}
    message = refused("10 sample.* in 1 place.*line 52 in column 'y'", path, use=turned)
    assert "gaps='split'" in message
    assert max(map(len, message.replace(str(path), "a.csv").splitlines())) <= 160
    timed(path, np.delete(np.arange(300), [*range(100, 105), *range(200, 206)]) / 100)
    refused(r"2 gap\(s\) of 11 sample\(s\) in all, the first before line 102", path, use=TIMED)
    np.savez(tmp_path / "a.npz", u=np.arange(60.0), y=np.where(np.arange(60) == 7, np.nan, 1))
    refused(r"1 sample.*the first at sample 7 \(from 0\) in column 'y'", tmp_path / "a.npz",
            use={"inputs": "y", "outputs": "u", "fs": 1})  # fmt: skip
    refused("gaps is 'skip'", path, use=TIMED, gaps="skip")


@pytest.mark.parametrize("lost", [[700], [100, 101, 102, 700]])
@pytest.mark.parametrize("use", [BARE, BARE | {"fs": 100.0}, TIMED])
def test_a_few_lost_samples_are_masked_or_split(tmp_path, lost, use):
    path, t = tmp_path / "a.csv", np.arange(900) / 100
    values = timed(path, t)
    kept = np.delete(np.arange(900), lost)
    write(path, np.column_stack([t, values])[kept], "t,u,y")
    data = load_records(path, **use, test="all")
    (record,) = data.tests
    assert record.valid is not None
    assert np.array_equal(np.flatnonzero(~record.valid), lost)
    assert np.array_equal(joined(record)[kept], values[kept])
    (note,) = [note for note in data.notes if "missing between" in note]
    assert note.startswith(
        f"{len(lost)} sample(s) are missing between the others, the first before"
    )
    split = load_records(path, **use, test="all", gaps="split")
    assert sum(record.samples for record in split.tests) == len(kept)
    assert len(split.tests) == 2 if len(lost) == 1 else 3


def test_outputs_without_a_value_are_left_out(tmp_path):
    path = tmp_path / "a.csv"
    values = timed(path, np.arange(300) / 100, slice(50, 60))
    data = load_records(path, **TIMED, validation=0.2, test=0.2)
    (note,) = [note for note in data.notes if "no value" in note]
    assert "10 output sample(s) have no value, the first at line 52 in column 'y'" in note
    (train,), (test,) = data.train, data.tests
    assert train.valid is not None
    assert np.array_equal(np.flatnonzero(~train.valid), np.arange(50, 60))
    assert np.array_equal(train.y[train.valid], values[: train.samples, 1][train.valid[:, 0]])
    assert test.scored.sum() == 60  # simulated from the beginning, so through the gap
    refused("a steady state needs whole periods", path, use=TIMED, start="periodic", period=100)


def test_stretches_between_gaps_are_records(tmp_path):
    path = tmp_path / "rig.csv"
    k = np.delete(np.arange(400), [150, 151])
    values = timed(path, k / 100, slice(60, 63))
    write(path, np.hstack([k[:, None] / 100, values])[:305], "t,u,y")
    text = path.read_text().splitlines()
    text[303] = "," + text[303].split(",", 1)[1]  # a missing time stamp
    path.write_text("\n".join(text))
    data = load_records(path, **TIMED, gaps="split", validation=0, test=0)
    assert [r.name for r in data.train] == ["rig_1", "rig_2", "rig_3"]
    for record, part in zip(data.train, [(0, 60), (63, 150), (150, 302)], strict=True):
        assert np.array_equal(joined(record), values[slice(*part)])
    assert [r.start for r in data.train] == ["zero", "estimated", "estimated"]
    left_out = "rig_4: left out, as it is too short"
    assert data.notes == ("rig: 4 stretches between gaps, a record each", left_out)
    data = load_records(path, **TIMED, gaps="split", validation="rig_2", test=1)
    assert [len(r) for r in (data.train, data.validation, data.tests)] == [1, 1, 1]
    assert data.tests[0].samples == 152
    refused("no run or stretch between gaps is long", path, use=TIMED, gaps="split", skip=148)


def test_a_file_without_values_is_refused(tmp_path):
    path = write(tmp_path / "a.csv", np.c_[np.arange(50), np.full((50, 2), np.nan)], "n,u,y")
    for gaps in ("error", "split"):
        refused("no sample in which all columns", path, use=BARE, fs=1.0, gaps=gaps)


def test_empty_lines_at_the_end_are_no_gap(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)
    path.write_text(path.read_text() + ",,\n" * 5)
    assert load_records(path, **USE).tests[0].samples == SAMPLES


# --- periods --------------------------------------------------------------------------------


def periodic(path, periods, *, settled=False, noise=1e-3, more=0):
    """A file of a resonance under a multisine from rest, or in steady state; u and y."""
    u = np.resize(
        multisine(N, fs=1.0, band=(0.01, 0.4), seed=1).u[0][:, 0], 3 * N + periods * N + more
    )
    y = scipy.signal.lfilter([1.0], [1, -1.6, 0.81], u if settled else u[3 * N :])
    table = np.stack([u[3 * N :], y[3 * N :] if settled else y], axis=1)
    table[:, 1] += noise * np.random.default_rng(0).normal(size=len(table))
    write(path, table, "u,y")
    return table


PERIODIC: dict[str, Any] = {"inputs": "u", "outputs": "y", "fs": 1.0, "start": "zero"}
SAME_INPUT = "the parts of a record have the same input in every period"


@pytest.mark.numeric
def test_period_and_transient_are_found(tmp_path):
    periodic(tmp_path / "a.csv", 5, more=30)
    data = load_records(tmp_path / "a.csv", **PERIODIC)
    assert [(r.skip, r.samples, r.period) for r in data.train] == [(N, 318, N)]
    assert [(r.skip, r.samples, r.period) for r in data.tests] == [(424, 530, N)]
    assert data.notes[0] == (
        "the input repeats every 100 samples, 5.3 times; the first period is the transient and is "
        "not fitted"
    )
    assert data.notes[1].startswith(SAME_INPUT)
    data = load_records(tmp_path / "a.csv", **PERIODIC, period=None)
    assert (data.train[0].skip, data.train[0].period, data.notes) == (26, None, ())
    data = load_records(tmp_path / "a.csv", **PERIODIC, skip=5, validation=0, test=0)
    assert (data.train[0].skip, data.train[0].period) == (5, N)
    assert data.notes == ("the input repeats every 100 samples, 5.3 times",)


@pytest.mark.numeric
@pytest.mark.parametrize("count", [3, 5, 11])
@pytest.mark.parametrize("start", ["zero", "periodic"])
def test_outputs_of_the_test_part_move_nothing_before_it(
    tmp_path, count: int, start: Literal["zero", "periodic"]
):
    table = periodic(tmp_path / "a.csv", count)
    tests = max(1, round(0.2 * (count - 1))) * N if start == "periodic" else round(0.2 * len(table))
    table[-tests:, 1] += np.random.default_rng(1).normal(size=tests) * 10.0
    write(tmp_path / "b.csv", table, "u,y")
    one, other = (
        load_records(tmp_path / name, **begun(PERIODIC, start), validation=0.2 * (count > 3))
        for name in ("a.csv", "b.csv")
    )
    for a, b in zip(one.train + one.validation, other.train + other.validation, strict=True):
        assert (a.skip, a.start, a.period) == (b.skip, b.start, b.period)
        np.testing.assert_array_equal(a.y, b.y)
    assert np.abs(one.tests[0].y - other.tests[0].y).max() > 1.0


@pytest.mark.numeric
def test_a_transient_of_several_periods(tmp_path):
    """A pole of 0.98 takes the response below noise of a thousandth in three to five periods."""
    table = periodic(tmp_path / "a.csv", 12)
    slow = scipy.signal.lfilter([1.0], [1, -0.98], table[:, 0])
    slow += 1e-3 * np.std(slow) * np.random.default_rng(0).normal(size=len(slow))
    write(tmp_path / "a.csv", np.stack([table[:, 0], slow], axis=1), "u,y")
    data = load_records(tmp_path / "a.csv", **PERIODIC)
    count = data.train[0].skip // N
    assert 2 <= count <= 5
    assert f"the first {count} periods are the transient and are not fitted" in data.notes[0]


@pytest.mark.numeric
def test_no_transient_and_one_that_is_most_of_the_record(tmp_path):
    periodic(tmp_path / "a.csv", 2)
    assert load_records(tmp_path / "a.csv", **PERIODIC).train[0].skip == 10
    periodic(tmp_path / "b.csv", 4, settled=True)
    data = load_records(tmp_path / "b.csv", **PERIODIC)
    assert data.notes[0].endswith("settled from the first sample on: use start='periodic'")


@pytest.mark.numeric
def test_no_steady_state_is_advised_for_a_system_that_integrates(tmp_path):
    """Its output repeats if the mean of the input is 0, and would not if it were simulated."""
    u = np.tile(np.random.default_rng(0).standard_normal(N), 5)
    u -= u.mean()
    write(tmp_path / "a.csv", np.stack([u, np.cumsum(u)], axis=1), "u,y")
    notes = load_records(tmp_path / "a.csv", **PERIODIC).notes
    assert notes[0] == f"the input repeats every {N} samples, 5 times"


@pytest.mark.numeric
def test_steady_state_is_cut_to_whole_periods(tmp_path):
    table = periodic(tmp_path / "a.csv", 7, more=40)
    data = load_records(tmp_path / "a.csv", **begun(PERIODIC, "periodic"))
    records = [*data.train, *data.validation, *data.tests]
    assert [(r.start, r.samples, r.period, r.skip) for r in records] == [
        ("periodic", count * N, N, 0) for count in (4, 1, 1)
    ]
    assert np.array_equal(np.concatenate([joined(r) for r in records]), table[N : 7 * N])
    data = load_records(tmp_path / "a.csv", **begun(PERIODIC, "periodic"), skip=30, test=0)
    assert np.array_equal(joined(data.train[0]), table[30 : 6 * N + 30])
    given = load_records(tmp_path / "a.csv", **begun(PERIODIC, "periodic"), period=2 * N, skip=0)
    assert [r.samples for r in (*given.train, *given.tests)] == [2 * N] * 2 or given.train


@pytest.mark.numeric
def test_refused_periods(tmp_path, signals):
    path = tmp_path / "a.csv"
    periodic(path, 3)
    refused("has 2 whole period.* train, validation, test need one each", path, use=PERIODIC,
            start="periodic")  # fmt: skip
    refused("no whole period of 250 samples: 300 samples, of which 100", path, use=PERIODIC,
            start="periodic", period=250, skip=100)  # fmt: skip
    refused("has 300 samples and a period of 301; it must hold at least one", path, use=PERIODIC,
            period=301)  # fmt: skip
    refused("period is 0", path, use=PERIODIC, period=0)
    wanted = "start is 'given'; give 'auto', 'zero', 'estimated', 'periodic' or 'measured'"
    refused(wanted, path, use=PERIODIC, start="given")
    write(path, signals)
    refused("start is 'periodic' and the input of .* does not repeat", path, start="periodic")


# --- how records begin ----------------------------------------------------------------------

AUTO: dict[str, Any] = PERIODIC | {"start": "auto"}


def cut_out(path, before, samples=400, seed=0):
    """A file of a slow resonance from rest, without its first samples; u and y."""
    noise, u = np.random.default_rng(seed).normal(size=(2, samples + before))
    y = scipy.signal.lfilter([1.0], [1, -1.96, 0.9702], u)
    table = np.stack([u, y + 0.03 * y.std() * noise], axis=1)[before:]
    write(path, table, "u,y")
    return table


def starts(data) -> list[tuple[str, int]]:
    return [(r.start, r.skip) for r in (*data.train, *data.validation, *data.tests)]


@pytest.mark.numeric
def test_a_record_in_motion_has_an_estimated_start(tmp_path):
    cut_out(tmp_path / "a.csv", 1000)
    data = decided(load_records(tmp_path / "a.csv", **AUTO))
    assert starts(data) == [("estimated", 0), ("estimated", 240), ("estimated", 320)]
    (note,) = data.notes
    assert "at rest, and by" in note
    assert note.endswith("with an estimated start: start is estimated")


def test_what_does_not_estimate_chooses_no_start(tmp_path, monkeypatch):
    tried = []

    def trial(record):
        tried.append(record)
        return StartTrial(1.0, 0.5)

    monkeypatch.setattr(record_start, "try_starts", trial)
    table = cut_out(tmp_path / "a.csv", 1000)
    decided(load_records(tmp_path / "a.csv", **AUTO))
    assert np.array_equal(tried[0].y[:, 0], table[:320, 1])  # without the part that tests
    skipping = decided(load_records(tmp_path / "a.csv", **AUTO, skip=7, test=0))
    assert np.array_equal(tried[1].y[:, 0], table[:, 1])
    assert starts(skipping) == [("estimated", 7), ("estimated", 320)]
    everything = decided(load_records(tmp_path / "a.csv", **AUTO, test="all"))
    assert (starts(everything), everything.notes) == ([("zero", 20)], ())
    assert len(tried) == 2


@pytest.mark.numeric
def test_a_record_from_rest_has_an_estimated_start_that_does_no_harm(tmp_path):
    cut_out(tmp_path / "a.csv", 0)
    data = decided(load_records(tmp_path / "a.csv", **AUTO, test=0))
    assert starts(data) == [("estimated", 0), ("estimated", 320)]
    assert data.notes[0].endswith("no harm at rest either: start is estimated")


@pytest.mark.parametrize(
    ("resting", "others"), [(["run1", "run3"], "estimated"), (["run0", "run1", "run2"], "zero")]
)
def test_each_record_begins_by_itself_and_those_not_tried_as_all_that_are(
    tmp_path, signals, monkeypatch, resting: list[str], others: str
):
    tried = []

    def trial(record):
        tried.append(record.name)
        return StartTrial(0.5 if record.name in resting else 1.0, 1.0)

    monkeypatch.setattr(record_start, "try_starts", trial)
    for name in ("run0", "run1", "run2", "run3", "run4", "test"):
        write(tmp_path / f"{name}.csv", signals)
    use = USE | {"start": "auto", "validation": 1, "test": tmp_path / "test.csv"}
    read = load_records(tmp_path / "run*.csv", **use)
    assert not tried  # a file that is read is not fitted
    assert [r.start for r in read.train] == ["estimated"] * 4
    data = decided(read)
    assert not data.undecided
    wanted = ["zero" if f"run{i}" in resting else "estimated" for i in range(3)]
    assert [r.start for r in data.train] == [*wanted, others]
    # What does not train tells by itself where it begins, in the samples that a score leaves out.
    assert [r.start for r in (*data.validation, *data.tests)] == ["estimated", "estimated"]
    assert data.notes[-1] == f"start is {others} for the records after the first 3, too"
    assert tried == ["run0", "run1", "run2"]


def test_parts_of_a_record_from_rest_begin_with_it(tmp_path, monkeypatch):
    monkeypatch.setattr(record_start, "try_starts", lambda _: StartTrial(0.5, 1.0))
    cut_out(tmp_path / "a.csv", 0)
    data = decided(load_records(tmp_path / "a.csv", **AUTO))
    assert starts(data) == [("zero", 20), ("zero", 240), ("zero", 320)]
    run = Settings(nx=1, nz=1, nn=2, trainer=LevenbergMarquardt(max_iter=1))
    found = identify(load_records(tmp_path / "a.csv", **AUTO), run)
    assert starts(found.dataset) == starts(data)
    assert found.dataset.notes == data.notes


@pytest.mark.numeric
def test_whole_periods_in_steady_state_are_periodic(tmp_path):
    periodic(tmp_path / "a.csv", 4, settled=True)
    data = load_records(tmp_path / "a.csv", **AUTO)
    assert starts(data) == [("periodic", 0)] * 3
    assert data.notes[0].endswith("settled from the first sample on: start is periodic")
    # A part without a whole period, a part of a period, a transient, samples without a value:
    few = load_records(tmp_path / "a.csv", **AUTO, validation=0.5, test=0.4)
    assert starts(few)[0][0] != "periodic"
    assert few.notes[0].endswith("use start='periodic'")
    table = periodic(tmp_path / "a.csv", 5, settled=True, more=30)
    assert starts(load_records(tmp_path / "a.csv", **AUTO))[0][0] != "periodic"
    table = table[:500]
    table[5, 1] = np.nan
    write(tmp_path / "a.csv", table, "u,y")
    assert starts(load_records(tmp_path / "a.csv", **AUTO))[0][0] != "periodic"
    periodic(tmp_path / "a.csv", 5)
    data = decided(load_records(tmp_path / "a.csv", **AUTO))
    assert starts(data)[0] == ("zero", N)  # the transient is left out, and tells enough
    assert not any("at rest, and by" in note for note in data.notes)


def test_a_record_that_tells_nothing_is_from_rest(tmp_path):
    cut_out(tmp_path / "a.csv", 1000, samples=30)
    write(tmp_path / "b.csv", np.ones((100, 2)), "u,y")
    for name in "ab":
        data = decided(load_records(tmp_path / f"{name}.csv", **AUTO, validation=0, test=0))
        assert data.train[0].start == "zero"
        assert data.notes == ("start is zero: too little data or excitation to compare starts",)


@pytest.mark.numeric
def test_gaps_and_references_hinder_no_choice(tmp_path, monkeypatch):
    table = cut_out(tmp_path / "a.csv", 1000)
    table = np.hstack([table, table[:, :1]])
    table[300, 1] = np.nan
    write(tmp_path / "a.csv", table, "u,y,r")
    data = decided(load_records(tmp_path / "a.csv", **AUTO, reference="r", test=0))
    assert data.train[0].start == "estimated"
    tried = []
    trial = StartTrial(1.0, 0.5)
    monkeypatch.setattr(record_start, "try_starts", lambda r: tried.append(r.samples) or trial)
    data = decided(load_records(tmp_path / "a.csv", **AUTO, gaps="split", test=0))
    assert tried == [300]  # the samples before the gap
    assert [r.start for r in data.train] == ["estimated"] * 2


# --- what is refused ------------------------------------------------------------------------


def test_refused_arguments(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)
    other = write(tmp_path / "b.csv", signals, "v1,v2,y")
    refused(r"inputs is None.*'v1', 'v2', 'y'", other, inputs=None)
    refused(r"outputs is \[\]", path, outputs=[])
    refused(r"names of columns or their numbers", path, inputs=[1.5])
    refused("fs is 0; give a positive number", path, fs=0)
    refused("'u2' stands twice", path, outputs=["y", "u2"])
    refused("'u1' stands twice", path, inputs=["u1", 0])
    refused("no column 'v', named in inputs; .*'u1', 'u2', 'y'", path, inputs="v")
    refused("no column number 3.*'u1', 'u2', 'y'", path, outputs=3)
    refused("skip is -1", path, skip=-1)
    refused("has 0 scored samples of 200, with skip=300", path, skip=300)


def test_refused_parts(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)
    refused("fractions are validation=", path, validation=0.5, test=0.5)
    for validation, test, bad in ((-0.1, 0.2, "-0.1"), (0.2, np.nan, "nan"), (0.2, True, "True")):
        refused(f"is {bad}; give a number", path, validation=validation, test=test)
    refused("validation is .*; give ", path, validation=[1, 2])
    refused("test is .*; give ", path, test=[1, 2])
    for units in ("N", -1):
        refused("units is .*; give ", path, units=units)
    refused("the test part has 8 scored samples of 200", path, test=0.04)
    refused("the validation part has 8 scored", path, validation=0.04)
    refused("the train part has 4 scored", path, validation=0.49, test=0.49, skip=0)
    refused("the train part has 9 scored samples of 200, with skip=111", path, skip=111)
    load_records(path, **USE, skip=110)  # exactly the ten samples that are needed


def test_refused_paths(tmp_path):
    assert "absent.csv" in refused("no file", tmp_path / "absent.csv", FileNotFoundError)
    refused("is a folder; name a file", tmp_path)
    refused("path is None; give the path of a file", None)
    refused("path is []".replace("[", r"\["), [])
    refused(r"no file matches '.*run\*\.csv'", str(tmp_path / "run*.csv"), FileNotFoundError)


def test_refused_values(tmp_path, signals):
    path = write(tmp_path / "a.csv", signals)
    path.write_text(path.read_text().replace(repr(float(signals[7, 1])), "-inf"))
    refused("1 infinite value.*line 9 in column 'u2'", path)
    path.write_text("u1,u2,y\n" + ",2,3\n" * 50)
    refused("50 sample.*missing values", path)
    refused("no sample in which all columns have a value", path, gaps="split")


# --- measurements ---------------------------------------------------------------------------


@pytest.mark.data
def test_cascaded_tanks_as_a_spreadsheet(tmp_path, benchmark_root):
    """The benchmark's own file, its estimation and validation signals as two files of Excel."""
    path = benchmark_root / "Cascaded_Tanks/CascadedTanksFiles/dataBenchmark.mat"
    if not path.is_file():
        pytest.skip(f"no file '{path}'")
    found = scipy.io.loadmat(path, squeeze_me=True)
    ts = float(found["Ts"])
    for name, part in (("estimation", "Est"), ("test", "Val")):
        columns = {"t [s]": ts * np.arange(1024), "u (V)": found[f"u{part}"]}
        table = pd.DataFrame(columns | {"y (V)": found[f"y{part}"]})
        how: dict[str, Any] = {"sep": ";", "decimal": ",", "index": False, "encoding": "utf-16"}
        table.to_csv(tmp_path / f"{name}.csv", **how)
    use: dict[str, Any] = TIMED | {"start": "estimated", "test": tmp_path / "test.csv"}
    data = load_records(tmp_path / "estimation.csv", **use)
    assert data.train[0].fs == pytest.approx(1 / ts)
    assert np.array_equal(data.validation[0].u[:, 0], found["uEst"])
    assert np.array_equal(data.tests[0].y[:, 0], found["yVal"])
    assert data.tests[0].outputs == (Channel("y", "V"),)


@pytest.mark.data
def test_silverbox_in_matlab_and_text(tmp_path, benchmark_root):
    path = benchmark_root / "Silverbox/SilverboxFiles/SNLS80mV.mat"
    if not path.is_file():
        pytest.skip(f"no file '{path}'")
    found = scipy.io.loadmat(path, squeeze_me=True)
    use: dict[str, Any] = {"fs": 1e7 / 2**14, "period": None, "start": "zero"}
    data = load_records(path, inputs="V1", outputs="V2", **use)
    np.savetxt(
        tmp_path / "a.txt", np.stack([found["V1"], found["V2"]], axis=1)[:2000], header="V1 V2",
        fmt="%.17g",
    )  # fmt: skip
    text = load_records(tmp_path / "a.txt", inputs="V1", outputs="V2", **use)
    assert Path(path).stem == data.name
    assert np.array_equal(data.tests[0].y[:, 0], found["V2"])
    assert np.array_equal(text.tests[0].y, data.tests[0].y[:2000])


def test_columns_that_are_not_used_are_looked_at_together(tmp_path, monkeypatch):
    signals = np.random.default_rng(0).normal(size=(50, 200))
    write(tmp_path / "a.csv", signals, ",".join(f"c{i}" for i in range(200)))
    passes, blocks = [], TextTable.blocks

    def counted(table: TextTable, *given: Any) -> Any:
        passes.append(given)
        return blocks(table, *given)

    monkeypatch.setattr(TextTable, "blocks", counted)
    with pytest.raises(ValueError, match="give fs=HZ"):
        load_records(tmp_path / "a.csv", inputs="c0", outputs="c1", start="zero")
    assert len(passes) == 1


def test_a_column_of_dates_is_the_time_whatever_its_name(tmp_path, signals):
    stamps = pd.date_range("2024-12-31T23:59:58", periods=SAMPLES, freq="1s")
    table = pd.DataFrame(signals, columns=["u1", "u", "y"])
    table.assign(begun=stamps.map(lambda stamp: stamp.isoformat())).to_csv(tmp_path / "a.csv")
    data = load_records(tmp_path / "a.csv", **BARE, test="all")
    assert data.notes[0] == "the column 'begun' is taken for the time, 1 Hz"
    assert look_at(open_table(tmp_path / "a.csv"), "u", "y").notes == [data.notes[0]]


def test_a_clock_among_columns_of_text_is_the_time(tmp_path):
    lines = [f"a,{0.01 * i:.2f},b,{i % 7},{i % 5}" for i in range(50)]
    (tmp_path / "a.csv").write_text("\n".join(["x,clock,z,u,y", *lines]))
    data = load_records(tmp_path / "a.csv", **BARE)
    assert data.notes[0] == "the column 'clock' is taken for the time, 100 Hz"


def test_a_line_may_have_thousands_of_cells(tmp_path):
    row = np.arange(14_000.0)
    names = ",".join(f"signal {i}" for i in range(len(row)))
    assert len(names) > csv.field_size_limit()
    write(tmp_path / "a.csv", np.tile(row, (60, 1)) + np.arange(60)[:, None] % 3, names)
    data = load_records(
        tmp_path / "a.csv", inputs="signal 0", outputs="signal 13999", fs=1.0, start="zero"
    )
    assert data.train[0].y[2] == row[-1] + 2
