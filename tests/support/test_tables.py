"""Numbers and tables as people read them."""

import math

import pytest

from lfrtorch._support.tables import (
    UNKNOWN,
    engineering,
    number,
    percent,
    quantities,
    quantity,
    radius,
    table,
)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (0.0, "0"),
        (1234.56, "1235"),
        (12.345, "12.3"),
        (-0.1, "-0.100"),
        (0.00123456, "0.00123"),
        (9.9999, "10.0"),  # the digits are those of the rounded value
        (99.99, "100"),
        (999.9, "1000"),
        (0.00099999, "0.00100"),
        (99999.0, "1.00e5"),
        (9.999e-5, "1.00e-4"),
        (9.4e-5, "9.40e-5"),
        (2e6, "2.00e6"),
        (math.nan, UNKNOWN),
        (math.inf, UNKNOWN),
        (None, UNKNOWN),
    ],
)
def test_numbers_have_three_digits(value: float | None, shown: str):
    assert number(value) == shown


def test_more_digits_on_request():
    assert number(0.99913, digits=4) == "0.9991"
    assert number(0.99996, digits=4) == "1.000"
    assert number(1e-7, digits=1) == "1e-7"


def test_a_stable_and_an_unstable_pole_do_not_look_alike():
    shown = [radius(value) for value in (0.9986, 0.99998, 1.0 - 2e-6, 1.0, 1.0 + 2e-6, 1.0002, 1.5)]
    assert len(set(shown)) == len(shown)
    assert shown[2:5] == ["1 - 2.0e-6", "1", "1 + 2.0e-6"]


def test_units_follow_the_number():
    assert quantity(0.2, "V") == "0.200 V"
    assert quantity(0.02, "") == "0.0200"
    assert percent(0.5) == "50.0 %"
    assert percent(None) == percent(math.nan) == UNKNOWN


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (0.02, "V", "20.0 mV"),
        (-3.2e-6, "m", "-3.20 µm"),
        (4.5e4, "N", "45.0 kN"),
        (999.0, "V", "999 V"),
        (0.0015, "m/s²", "1.50 mm/s²"),
        (0.02, "mm", "0.0200 mm"),  # prefixed already
        (0.02, "kg", "0.0200 kg"),
        (0.02, "°C", "0.0200 °C"),
        (3600.0, "s", "3600 s"),
        (5e-3, "s", "5.00 ms"),
        (1e-16, "V", "1.00e-16 V"),  # rounding errors
        (math.inf, "V", f"{UNKNOWN} V"),
    ],
)
def test_units_take_the_prefix_that_reads_well(value: float, unit: str, shown: str):
    assert quantity(value, unit) == shown


def test_numbers_of_a_column_share_their_prefix():
    assert quantities([0.04, 0.0004, None], "V") == ["40.0 mV", "0.400 mV", f"{UNKNOWN} mV"]
    assert engineering([1e-6, 2e-6, 3.0], "m") == (pytest.approx(1e6), "µm")
    assert engineering([0.0, math.nan], "m") == (1.0, "m")


def test_columns_of_words_start_at_the_left_and_others_end_at_the_right():
    rows = [["test", "V", 300, 0.5], ["validation", "", 4, None]]
    head, rule, first, second = table(["record", "unit", "samples", "RMSE"], rows).splitlines()
    assert head.split() == ["record", "unit", "samples", "RMSE"]
    assert set(rule) == {"-", " "}
    assert first.split() == ["test", "V", "300", "0.500"]
    assert second.split() == ["validation", "4", UNKNOWN]
    assert (first.index("test"), first.index("V")) == (0, head.index("unit"))
    assert len(first) == len(second) == len(head)
    assert first.index("300") + 3 == second.index("4") + 1 == head.index("samples") + 7
    assert table(["a", "b"], []).splitlines()[0].split() == ["a", "b"]
