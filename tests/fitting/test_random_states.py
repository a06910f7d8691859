"""Starts with random states find systems that the linear model hides, and keep what is held."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import butter, lfilter

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.data.records import Record, Start
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.start_models import starting_model
from lfrtorch.fitting.starts import initialise
from lfrtorch.linear.bla import estimate_bla

pytestmark = pytest.mark.numeric

SIZES: dict[str, Any] = {"nz": 1, "nw": 1, "nn": 8}


def hidden(T: int = 300, *, seed: int = 0, start: Start = "zero") -> Record:
    """A speed v of order 3, of which a sensor tells |v|, as of coupled drives."""
    steps = np.sign(np.random.default_rng(seed).normal(size=(T // 5, 1)))
    u = np.repeat(steps, 5, axis=0)
    twice = np.vstack([u, u]) if start == "periodic" else u
    y = np.abs(lfilter([0.0, 0.2], [1.0, -2.6, 2.33, -0.71], twice, axis=0))[-T:]
    return Record(u, y, 1.0, start)


def relative(record: Record, y: Array) -> float:
    """Root mean square error over the output's deviation."""
    return lfrtorch.rmse(record, y) / float(record.y.std())


def test_a_hidden_sign_is_found_from_random_states_and_not_from_the_linear_model():
    record, new = hidden(), hidden(seed=1)
    bla = estimate_bla(record, nx=3)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=40)
    found = {
        method: min(
            relative(new, lfrtorch.fit(model, record, trainer=trainer).model.simulate(new))
            for seed in range(3)
            for model in [initialise(bla, record, **SIZES, method=method, seed=seed)]
        )
        for method in ("zero_output", "random_states")
    }
    assert relative(new, bla.simulate(new)) > 0.9
    assert found["random_states"] < 0.1
    assert found["zero_output"] > 0.5


@pytest.mark.slow
def test_a_system_whose_linear_approximation_is_zero_is_identified():
    """A filtered input, squared: sizes are chosen, and the model is recommended."""

    def measured(T: int, seed: int) -> Record:
        u = np.random.default_rng(seed).normal(size=(T, 1))
        v = 3.0 * lfilter(*butter(2, 0.1), u, axis=0)
        return Record(u, v**2, 1.0, "estimated", skip=50)

    train, new = measured(1500, 0), measured(2000, 1)
    noise = 0.02 * train.y.std() * np.random.default_rng(5).normal(size=train.y.shape)
    train = Record(train.u, train.y + noise, 1.0, "estimated", skip=50)
    sizes: dict[str, Any] = dict.fromkeys(("nx", "nz", "nw", "nn"), "auto")
    run = lfrtorch.identify(lfrtorch.Dataset("even", [train]), Settings(**sizes))
    assert relative(new, run.linear.simulate(new)) > 0.9
    assert relative(new, run.model.simulate(new)) < 0.1
    assert run.verdict.use == "NL-LFR"


@pytest.mark.parametrize("start", ["zero", "estimated", "periodic"])
def test_the_start_explains_more_than_the_linear_model(start: Start):
    record = hidden(start=start)
    bla = estimate_bla(record, nx=3)
    models = [
        initialise(bla, record, **SIZES, method="random_states", seed=seed) for seed in range(3)
    ]
    least = min(relative(record, model.simulate(record)) for model in models)
    assert least < 0.95 * relative(record, bla.simulate(record))
    assert models[0].sizes == {"nx": 3, **SIZES}


@pytest.mark.parametrize("nw", [1, 2, 3])
def test_several_outputs_share_the_maps_that_there_are(nw: int):
    one, two = hidden(), hidden(seed=1)
    record = Record(np.hstack([one.u, two.u]), np.hstack([one.y, one.y + two.y, two.y]), 1.0)
    bla = estimate_bla(record, nx=4)
    model = initialise(bla, record, nz=2, nw=nw, nn=16, method="random_states")
    errors = [lfrtorch.rmse(record, each.simulate(record)) for each in (model, bla)]
    assert errors[0] < (1.2 if nw == 1 else 1.0) * errors[1]


