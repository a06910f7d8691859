"""The site's file: the error as its templates compute it, in its unit and form."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from reference import random_cell, random_model

from lfrtorch import Record
from lfrtorch.data.records import Channel
from scripts import leaderboard

pytestmark = pytest.mark.numeric
MODEL = random_model(random_cell(2, 1, 3, 2, 1, 4), fs=50.0)
RNG = np.random.default_rng(0)


def record(name: str, unit: str = "V", noise: float = 1e-3) -> Record:
    """From a state of its own, with noise."""
    u = RNG.standard_normal((400, 2))
    y = MODEL.simulate(u)[100:] + noise * RNG.standard_normal((300, 1))
    channel = (Channel("y", unit),)
    return Record(u[100:], y, fs=50.0, start="estimated", skip=50, name=name, outputs=channel)


def entry(*records: Record, benchmark: str = "bench") -> leaderboard.Entry:
    return leaderboard.entry(benchmark, MODEL, records, seconds=12.3, command="python train.py x")


def test_errors_are_those_of_the_templates():
    """RMSE(y[n:], y_model[n:]) of a model that saw u and y[:n]."""
    shown = record("test")
    n, y = shown.skip, shown.y
    y_model = MODEL.simulate(shown)
    (error,) = leaderboard.errors_of(MODEL, shown)
    # Outputs of about 1, errors of 1e-3: rounding is 1e-13 of them.
    assert error == pytest.approx(np.sqrt(np.mean((y[n:] - y_model[n:]) ** 2)), rel=1e-9)
    assert error < 1.2e-3  # the start was found: it is noise
    later = np.where(np.arange(len(y))[:, None] < n, y, 0.0)
    again = MODEL.simulate(Record(shown.u, later, fs=50.0, start="estimated", skip=n))
    assert np.array_equal(again, y_model)


def test_several_records_are_one_list_in_the_unit_of_the_site():
    first, second = record("multisine"), record("arrow", noise=0.1)
    line = entry(first, second)
    errors = [1e3 * leaderboard.errors_of(MODEL, r)[0] for r in (first, second)]
    assert line.rmse_to_submit == f"[{errors[0]:.3g}; {errors[1]:.3g}]"
    assert (line.unit, line.records) == ("mV", "multisine; arrow")
    assert line.samples_for_the_start == "50; 50"
    assert line.parameters == MODEL.parameter_count
    assert "nx 3, nz 2, nw 1, nn 4" in line.model_class


def test_a_group_is_one_number_and_outputs_of_weight_0_are_none():
    model = random_model(random_cell(2, 2, 3, 2, 1, 4), fs=50.0)
    u = RNG.standard_normal((2, 60, 2))
    y = [model.simulate(each) + RNG.uniform(1, 2, 2) for each in u]
    first, second = (Record(u[i], y[i], fs=50.0, name=f"level_{i}") for i in range(2))
    errors = [leaderboard.errors_of(model, r) for r in (first, second)]
    options = {"seconds": 1.0, "command": "python train.py x"}
    groups = {"level": ("level_0", "level_1"), "other": ("none",)}
    line = leaderboard.entry(
        "fine_steering_mirror",
        model,
        [replace(r, outputs=(Channel("a", "m"), Channel("b", "m"))) for r in (first, second)],
        groups=groups,
        **options,
    )
    assert line.rmse_to_submit == f"{1e6 * np.mean(errors):.3g}"
    assert (line.unit, line.records) == ("µm", "level")
    single = [replace(r, weight=np.array([0.0, 1.0])) for r in (first, second)]
    line = leaderboard.entry("f16", model, single, **options)
    assert line.rmse_to_submit == f"[{errors[0][1]:.3g}; {errors[1][1]:.3g}]"


def test_units_stay_where_the_site_has_them():
    assert entry(record("low", "ticks/s")).unit == "ticks/s"
    assert entry(record("test", "m")).unit == "mm"
    tanks = entry(record("test"), benchmark="cascaded_tanks")
    assert (tanks.unit, float(tanks.rmse_to_submit) < 0.01) == ("V", True)


def test_the_file_reads_back():
    lines = [entry(record("test")), entry(record("low"), record("high"))]
    text = leaderboard.table(lines)
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["rmse_to_submit"] for row in rows] == [line.rmse_to_submit for line in lines]
    assert {row["command"] for row in rows} == {"python train.py x"}
