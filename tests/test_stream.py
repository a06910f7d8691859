"""Blocks give the numbers of one simulation, hold one block at a time, and say where they fail."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from itertools import islice

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import random_cell, random_model

import lfrtorch
from lfrtorch import simulate_blocks
from lfrtorch._support.types import Array
from lfrtorch.data.metrics import BlockScores, nrmse, rmse
from lfrtorch.data.records import Record
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

T = 1000
U = np.random.default_rng(0).normal(size=(T, 2))
MODEL = random_model(random_cell(2, 2, 3, 2, 1, 4))


def cut(u: Array, *ends: int) -> list[Array]:
    return np.split(u, ends)


def streamed(model: Model, blocks: list[Array], **options) -> Array:
    return np.concatenate(list(simulate_blocks(model, blocks, **options)))


# --- the same numbers -----------------------------------------------------------------------


@given(ends=st.lists(st.integers(1, T - 1), unique=True, max_size=8))
@settings(max_examples=25)
def test_any_blocks_give_the_bits_of_one_simulation(ends: list[int]):
    found = list(simulate_blocks(MODEL, cut(U, *sorted(ends))))
    assert [len(y) for y in found] == np.diff([0, *sorted(ends), T]).tolist()
    assert np.array_equal(np.concatenate(found), MODEL.simulate(U))


@pytest.mark.parametrize("activation", ["tanh", "sigmoid", "relu", "rbf", "softplus"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_every_compiled_model(activation: str, dtype: torch.dtype):
    model = random_model(random_cell(2, 2, 3, 2, 1, 4, activation=activation, dtype=dtype))
    assert np.array_equal(streamed(model, cut(U, 1, 400)), model.simulate(U))


def test_linear_model():
    cell = random_cell(2, 1, 3, 0, 0)
    A, B, C, D = (getattr(cell, name).detach().numpy() for name in ("A", "Bu", "Cy", "Dyu"))
    linear = lfrtorch.LinearModel(
        A, B, C, D, fs=100.0, u_offset=np.ones(2), y_offset=np.ones(1),
        inputs=MODEL.inputs, outputs=MODEL.outputs[:1],
    )  # fmt: skip
    assert np.array_equal(streamed(linear.to_model(), cut(U, 123)), linear.simulate(U))


def test_a_map_of_ones_own_agrees_to_rounding():
    """Newton's method over a block stops within the rounding of the loop over time."""
    model = random_model(random_cell(2, 2, 3, 2, 1, static=lfrtorch.Polynomial(2, 1, 2)))
    model.lfr.cell.get_parameter("static.C").detach().mul_(0.02)
    assert np.allclose(streamed(model, cut(U, 300, 301)), model.simulate(U), rtol=0, atol=1e-12)


def test_a_given_start_state():
    x0 = [0.3, -1.0, 2.0]
    expected = MODEL.simulate(U, start="given", x0=x0)
    assert np.array_equal(streamed(MODEL, cut(U, 10), x0=x0), expected)
    assert not np.array_equal(expected, MODEL.simulate(U))


def test_an_estimated_start_state_continues_a_measurement():
    y = MODEL.simulate(U)
    record = Record(U[500:600], y[500:600], fs=MODEL.fs)
    x0 = MODEL.signals(record, start="estimated").x[0, 0]
    found = streamed(MODEL, cut(U[500:], 50), x0=x0)
    assert np.allclose(found, y[500:], rtol=0, atol=1e-8)  # tolerance of the estimated state


def test_one_input_in_flat_blocks():
    model = random_model(random_cell())
    assert np.array_equal(streamed(model, cut(U[:, 0], 7)), model.simulate(U[:, 0]))


def test_no_blocks():
    assert list(simulate_blocks(MODEL, [])) == []


# --- memory ---------------------------------------------------------------------------------


