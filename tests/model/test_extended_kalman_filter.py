"""The extended Kalman filter beside textbook formulas, and on systems that have its noise."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy
import torch
from exported import MODELS, inputs, jacobians, measured_with_gaps, some_noise, step
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import (
    MATRICES,
    POLES,
    measure,
    normal,
    random_cell,
    random_model,
    special_matrix,
    special_poles,
)

import lfrtorch
from lfrtorch import NoiseCovariance
from lfrtorch._support.types import Array
from lfrtorch.engine.kalman_kernel import correct, propagate
from lfrtorch.fitting.state_scaling import scale_states
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


def textbook(
    model: Model, noise: NoiseCovariance, x: Array, P: Array, u: Array, y: Array
) -> tuple[Array, Array]:
    """One sample by covariances, in physical units; outputs that are NaN are left out."""
    Q, R, S = (np.asarray(each) for each in (noise.Q, noise.R, noise.S))
    known = np.isfinite(y)
    e = (y - step(model, x, u)[1])[known]
    H = jacobians(model, x, u)[2][known]
    R, S = R[known][:, known], S[:, known]
    innovations = H @ P @ H.T + R
    L, from_e = P @ H.T @ np.linalg.inv(innovations), S @ np.linalg.inv(innovations)
    x = x + L @ e
    F, I_LH = jacobians(model, x, u)[0], np.eye(len(x)) - L @ H
    P = I_LH @ P @ I_LH.T + L @ R @ L.T
    both = F @ L @ S.T
    return step(model, x, u)[0] + from_e @ e, F @ P @ F.T + Q - from_e @ S.T - both - both.T


def with_own_map(model: Model) -> Model:
    """The same model with a module that is not compiled."""
    cell = copy.deepcopy(model.lfr.cell)
    assert cell.static is not None
    cell.static = torch.nn.Sequential(cell.static)
    return replace(model, lfr=lfrtorch.LFR(cell))


CASES = MODELS | {"own": with_own_map(MODELS["softplus"])}


@pytest.mark.parametrize("name", CASES)
def test_states_and_covariance_are_those_of_the_textbook(name: str):
    model, T = CASES[name], 12
    noise, (u, y) = some_noise(model), measured_with_gaps(model, T)
    x, P = np.full(model.lfr.cell.nx, 0.1), 0.5 * np.eye(model.lfr.cell.nx)
    observer = model.observer(noise=noise, x0=x, P0=0.5)
    at_once = model.observer(noise=noise, x0=x, P0=P)
    for u_k, y_k in zip(u, y, strict=True):
        y_hat = observer.predict(u_k)
        np.testing.assert_allclose(y_hat, step(model, x, u_k)[1], rtol=1e-9, atol=1e-12)
        e = observer.update(None if np.isnan(y_k).all() else y_k)
        np.testing.assert_allclose(e, y_k - y_hat, atol=1e-12)
        x, P = textbook(model, noise, x, P, u_k, y_k)
        np.testing.assert_allclose(observer.state, x, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(observer.covariance, P, rtol=1e-9, atol=1e-12)
    at_once.follow(u, y)
    np.testing.assert_allclose(at_once.state, observer.state, rtol=1e-12)
    np.testing.assert_allclose(at_once.covariance, observer.covariance, rtol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_correct_and_advance_are_an_update_and_know_the_output_between(name: str):
    model, T = CASES[name], 8
    noise, (u, y) = some_noise(model), measured_with_gaps(model, T)
    apart, together = (model.observer(noise=noise, P0=0.5) for _ in range(2))
    R = np.asarray(noise.R)
    for u_k, y_k in zip(u, y, strict=True):
        x, P, known = together.state, together.covariance, np.isfinite(y_k)
        H = jacobians(model, x, u_k)[2][known]
        L = P @ H.T @ np.linalg.inv(H @ P @ H.T + R[known][:, known])
        e = apart.correct(y_k, u_k)
        np.testing.assert_allclose(apart.state, x + L @ e[known], rtol=1e-9, atol=1e-12)
        apart.advance(u_k)
        together.predict(u_k)
        np.testing.assert_allclose(e, together.update(y_k), atol=1e-12)
        np.testing.assert_allclose(apart.state, together.state, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(apart.covariance, together.covariance, rtol=1e-9, atol=1e-12)


def test_advance_alone_is_a_sample_without_outputs_and_states_may_be_set():
    model = MODELS["softplus"]
    noise, u = some_noise(model), inputs(model, 2)
    first, second = (model.observer(noise=noise) for _ in range(2))
    second.state, second.covariance = first.state, first.covariance
    first.advance(u[0])
    second.predict(u[0])
    second.update(None)
    np.testing.assert_allclose(first.state, second.state, rtol=1e-12)
    np.testing.assert_allclose(first.covariance, second.covariance, rtol=1e-12)
    first.state = np.ones(model.lfr.cell.nx)
    assert (first.state == 1.0).all()
    with pytest.raises(ValueError, match="state has the shape"):
        first.state = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    with pytest.raises(ValueError, match="covariance has a negative eigenvalue"):
        first.covariance = -np.eye(model.lfr.cell.nx)


def test_the_input_is_needed_only_with_feedthrough_and_a_sample_is_corrected_once():
    model = MODELS["softplus"]
    observer = model.observer(noise=some_noise(model))
    y, u = model.scaler.y_offset, model.scaler.u_offset
    with pytest.raises(ValueError, match="give correct\\(y, u\\)"):
        observer.correct(y)
    cell = copy.deepcopy(model.lfr.cell)
    with torch.no_grad():
        cell.Dyu.zero_()
        cell.Dzu.zero_()
    observer = replace(model, lfr=lfrtorch.LFR(cell)).observer(noise=some_noise(model))
    observer.correct(y)
    for again in (lambda: observer.correct(y), lambda: observer.predict(u)):
        with pytest.raises(ValueError, match="call advance"):
            again()


@pytest.mark.parametrize("at", ["input", "output", "matrix"])
def test_an_observer_finds_a_constant_disturbance(at: str):
    model, T = MODELS["softplus"], 300
    nu, ny = len(model.inputs), len(model.outputs)
    E = np.ones((nu + ny, 1))
    u, amount = inputs(model, T), 0.2
    if at == "input":
        E = np.eye(nu + ny, nu)[:, :1]
    d = np.full(E.shape[1] if at != "output" else ny, amount)
    Eu = E[:nu] @ d if at != "output" else np.zeros(nu)
    Ey = E[nu:] @ d if at != "output" else d
    y = model.simulate(u + Eu) + Ey
    noise = NoiseCovariance(1e-8, np.diag((1e-3 * model.scaler.y_scale) ** 2))
    observer = model.observer(noise=noise, disturbance=E if at != "output" else at)
    whole, all_noise = model.with_disturbance(E if at != "output" else at, noise)
    same = whole.observer(noise=all_noise)
    for u_k, y_k in zip(u, y, strict=True):
        same.predict(u_k)
        same.update(y_k)
        observer.correct(y_k, u_k)
        observer.advance(u_k)
    np.testing.assert_allclose(observer.disturbance, d, rtol=0.05)
    np.testing.assert_allclose(same.state, [*observer.state, *observer.disturbance], rtol=1e-9)


def test_disturbances_that_the_outputs_do_not_tell_are_refused():
    model = MODELS["softplus"]
    noise, count = some_noise(model), len(model.inputs) + len(model.outputs)
    with pytest.raises(ValueError, match="do not distinguish"):
        model.observer(noise=noise, disturbance=np.eye(count))
    with pytest.raises(ValueError, match="disturbance is 'load'"):
        model.with_disturbance("load", noise)
    with pytest.raises(ValueError, match="finite numbers"):
        model.with_disturbance(np.ones((count + 1, 1)), noise)
    with pytest.raises(ValueError, match="give noise, too"):
        model.observer(disturbance="input")  # pyright: ignore[reportCallIssue]


def test_a_linear_model_settles_at_the_solution_of_the_riccati_equation():
    model = MODELS["linear"]
    noise = some_noise(model)
    observer = model.observer(noise=noise)
    u = inputs(model, 400)
    observer.follow(u, model.simulate(u))
    F, _, H, _ = jacobians(model, np.zeros(3), u[0])
    P = scipy.linalg.solve_discrete_are(F.T, H.T, noise.Q, noise.R, s=noise.S)
    np.testing.assert_allclose(observer.covariance, P, rtol=1e-9, atol=1e-12)


def test_the_likelihood_is_that_of_all_outputs_together():
    """y of a linear model is normal; its covariance is built from the responses to all noise."""
    model, T = MODELS["linear"], 6
    noise, s = some_noise(model), model.scaler
    F, _, H, _ = jacobians(model, np.zeros(3), s.u_offset)
    Q, R, S = (np.asarray(each) for each in (noise.Q, noise.R, noise.S))
    joint = np.block([[Q, S], [S.T, R]])
    responses = np.zeros((T, 2, 3 + 5 * T))  # to x0, and w and v of every sample
    for k in range(T):
        responses[k, :, :3] = H @ np.linalg.matrix_power(F, k)
        for j in range(k):
            at = 3 + 5 * j
            responses[k, :, at : at + 3] = H @ np.linalg.matrix_power(F, k - 1 - j)
        responses[k, :, 3 + 5 * k + 3 : 3 + 5 * k + 5] = np.eye(2)
    flat = (responses / s.y_scale[:, None]).reshape(2 * T, -1)
    inside = scipy.linalg.block_diag(2.0 * np.eye(3), *[joint] * T)
    u = inputs(model, T)
    y_hat = model.simulate(u)
    y = y_hat + s.y_scale * np.random.default_rng(3).normal(size=(T, 2))
    expected = scipy.stats.multivariate_normal.logpdf(
        ((y - y_hat) / s.y_scale).ravel(), cov=flat @ inside @ flat.T
    )
    assert model.observer(noise=noise, P0=2.0).follow(u, y) == pytest.approx(expected, rel=1e-9)


def test_with_the_noise_of_an_innovation_form_it_has_the_gain_K():
    model = replace(random_model(random_cell(2, 2, 3, 2, 1, 4)), K=0.2 * normal(3, 2, seed=5))
    assert model.K is not None
    K, R = model.K.numpy() / model.scaler.y_scale, np.diag([0.3, 0.2])
    noise = NoiseCovariance(K @ R @ K.T, R, K @ R)
    steady, observer = model.observer(), model.observer(noise=noise, P0=0.0)
    u = inputs(model, 50)
    y = model.simulate(u) + np.random.default_rng(0).normal(size=(50, 2))
    for u_k, y_k in zip(u, y, strict=True):
        np.testing.assert_allclose(observer.predict(u_k), steady.predict(u_k), rtol=1e-9)
        for each in (observer, steady):
            each.update(y_k)
    assert np.abs(observer.covariance).max() < 1e-12
    observer.predict(u[0])
    observer.update([np.nan, y[0, 1]])
    assert np.trace(observer.covariance) > 1e-3  # what is not measured is not known


@pytest.mark.parametrize("name", ["tanh", "polynomial"])
def test_errors_are_as_large_as_the_covariance_says(name: str):
    """NEES: e' P⁻¹ e has the mean nx; 60 independent runs leave the square root of 2 nx / 60."""
    model, runs, T = MODELS[name], 60, 40
    nx, ny = model.lfr.cell.nx, len(model.outputs)
    scale, rng = model.scaler.y_scale, np.random.default_rng(0)
    noise = NoiseCovariance(Q=4e-4, R=1e-2 * scale**2)
    u, x, y = inputs(model, T), 0.1 * rng.normal(size=(runs, nx)), np.empty((runs, T, ny))
    for k in range(T):
        x_next, y[:, k] = step(model, x, np.tile(u[k], (runs, 1)))
        y[:, k] += 0.1 * scale * rng.normal(size=(runs, ny))
        x = x_next + 0.02 * rng.normal(size=(runs, nx))
    squares = []
    for each, end in zip(y, x, strict=True):
        observer = model.observer(noise=noise, P0=0.01)
        observer.follow(u, each)
        e = observer.state - end
        squares.append(e @ np.linalg.solve(observer.covariance, e))
    low, high = scipy.stats.chi2.ppf([1e-4, 1 - 1e-4], runs * nx) / runs
    assert low < np.mean(squares) < high