def test_there_may_be_fewer_neurons_than_outputs():
    one = hidden()
    record = Record(one.u, np.hstack([one.y, 2.0 * one.y + one.u, one.u]), 1.0)
    sizes: dict[str, Any] = {"nz": 1, "nw": 3, "nn": 1}
    bla = estimate_bla(record, nx=3)
    model = initialise(bla, record, **sizes, method="random_states")
    assert lfrtorch.rmse(record, model.simulate(record)) < float(record.y.std())


def test_a_beginning_without_measurements_is_passed_over():
    """A long record is compared on its first scored samples, wherever they are."""
    whole = hidden(24_000)
    valid = np.ones((24_000, 2), dtype=bool)
    valid[:8000, 0] = False
    y = np.hstack([whole.y, whole.y])
    some = Record(whole.u, y, 1.0, "estimated", valid=valid)
    bla = estimate_bla(Record(whole.u, y, 1.0), nx=3)
    model = initialise(bla, some, nz=1, nw=2, nn=8, method="random_states")
    errors = model.simulate(some) - y
    assert np.isfinite(errors).all()
    assert (errors[12_000:].std(axis=0) < y.std()).all()


def test_no_feedthrough_stays_none():
    record = hidden()
    bla = estimate_bla(record, nx=3, feedthrough=False)
    held: dict[str, Any] = {"feedthrough": False, "z_feedthrough": False}
    cell = initialise(bla, record, **SIZES, method="random_states", **held).lfr.cell
    assert not cell.Dyu.any()
    assert not cell.Dzu.any()
    assert {"Dyu", "Dzu"} <= {*cell.held}


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"static": lfrtorch.Polynomial(1, 1, 3)}, "the static map is no network"),
        ({"structure": "wiener"}, "entries of Bw are held"),
        ({"feedthrough": False}, "entries of Dyw are held"),
    ],
)
def test_what_has_no_random_states_is_refused(options: dict[str, Any], told: str):
    record = hidden()
    bla = estimate_bla(record, nx=3, feedthrough=options.get("feedthrough", True))
    with pytest.raises(ValueError, match=f"method is 'random_states', but {told}; give 'zero"):
        initialise(bla, record, **SIZES | options, method="random_states")


def test_a_given_start_state_and_a_noise_model_are_refused():
    record = hidden()
    given = Record(record.u, record.y, 1.0, "measured")
    with pytest.raises(ValueError, match="a record has start='measured'"):
        initialise(estimate_bla(record, nx=3), given, **SIZES, method="random_states")
    with pytest.raises(ValueError, match="the linear model models noise"):
        initialise(
            estimate_bla(record, nx=3, refine="prediction"), record, **SIZES, method="random_states"
        )


def test_every_second_start_has_random_states_if_it_can():
    record = hidden()
    bla = estimate_bla(record, nx=3)

    def is_linear(seed: int, **options: Any) -> bool:
        settings = Settings(nx=3, **SIZES, **options)
        model = starting_model([record], settings, bla, seed)
        near = lfrtorch.rmse(record, model.simulate(record) - bla.simulate(record) + record.y)
        return near < 1e-6

    assert [is_linear(seed) for seed in (0, 1000, 2000, 3000)] == [True, False, True, False]
    assert is_linear(1000, init="zero_output")
    assert is_linear(1000, structure="wiener")
    assert is_linear(1000, trainer=lfrtorch.LevenbergMarquardt(guarantee="contracting"))
    assert not is_linear(0, init="random_states")
    torch.manual_seed(1)
    one, other = (starting_model([record], Settings(nx=3, **SIZES), bla, 1000) for _ in range(2))
    np.testing.assert_array_equal(one.simulate(record), other.simulate(record))
