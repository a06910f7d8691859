"""Which records and outputs a report shows."""

from dataclasses import replace

import numpy as np
import pytest

import lfrtorch
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Channel, Record
from lfrtorch.reporting import figures, plots
from lfrtorch.reporting.evaluation import Response

DATA = Dataset("lab", [], [], [])
Y = np.random.default_rng(0).standard_normal((200, 1))


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A figure is what it was asked to show."""
    for name in ("response", "close_up", "spectrum", "density", "distribution"):
        monkeypatch.setattr(plots, name, lambda *asked, name=name, **_: (name, *asked[2:]))


def responses(use: str, errors: dict[str, float]) -> list[Response]:
    """Records by name with an error each."""
    return [
        Response(Record(Y, Y, name=name), use, {"linear": 0.5 * Y, "NL-LFR": Y + error})
        for name, error in errors.items()
    ]


def test_the_report_begins_with_the_worst_test():
    tests = responses("test", {"a": 0.1, "b": np.inf, "c": 0.3})
    drawn, views = figures.of_records([*responses("validation", {"v": 9.0}), *tests], DATA)
    assert list(views) == ["b", "c", "a"]
    assert list(views["b"]) == ["b", "b_near", "b_density", "b_distribution"]
    assert set(drawn) == {name for own in views.values() for name in own}
    assert drawn["b"] == ("response", range(1))


def test_of_many_tests_the_worst_have_all_views_and_each_its_errors():
    tests = responses("test", {f"t{k}": 1.0 / (1 + k) for k in range(6)})
    drawn, views = figures.of_records(tests, DATA)
    assert list(views) == ["t0", "t1", "t2", "t3"]
    assert {name for name in drawn if name.startswith(("t4", "t5"))} == {
        "t4", "t4_density", "t5", "t5_density"
    }  # fmt: skip


def test_of_a_group_the_worst_record_is_shown():
    tests = responses("test", {"a": 0.1, "b": 0.3, "c": 0.2})
    data = Dataset("lab", [], [], [], groups={"board": ("a", "b")})
    drawn, views = figures.of_records(tests, data)
    assert list(views) == ["b", "c"]
    assert not any(name.startswith("a") for name in drawn)


def test_without_tests_what_there_is_is_shown():
    validation, train = responses("validation", {"v": 0.1}), responses("train", {"a": 9.0})
    assert list(figures.of_records([*train, *validation], DATA)[1]) == ["v"]
    assert list(figures.of_records(train, DATA)[1]) == ["a"]


def test_many_outputs_have_several_files_and_the_first_is_in_the_report():
    y = np.tile(Y, 6)
    outputs = tuple(Channel(f"y{i}") for i in range(6))
    record = Record(Y, y, name="a", outputs=outputs, start="periodic")
    drawn, captions = figures.of_record(record, {"linear": y})
    assert list(captions) == ["a_response", "a_near", "a", "a_distribution"]
    assert drawn["a"] == ("spectrum", range(4))
    assert drawn["a_response_5_to_6"] == ("response", range(4, 6))
    assert all("Outputs 5 to 6: in figures/." in caption for caption in captions.values())


def test_the_captions_say_what_the_bands_are_and_what_speaks_against_them():
    u = np.random.default_rng(0).standard_normal((400, 1))
    y = np.tanh(u) + 0.1 * np.random.default_rng(1).standard_normal((400, 1))
    record = Record(u, y, name="a")
    settings = lfrtorch.Settings(nx=1, nz=1, nn=3, starts=1)
    run = lfrtorch.identify(Dataset("lab", [record]), settings)
    drawn, views = figures.of_run(run)
    assert "contains 95 % of the errors" in views["a"]["a_near"]
    assert {"a_near", "steps", "static_map"} <= {*drawn}
    run = replace(run, settings=replace(run.settings, horizon=20))  # fitted in windows: no bands
    assert "95 %" not in figures.of_run(run)[1]["a"]["a_near"]