def test_it_begins_with_the_covariance_of_the_states_in_the_data():
    """Amid a record it knows the state after few samples, however large the states were."""
    model = random_model(random_cell(1, 1, 2, 1, 1, 3), seed=1)
    cell, far = model.lfr.cell, torch.tensor([30.0, 100.0], dtype=torch.float64)
    with torch.no_grad():
        cell.A.copy_(cell.A * far[:, None] / far)
        for into, of in ((cell.Bu, cell.Cy), (cell.Bw, cell.Cz)):
            into.mul_(far[:, None])
            of.div_(far)
    record = measure(model, 300)

    def error_after_two_samples() -> float:
        x = model.signals(record).x[0].numpy()
        noise = NoiseCovariance(1e-6 * x.var(axis=0), 1e-4 * model.scaler.y_scale**2)
        observer = model.observer(noise=noise)
        assert np.allclose(observer.covariance, model.state_covariance)
        for k in (100, 101):
            observer.predict(record.u[k])
            observer.update(record.y[k])
        return float(np.abs((observer.state - x[102]) / x.std(axis=0)).max())

    assert error_after_two_samples() > 0.1
    scale_states(model, record)
    assert error_after_two_samples() < 0.05


def test_past_data_give_the_state_where_a_simulation_starts():
    """Also without outputs in between: the start of a free run, from any x0."""
    model, rng = MODELS["tanh"], np.random.default_rng(0)
    u = inputs(model, 300)
    truth = model.simulate(u, start="given", x0=[3.0, -2.0, 1.0, 2.0])
    y = truth + 0.01 * model.scaler.y_scale * rng.normal(size=truth.shape)
    record = lfrtorch.Record(u, y, fs=model.fs, inputs=model.inputs, outputs=model.outputs)
    noise = NoiseCovariance(Q=0.0, R=(0.01 * model.scaler.y_scale) ** 2)
    x0 = model.observer(noise=noise, after=record[:10]).state
    found = model.simulate(u[10:], start="given", x0=x0)
    error = np.abs(found - truth[10:]) / model.scaler.y_scale
    assert error.max() < 0.05
    rest = np.abs(model.simulate(u[10:]) - truth[10:]) / model.scaler.y_scale
    assert rest.max() > 0.2


