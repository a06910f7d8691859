"""Units of time are read or refused, and grids are found up to the digits of the stamps."""

import numpy as np
import pytest

from lfrtorch._support.sampling import Sampling, UnevenError, sampling
from lfrtorch.data.records import Channel
from lfrtorch.files.time_stamps import is_time, seconds, time_unit

pytestmark = pytest.mark.numeric

T = np.arange(400) / 100


def column_sampling(t, channel: Channel) -> Sampling:
    times, unit = seconds(t, channel)
    return sampling(times)._replace(unit=unit)


@pytest.mark.parametrize(
    ("units", "each"),
    [
        ("ns nsec nanoseconds", 1e-9),
        ("us µs μs usec microseconds", 1e-6),
        ("ms msec msecs milliseconds Milliseconds MSEC ms. Millisekunden", 1e-3),
        ("s S sec sec. secs seconds Sekunden", 1.0),
        ("min minute minutes mins Minuten", 60.0),
        ("h hr hrs hour hours Std Stunden", 3600.0),
        ("d day days Tage", 86400.0),
        ("ks", 1e3),
    ],
)
def test_units_of_time_and_their_spellings(units, each):
    for unit in units.split():
        found = column_sampling(T / each, Channel("time", unit))
        assert found.fs == pytest.approx(100.0, rel=max(1e-9, found.uncertainty)), unit
    since = Channel("time", f"{units.split()[0]} since 2024-01-01")
    assert time_unit(T, since).seconds == each


@pytest.mark.parametrize("unit", ["Ms", "MS", "m", "V", "samples", "-", "UTC"])
def test_other_units_are_refused(unit):
    with pytest.raises(UnevenError, match=f"has the unit '{unit}', which is not a unit of time"):
        column_sampling(T, Channel("time", unit))


@pytest.mark.parametrize("name", ["time_ms", "Time ms", "timestamp-ms", "t_ms", "TIME.ms"])
def test_a_unit_behind_the_name(name):
    assert is_time(Channel(name))
    assert column_sampling(1000 * T, Channel(name)).fs == 100.0
    for other in ("torque_ms", "t_d", "time_of_day", "dms", "level_h"):
        assert not is_time(Channel(other))


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_stamps_since_1970_have_the_unit_of_their_size(factor):
    stamps = np.rint(factor * (1.7e9 + T))
    found = column_sampling(stamps, Channel("timestamp"))
    assert found.fs == pytest.approx(100.0, rel=1e-6)
    assert found.unit.endswith("seconds since 1970")
    assert column_sampling(1.7e9 + T, Channel("timestamp")).unit == ""
    with pytest.raises(UnevenError, match=r"goes up to 1e\+11 and has no unit"):
        column_sampling(1e11 + T, Channel("t"))


@pytest.mark.parametrize("first", [45382.083310185, 739342.083310185])
def test_days_of_a_calendar_are_told_or_refused(first):
    found = column_sampling(first + T / 86400, Channel("time"))
    assert found.fs == pytest.approx(100.0, rel=1e-3)
    assert "days of a calendar" in str(found)
    minutes = np.round(first + np.arange(400) / 1440, 6)
    with pytest.raises(UnevenError, match="may be seconds or the days of a calendar"):
        column_sampling(minutes, Channel("time"))
    assert column_sampling(minutes, Channel("time", "d")).fs == pytest.approx(1 / 60, rel=1e-4)


@pytest.mark.parametrize("fs", [1.0, 100.0, 2048.0])
def test_seconds_of_a_day_are_no_days_of_a_calendar(fs):
    assert column_sampling(45382 + np.arange(400) / fs, Channel("time")).fs == fs


@pytest.mark.parametrize("offset", [0.0, 1000.0, 836.652, 7429.635, 1.7e9])
@pytest.mark.parametrize("samples", [451, 2101])
def test_stamps_that_are_coarser_than_a_sample_have_no_gaps(offset, samples):
    """2048 Hz in ms: 46 to 1000 gaps were found."""
    found = sampling(np.round(offset + np.arange(samples) / 2048, 3))
    assert found.gaps.size == 0
    assert found.fs == pytest.approx(2048, rel=2 * found.uncertainty)
    assert "±" in str(found) or found.uncertainty < 1e-3


def test_a_stamp_that_is_missing_moves_no_other():
    t = T.copy()
    t[[0, 1, 200, 399]] = np.nan
    assert column_sampling(t, Channel("t")).fs == 100.0
    with pytest.raises(UnevenError, match="has no values"):
        column_sampling(np.full(9, np.nan), Channel("t"))


def test_stamps_that_stand_twice():
    with pytest.raises(UnevenError, match=r"has 2 time stamp\(s\) twice, the first 1 s") as found:
        sampling(np.sort(np.append(T, [1.0, 3.0])))
    assert found.value.sample == 101
