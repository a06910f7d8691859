"""The report of a run: a whole page without the network that says what the numbers say."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from importlib.metadata import version

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch._support.tables import number
from lfrtorch.analysis.linearisation import poles_at_rest
from lfrtorch.data.dataset import Dataset, Published
from lfrtorch.data.records import Channel, Record
from lfrtorch.engine.lfr import LFR
from lfrtorch.reporting import html as html_report
from lfrtorch.reporting import scores as report
from lfrtorch.reporting.advice import Advice
from lfrtorch.reporting.evaluation import Evaluation, Response, worst_residuals
from lfrtorch.reporting.verdict import judge

pytestmark = pytest.mark.numeric
VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Text, addresses and tags of a page; refuses tags that are not closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.classes: list[str] = []
        self.feed(html)
        self.close()
        assert not self.open

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        self.classes += [value or "" for name, value in attrs if name == "class"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.words.append(data)


@dataclass
class Run:
    """All that a report is made of."""

    result: lfrtorch.FitResult
    bla: lfrtorch.LinearModel
    dataset: Dataset

    def __post_init__(self) -> None:
        self.evaluation = Evaluation(dataset=self.dataset, linear=self.bla, model=self.result.model)

    @property
    def responses(self) -> list[Response]:
        return self.evaluation.simulations

    def page(self, advice: tuple[Advice, ...] = (), search=(), residuals=None, config="") -> Page:
        found = lfrtorch.Run(
            dataset=self.dataset,
            settings=lfrtorch.Settings(nx=2, starts=2),
            linear=self.bla,
            order_scan=None,
            choice=None,
            fit=self.result,
            evaluation=self.evaluation,
            residuals=residuals,
            verdict=judge(self.result, self.responses, linear_nx=self.bla.nx),
            advice=list(advice),
        )
        vars(found)["metrics"] = {**found.metrics, "sizes_search": search}
        images = {"convergence": b"PNG 1", "near": b"PNG 2"}
        views = {record.name: {"near": "a close-up"} for record in self.dataset.tests}
        options = {"views": views, "command": "train.py a=1", "config": config}
        return Page(html_report.render(found, images, **options))

    def lines(self, *responses: Response) -> list[str]:
        """What is said of all records, or of others."""
        evaluation = Evaluation(dataset=self.dataset, linear=self.bla, model=self.result.model)
        vars(evaluation)["simulations"] = list(responses) or self.responses
        return html_report.comparisons(evaluation)


def with_output(response: Response, y_hat: np.ndarray) -> Response:
    return replace(response, simulated={**response.simulated, "NL-LFR": y_hat})


def run(outputs: tuple[Channel, ...] = (Channel("v", "V"),), starts: int = 1) -> Run:
    """A short fit of a saturating system."""
    rng = np.random.default_rng(0)
    parts = {}
    for name in ("train", "validation", "test"):
        u = rng.standard_normal(300)
        y = np.tanh(np.convolve(u, [0.0, 0.6, 0.3])[:300])
        y = np.column_stack([(1 + i) * y for i in range(len(outputs))])
        parts[name] = Record(u, y, fs=10.0, name=name, outputs=outputs, skip=5)
    train, validation, test = ([record] for record in parts.values())
    others = (Published("else", {"test": 0.5}, "A <i>(2001)"),)
    data = Dataset("lab", train, validation, test, published=others, notes=("a note",))
    bla = lfrtorch.estimate_bla(train, nx=2)
    models = [
        lfrtorch.initialise(bla, train, nz=1, nw=1, nn=3, seed=seed) for seed in range(starts)
    ]
    optimiser = lfrtorch.LevenbergMarquardt(max_iter=3)
    if starts > 1:
        result = lfrtorch.fit(models, train, validation, trainer=optimiser)
    else:
        result = lfrtorch.fit(models[0], train, validation, trainer=optimiser)
    return Run(result, bla, data)


@pytest.fixture(scope="module")
def single() -> Run:
    return run()


def test_page_has_the_numbers_and_no_address_outside(single: Run):
    # The same numbers in three digits: rounding shows in them once in 10^12 runs.
    page = single.page((Advice("Do this.", "as x is 3"),), config="nx: 2\n")
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    assert len(page.addresses) == 2
    assert "script" not in page.tags
    test = single.responses[-1]
    linear, error = (
        number(1e3 * lfrtorch.rmse(test.record, y)) for y in (test.y_linear, test.y_hat)
    )
    for words in (
        "Simulation errors (RMSE, mV)",
        f"test {linear} {error}",
        "ratio linear NRMSE NRMSE else",
        "500 else:",  # what others published, in the same unit
        f"({error} mV against {linear} mV)",
        "Do this. as x is 3",
        "else: A <i>(2001)",
        "a note",
        "a close-up",
        "sampled at 10 Hz: 30.0 s",
        "25 parameters, 19 without the directions",
        "train.py a=1",
        "nx: 2",
        f"torch {version('torch')}",
    ):
        assert words in page.text
    order = [page.text.index(word) for word in ("What to try next", "Scores", "Data", "Best lin")]
    assert order == sorted(order)


def test_residuals_of_the_worst_record_are_shown(single: Run):
    found = worst_residuals(single.responses)
    assert found is not None
    assert found.worst == "test"
    page = single.page(residuals=found)
    assert "Residuals: test" in page.text
    assert f"test, v: {found.parts[0].verdict}." in page.text
    assert "Residuals" not in single.page().text
    lost = [with_output(r, np.full_like(r.y_hat, math.inf)) for r in single.responses]
    assert worst_residuals(lost) is None
    (train,) = (r for r in single.responses if r.use == "train")
    kept = worst_residuals([train])
    assert kept is not None
    assert kept.worst == "train"


def test_sizes_that_were_tried(single: Run):
    entry = {"nz": 1, "nw": 1, "nn": 3, "ridge": 0.1, "parameters_net": 19, "ratio": 0.5}
    entry |= {"standard_errors_above": 0.0, "chosen": False}
    less = entry | {"ridge": 0.01, "ratio": 0.52, "chosen": True}
    large = entry | {"nn": 9, "parameters_net": 37, "ratio": 0.6}
    runs_away = large | {"ridge": 0.01, "ratio": None, "standard_errors_above": None}
    page = single.page(search=[runs_away, large, entry, less])
    assert "1 1 3 0.0100 19 0.520 0 chosen 1 1 9 0.100 37 0.600 0" in page.text
    assert "4 models were tried; the table has each size with its best ridge." in page.text
    assert page.tags.count("details") == 4  # sizes, poles, parameters, configuration
    assert "Sizes" not in single.page().text


def test_what_users_named_is_escaped(single: Run):
    evil = "<script>alert('&')</script>"
    test = replace(single.dataset.tests[0], name=evil, outputs=(Channel(evil, evil),))
    data = replace(single.dataset, name=evil, tests=[test], notes=(evil,))
    page = Run(single.result, single.bla, data).page((Advice(evil, evil),), config=evil)
    assert "script" not in page.tags
    assert page.text.count(evil) >= 8


def test_a_diverging_test_and_a_resting_one_are_said(single: Run):
    rest = replace(single.dataset.tests[0], y=np.zeros((300, 1)), name="rest")
    changed = Run(single.result, single.bla, replace(single.dataset, tests=[rest]))
    changed.responses.append(with_output(single.responses[-1], np.full((300, 1), math.inf)))
    page = changed.page()
    assert "test: the NL-LFR diverges" in page.text
    assert "verdict red" in page.classes
    assert re.search(r"rest: error .* of the output's standard deviation", page.text)
    assert not re.search(r"\b(nan|inf|None)\b", page.text)


def test_without_tests_the_verdict_is_on_what_there_is(single: Run):
    validated = Run(single.result, single.bla, replace(single.dataset, tests=[]))
    page = validated.page()
    assert "There is no test record" in page.text
    (line,) = validated.lines()
    assert line.startswith("validation: ")
    assert line in page.text
    model = lfrtorch.initialise(single.bla, single.dataset.train, nz=1, nw=1, nn=3)
    result = lfrtorch.fit(
        model, single.dataset.train, trainer=lfrtorch.LevenbergMarquardt(max_iter=1)
    )
    data = replace(single.dataset, tests=[], validation=[])
    trained = Run(result, single.bla, data)
    page = trained.page()
    (line,) = trained.lines()  # one iteration may gain nothing
    assert line.startswith("train: ")
    assert line in page.text
    assert "the best on training" in page.text


def test_several_outputs_have_scores_of_their_own():
    same = run((Channel("a", "V"), Channel("b", "V")), starts=2)
    page = same.page()
    test = same.responses[-1]
    for i, name in ((0, "a"), (1, "b")):
        error = np.sqrt(np.mean(test.error[:, i] ** 2))
        linear = np.sqrt(np.mean(test.linear_error[:, i] ** 2))
        scores = {
            unit: f"{name} {unit} {number(factor * linear)} {number(factor * error)}"
            for unit, factor in (("V", 1.0), ("mV", 1e3))
        }
        assert any(line in page.text for line in scores.values())
    assert "test all V" in page.text or "test all mV" in page.text
    assert page.text.count("maximum number of iterations") == 2
    assert "The best of 2 starts" in page.text
    lines = same.lines()
    assert [line.split(":")[0] for line in lines] == ["test, a", "test, b"]
    outputs = (Channel("a", "V"), Channel("b", "m"))
    mixed = [replace(r, record=replace(r.record, outputs=outputs)) for r in same.responses]
    lines = same.lines(*mixed)
    assert [line.split(":")[0] for line in lines] == ["test, a", "test, b"]


def test_records_of_a_group_have_one_score():
    same = run((Channel("a", "V"), Channel("b", "V")))
    (test,) = same.dataset.tests
    tests = [test, replace(test, y=2 * test.y, name="again")]
    other = Published("other", {"board": 0.25, "board b": 0.125}, "B", unit="mV")
    groups = {"board": ("test", "again")}
    data = replace(same.dataset, tests=tests, groups=groups, published=(other,))
    grouped = Run(same.result, same.bla, data)
    metrics = report.scored(grouped.evaluation)
    errors = [r.score for r in grouped.responses if r.use == "test"]
    (score,) = metrics["scores"].values()
    expected = np.mean([each.rmse_by_output for each in errors], axis=0)
    assert score["rmse_by_output"] == pytest.approx(expected)
    assert score["rmse"] == pytest.approx(expected.mean())
    assert score["records"] == 2
    linear, error = (number(1e3 * score[name]) for name in ("lti_rmse", "rmse"))
    page = grouped.page().text
    assert f"board all mV {linear} {error}" in page
    a, b = (number(1e3 * score["rmse_by_output"][i]) for i in range(2))
    assert re.search(rf"a mV \S+ {a} .* b mV \S+ {b} ", page)
    table, by_output = report.table(grouped.evaluation).split("RMSE of each output")
    assert by_output.count("board") == 2
    rows = {line.split("  ")[0]: line.split()[-1] for line in table.splitlines() if "  " in line}
    assert (rows["board"], rows["board b"], rows["validation b"]) == ("250", "125", "–")
    untested = Run(same.result, same.bla, replace(data, tests=[], groups={}))
    untested = report.table(untested.evaluation)
    assert "validation b" in untested
    assert "other" not in untested  # nothing to compare with


def test_many_tests_have_one_verdict(single: Run):
    test = single.responses[-1]
    error = test.record.y - test.y_linear
    many = [
        with_output(
            replace(test, record=replace(test.record, name=f"t{k}")), test.y_linear + error * part
        )
        for k, part in enumerate((0.5, 0.9, 0.75, math.nan, 0.0))
    ]
    line, lost = single.lines(*many)
    assert line.startswith("4 test errors: 10.0 % (t1) to 100 % (t4) of the linear model's")
    assert lost == "t3: the NL-LFR diverges"


@pytest.mark.parametrize(
    ("part", "said"), [(1 - 1e-15, "100 %"), (1 + 1e-15, "100 %"), (0.99, "99.0 %")]
)
def test_a_ratio_of_one_plus_rounding_is_no_gain(single: Run, part: float, said: str):
    test = single.responses[-1]
    error = test.record.y - test.y_linear
    (line,) = single.lines(with_output(test, test.record.y - part * error))
    assert f"error {said} of the linear model's" in line


def test_a_linear_model_alone_is_shown(single: Run):
    cell = lfrtorch.LFRCell(1, 1, 2, 0, 0, None, random=False).double()
    single.bla.write(cell, single.result.model.scaler)
    result = replace(single.result, model=replace(single.result.model, lfr=LFR(cell)))
    page = Run(result, single.bla, single.dataset).page()
    assert "As the linear model (nx 2): " in page.text
    assert "verdict amber" in page.classes
    assert "checkpoint=RUN/linear" in page.text
    assert "9 parameters, 5 without" in page.text


def test_poles_at_rest_are_those_of_a_step_away_from_it(single: Run):
    model = single.result.model
    cell = model.lfr.cell
    u = torch.zeros(1, 1, 1, dtype=torch.float64)
    rest = model.lfr.trajectory(u, start="periodic").x[0, 0]
    F = torch.func.jacrev(lambda x: cell(u[0, 0], x)[1])(rest)
    expected = np.sort_complex(np.linalg.eigvals(F.detach().numpy()))
    assert np.sort_complex(poles_at_rest(model)) == pytest.approx(expected, abs=1e-9)