@pytest.mark.parametrize(
    ("said", "given"),
    [
        ("no innovation gain K: give noise", {}),
        ("Q has the shape", {"noise": NoiseCovariance(Q=[1.0, 2.0], R=1.0)}),
        ("Q is not symmetric", {"noise": NoiseCovariance(Q=np.triu(np.ones((3, 3))), R=1.0)}),
        ("Q is not symmetric, or not finite", {"noise": NoiseCovariance(Q=np.inf, R=1.0)}),
        ("negative eigenvalue", {"noise": NoiseCovariance(Q=-1.0, R=1.0)}),
        ("negative eigenvalue", {"noise": NoiseCovariance(1.0, 1.0, 2.0 * np.ones((3, 2)))}),
        ("R is not positive", {"noise": NoiseCovariance(Q=1.0, R=0.0)}),
        ("S has the shape", {"noise": NoiseCovariance(1.0, 1.0, np.ones((2, 3)))}),
        ("P0 has a negative", {"noise": NoiseCovariance(1.0, 1.0), "P0": [1.0, -1.0, 1.0]}),
        ("x0 has the shape", {"noise": NoiseCovariance(1.0, 1.0), "x0": [1.0]}),
    ],
)
def test_what_is_no_noise_is_refused(said: str, given: dict[str, Any]):
    with pytest.raises(lfrtorch.InputError, match=said):
        MODELS["linear"].observer(**given)


