"""A new stage of an identification is a file and a line."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lfrtorch
from lfrtorch import Dataset, LevenbergMarquardt, Record, Settings, identify
from lfrtorch.fitting.stage import Data, Job, Stage
from lfrtorch.fitting.stages import STAGES
from lfrtorch.fitting.trainer import FitResult, StoppedError, Trainer
from lfrtorch.fitting.whole_fit import WholeFit

pytestmark = pytest.mark.numeric


class Reweighted(Stage):
    """A second fit, each record weighted by the inverse variance of its errors in the first."""

    name = "the fit to weighted records"

    def data(self, job: Job) -> Data:
        model = job.result.model
        errors = [np.mean(r.errors(model.simulate(r)) ** 2) for r in job.dataset.train]
        least = min(errors)
        pairs = zip(job.dataset.train, errors, strict=True)
        return Data([replace(r, weight=np.asarray(r.weight) * least / e) for r, e in pairs])

    def trainer(self, job: Job) -> Trainer:
        return LevenbergMarquardt(max_iter=25)

    def models(self, job: Job) -> list[lfrtorch.Model]:
        return [job.result.model]

    def keep(self, job: Job, result: FitResult) -> Job:
        return replace(job, result=replace(job.result, model=result.model))


def records() -> list[Record]:
    """One record of a saturation that is quiet, and one with much noise."""
    random, found = np.random.default_rng(0), []
    for noise in (0.01, 1.0):
        u = random.standard_normal(300)
        x, y = 0.0, np.zeros(300)
        for k in range(300):
            y[k] = x + noise * random.standard_normal()
            x = 0.7 * x + np.tanh(u[k])
        found.append(Record(u, y, name=f"noise {noise}"))
    return found


def identified() -> lfrtorch.Run:
    trainer = LevenbergMarquardt(max_iter=25)
    settings = Settings(nx=1, nz=1, nw=1, nn=6, starts=1, trainer=trainer)
    return identify(Dataset("two", records(), [], []), settings)


def after_the_fit(stage: Stage) -> tuple[Stage, ...]:
    at = next(i for i, one in enumerate(STAGES) if isinstance(one, WholeFit)) + 1
    return (*STAGES[:at], stage, *STAGES[at:])


def test_a_stage_is_added_by_one_line(monkeypatch: pytest.MonkeyPatch):
    quiet = records()[0]
    alike = lfrtorch.rmse(quiet, identified().model.simulate(quiet))
    monkeypatch.setattr("lfrtorch.job.STAGES", after_the_fit(Reweighted()))
    weighted = lfrtorch.rmse(quiet, identified().model.simulate(quiet))
    assert weighted < 0.9 * alike


class Cut(LevenbergMarquardt):
    """A search that is interrupted at its second step."""

    def step(self, problem: Any, state: Any) -> Any:
        if state.iteration:
            raise KeyboardInterrupt
        return super().step(problem, state)


class Interrupted(Reweighted):
    def trainer(self, job: Job) -> Trainer:
        return Cut(max_iter=4)


def test_a_stage_that_is_cut_short_leaves_the_whole_fit(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("lfrtorch.job.STAGES", after_the_fit(Interrupted()))
    run = identified()
    assert run.fit.reason == lfrtorch.Reason.INTERRUPTED
    assert run.fit.iterations == 25


def test_a_stage_that_is_cut_short_before_the_whole_fit_says_which(monkeypatch: pytest.MonkeyPatch):
    class Early(Interrupted):
        def models(self, job: Job) -> list[lfrtorch.Model]:
            return [*job.models]

        def data(self, job: Job) -> Data:
            return Data(job.dataset.train)

    at = next(i for i, one in enumerate(STAGES) if isinstance(one, WholeFit))
    monkeypatch.setattr("lfrtorch.job.STAGES", (*STAGES[:at], Early(), *STAGES[at:]))
    with pytest.raises(StoppedError, match="stopped during the fit to weighted records"):
        identified()


def test_a_stage_that_keeps_nothing_is_an_error():
    with pytest.raises(NotImplementedError):
        Stage().keep(None, None)  # pyright: ignore[reportArgumentType]


def test_what_cannot_be_is_refused_before_anything_is_computed():
    said: list[str] = []

    class Heard(lfrtorch.Observer):
        def say(self, text: str) -> None:
            said.append(text)

    settings = Settings(nx=2, nz=1, nw=1, nn=2, fixed={"Cy": [[1.0, 0.0, 0.0]]})
    with pytest.raises(lfrtorch.InputError, match="fixed Cy has the shape"):
        identify(Dataset("two", records(), [], []), settings, observer=Heard())
    assert not said
