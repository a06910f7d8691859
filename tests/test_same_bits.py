"""The same data and seed give the same bits on any number of threads."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, random_cell, random_model
from threadpoolctl import threadpool_limits
from torch import Tensor

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.data.records import Record
from lfrtorch.engine.sensitivity import Linearisation, output_jacobian
from lfrtorch.engine.simulation import simulate
from lfrtorch.fitting.multistart import fit
from lfrtorch.least_squares import jacobian
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


class Sine(torch.nn.Linear):
    """w = sin(W z + b), a map that is not compiled."""

    def forward(self, input: Tensor) -> Tensor:
        return torch.sin(super().forward(input))


def on_threads(threads: int, work: Callable[[], Any]) -> Any:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with threadpool_limits(limits=threads, user_api="blas"):
            return work()
    finally:
        torch.set_num_threads(before)


def truth(**options: Any) -> Model:
    return random_model(random_cell(2, 2, 3, 2, 1, 5, radius=0.7, **options))


def own_map() -> dict[str, Any]:
    torch.manual_seed(0)
    return {"static": Sine(2, 1, dtype=torch.float64)}


def records(T: int = 3000) -> list[Record]:
    """Of every start state."""
    model = truth()
    late = measure(model, 1020, seed=2)[20:]
    return [
        measure(model, T),
        measure(model, 1000, seed=1, start="periodic"),
        Record(late.u, late.y, fs=late.fs, start="estimated"),
    ]


def noisy(data: list[Record]) -> list[Record]:
    rng = np.random.default_rng(0)
    return [
        Record(r.u, r.y + 0.1 * rng.normal(size=r.y.shape), fs=r.fs, start=r.start) for r in data
    ]


def bits(found: Any) -> list[bytes]:
    """All numbers of a result."""
    if isinstance(found, lfrtorch.LinearModel):
        arrays = (found.A, found.B, found.C, found.D, found.u_offset, found.y_offset)
        return [np.ascontiguousarray(array).tobytes() for array in arrays]
    if isinstance(found, Model):
        return [p.detach().numpy().tobytes() for p in found.lfr.parameters()]
    if isinstance(found, lfrtorch.FitResult):
        errors = [(p.train, p.validation) for p in found.history]
        return [*bits(found.model), np.array(errors).tobytes()]
    return [np.ascontiguousarray(found).tobytes()]


def same(work: Callable[[], Any]) -> None:
    """Whether the work gives the same bits on one and two threads."""
    assert bits(on_threads(1, work)) == bits(on_threads(2, work))


@pytest.mark.parametrize("options", [dict, own_map], ids=["network", "own map"])
@pytest.mark.parametrize("start", ["zero", "periodic", "estimated"])
def test_simulation(options: Callable[[], dict[str, Any]], start: Any):
    model = truth(**options())
    (record, *_) = noisy(records(12000))  # torch would use two threads for so many
    same(lambda: model.simulate(record, start=start))


@pytest.mark.parametrize("refine", ["simulation", "prediction", "frequency"])
def test_best_linear_approximation(refine: Any):
    data = noisy(records())
    same(lambda: lfrtorch.estimate_bla(data, nx=3, refine=refine, max_iter=3))


THREADS = (1, 2, 3, 4, 8)


@pytest.mark.parametrize("nx", [3, 8, 12, 20])
@pytest.mark.parametrize("R", [1, 3])
def test_jacobian(nx: int, R: int):
    """Each number of threads shares its columns in another way."""
    cell = random_cell(2, 2, nx, 2, 2, 9, radius=0.7)
    u = torch.from_numpy(np.random.default_rng(0).normal(size=(R, 50, 2)))
    trajectory = simulate(cell, u, u.new_zeros(R, nx))

    def work() -> Array:
        return output_jacobian(Linearisation(cell, u, trajectory)).numpy()

    first, *others = (bits(on_threads(threads, work)) for threads in THREADS)
    assert others == 4 * [first]


@pytest.mark.slow
@pytest.mark.parametrize("nx", [3, 8, 12, 20])
def test_linear_model_and_fit(nx: int):
    data = noisy([measure(random_model(random_cell(1, 1, nx, 2, 1, 5, radius=0.7)), 1000)])

    def work() -> Any:
        bla = lfrtorch.estimate_bla(data, nx=nx, max_iter=3)
        model = lfrtorch.initialise(bla, data, nz=2, nw=1, nn=5)
        return bla, lfrtorch.fit(model, data, trainer=LM)

    found = (on_threads(threads, work) for threads in THREADS)
    first, *others = ([bits(each) for each in both] for both in found)
    assert others == 4 * [first]


def test_initialisation():
    data = noisy(records())
    bla = lfrtorch.estimate_bla(data[:1], nx=3, max_iter=1)
    same(lambda: lfrtorch.initialise(bla, data, nz=2, nw=1, nn=5, seed=1))


LM = LevenbergMarquardt(max_iter=2)


@pytest.mark.parametrize(
    ("trainer", "options", "regime", "kept"),
    [
        (LM, dict, 0.0, jacobian.CACHED_BYTES),  # normal equations
        (LM, dict, math.inf, jacobian.CACHED_BYTES),  # orthogonal
        (LM, dict, 0.0, 0),  # rows in blocks
        (LM, dict, math.inf, 0),
        pytest.param(LM, own_map, 0.0, jacobian.CACHED_BYTES, marks=pytest.mark.slow),
        (Adam(max_iter=2), dict, 0.0, jacobian.CACHED_BYTES),
        (Adam(max_iter=1), own_map, 0.0, jacobian.CACHED_BYTES),
    ],
)
def test_single_fit(
    trainer: Any,
    options: Callable[[], dict[str, Any]],
    regime: float,
    kept: int,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(jacobian, "NORMAL", regime)
    monkeypatch.setattr(jacobian, "CACHED_BYTES", kept)
    train, validation = noisy(records()), noisy([measure(truth(), 500, seed=5)])

    def work() -> lfrtorch.FitResult:
        model = truth(seed=7, **options())
        return lfrtorch.fit(model, train, validation, trainer=trainer)

    same(work)


def test_several_starts():
    train, validation = noisy(records()), noisy([measure(truth(), 500, seed=5)])

    def work() -> lfrtorch.FitResult:
        models = [truth(seed=seed) for seed in range(3)]
        return fit(models, train, validation, trainer=LM)

    same(work)
