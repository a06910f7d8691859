"""What a record takes, what it refuses, and the scaling of its signals."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from lfrtorch.data.records import (
    Channel,
    Record,
    Scaler,
    as_records,
    rms_scale,
    with_past_outputs,
    without_coordinates,
)
from lfrtorch.fitting.first_fit import part_of
from lfrtorch.fitting.refit import all_records
from lfrtorch.fitting.windows import windows, windows_from_outputs

U, Y = np.linspace(-1, 1, 20).reshape(10, 2), np.linspace(3, 4, 10)


def refused(message: str, **given):
    with pytest.raises(ValueError, match=re.escape(message)) as told:
        Record(**{"u": U, "y": Y, "name": "lab"} | given)
    assert "record 'lab'" in str(told.value)


def lab(**given) -> Record:
    return Record(**{"u": U, "y": Y, "name": "lab"} | given)


# --- what it takes --------------------------------------------------------------------------


def test_one_dimensional_array_is_one_channel():
    record = Record(np.array([1, 2, 3]), np.array([4, 5, 6]))
    assert record.u.shape == record.y.shape == (3, 1)
    assert record.u.dtype == np.float64
    assert record.samples == 3


def test_defaults():
    record = Record(U, Y)
    assert (record.fs, record.start, record.skip, record.source) == (1.0, "zero", 0, "file")
    assert record.inputs == (Channel("u1"), Channel("u2"))
    assert record.outputs == (Channel("y"),)


def test_channels_are_named_with_their_units():
    record = Record(U, Y, inputs=(Channel("force", "N"), Channel("valve")))
    assert [str(c) for c in record.inputs] == ["force (N)", "valve"]


def test_arrays_are_frozen_copies():
    u, y = U.copy(), Y.copy()
    record = Record(u, y)
    u[0], y[0] = 99.0, 99.0  # the caller's arrays stay writable
    assert np.array_equal(record.u, U)
    assert np.array_equal(record.y[:, 0], Y)
    for signal in (record.u, record.y):
        with pytest.raises(ValueError, match="read-only"):
            signal[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        record.fs = 2.0  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("dtype", [bool, np.int16, np.uint8, np.float32])
def test_any_real_type_becomes_float64(dtype):
    record = Record(np.ones(4, dtype), np.ones(4, dtype))
    assert record.u.dtype == np.float64
    assert np.array_equal(record.u, np.ones((4, 1)))


def test_output_is_shown_up_to_the_limits_of_the_sensor():
    record = lab(limits=(3.2, 3.9))
    assert record.beyond[:, 0].tolist() == [-1, -1, 0, 0, 0, 0, 0, 0, 0, 1]
    assert record.shown(np.array([[3.0], [3.5], [9.0]]))[:, 0].tolist() == [3.2, 3.5, 3.9]
    assert record.start_factors[:, 0].tolist() == [0, 0, *[1] * 7, 0]
    assert lab(limits=(None, 3.9), skip=2).start_factors[:, 0].tolist() == [1, 1, *[0] * 8]
    two = lab(y=np.c_[Y, Y], limits=(None, [3.9, np.inf]))
    assert two.beyond.sum(axis=0).tolist() == [1, 0]
    assert np.array_equal(two.shown(two.y + 9.0)[:, 1], Y + 9.0)
    assert two[:9].beyond.sum() == 0
    assert not lab().beyond.any()


def test_slice_is_a_record_from_zero_with_nothing_skipped():
    inputs = (Channel("a", "V"), Channel("b", "V"))
    record = Record(U, Y, 50.0, "periodic", 3, "lab", "official", inputs)
    part = record[2:7]
    assert np.array_equal(part.u, U[2:7])
    assert np.array_equal(part.y[:, 0], Y[2:7])
    assert (part.start, part.skip) == ("zero", 0)
    assert float(lab(start="periodic", weight=3.0)[2:].weight) == 3.0
    kept = (part.fs, part.name, part.source, part.inputs, part.outputs)
    assert kept == (50.0, "lab", "official", inputs, record.outputs)


# --- what it refuses ------------------------------------------------------------------------

STEADY = {"start": "periodic"}
LINES = STEADY | {"line_weight": np.ones(6)}
RAMP = np.arange(10.0)
WEIGHTS = "must be finite, at least 0 and not all 0"


@pytest.mark.parametrize(
    ("message", "given"),
    [
        ("the input has 10 samples and the output 9;", {"y": Y[:9]}),
        *[("the sampling frequency is", {"fs": fs}) for fs in (0.0, -1.0, np.nan, np.inf)],
        ("the sampling frequency is 1e-320 Hz; give one between", {"fs": 1e-320}),
        ("the sampling frequency is True; give a positive number", {"fs": True}),
        *[("between 1e-100 and 1e+100", {"y": factor * Y}) for factor in (1e300, 1e-300)],
        ("start is 'steady'; use 'zero', 'given', 'estimated', 'measured' or", {"start": "steady"}),
        ("skip is -1; give a whole number of at least 0", {"skip": -1}),
        *[(f"skip={skip} leaves no sample of 10;", {"skip": skip}) for skip in (10, 11)],
        ("input has shape (2, 30): more channels than samples.", {"u": np.ones((2, 30))}),
        ("output has shape (2, 30): more channels than samples.", {"y": np.ones((2, 30))}),
        *[(f"input has shape {shape};", {"u": np.ones(shape)}) for shape in ((), (10, 1, 1))],
        *[("input is empty", {"u": empty}) for empty in ([], np.ones((0, 1)), np.ones((10, 0)))],
        *[("input has type", {"u": U.astype(dtype)}) for dtype in (complex, object, str)],
        ("input is no array of real numbers (", {"u": [[1.0, 2.0], [3.0]]}),
        ("input is no array of real numbers (", {"u": torch.ones(10, device="meta")}),
        *[
            ("give real numbers", {"u": u})
            for u in (np.arange(10).astype("datetime64[s]"), Y + 0j, [None] * 10, Y.astype(str))
        ],
        ("x0 is [ 1. nan]; give finite", {"start": "given", "x0": [1.0, np.nan]}),
        *[
            ("and the input (10, 2); give as many samples, and a reference", {"reference": r})
            for r in (U[:, :1], U[:5], np.zeros(10))
        ],
        *[(f"weight {WEIGHTS}", {"weight": bad}) for bad in (-1.0, np.nan, np.inf, 0.0)],
        *[
            (f"line_weight {WEIGHTS}", STEADY | {"line_weight": np.full(6, bad)})
            for bad in (-1.0, np.nan, np.inf, 0.0)
        ],
        ("weight has shape (3,); give one number, or", {"weight": [1, 2, 3]}),
        (
            "line_weight has shape (5,); 10 samples have 6 lines from 0 to fs / 2: give (6,)",
            STEADY | {"line_weight": np.ones(5)},
        ),
        ("line_weight needs start='periodic'", {"line_weight": np.ones(6)}),
        ("line_weight needs start='periodic' and skip=0", LINES | {"skip": 2}),
        *[
            ("give the least and the greatest output", {"limits": limits})
            for limits in ((4.0, 3.0), (None,), 3.0, (None, [1.0, 2.0]), ("low", "high"))
        ],
        ("has limits and line_weight", LINES | {"limits": (None, 3.9)}),
        ("has 10 samples and a period of 4; a steady-state", STEADY | {"period": 4}),
        ("has 10 samples and a period of 11; it must hold at least one", {"period": 11}),
        ("period is 0; give a whole number of at least 1", {"period": 0}),
        ("valid has shape (9,) and type bool; give True and False", {"valid": np.ones(9, bool)}),
        ("valid has shape (10,) and type float64; give True and", {"valid": np.ones(10)}),
        ("leaves no sample of an output; leave that output out", {"valid": np.zeros(10, bool)}),
        ("valid and skip=3 leave no sample", {"valid": RAMP < 3, "skip": 3}),
        ("a steady state needs whole periods", STEADY | {"valid": RAMP < 3}),
    ],
)
def test_what_cannot_be_is_refused(message: str, given: dict):
    refused(message, **given)


def test_channel_names_that_do_not_fit():
    with pytest.raises(ValueError, match=r"u has 2 column\(s\) but 1 channel name\(s\) were given"):
        lab(inputs=(Channel("force"),))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_samples_that_are_not_finite(bad: float):
    u = U.copy()
    u[4:6, 1] = bad
    refused("input 'u2' has 2 NaN, infinite or masked sample(s), the first at index 4;", u=u)
    y = Y.copy()
    y[7] = bad
    refused("output 'force' has 1 NaN", y=y, outputs=(Channel("force"),))
    refused("leave these samples out: valid=np.isfinite(y).", y=y)


def test_masked_samples_are_missing():
    masked = np.ma.masked_array(Y, mask=Y > 3.5)
    refused(f"output 'y' has {masked.mask.sum()} NaN, infinite or masked sample(s)", y=masked)
    refused("masked sample(s)", u=[masked, masked])
    refused("x0 is", start="given", x0=np.ma.masked_array([0.0], mask=[True]))
    whole = np.ma.masked_array(Y)
    assert np.array_equal(Record(U, whole).y[:, 0], Y)


def test_a_tensor_of_a_graph_is_a_signal():
    y = torch.tensor(Y, requires_grad=True)
    assert np.array_equal(lab(y=2.0 * y).y[:, 0], 2.0 * Y)


def test_as_many_channels_as_samples_are_a_record():
    assert Record(np.ones((1, 3)), np.ones(1)).samples == 1
    record = Record(np.ones((30, 30)), np.ones((30, 30)))
    assert (record.inputs[-1].name, record.outputs[0].name) == ("u30", "y1")


@pytest.mark.parametrize("window", [3, slice(None, None, 2), slice(None, None, -1), slice(2, 1, 0)])
def test_a_part_that_is_no_window(window):
    with pytest.raises(ValueError, match="is empty"):
        Record(U, Y)[5:5]
    with pytest.raises(ValueError, match=r"a record is cut by record\[first:last\], not by"):
        Record(U, Y)[window]


# --- several records ------------------------------------------------------------------------


def test_one_record_is_a_list_of_one():
    record = Record(U, Y)
    assert as_records(record) == [record]
    assert as_records((record, record)) == [record, record]


@pytest.mark.parametrize("data", [U, (U, Y), [Record(U, Y), None], None, 3])
def test_something_else_than_records(data):
    with pytest.raises(ValueError, match="where a record is expected; make one of the signals"):
        as_records(data)
    with pytest.raises(ValueError, match="no record given"):
        as_records([])


def test_records_of_different_channels():
    others = Record(Y, Y, name="a"), Record(U, U, name="b")
    for other in others:
        with pytest.raises(ValueError, match=f"records 'lab' and '{other.name}' differ in chan"):
            as_records([Record(U, Y, name="lab"), other])


def test_records_of_different_rates():
    first, same = Record(U, Y, name="a"), Record(U, Y, 1.0 + 1e-12)
    with pytest.raises(ValueError, match=r"'a' and 'b' are sampled at 1\.0 and 2\.0 Hz; resample"):
        as_records([first, same, Record(U, Y, 2.0, name="b")])
    assert as_records([first, same]) == [first, same]


# --- scaling --------------------------------------------------------------------------------


@pytest.mark.numeric
def test_scaler_maps_to_offset_and_scale_and_back():
    scaler = Scaler(np.array([1.0, 2.0]), np.array([2.0, 4.0]), np.array([-1.0]), np.array([0.5]))
    assert np.array_equal(scaler.normalise_u(np.array([[3.0, 2.0]])), [[1.0, 0.0]])
    assert np.array_equal(scaler.normalise_y(np.array([[0.0]])), [[2.0]])
    assert np.array_equal(scaler.restore_y(np.array([[2.0]])), [[0.0]])
    volts = Scaler(np.zeros(1), np.ones(1), np.zeros(1), np.array([1e3]))
    runs_away = np.array([[1.0], [1e307], [-np.inf], [np.nan]])  # and no warning
    assert np.array_equal(
        volts.restore_y(runs_away), [[1e3], [np.inf], [-np.inf], [np.nan]], equal_nan=True
    )


@pytest.mark.numeric
def test_rms_scale_is_about_the_offset_and_1_for_a_constant_channel():
    signals = [np.array([[4.0, 7.0], [-2.0, 7.0]]), np.array([[1.0, 7.0]])]
    assert np.allclose(rms_scale(signals, np.array([1.0, 7.0])), [np.sqrt(6.0), 1.0])


# --- starts and weights ---------------------------------------------------------------------


def test_start_state_goes_with_a_given_start():
    record = lab(start="given", x0=[1, 2])
    assert record.x0 is not None
    assert record.x0.tolist() == [1.0, 2.0]
    refused("record 'lab': start is 'given' and x0 is None;", start="given")
    refused("record 'lab': start is 'zero' and x0 is", x0=[1.0])


@pytest.mark.parametrize(("T", "F"), [(10, 6), (9, 5)])
def test_every_output_has_its_weights(T: int, F: int):
    """Lines from 0 to fs / 2: one more than half the samples, rounded down."""
    lines = np.arange(2 * F).reshape(F, 2)
    record = lab(u=U[:T], y=U[:T], start="periodic", weight=[0, 2], line_weight=lines)
    assert np.array_equal(record.weight, [0.0, 2.0])
    assert record.line_weight is not None
    assert np.array_equal(record.line_weight, lines)
    one = lab(u=U[:T], y=U[:T], start="periodic", line_weight=lines[:, :1])
    assert one.line_weight is not None
    assert np.array_equal(one.line_weight, lines[:, [0, 0]])


def test_a_reference_goes_with_the_signals():
    record = lab(reference=U[::-1], start="periodic", period=5)
    assert repr(record).endswith("period 5, with reference)")
    part = record[2:6].reference
    assert part is not None
    assert np.array_equal(part, U[::-1][2:6])
    with pytest.raises(ValueError, match="read-only"):
        record.reference[0] = 0.0  # pyright: ignore[reportOptionalSubscript]
    assert with_past_outputs(record).reference is None


def test_a_mean_period_weighs_as_much_as_all():
    lines = np.arange(6.0)
    record = lab(start="periodic", period=5, weight=3.0, line_weight=lines, reference=U)
    mean = record.mean_period()
    assert np.allclose(mean.u, (U[:5] + U[5:]) / 2)
    assert np.allclose(mean.y[:, 0], (Y[:5] + Y[5:]) / 2)
    assert mean.reference is not None
    assert np.allclose(mean.reference, mean.u)
    assert mean.line_weight is not None
    assert (mean.samples, float(mean.weight)) == (5, 6.0)
    assert mean.line_weight[:, 0].tolist() == [0.0, 2.0, 4.0]
    with pytest.raises(ValueError, match="start is 'zero'; mean_period is for whole periods"):
        lab().mean_period()


def test_errors_count_by_the_root_of_their_weight_where_they_are_scored():
    """What is skipped tells an estimated start; all of it does where nothing is skipped."""
    record = lab(u=U[:4], y=U[:4], weight=[4.0, 9.0], skip=1)
    assert record.factors.tolist() == [[0, 0], [2, 3], [2, 3], [2, 3]]
    assert record.start_factors.tolist() == [[2, 3], [0, 0], [0, 0], [0, 0]]
    whole = Record(U[:2], U[:2], weight=4.0)
    assert whole.factors.tolist() == whole.start_factors.tolist() == [[2, 2], [2, 2]]


def test_start_state_in_the_coordinates_of_a_model_is_estimated_for_another():
    other = without_coordinates(lab(start="given", x0=[1.0], skip=2))
    assert (other.start, other.x0, other.skip) == ("estimated", None, 2)
    for start in ("zero", "estimated", "periodic"):
        record = lab(start=start)
        assert without_coordinates(record) is record


def test_no_part_of_a_record_loses_its_line_weights():
    with pytest.raises(ValueError, match="has line_weight, and a part of it has other lines"):
        lab(start="periodic", line_weight=np.ones(6))[2:]


# --- periods --------------------------------------------------------------------------------


def test_period_is_kept_by_a_part_that_holds_one():
    assert lab(period=10).period == lab(start="periodic", period=10).period == 10
    assert lab(period=4).period == 4
    record = lab(start="periodic", period=5)
    assert record[3:8].period == 5
    assert record[3:7].period is None


# --- outputs that are left out --------------------------------------------------------------


def with_gap() -> Record:
    """Two outputs, of which the second has no measurement at samples 3 and 4."""
    y = np.stack([RAMP, 2.0 * RAMP], axis=1)
    y[3:5, 1] = np.nan
    return Record(np.ones(10), y, skip=2, valid=np.isfinite(y), weight=np.array([1.0, 4.0]))


def test_outputs_that_are_not_valid_are_interpolated_and_do_not_count():
    record = with_gap()
    np.testing.assert_allclose(record.y[:, 1], 2.0 * RAMP)
    expected = np.ones((10, 2))
    expected[:2] = expected[3:5, 1] = 0.0
    np.testing.assert_array_equal(record.scored, expected == 1.0)
    np.testing.assert_array_equal(record.factors, expected * [1.0, 2.0])
    np.testing.assert_array_equal(record.errors(np.zeros((10, 2))), (record.y * expected)[2:])
    assert "2 outputs not valid" in repr(record)


def test_what_an_output_says_where_it_is_not_valid_does_not_matter():
    one, other = (
        Record(RAMP, np.where(RAMP == 5.0, bad, RAMP), valid=RAMP != 5.0) for bad in (1e9, np.inf)
    )
    np.testing.assert_array_equal(one.y, other.y)
    np.testing.assert_array_equal(one.y[:, 0], RAMP)


def test_parts_of_a_record_keep_what_is_not_valid():
    valid = with_gap()[2:6].valid
    assert valid is not None
    assert valid.tolist() == [[True, True], [True, False], [True, False], [True, True]]
    assert with_gap()[5:].valid is None
    assert Record(RAMP, RAMP, valid=np.full(10, True)).valid is None


def test_a_start_is_estimated_from_valid_outputs():
    weights = dataclasses.replace(with_gap(), start="estimated", skip=5).start_factors
    assert weights[:, 1].tolist() == [2.0, 2.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_a_prediction_needs_all_outputs():
    with pytest.raises(ValueError, match=r"2 output sample\(s\) that are not valid; a prediction"):
        with_past_outputs(with_gap())


# --- records of other samples ---------------------------------------------------------------

SAMPLES, LATE = 37, 20


def with_every_field(**others) -> Record:
    """A record whose fields all have a value, or cannot have one beside those; u counts."""
    rng = np.random.default_rng(0)
    k = np.arange(float(SAMPLES))
    valid = np.ones((SAMPLES, 2), dtype=bool)
    valid[LATE + 5 : LATE + 7, 1] = False
    given = {
        "u": k,
        "y": rng.standard_normal((SAMPLES, 2)),
        "fs": 2.0,
        "start": "estimated",
        "skip": 3,
        "name": "lab",
        "source": "simulated",
        "inputs": (Channel("force", "N"),),
        "outputs": (Channel("x", "m"), Channel("v", "m/s")),
        "period": None,  # a part need not hold one
        "x0": None,  # of start="given"
        "weight": np.array([1.0, 4.0]),
        "line_weight": None,  # of start="periodic"
        "limits": (-9.0, 9.0),
        "reference": k + 100.0,
        "valid": valid,
    }
    assert set(given) == {field.name for field in dataclasses.fields(Record)}
    return Record(**given | others)


def of_samples(record: Record) -> dict[str, np.ndarray]:
    """What a record has for each sample: all fields of that length."""
    found = {name: value for name, value in vars(record).items() if np.shape(value)[:1]}
    sampled = {name: value for name, value in found.items() if len(value) == record.samples}
    return sampled | {"valid": record.is_valid}


def of_a_join(record: Record) -> list[Record]:
    """The record again, of a training part, of which all is valid, and a later one."""
    (joined,) = all_records([record[:LATE]], [dataclasses.replace(record, skip=LATE)])
    assert joined.samples == SAMPLES
    return [joined]


def of_a_join_at_a_hole(record: Record) -> list[Record]:
    """Of two parts that meet where the output is not valid."""
    meet = LATE + 6
    train = dataclasses.replace(record[:meet], start="estimated")
    (joined,) = all_records([train], [dataclasses.replace(record, skip=meet)])
    return [joined]


PARTS = {
    "cut": lambda record: [record[4:30], record[LATE:]],
    "join": of_a_join,
    "join at a hole": of_a_join_at_a_hole,
    "windows": lambda record: windows([record], 10, nx=1),
    "windows of validation": lambda record: windows([record], 10, nx=1, fitted=False),
    "windows from outputs": lambda record: windows_from_outputs(
        dataclasses.replace(record, start="measured", valid=None), 10, 5, None
    ),
    "beginning": lambda record: part_of([record], 0.8),
    "start given": lambda record: [without_coordinates(record)],
}


@pytest.mark.parametrize("kind", PARTS)
def test_what_a_record_has_for_each_sample_goes_with_the_samples(kind: str):
    record = with_every_field()
    expected = of_samples(record)
    assert set(expected) == {"u", "y", "reference", "valid"}
    found = PARTS[kind](record)
    assert found
    for part in found:
        at = part.u[:, 0].astype(int)
        own = of_samples(part)
        assert set(own) == set(expected), "a field is lost"
        for name, signal in own.items():
            if name == "valid" and "outputs" in kind:
                continue  # all are
            there = part.is_valid if name == "y" else ...
            np.testing.assert_array_equal(signal[there], expected[name][at][there], err_msg=name)
        for name in ("fs", "name", "source", "inputs", "outputs"):
            assert getattr(part, name) == getattr(record, name)
        np.testing.assert_array_equal(part.limits, record.limits)


def test_other_signals_of_a_record_are_named_each():
    record = with_every_field()
    signals = record.signals_in(slice(None))
    kept = {name: getattr(record, name) for name in ("limits", "start", "skip", "period")}
    assert record.with_signals(**signals, **kept).samples == SAMPLES
    for name in signals | kept:
        others = {field: value for field, value in (signals | kept).items() if field != name}
        with pytest.raises(TypeError, match=f"'{name}'"):
            record.with_signals(**others)


def test_a_measured_start_needs_the_first_output():
    with pytest.raises(ValueError, match="its first output is not valid; cut the record"):
        dataclasses.replace(with_gap()[3:], start="measured")
    assert dataclasses.replace(with_gap(), start="measured").samples == 10
