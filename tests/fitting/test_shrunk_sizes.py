"""Group lasso: its derivative, its changes of coordinates and cuts, and planted sizes found."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, random_cell, random_model
from torch.autograd.functional import jacobian

import lfrtorch
from lfrtorch.distributed import Ranks
from lfrtorch.fitting.observer import Observer
from lfrtorch.fitting.settings import SizesSearch
from lfrtorch.fitting.shrunk_sizes import shrink_sizes, turned, without
from lfrtorch.fitting.size_search import SizeSearch
from lfrtorch.fitting.trainer import StoppedError
from lfrtorch.job import choose_sizes
from lfrtorch.least_squares.group_lasso import GroupLassoProblem
from lfrtorch.model import Model
from lfrtorch.records import Record

pytestmark = pytest.mark.numeric

KINDS = ("nx", "nz", "nw", "nn")


class Two(Ranks):
    world = 2


@pytest.fixture(scope="module")
def model() -> Model:
    return random_model(random_cell(nx=3, nz=2, nw=3, nn=4, radius=0.7, feedback=0.5))


def noisy(system: Model, seed: int, T: int = 500) -> Record:
    record = measure(system, T, seed=seed, start="periodic")
    rng = np.random.default_rng(seed)
    y = record.y + 0.01 * record.y.std() * rng.standard_normal(record.y.shape)
    return lfrtorch.Record(record.u, y, record.fs, "periodic")


def shrunk(seed: int, T: int = 500, **options: Any) -> SizeSearch:
    """From nx 5, nz 3, nw 3 down, of a system of 3, 1, 1 with noise of 1 %."""
    system = random_model(random_cell(1, 1, 3, 1, 1, 4, radius=0.8, feedback=1.0, seed=seed))
    train, validation = noisy(system, 1, T), noisy(system, 2, T)
    linear = cache(lambda nx: lfrtorch.estimate_bla(train, nx=nx))

    def start(sizes: Any, seed: int) -> Model:
        own = {name: size for name, size in sizes.items() if name != "nx"}
        return lfrtorch.initialise(linear(sizes["nx"]), train, **own, seed=seed)

    given: dict[str, Any] = {"nx": (3, 5), "nn": 6, "seeds": (0, 1), "linear": linear(3)}
    return shrink_sizes(start, train, validation, **given | options)


def test_the_penalty_is_the_sum_of_the_norms_and_has_its_derivative(model: Model):
    record = measure(model, 20)
    options: Any = {"names": KINDS, "weight": 0.7}
    problem = GroupLassoProblem.of(model, record, **options)
    theta = problem.theta
    data = len(record.y)
    penalty = problem.residual(theta)[data:]
    norms = torch.cat(list(problem.norms().values()))
    assert len(norms) == 3 + 2 + 3 + 4
    # ε = 1e-3 changes norms of about 1 by a millionth
    torch.testing.assert_close(penalty.square().sum(), 0.7 * norms.sum(), rtol=1e-4, atol=0.0)
    linearised = problem.linearise(theta)
    reference = jacobian(lambda t: problem._penalty(t)[0], theta)
    change = torch.linspace(-1.0, 1.0, len(theta)).to(theta)
    torch.testing.assert_close(linearised.tangent(change)[data:], reference @ change)
    r = problem.residual(theta)
    only = torch.cat([torch.zeros(data).to(r), penalty])
    torch.testing.assert_close(linearised.adjoint(only), reference.mT @ penalty)
    _, gradient = linearised.system(1e-3, 1e-12)
    torch.testing.assert_close(gradient, linearised.adjoint(r))


def test_a_turned_model_is_the_same_and_shows_what_is_of_no_use(model: Model):
    cell = model.lfr.cell
    with torch.no_grad():  # one z is the other's double, and one w the difference of the others
        cell.Cz[1], cell.Dzu[1] = 2.0 * cell.Cz[0], 2.0 * cell.Dzu[0]
        for matrix in (cell.Bw, cell.Dyw):
            matrix[:, 2] = matrix[:, 0] - matrix[:, 1]
    record = measure(model, 200)
    for states in (False, True):
        other = turned(model, states=states)
        np.testing.assert_allclose(other.simulate(record), record.y, atol=1e-9)
        assert torch.equal(other.lfr.cell.A, cell.A) is not states
        options: Any = {"names": ("nz", "nw"), "weight": 1.0}
        norms = GroupLassoProblem.of(other, record, **options).norms()
        assert [int((each > 1e-6).sum()) for each in norms.values()] == [1, 2]
        cut = without(other, {name: each > 1e-6 for name, each in norms.items()})
        assert cut.sizes == {"nx": 3, "nz": 1, "nw": 2, "nn": 4}
        np.testing.assert_allclose(cut.simulate(record), record.y, atol=1e-6)


def test_states_and_neurons_are_cut():
    model = random_model(random_cell(nx=3, nz=1, nw=1, nn=4))
    cell = model.lfr.cell
    with torch.no_grad():
        cell.A[1] = cell.A[:, 1] = 0.0
        cell.Bu[1] = cell.Bw[1] = cell.Cz[:, 1] = cell.Cy[:, 1] = 0.0
        static: Any = cell.static
        static.Ww[:, 2] = 0.0
    kept = {"nx": torch.tensor([1, 0, 1]) > 0, "nn": torch.tensor([1, 1, 0, 1]) > 0}
    cut = without(model, kept)
    assert cut.sizes == {"nx": 2, "nz": 1, "nw": 1, "nn": 3}
    record = measure(model, 50)
    np.testing.assert_allclose(cut.simulate(record), record.y, atol=1e-12)


def test_planted_sizes_of_z_and_w_are_found():
    trainer = lfrtorch.LevenbergMarquardt(max_iter=25)
    search = shrunk(9, 300, nx=3, nz=(1, 2), nw=(1, 2), nn=4, seeds=(0,), trainer=trainer)
    assert search.candidates[0].sizes == {"nx": 3, "nz": 2, "nw": 2, "nn": 4}
    chosen = search.chosen
    assert chosen.sizes == {"nx": 3, "nz": 1, "nw": 1, "nn": 4}
    assert chosen.model is not None
    assert chosen.model.parameter_count == chosen.parameters
    assert chosen.error < 0.012


@pytest.mark.slow
def test_planted_sizes_are_found():
    """nx = 3 and nz = nw = 1, in three of four systems at least."""
    found = [shrunk(seed, 1024, nn=8, seeds=(0, 1000)).chosen.sizes for seed in (1, 3, 8, 9)]
    assert sum(sizes == {"nx": 3, "nz": 1, "nw": 1, "nn": 8} for sizes in found) >= 3


def test_the_fit_goes_on_from_the_model_that_has_shrunk():
    system = random_model(random_cell(1, 1, 2, 1, 1, 4, radius=0.8, feedback=1.0, seed=1))
    data = lfrtorch.Dataset("planted", [noisy(system, 1, 300)], [noisy(system, 2, 300)], [])
    grid = SizesSearch(method="group_lasso", starts=1, iterations=1.0)
    settings = lfrtorch.Settings(
        nx=2, nz="auto", nw="auto", nn=3, sizes_search=grid,
        trainer=lfrtorch.LevenbergMarquardt(max_iter=10),
    )  # fmt: skip
    run = lfrtorch.identify(data, settings, observer=Observer())
    assert run.size_search is not None
    chosen = run.size_search.chosen
    assert chosen.model is not None
    assert {**run.settings.sizes} == chosen.model.sizes
    first = next(start for start in run.fit.starts if start.number == 0)
    scale = data.validation[0].y.std()
    assert first.validation <= chosen.error * scale * 1.01  # no worse than where it began
    linear = lfrtorch.estimate_bla(data.train, nx=2)
    with pytest.raises(lfrtorch.InputError, match="one process"):
        choose_sizes(data, settings, linear, observer=Observer(), ranks=Two(), stop=None)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"nx": 3, "nz": 1, "nw": 1}, "all sizes are given"),
        ({"seeds": ()}, "seeds is empty"),
        ({"weights": ()}, "weights is empty"),
    ],
)
def test_bad_calls_are_refused(options: dict[str, Any], message: str):
    with pytest.raises(lfrtorch.InputError, match=message):
        shrunk(0, 60, **{"nx": 3} | options)


def test_bad_settings_are_refused():
    lasso = SizesSearch(method="group_lasso")
    with pytest.raises(lfrtorch.InputError, match="use 'race' or 'group_lasso'"):
        SizesSearch(method="lasso")  # pyright: ignore[reportArgumentType]
    with pytest.raises(lfrtorch.InputError, match="has no use for"):
        SizesSearch(method="group_lasso", folds=4)
    others: list[dict[str, Any]] = [{"static": "polynomial"}, {"noise": "innovation"}]
    for other in others:
        with pytest.raises(lfrtorch.InputError, match="which is for static='network'"):
            lfrtorch.Settings(nx=2, nz="auto", sizes_search=lasso, **other)


def test_a_search_ends_if_it_is_asked_to():
    with pytest.raises(StoppedError):
        shrunk(0, 60, nx=3, stop=lambda: True)
