"""Data frames of pandas: as records, as measurements, as inputs of a model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from reference import random_cell, random_model

import lfrtorch
from lfrtorch import InputError, Record

pytestmark = pytest.mark.numeric

T, FS = 400, 50.0
U = np.random.default_rng(0).normal(size=T)
Y = np.convolve(U, [0.0, 0.5, 0.3, 0.1])[:T]


def frame(**index: object) -> pd.DataFrame:
    return pd.DataFrame({"force (N)": U, "disp/mm": Y, "note": "x"}, **index)  # pyright: ignore[reportArgumentType]


STAMPS = pd.date_range("2026-01-05 08:00", periods=T, freq="20ms")


@pytest.mark.parametrize(
    "index",
    [STAMPS, STAMPS - STAMPS[0], pd.Index(np.arange(T) / FS), pd.Index(3.0 + np.arange(T) / FS)],
)
def test_the_index_tells_the_rate(index: pd.Index):
    record = Record.from_frame(frame(index=index), ["force"], ["disp"], skip=7, name="run")
    assert record.fs == pytest.approx(FS)
    assert [str(c) for c in (*record.inputs, *record.outputs)] == ["force (N)", "disp (mm)"]
    np.testing.assert_array_equal(record.u[:, 0], U)
    assert (record.skip, record.name) == (7, "run")
    loaded = lfrtorch.load_records(frame(index=index), inputs="force", outputs="disp", start="zero")
    assert loaded.train[0].fs == pytest.approx(FS)
    assert str(loaded.train[0].outputs[0]) == "disp (mm)"
    assert (loaded.name, len(loaded.tests)) == ("frame", 1)


@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_a_column_of_date_times_tells_the_rate(zone: str | None):
    """Date-times were read as nanoseconds since 1970."""
    given = frame().assign(when=STAMPS.tz_localize(zone))
    loaded = lfrtorch.load_records(given, inputs="force", outputs="disp", start="zero")
    assert loaded.train[0].fs == pytest.approx(FS)
    assert loaded.notes == ("the column 'when' is taken for the time, 50 Hz",)


def test_rows_that_only_count_need_a_rate():
    with pytest.raises(InputError, match="index is not a time; give fs=HZ"):
        Record.from_frame(frame(), "force", "disp")
    assert Record.from_frame(frame(), "force (N)", "disp/mm", 20.0).fs == 20.0
    with pytest.raises(InputError, match="sampling frequency of 'frame' is not known"):
        lfrtorch.load_records(frame(), inputs="force", outputs="disp")
    two = lfrtorch.load_records([frame(), frame()], inputs="force", outputs="disp", fs=FS, test=1)
    assert [record.name for record in (*two.train, *two.validation, *two.tests)] == [
        "train", "validation", "test",
    ]  # fmt: skip


def test_what_is_wrong_with_a_frame_is_said():
    with pytest.raises(
        InputError, match=r"index has a gap before row 200; load_records\(df, inputs"
    ):
        Record.from_frame(frame(index=STAMPS).drop(STAMPS[200:210]), "force", "disp")
    with pytest.raises(InputError, match="the frame has no column 'power', of the inputs; it has"):
        Record.from_frame(frame(index=STAMPS), "power", "disp")
    with pytest.raises(InputError, match="the column 'note' has no numbers"):
        Record.from_frame(frame(index=STAMPS), "force", "note")
    with pytest.raises(InputError, match="fs is 10 Hz and the frame's index says 50 Hz"):
        Record.from_frame(frame(index=STAMPS), "force", "disp", 10.0)
    twice = pd.concat([frame(index=STAMPS)] * 2, axis=1)
    with pytest.raises(InputError, match=r"the frame has 2 columns 'force \(N\)', of the inputs"):
        Record.from_frame(twice, "force (N)", "disp/mm")
    with pytest.raises(InputError, match="index is not a time; give fs=HZ"):
        Record.from_frame(frame(index=STAMPS).iloc[:0], "force", "disp")
    with pytest.raises(InputError, match="give a pandas DataFrame"):
        Record.from_frame(U, "force", "disp")
    with pytest.raises(InputError, match=r"DataFrame; lfrtorch.load_records\(df, inputs"):
        lfrtorch.identify(frame(), lfrtorch.Settings(nx=1))  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"trainer=lfrtorch.LevenbergMarquardt\(max_iter=10\)"):
        lfrtorch.Settings(nx=1, max_iter=10)  # pyright: ignore[reportCallIssue]


@pytest.mark.parametrize("dates", [False, True])
def test_an_uneven_index_is_interpolated_to_a_rate_that_is_given(dates: bool):
    t = np.arange(T) / FS
    t[1:] += np.random.default_rng(0).uniform(-0.3, 0.3, T - 1) / FS
    index = pd.Index(t)
    if dates:
        index = pd.Timestamp("2026-01-05") + pd.to_timedelta(t, unit="s")
    some = pd.DataFrame({"u": np.sin(t), "y": np.cos(t)}, index=index)
    with pytest.raises(InputError, match=r"not evenly spaced.*; fs=50 interpolates the signals to"):
        Record.from_frame(some, "u", "y")
    record = Record.from_frame(some, "u", "y", fs=FS)
    at = np.arange(record.samples) / FS
    assert np.abs(record.u[:, 0] - np.sin(at)).max() < 1e-3
    assert record.fs == FS
    loaded = lfrtorch.load_records(some, inputs="u", outputs="y", test="all")
    assert "signals are interpolated to even times of 50 Hz" in loaded.notes[1]
    np.testing.assert_array_equal(loaded.tests[0].u, record.u)
    np.testing.assert_array_equal(loaded.tests[0].y, record.y)
    lost = frame(index=STAMPS).drop(STAMPS[[100, 101, 300]])
    with pytest.raises(InputError, match=r"lacks 3 sample\(s\); fs=50 interpolates"):
        Record.from_frame(lost, "force", "disp")
    record = Record.from_frame(lost, "force", "disp", fs=FS)
    assert record.valid is not None
    assert np.flatnonzero(~record.valid).tolist() == [100, 101, 300]
    np.testing.assert_array_equal(record.y[record.valid], np.delete(Y, [100, 101, 300]))


def test_infinite_values_are_none():
    some = frame(index=STAMPS)
    some.iloc[5, 1] = np.inf
    with pytest.raises(InputError, match="'disp/mm' is infinite in row 5; correct it, or leave"):
        Record.from_frame(some, "force", "disp")
    with pytest.raises(InputError, match="infinite value"):
        lfrtorch.load_records(some, inputs="force", outputs="disp")


def test_runs_in_one_frame_are_records():
    each = frame(index=pd.Index(np.arange(T) / FS))
    both = pd.concat([each, each.iloc[:300]])
    numbered = both.reset_index(drop=True).assign(Run=["one"] * T + ["two"] * 300)
    for some, told, fs in ((both, "the index begins again", None), (numbered, "'Run' says", FS)):
        with pytest.raises(InputError, match=rf"has 2 runs, as .*{told}; .*load_records\(df"):
            Record.from_frame(some, "force", "disp", fs)
        data = lfrtorch.load_records(some, inputs="force", outputs="disp", fs=fs, test="all")
        assert [record.samples for record in data.tests] == [T, 300]
        np.testing.assert_array_equal(data.tests[1].y[:, 0], Y[:300])
    assert [record.name for record in data.tests] == ["frame_one", "frame_two"]
    first = Record.from_frame(numbered[numbered.Run == "one"], "force", "disp", FS)
    np.testing.assert_array_equal(first.y[:, 0], Y)


def test_outputs_without_a_value_are_left_out():
    some = frame(index=STAMPS)
    some.iloc[5:9, 1] = np.nan
    record = Record.from_frame(some, "force", "disp")
    assert record.valid is not None
    assert (~record.valid).sum() == 4


def test_a_model_simulates_a_frame():
    model = random_model(random_cell(2, 2, 3, 2, 1, 4), fs=FS)
    u = np.random.default_rng(1).normal(size=(T, 2))
    inputs = pd.DataFrame({"other": U, "u2 (V)": u[:, 1], "u1": u[:, 0]}, index=STAMPS)
    found: Any = model.simulate(inputs)
    assert list(found.columns) == ["y1", "y2"]
    assert found.index.equals(STAMPS)
    np.testing.assert_array_equal(found.to_numpy(), model.simulate(u))
    with pytest.raises(InputError, match="no column 'u1', of the model's inputs"):
        model.simulate(inputs.drop(columns="u1"))
    jitter = pd.Index(np.arange(T) / FS + 0.006 * np.sin(np.arange(T) ** 2))
    with pytest.raises(InputError, match=r"not an even time; Record.from_frame\(df, ..., fs=50\)"):
        model.simulate(inputs.set_axis(jitter))
    with pytest.raises(InputError, match="fs is 50 Hz and the frame's index says 25 Hz"):
        model.simulate(inputs.iloc[::2])


def test_a_record_is_cut_as_a_file_is():
    record = Record.from_frame(frame(index=STAMPS), "force", "disp", name="mine")
    trainer = lfrtorch.LevenbergMarquardt(max_iter=3)
    settings = lfrtorch.Settings(nx=2, nz=1, nn=2, trainer=trainer)
    run = lfrtorch.identify(record, settings, observer=lfrtorch.Observer())
    assert run.dataset.name == "mine"
    cut = [run.dataset.train[0], run.dataset.validation[0], run.dataset.tests[0]]
    assert [(r.name, r.scored_samples) for r in cut] == [
        ("train", 240), ("validation", 80), ("test", 80),
    ]  # fmt: skip
    several = lfrtorch.identify([record, record], settings, observer=lfrtorch.Observer())
    assert len(several.dataset.tests) == 2
