"""Signals of any size, offset and rank are fitted or refused, and their units change nothing."""

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch._support.types import Array

pytestmark = pytest.mark.numeric


def measured() -> tuple[Array, Array]:
    """Input and output of an oscillator with a softening spring, (400, 1)."""
    rng = np.random.default_rng(0)
    u, y, x = rng.standard_normal((400, 1)), np.empty((400, 1)), np.zeros(2)
    A = 0.8 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    for k in range(400):
        y[k] = x[0] + 0.01 * rng.standard_normal()
        x = A @ x + np.array([-0.05 * x[0] ** 3, u[k, 0]])
    return u, y


class Fitted(NamedTuple):
    """A linear model, an NL-LFR a few iterations later, and its error relative to the output."""

    linear: lfrtorch.LinearModel
    model: lfrtorch.Model
    error: Array


def fitted(u: Array, y: Array, dtype: torch.dtype = torch.float64) -> Fitted:
    record = lfrtorch.Record(u, y, skip=20)
    linear = lfrtorch.estimate_bla(record, nx=2)
    start = lfrtorch.initialise(linear, record, nz=1, nw=1, nn=3, dtype=dtype)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=3)
    model = lfrtorch.fit(start, record, trainer=trainer, monitors=[]).model
    error = np.asarray(lfrtorch.rmse(record, model.simulate(record)))
    return Fitted(linear, model, error / y[20:].std(axis=0))


def parameters(model: lfrtorch.Model) -> list[Array]:
    return [p.detach().numpy() for p in model.lfr.cell.parameters()]


def test_units_that_are_powers_of_two_give_the_same_bits():
    u, y = measured()
    one, other = fitted(u, y), fitted(u * 2.0**-40, y * 2.0**37)
    for a, b in zip(parameters(one.model), parameters(other.model), strict=True):
        assert np.array_equal(a, b)


def test_other_units_give_the_same_linear_model():
    u, y = measured()
    one, other = (
        lfrtorch.estimate_bla(lfrtorch.Record(a * u, b * y, skip=20), nx=2)
        for a, b in ((1.0, 1.0), (1e-3, 1e5))
    )
    assert np.abs(one.poles - other.poles).max() < 1e-9


HARD: dict[str, Any] = {
    "1e-12 and 1e12": lambda u, y: (1e-12 * u, 1e12 * y),
    "1e90 and 1e-90": lambda u, y: (1e90 * u, 1e-90 * y),
    "offset": lambda u, y: (u + 1e6, y + 1e6),
    "duplicate input": lambda u, y: (np.hstack([u, u]), y),
    "nearly duplicate input": lambda u, y: (np.hstack([u, u + 1e-9 * u[::-1]]), y),
    "duplicate output": lambda u, y: (u, np.hstack([y, y])),
    "two levels": lambda u, y: (np.sign(u), y),
    "integers": lambda u, y: ((10 * u).astype(int), (10 * y).astype(int)),
}


@pytest.mark.parametrize("kind", HARD)
def test_hard_signals_are_fitted(kind: str):
    found = fitted(*HARD[kind](*measured()))
    assert (found.error < 0.9).all()


def test_single_precision():
    assert fitted(*measured(), dtype=torch.float32).error < 0.2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda u, y: (u, 0.0 * y), "'y' is constant"),
        (lambda u, y: (0.0 * u + 3.0, y), "'u' is constant"),
        (lambda u, y: (u, np.hstack([y, 0.0 * y])), "'y2' is constant"),
        (lambda u, y: (u[:1], y[:1]), "skip=20 leaves no sample"),
        (lambda u, y: (u[:28], y[:28]), "record more, or lower nx"),
    ],
)
def test_data_without_a_model_are_refused(change: Any, message: str):
    with pytest.raises(lfrtorch.InputError, match=message):
        fitted(*change(*measured()))


@pytest.mark.parametrize("order", [25, 50])
def test_an_order_beyond_the_data_is_refused(order: int):
    u, y = measured()
    with pytest.raises(lfrtorch.InputError, match="lower nx"):
        lfrtorch.estimate_bla(lfrtorch.Record(u[:200], y[:200]), nx=order)
