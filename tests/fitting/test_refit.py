"""A last fit to all records: what it is fitted to, how far it goes, what it leaves alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lfrtorch import LevenbergMarquardt, Record, estimate_bla, fit, initialise, refit, rmse
from lfrtorch.fitting.refit import all_records


def saturation(seed: int, samples: int = 400, noise: float = 0.3) -> Record:
    """A first-order system that saturates at its input, measured with noise."""
    rng = np.random.default_rng(seed)
    u, y = rng.standard_normal(samples), np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + np.tanh(u[k])
    return Record(u, y + noise * rng.standard_normal(samples), skip=20)


def test_a_record_that_begins_in_a_training_record_continues_it():
    whole = replace(saturation(0), skip=0)
    train, late = whole[:250], replace(whole[200:], skip=50)
    from_the_start = replace(whole, skip=250)
    for held_out in (late, from_the_start):
        (joined,) = all_records([train], [held_out])
        assert np.array_equal(joined.u, whole.u)
        assert np.array_equal(joined.y, whole.y)
        assert joined.skip == 0
    two = [whole[:100], whole[100:250]]
    assert [r.samples for r in all_records(two, [late])] == [100, 300]


def test_other_records_are_fitted_beside():
    whole = saturation(0)
    rest = Record(np.zeros(60), np.zeros(60))
    steady = replace(whole[:300], start="periodic", period=100)
    for train, held_out in (
        (whole, saturation(1)),  # another measurement
        (rest, replace(whole[:100], u=np.zeros(100), y=np.zeros(100), skip=10)),  # alike by chance
        (steady, replace(steady, skip=100)),  # whole periods
        (whole[:300], whole[300:]),  # nothing is skipped
    ):
        assert all_records([train], [held_out]) == [train, held_out]


@pytest.mark.numeric
def test_held_out_records_make_the_model_better_elsewhere():
    # With noise of 0.1 the start is the best iterate in none of 12 random starts, with 0.3 in one.
    train = saturation(0, 120, noise=0.1)
    held_out = [saturation(seed, noise=0.1) for seed in (1, 2, 3)]
    bla = estimate_bla(train, nx=1)
    model = initialise(bla, train, nz=1, nw=1, nn=3)
    trainer = LevenbergMarquardt(max_iter=10)
    result = fit(model, train, held_out[:1], trainer=trainer)
    before = [p.detach().clone() for p in result.model.lfr.parameters()]
    again = refit(result, train, held_out, trainer=trainer)
    assert again.history[-1].train < again.history[0].train
    assert all(map(torch.equal, before, result.model.lfr.parameters()))
    other = saturation(4, 2000, noise=0.1)
    errors = [rmse(other, r.model.simulate(other)) for r in (result, again)]
    assert errors[1] < errors[0]


def test_iterations_are_in_proportion_to_the_new_samples():
    train, held_out = replace(saturation(0), skip=0), saturation(1)[:100]
    model = initialise(estimate_bla(train, nx=1), train, nz=1, nw=1, nn=3)
    result = fit(model, train, trainer=LevenbergMarquardt(max_iter=8, tolerance=0.0))
    for chosen, iterations in ((8, 2), (5, 2), (0, 0)):
        again = refit(replace(result, chosen_iteration=chosen), train, held_out)
        assert again.iterations == iterations
    mean_of_four = replace(result, chosen_iteration=8)
    assert refit(mean_of_four, replace(train, weight=4.0), held_out).iterations == 1


@pytest.mark.numeric
def test_each_model_of_a_mean_is_refitted():
    train, held_out = saturation(0), saturation(1)
    bla = estimate_bla(train, nx=1)
    models = [initialise(bla, train, nz=1, nw=1, nn=3, seed=seed) for seed in range(3)]
    trainer = LevenbergMarquardt(max_iter=6)
    result = fit(models, train, trainer=trainer, average=2)
    assert len(result.members) == result.averaged == 2
    again = refit(result, train, held_out, trainer=trainer)
    assert again.averaged == 2
    assert again.model.sizes == result.model.sizes
    assert not np.array_equal(again.model.simulate(train), result.model.simulate(train))