def test_an_infinite_output_is_refused():
    observer = MODELS["linear"].observer(noise=NoiseCovariance(1.0, 1.0))
    observer.predict([0.0, 0.0])
    with pytest.raises(lfrtorch.InputError, match="NaN for a missing output"):
        observer.update([np.inf, 0.0])


@given(
    poles=st.sampled_from(POLES),
    kind=st.sampled_from(MATRICES),
    sizes=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    noise=st.sampled_from([0.0, 1e-12, 1.0, 1e6]),
    gain=st.sampled_from([0.0, 1e-3, 1.0]),
    missing=st.sampled_from([0.0, 0.5, 1.0]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40)
def test_roots_of_any_covariances_are_those_of_the_textbook(
    poles: str,
    kind: str,
    sizes: tuple[int, int],
    noise: float,
    gain: float,
    missing: float,
    seed: int,
):
    """P singular or 0, states without noise, outputs that show nothing or are missing."""
    (nx, ny), rng = sizes, np.random.default_rng(seed)
    F, H = special_poles(poles, nx, rng), gain * special_matrix(kind, ny, nx, rng)
    H /= max(1.0, float(np.abs(H).max()))
    U = special_matrix(kind, nx, nx, rng)
    U /= max(1.0, float(np.abs(U).max()))
    G = np.tril(rng.normal(size=(ny + nx, ny + nx)))
    G[:ny, :ny] = np.eye(ny)
    G[ny:] *= np.sqrt(noise)
    joint, P, e = G @ G.T, U @ U.T, rng.normal(size=ny)
    e[rng.random(ny) < missing] = np.nan
    known = np.isfinite(e)
    x, w = np.zeros(nx), np.zeros(nx)
    M, count, log_p = correct(e.copy(), H, G, x, U, w)
    H, R = H[known], joint[:ny, :ny][known][:, known]
    Q, S, V = joint[ny:, ny:], joint[ny:, :ny][:, known], H @ P @ H.T + R
    L, W = P @ H.T @ np.linalg.inv(V), S @ np.linalg.inv(V)
    # The condition of V is at most 1 + |H|² |P|: 30.
    size = 1e-12 * (1.0 + np.abs(S).max(initial=0.0))
    np.testing.assert_allclose(x, L @ e[known], rtol=0, atol=1e-12)
    np.testing.assert_allclose(w, W @ e[known], rtol=0, atol=size)
    expected = -0.5 * (e[known] @ np.linalg.inv(V) @ e[known] + np.linalg.slogdet(2 * np.pi * V)[1])
    assert log_p == pytest.approx(expected, rel=1e-12, abs=1e-12)
    propagate(F, M, count, U)
    across = F @ L @ S.T
    after = F @ (P - L @ V @ L.T) @ F.T + Q - W @ S.T - across - across.T
    limit = 1e-11 * (1.0 + np.abs(Q).max() + np.abs(F).max() ** 2)
    np.testing.assert_allclose(U @ U.T, after, rtol=0, atol=limit)
