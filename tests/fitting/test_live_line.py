"""The line that follows a fit, on a terminal, in a notebook and elsewhere."""

import io
import math
import shutil
from dataclasses import replace
from os import terminal_size

import numpy as np
import pytest

import lfrtorch
from lfrtorch.data.records import Channel, Record
from lfrtorch.fitting.live_line import ProgressLine, StartsLine
from lfrtorch.fitting.observer import LineObserver
from lfrtorch.fitting.trainer import Progress, RestartSummary, Round

U = np.random.default_rng(0).standard_normal(100)
RECORD = Record(U, np.tanh(U), 10.0, outputs=(Channel("y", "m"),))
ONE = lfrtorch.LevenbergMarquardt(max_iter=1)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True

    def screen(self) -> list[str]:
        """What is seen at the end."""
        lines = self.getvalue().split("\n")
        return [overwritten(line.split("\r")).rstrip() for line in lines]


def overwritten(texts: list[str]) -> str:
    """Texts in one line, each over the one before."""
    seen = ""
    for text in texts:
        seen = text + seen[len(text) :]
    return seen


@pytest.fixture(autouse=True)
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(shutil, "get_terminal_size", lambda *_, **__: terminal_size((120, 24)))


@pytest.fixture(scope="module")
def bla() -> lfrtorch.LinearModel:
    return lfrtorch.estimate_bla(RECORD, nx=1)


def models(bla: lfrtorch.LinearModel, count: int) -> list[lfrtorch.Model]:
    return [lfrtorch.initialise(bla, RECORD, nz=1, nw=1, nn=2, seed=i) for i in range(count)]


def step(iteration: int, **report: float) -> Progress:
    return Progress(iteration, 40, 1.5e-3, 2.5e-3, 2.0 * iteration, iteration == 4, report, 1.0)


def written(bla: lfrtorch.LinearModel, *steps: Progress) -> list[str]:
    """The lines of these iterations in a file."""
    (model,), stream = models(bla, 1), io.StringIO()
    line = ProgressLine(every=1, stream=stream)
    for each in steps:
        line(model, each)
    line.close()
    return stream.getvalue().splitlines()


def test_text_names_every_number(bla: lfrtorch.LinearModel):
    whole = step(4, damping=0.125, gain_ratio=0.75, rank=9)
    begin, text, worse = written(bla, step(0), whole, replace(step(5), validation=4e-3))
    assert text == (
        " 4/40  train 1.500 mm  validation 2.500 mm*  72 s left  damping 0.12  gain 0.75"
    )
    assert "left" not in begin
    assert "validation 4.000 mm (best 2.500 mm)  " in worse


def test_a_file_gets_a_line_now_and_then_and_the_last(bla: lfrtorch.LinearModel):
    stream = io.StringIO()
    line = ProgressLine(every=10, stream=stream)
    for iteration in range(13):
        line(models(bla, 1)[0], step(iteration))
    line.close()
    assert [text.split("/")[0].strip() for text in stream.getvalue().splitlines()] == [
        "0",
        "10",
        "12",
    ]


@pytest.mark.parametrize("width", [200, 50, 20])
def test_a_terminal_gets_one_live_line_that_fits(
    width: int, bla: lfrtorch.LinearModel, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(shutil, "get_terminal_size", lambda *_, **__: terminal_size((width, 24)))
    (model,), stream = models(bla, 1), Terminal()
    line = ProgressLine(stream=stream)
    line(model, step(10, gradient_norm=1e-9))  # a longer one
    line(model, step(4))
    line.close()
    line.close()
    (whole,) = written(bla, step(4))
    (seen, after) = stream.screen()
    assert whole.startswith(seen)
    assert len(seen) < width
    assert (seen == whole) is (width == 200)
    assert after == ""
    assert stream.getvalue().count("\r") == 2


def test_a_dumb_terminal_is_a_file(bla: lfrtorch.LinearModel, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TERM", "dumb")
    stream = Terminal()
    line = ProgressLine(stream=stream)
    line(models(bla, 1)[0], step(0))
    line.close()
    assert "\r" not in stream.getvalue()
    assert stream.getvalue().count("\n") == 1


def test_a_round_of_starts_is_a_line(bla: lfrtorch.LinearModel):
    starts = tuple(
        RestartSummary(i, 25, 1.0, e, math.nan, "") for i, e in ((3, 1e-3), (0, 2e-3), (1, 5e-3))
    )
    for stream, live in ((io.StringIO(), False), (Terminal(), True)):
        line = StartsLine(3, "m", stream, iterations=80)
        line(models(bla, 1)[0], step(1))
        line.round(Round(1, 4, starts, 7.2))
        line.close()
        text = stream.getvalue()
        assert (
            "round 1 of 4: 3 start(s) to iteration 25, "
            "best 1.000 mm, median 2.000 mm, worst 5.000 mm, 7 s"
        ) in text
        shown = (
            "1/80 iterations of 3 starts  train 1.500 mm  validation 2.500 mm  best validation 2"
        )
        assert (shown in text) is live
        assert text.count("\n") == 1


@pytest.mark.numeric
@pytest.mark.parametrize("count", [1, 2])
def test_a_fit_shows_its_line_on_a_terminal_alone(
    count: int, bla: lfrtorch.LinearModel, monkeypatch: pytest.MonkeyPatch
):
    for stream, given, lines in ((Terminal(), {}, 1), (io.StringIO(), {}, 0)):
        monkeypatch.setattr("sys.stdout", stream)
        lfrtorch.fit(models(bla, count), RECORD, trainer=ONE, **given)
        assert stream.getvalue().count("\n") == lines
        assert ("train" in stream.getvalue()) is bool(lines)
    monkeypatch.setattr("sys.stdout", stream := Terminal())
    lfrtorch.fit(models(bla, count), RECORD, trainer=ONE, monitors=[])
    assert stream.getvalue() == ""


@pytest.mark.numeric
def test_an_identification_shows_one_line_unless_somebody_else_looks_on(monkeypatch):
    data = lfrtorch.Dataset("tanh", [RECORD], [], [])
    settings = lfrtorch.Settings(nx=1, nz=1, nw=1, nn=2, trainer=ONE)
    for observer, lines in ((None, 1), (lfrtorch.Observer(), 0)):
        monkeypatch.setattr("sys.stdout", stream := Terminal())
        lfrtorch.identify(data, settings, observer=observer)
        assert [bool(line) for line in stream.screen()] == [True] * lines + [False]
        assert ("BLA: order 1" in stream.getvalue()) is bool(lines)


def test_an_error_ends_the_line(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sys.stdout", stream := Terminal())
    observer = LineObserver()
    observer.say("sizes: ...")
    observer.close()
    assert stream.screen() == ["sizes: ...", ""]


def test_a_notebook_keeps_the_last_text_alone(bla: lfrtorch.LinearModel, monkeypatch):
    display = pytest.importorskip("IPython.display")
    shown: list[str] = []

    class Cell:
        def update(self, data: dict[str, str], *, raw: bool) -> None:
            shown[-1] = data["text/plain"]

    def first(data: dict[str, str], *, raw: bool, display_id: bool) -> Cell:
        shown.append(data["text/plain"])
        return Cell()

    monkeypatch.setattr(display, "display", first)
    stream = type("OutStream", (io.StringIO,), {"__module__": "ipykernel.iostream"})()
    monkeypatch.setattr("sys.stdout", stream)
    lfrtorch.fit(models(bla, 1), RECORD, trainer=ONE)
    (last,) = shown
    assert last.startswith("1/1  train")
    assert stream.getvalue() == ""
