"""Modes that matter little: measured against systems put together from known parts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from lfrtorch.data.records import Channel, Record, Start
from lfrtorch.fitting.starts import initialise
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.modes import shares, without_slow_minor_modes

pytestmark = pytest.mark.numeric

NOISE = 0.1


def oscillation(radius: float, angle: float) -> np.ndarray:
    c, s = radius * np.cos(angle), radius * np.sin(angle)
    return np.array([[c, s], [-s, c]])


def assembled(slow: float = 0.998, gain: float = 1e-3) -> tuple[LinearModel, LinearModel]:
    """Two modes that matter, with a slow oscillation of small gain; the latter alone."""
    A = block_diag(oscillation(0.9, 0.5), [[0.5]], oscillation(slow, 0.2))
    B, C = np.ones((5, 1)), np.array([[1.0, 0.5, 2.0, gain, gain]])
    zero = np.zeros(1)
    rest = (np.zeros((1, 1)), 1.0, zero, zero, (Channel("u"),), (Channel("y"),))
    whole = LinearModel(A, B, C, *rest)
    alone = LinearModel(A[3:, 3:], B[3:], C[:, 3:], *rest)
    T = np.random.default_rng(1).normal(size=(5, 5))
    return whole.transformed(T), alone


def measured(model: LinearModel, start: Start = "periodic") -> Record:
    """Output of the model with noise of a known rms."""
    generator = np.random.default_rng(0)
    u = generator.normal(size=(4096, 1))
    blank = Record(u, np.zeros_like(u), 1.0, start, inputs=model.inputs, outputs=model.outputs)
    noise = generator.normal(size=u.shape)
    return replace(blank, y=model.simulate(blank) + NOISE * noise / noise.std())


@pytest.mark.parametrize("start", ["periodic", "zero"])
def test_a_share_is_what_the_mode_alone_puts_out(start):
    model, slow = assembled()
    record = measured(model, start)
    model = replace(model, K=np.ones((5, 1)), innovation_covariance=np.eye(1))  # no part of it
    poles, share = shares(model, record)
    np.testing.assert_allclose(np.poly(poles), np.poly(model.A), atol=1e-12)
    alone = replace(record, y=np.zeros_like(record.y))
    rms = np.sqrt(np.mean(slow.simulate(alone) ** 2))
    # The record's noise has a mean of about rms / sqrt(N).
    np.testing.assert_allclose(share[np.abs(poles) > 0.95], rms / NOISE, rtol=1e-3)
    assert (share[np.abs(poles) < 0.95] > 5).all()


def test_slow_minor_modes_take_the_radius_of_the_others():
    model, _ = assembled()
    quick = without_slow_minor_modes(model, measured(model))
    radius = np.sort(np.abs(quick.poles))
    np.testing.assert_allclose(radius, [0.5, 0.9, 0.9, 0.9, 0.9], rtol=1e-9)
    angles = np.sort(np.abs(np.angle(quick.poles)))
    np.testing.assert_allclose(angles, [0, 0.2, 0.2, 0.5, 0.5], atol=1e-9)
    # A gain of 2e-3 √(1 - 0.9²) / √(1 - 0.998²) at a distance of 0.18 and more from the pole.
    f = np.linspace(0.06, 0.5, 20)
    np.testing.assert_allclose(quick.frf(f), model.frf(f), rtol=0, atol=0.08)


@pytest.mark.parametrize(
    ("slow", "gain", "minor"),
    [
        (0.998, 1e-3, 0.0),  # nothing is to be minor
        (0.998, 0.3, 1 / 3),  # slow, but it matters
        (0.85, 1e-3, 1 / 3),  # it does not matter, and is not slow
    ],
)
def test_other_models_stay(slow, gain, minor):
    model, _ = assembled(slow, gain)
    assert without_slow_minor_modes(model, measured(model), minor) is model


@pytest.mark.parametrize("slow", [1.0, 1.0005])
def test_modes_that_do_not_fade_stay(slow: float):
    model, _ = assembled(slow, gain=1e-7)
    record = measured(model, "zero")
    assert (shares(model, record)[1] < 0.1).any()
    assert without_slow_minor_modes(model, record) is model


def test_a_model_without_error_stays():
    model, _ = assembled()
    record = measured(model)
    assert without_slow_minor_modes(model, replace(record, y=model.simulate(record))) is model


def test_a_model_of_equal_poles_stays():
    model, _ = assembled()
    A = model.A * 0 + 0.9 * np.eye(5) + np.diag(np.ones(4), 1)
    chain = replace(model, A=A * 0.9)
    assert without_slow_minor_modes(chain, measured(chain)) is chain


@pytest.mark.parametrize(
    ("method", "noise", "slowest"),
    [("paper", False, 0.998), ("zero_output", False, 0.9), ("zero_output", True, 0.998)],
)
def test_the_papers_start_and_a_noise_model_keep_all_modes(method, noise, slowest):
    model, _ = assembled()
    if noise:
        K = np.linalg.solve(model.C.T @ model.C + np.eye(5), 0.1 * model.A @ model.C.T)
        model = replace(model, K=K, innovation_covariance=np.eye(1))
    start = initialise(model, measured(model), nz=1, nw=1, nn=3, method=method)
    poles = np.linalg.eigvals(start.lfr.cell.A.detach().numpy())
    np.testing.assert_allclose(np.abs(poles).max(), slowest, rtol=1e-9)


@pytest.mark.parametrize("unit", [1e-6, 1e3, 1e9])
def test_states_do_not_depend_on_the_units_of_the_signals(unit: float):
    model, _ = assembled()
    whole = replace(
        model,
        C=np.vstack([model.C, model.C @ model.A]),
        D=np.zeros((2, 1)),
        y_offset=np.zeros(2),
        outputs=(Channel("y1"), Channel("y2")),
    )
    generator = np.random.default_rng(0)
    u = generator.normal(size=(4096, 1))
    y = whole.simulate(Record(u, np.zeros((4096, 2)), 1.0)) + generator.normal(size=(4096, 2))

    def quick(scale: np.ndarray) -> np.ndarray:
        scaled = replace(whole, C=scale[:, None] * whole.C)
        return without_slow_minor_modes(scaled, Record(u, y * scale)).A

    expected = quick(np.ones(2))
    assert not np.allclose(expected, whole.A)
    np.testing.assert_allclose(quick(np.array([1.0, unit])), expected, atol=1e-6)