def test_a_long_input_is_never_held_whole():
    n, count = 10_000, 60

    def blocks() -> Iterator[Array]:
        generator = np.random.default_rng(0)
        for _ in range(count):
            yield generator.normal(size=(n, 2))

    def peak(used: int) -> int:
        stream = simulate_blocks(MODEL, islice(blocks(), used))
        next(stream)  # compiled by now
        tracemalloc.start()
        samples = n + sum(len(y) for y in stream)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert samples == used * n
        return most

    few, many = peak(3), peak(count)
    assert many < 1.2 * few
    assert many < count * n * 2 * 8  # of the input alone


def test_blocks_are_asked_for_one_at_a_time():
    asked: list[int] = []

    def blocks() -> Iterator[Array]:
        for i in range(3):
            asked.append(i)
            yield U[:10]

    stream = simulate_blocks(MODEL, blocks())
    assert asked == []
    next(stream)
    assert asked == [0]


# --- refusals -------------------------------------------------------------------------------


def test_nan_is_found_at_its_place_in_the_whole_input():
    u = U.copy()
    u[437, 1] = np.nan
    stream = simulate_blocks(MODEL, cut(u, 200, 400))
    assert len(next(stream)) == len(next(stream)) == 200
    with pytest.raises(ValueError, match=r"input 'u2' has 1 NaN, .* first at index 437; cut"):
        next(stream)


def test_divergence_is_found_at_its_place_in_the_whole_input():
    model = random_model(random_cell(2, 2, 3, 2, 1, 4, radius=8.0))
    expected = model.simulate(U)
    first = np.argmin(np.isfinite(expected).all(axis=1))
    assert 200 < first < T
    with pytest.raises(ValueError, match=f"diverges: its output is not finite at sample {first};"):
        streamed(model, cut(U, 200, 250))


@pytest.mark.parametrize("block", [U[:, :1], U[:0], U[None]])
def test_wrong_shapes(block: Array):
    with pytest.raises(ValueError, match="input"):
        streamed(MODEL, [block])


def test_wrong_start_state():
    with pytest.raises(ValueError, match="x0 has 2 entries; the model has 3"):
        streamed(MODEL, [U], x0=[0.0, 1.0])


# --- scores ---------------------------------------------------------------------------------


@given(ends=st.lists(st.integers(1, T - 1), unique=True, max_size=5), skip=st.integers(0, T - 2))
@settings(max_examples=25)
def test_scores_of_blocks_are_those_of_the_whole(ends: list[int], skip: int):
    generator = np.random.default_rng(1)
    y = 1e3 + generator.normal(size=(T, 2)) * [1.0, 5.0]  # a spread far below the mean
    y_hat = y + generator.normal(size=(T, 2))
    scores = BlockScores(2, skip)
    for part, part_hat in zip(cut(y, *sorted(ends)), cut(y_hat, *sorted(ends)), strict=True):
        scores.add(part, part_hat)
    assert scores.samples.tolist() == [T - skip] * 2
    for i in range(2):
        record = Record(y[:, i], y[:, i], skip=skip)
        # Rounding of a thousand squares, of numbers 1e3 times their spread.
        assert scores.rmse[i] == pytest.approx(rmse(record, y_hat[:, [i]]), rel=1e-12)
        assert scores.nrmse[i] == pytest.approx(nrmse(record, y_hat[:, [i]]), rel=1e-9)


def test_missing_measurements_do_not_count():
    y = np.array([[1.0, np.nan], [np.nan, np.nan], [3.0, np.nan], [5.0, np.nan]])
    scores = BlockScores(2)
    for k in range(4):
        scores.add(y[k : k + 1], np.zeros((1, 2)))
    assert scores.samples.tolist() == [3, 0]
    assert scores.rmse[0] == pytest.approx(np.sqrt((1 + 9 + 25) / 3))
    assert scores.nrmse[0] == pytest.approx(scores.rmse[0] / np.sqrt(8 / 3))
    assert np.isnan([scores.rmse[1], scores.nrmse[1]]).all()


def test_a_constant_output_has_no_nrmse():
    scores = BlockScores(1)
    scores.add(np.ones((3, 1)), np.zeros((3, 1)))
    assert scores.rmse[0] == 1.0
    assert np.isnan(scores.nrmse[0])
