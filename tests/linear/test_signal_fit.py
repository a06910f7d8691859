"""Linear fits to signals: exact without noise, efficient and with the right covariance with it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import reference
import scipy.linalg
from reference import System, random_system, refined

from lfrtorch._support.types import Array
from lfrtorch.data.records import NormalisedRecord, Record
from lfrtorch.linear.signal_fit import OBSERVERS, SignalFit

pytestmark = pytest.mark.numeric

OMEGA = np.linspace(0.05, 3.0, 40)


def fit_of(records: list[Record], **options: Any) -> SignalFit:
    options = {"offset": False, "prediction": False} | options
    return SignalFit([NormalisedRecord(r.u, r.y, r) for r in records], **options)


def innovations(
    system: System, K: Array, T: int, seed: int, size: float = 0.3, y0: float = 0.0
) -> tuple[Record, Array]:
    """A record of x+ = A x + B u + K e, y = C x + D u + e + y0, and its innovations."""
    A, B, C, D = system
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=(T, B.shape[1])), size * rng.normal(size=(T, len(C)))
    both = A, np.hstack([B, K]), C, np.hstack([D, np.eye(len(C))])
    return Record(u, reference.dlsim(both, np.hstack([u, e])) + y0), e


def error(matrices: System, system: System) -> float:
    G = reference.frf(system, OMEGA)
    return float(np.abs(reference.frf(matrices, OMEGA) - G).max() / np.abs(G).max())


@pytest.mark.parametrize("start", ["zero", "estimated", "periodic"])
@pytest.mark.parametrize(("nu", "ny"), [(1, 1), (2, 2)])
def test_input_matrices_are_exact_for_the_true_A_and_C(nu: int, ny: int, start):
    system = random_system(3, nu, ny)
    u = np.random.default_rng(0).normal(size=(250, nu))
    if start == "periodic":
        record = Record(u, reference.periodic_response(system, u), start=start)
    else:
        first = 50 if start == "estimated" else 0
        record = Record(u[first:], reference.dlsim(system, u)[first:] + 5.0, start=start)
    cost, found = fit_of([record], offset=True).with_input_matrices(system[0], system[2])
    # Rounding of a least-squares problem of good condition, squared and summed.
    assert cost < 1e-20
    assert error(found, system) < 1e-10


def test_refined_simulation_leaves_the_offset_and_the_start_to_the_fit():
    system = random_system(2)
    u = np.random.default_rng(1).normal(size=(300, 1))
    record = Record(u[40:], reference.dlsim(system, u)[40:] - 2.0, start="estimated")
    A, B, C, D = system
    found = refined(fit_of([record], offset=True), (0.98 * A, B, 1.02 * C, D), 50)
    assert error(found.matrices, system) < 1e-9
    assert found.constant is not None
    np.testing.assert_allclose(found.constant, [-2.0], rtol=0, atol=1e-8)
    assert found.K is None
    assert found.rmse < 1e-9


@pytest.mark.parametrize(("nu", "ny"), [(1, 1), (2, 2)])
def test_prediction_finds_the_innovation_model(nu: int, ny: int):
    system = random_system(2, nu, ny)
    A, _, C, _ = system
    P = scipy.linalg.solve_discrete_are(A.T, C.T, np.eye(2), 0.5 * np.eye(ny))
    K = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + 0.5 * np.eye(ny))
    record, e = innovations(system, K, 8_000, seed=2, y0=0.5)
    found = refined(fit_of([record], offset=True, prediction=True), system, 60)
    # The innovations' rms is known to 1 / √(2 · 8000), and the fit takes off 10 parameters of it.
    assert found.rmse == pytest.approx(np.sqrt(np.mean(e**2)), rel=4 / np.sqrt(2 * e.size) + 1e-3)
    assert found.K is not None
    assert found.innovation_covariance is not None
    assert found.constant is not None
    # The mean of 8000 samples, whose noise has a gain of at most 10 and u another.
    np.testing.assert_allclose(found.constant, np.full(ny, 0.5), rtol=0, atol=0.1)
    noise_model = found.A, found.K, found.C, np.eye(ny)
    # |K e| / |e| is of order 1, and known to about 1 / √8000 = 1.1 % for each parameter.
    assert error(noise_model, (A, K, C, np.eye(ny))) < 0.08
    assert error(found.matrices, system) < 0.03
    np.testing.assert_allclose(
        found.innovation_covariance, np.cov(e.T, bias=True).reshape(ny, ny), rtol=0.02, atol=1e-3
    )


def test_prediction_is_more_precise_than_simulation_where_the_noise_is_coloured():
    system = np.array([[0.9]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]])
    K = np.array([[0.9]])  # noise through the system's own pole, as in ARX models
    spread = {}
    for prediction in (False, True):
        poles = []
        for seed in range(12):
            record, _ = innovations(system, K, 300, seed=10 + seed, size=2.0)
            found = refined(fit_of([record], prediction=prediction), system, 10)
            poles.append(found.A[0, 0] - 0.9)
        spread[prediction] = np.sqrt(np.mean(np.square(poles)))
    # 1.7 in deviation is a factor of 3 in variance, which 12 runs tell apart (F distribution).
    assert 1.7 * spread[True] < spread[False]


def predictor(system: System, K: Array) -> System:
    """The one-step-ahead predictor of an innovation model, driven by u and y."""
    A, B, C, D = system
    return A - K @ C, np.hstack([B - K @ D, K]), C, np.hstack([D, np.zeros((len(C), len(C)))])


def test_fit_of_a_predictor_describes_its_own_errors():
    """The prediction errors of what is found, where the start is forgotten: 0.6^60 = 5e-14."""
    K = np.array([[0.5, 0.1], [0.0, 0.4]])
    A, C = np.array([[0.9, 0.2], [0.0, 0.8]]), np.eye(2)
    system = A, np.ones((2, 1)), C, np.array([[0.5], [0.0]])
    record, _ = innovations(system, K, 140, seed=2, y0=3.0)
    record = Record(record.u, record.y, skip=70)
    found = refined(fit_of([record], offset=True, prediction=True), system, 5)
    assert found.K is not None
    assert found.constant is not None
    assert found.innovation_covariance is not None
    y = record.y - found.constant
    e = (y - reference.dlsim(predictor(found.matrices, found.K), np.hstack([record.u, y])))[70:]
    assert found.rmse == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-6)
    # Without their means, over as many as there are: one fewer would be 1.4 % off.
    e -= e.mean(axis=0)
    np.testing.assert_allclose(found.innovation_covariance, e.T @ e / 70, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("best", range(len(OBSERVERS)))
def test_prediction_starts_from_the_best_of_the_observers(best: int):
    """Steady-state Kalman gains: state noise of a part of the states' variance, output noise 1."""
    A, C = np.array([[0.95, 0.1], [0.0, 0.8]]), np.array([[1.0, 0.5], [0.0, 1.0]])
    system = A, np.array([[2.0], [1.0]]), C, np.array([[0.5], [0.0]])
    record, _ = innovations(system, np.zeros((2, 2)), 400, seed=4)
    states = reference.dlsim((A, system[1], np.eye(2), np.zeros((2, 1))), record.u)
    gains = []
    for part in OBSERVERS:
        P, K = np.zeros((2, 2)), np.zeros((2, 2))
        for _ in range(200):  # the Riccati equation, until it stands
            S = C @ P @ C.T + np.eye(2)
            K = A @ P @ C.T @ np.linalg.inv(S)
            P = A @ P @ A.T - K @ S @ K.T + part * np.diag(states.var(axis=0))
        gains.append(K)
    record, e = innovations(system, gains[best], 400, seed=4)
    driven = np.hstack([record.u, record.y])
    errors = [record.y - reference.dlsim(predictor(system, K), driven) for K in gains]
    costs = [np.sum(error**2) for error in errors]
    assert costs[best] == pytest.approx(np.sum(e**2))
    assert np.argmin(costs) == best
    fit = fit_of([record], prediction=True)
    np.testing.assert_allclose(fit.state_deviation(system), states.std(axis=0), rtol=1e-9)
    assert fit.search(system).state.cost == pytest.approx(costs[best], rel=1e-8)
    # No observer if none is asked for.
    simulated = np.sum((record.y - reference.dlsim(system, record.u)) ** 2)
    assert fit_of([record]).search(system).state.cost == pytest.approx(simulated, rel=1e-8)


def markov(theta: Array, nu: int, ny: int) -> Array:
    """D, C B and C A B of A, B, C, D by rows, of two states: what no coordinates change."""
    parts = np.split(theta, np.cumsum([4, 2 * nu, 2 * ny, ny * nu])[:-1])
    A, B, C, D = (p.reshape(-1, n) for p, n in zip(parts, (2, nu, 2, nu), strict=True))
    return np.concatenate([m.ravel() for m in (D, C @ B, C @ A @ B, C @ A @ A @ B)])


def slope(function: Callable[[Array], Array], theta: Array) -> Array:
    """Central differences: rounding leaves 1e-10 and the step 1e-12, times conditions of 1e3."""
    h = 1e-6 * np.eye(len(theta))
    return np.stack([(function(theta + d) - function(theta - d)) / 2e-6 for d in h], axis=1)


def test_covariance_of_simulation_errors_is_a_sum_over_their_lines():
    """JᵀJ's inverse around the sum of g gᵀ, g = Jᵀ (the error's part in a line of a record)."""
    nu, ny = 2, 2
    system = random_system(2, nu, ny)
    records = []
    for T, size in ((16, 1.0), (16, 2.0), (21, 1.0)):  # with a line at half the sample rate or not
        rng = np.random.default_rng([T, int(size)])
        u, e = size * rng.normal(size=(T, nu)), rng.normal(size=(T, ny))
        records.append(Record(u, reference.dlsim(system, u) + e + 0.5 * np.roll(e, 1)))
    found = refined(fit_of(records, offset=True), system, 3)
    assert found.covariance is not None
    assert found.constant is not None

    def errors(theta: Array) -> Array:
        parts = np.split(theta, np.cumsum([4, 2 * nu, 2 * ny, ny * nu]))
        A, B, C, D = (p.reshape(-1, n) for p, n in zip(parts[:4], (2, nu, 2, nu), strict=True))
        return np.concatenate(
            [reference.dlsim((A, B, C, D), r.u) + parts[4] - r.y for r in records]
        ).ravel()

    theta = np.concatenate([*(m.ravel() for m in found.matrices), found.constant])
    J, r = slope(errors, theta), errors(theta)
    inverse = np.linalg.pinv(J, rcond=1e-6)
    meat, first = np.zeros((len(theta), len(theta))), 0
    for record in records:
        T = len(record.u)
        rows = slice(first * ny, (first + T) * ny)
        for k in range(T // 2 + 1):
            angle = 2 * np.pi * k / T * np.arange(T)
            both = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            line = both @ np.linalg.pinv(both, rcond=1e-6)
            g = J[rows].T @ (line @ r[rows].reshape(T, ny)).ravel()
            meat += np.outer(g, g)
        first += T
    # 53 samples of 2 outputs, less 2 (2 + 2) + 4 of the system and 2 constants.
    spread = inverse @ inverse.T @ meat @ inverse @ inverse.T * (106 / (106 - 14))
    of_theta = slope(lambda t: markov(t, nu, ny), theta[:-2])
    np.testing.assert_allclose(
        np.diag(of_theta @ found.covariance @ of_theta.T),
        np.diag(of_theta @ spread[:-2, :-2] @ of_theta.T),
        rtol=1e-5,
    )


@pytest.mark.parametrize("T", [8, 30])
def test_covariance_of_prediction_errors_is_that_of_white_ones(T: int):
    """JᵀJ's inverse times the errors' variance, by differences of the predictor's errors."""
    system = random_system(2)
    record, _ = innovations(system, np.full((2, 1), 0.3), T, seed=5)
    found = refined(fit_of([record], prediction=True), system, 5)
    assert found.covariance is not None
    assert found.K is not None

    def errors(theta: Array) -> Array:
        parts = np.split(theta, np.cumsum([4, 2, 2, 1]))
        A, B, C, D, K = (p.reshape(-1, n) for p, n in zip(parts, (2, 1, 2, 1, 1), strict=True))
        driven = np.hstack([record.u, record.y])
        return (record.y - reference.dlsim(predictor((A, B, C, D), K), driven)).ravel()

    theta = np.concatenate([*(m.ravel() for m in found.matrices), found.K.ravel()])
    inverse = np.linalg.pinv(slope(errors, theta), rcond=1e-6)
    # T samples, less 2 · 2 + 1 of the system and 2 of the observer.
    spread = inverse @ inverse.T * np.sum(errors(theta) ** 2) / (T - 7)
    of_theta = slope(lambda t: markov(t, 1, 1), theta[:-2])
    np.testing.assert_allclose(
        np.diag(of_theta @ found.covariance @ of_theta.T),
        np.diag(of_theta @ spread[:-2, :-2] @ of_theta.T),
        rtol=1e-5,
    )


def test_covariance_of_a_predictor_is_that_of_its_system():
    """By the linear map of A' = A - K C and B' = B - K D, written out for small changes."""
    system = random_system(2, 1, 1)
    record, _ = innovations(system, np.array([[0.3], [0.2]]), 800, seed=7)
    fit = fit_of([record], prediction=True)
    rng = np.random.default_rng(0)
    C, D, K = rng.normal(size=(1, 2)), rng.normal(size=(1, 1)), rng.normal(size=(2, 1))
    sizes = [4, 4, 2, 2]  # A', [B' K], C, [D 0]

    def original(theta: Array) -> Array:
        A_, BK, C_, D_ = np.split(theta, np.cumsum(sizes)[:-1])
        B_, K_ = BK.reshape(2, 2)[:, :1], BK.reshape(2, 2)[:, 1:]
        C_, D_ = C_.reshape(1, 2), D_.reshape(1, 2)[:, :1]
        A = A_.reshape(2, 2) + K_ @ C_
        return np.concatenate([m.ravel() for m in (A, B_ + K_ @ D_, C_, D_)])

    A_, B_ = rng.normal(size=(2, 2)), rng.normal(size=(2, 1))
    theta = np.concatenate(
        [A_.ravel(), np.hstack([B_, K]).ravel(), C.ravel(), np.hstack([D, 0 * D]).ravel()]
    )
    h = 1e-6
    change = np.stack(
        [(original(theta + h * d) - original(theta - h * d)) / (2 * h) for d in np.eye(12)], axis=1
    )
    root = rng.normal(size=(12, 12))
    covariance = root @ root.T
    found = fit._of_system(covariance, C, D, K)
    np.testing.assert_allclose(found, change @ covariance @ change.T, rtol=1e-7, atol=1e-6)


def test_unstable_system_of_a_stable_predictor_is_refused():
    """The predictor of an unstable system can be stable; the model must not be unstable."""
    system = np.array([[1.01]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]])
    record, _ = innovations(system, np.array([[0.5]]), 300, seed=3)
    inside = np.array([[0.99]]), *system[1:]
    found = refined(fit_of([record], prediction=True), inside, 20)
    assert abs(found.A[0, 0]) < 1


def test_start_states_that_no_input_leads_to_are_improbable():
    """A mode that the input hardly moves fits a drift; one that it moves as far does not."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(400, 1))
    drift = 0.999 ** np.arange(400.0)[:, None]
    record = Record(u, drift + 0.01 * rng.normal(size=(400, 1)), fs=1.0, start="estimated")
    problem = fit_of([record])

    def ratio(gain: float) -> float:
        matrices = np.array([[0.999]]), np.array([[gain]]), np.eye(1), np.zeros((1, 1))
        search = problem.search(matrices)
        return problem.improbability(search) / search.state.cost

    # x0ᵀ P⁻¹ x0 times the errors' variance, of two states, by records that both count.
    B, C = np.array([[1.0], [0.5]]), np.eye(2)
    matrices = np.diag([0.9, 0.5]), B, C, np.zeros((2, 1))
    clean = reference.dlsim(matrices, u)
    noisy = clean + rng.normal(size=clean.shape)
    records = [Record(u[10:60], noisy[10:60], start="estimated"), Record(u, noisy)]
    both = fit_of(records)
    search = both.search(matrices).advance(1)
    errors = search.problem.errors
    (x0,) = errors.parameters.initial_states(search.state.theta).numpy()
    W = errors.parameters.weights(search.state.theta)
    A, B = W.A.numpy(), W.Bu.numpy()
    # The state after the last sample counts, too.
    states = [reference.dlsim((A, B, C, 0 * B), np.vstack([r.u, [[0.0]]])) for r in records]
    P = sum(x.T @ x for x in states) / 452
    variance = search.state.cost / 900
    expected = search.state.cost + variance * x0 @ np.linalg.solve(P, x0)
    assert both.improbability(search) == pytest.approx(expected, rel=1e-9)

    assert ratio(1e-6) > 100.0 * ratio(0.05)
    assert ratio(0.05) < 1.1
    # From rest there is no start state, and nothing to add.
    at_rest = fit_of([Record(u, drift, fs=1.0)])
    search = at_rest.search((0.9 * np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1))))
    assert at_rest.improbability(search) == search.state.cost


@pytest.mark.parametrize(
    ("start", "predicted_from"),
    [("zero", "zero"), ("estimated", "estimated"), ("periodic", "estimated")],
)
def test_prediction_estimates_the_start_of_what_repeats_but_for_its_noise(start, predicted_from):
    u = np.random.default_rng(0).normal(size=(60, 1))
    record = NormalisedRecord(u, u, Record(u, u, 10.0, start))
    options = {"offset": False, "feedthrough": True}
    (driven,) = SignalFit([record], prediction=True, **options)._driven
    assert driven.record.start == predicted_from
    (driven,) = SignalFit([record], prediction=False, **options)._driven
    assert driven.record.start == start


def test_an_input_that_acts_on_the_output_alone():
    system, rng = random_system(2), np.random.default_rng(1)
    A, B, C, D = system
    u, ramp = rng.normal(size=(200, 1)), 0.9 ** np.arange(200.0)[:, None]
    record = Record(np.hstack([u, ramp]), reference.dlsim(system, u) + 3.0 * ramp)
    whole = np.hstack([B, np.zeros((2, 1))]), np.hstack([D, np.zeros((1, 1))])
    found = refined(fit_of([record], direct=1), (0.98 * A, whole[0], 1.02 * C, whole[1]), 50)
    assert not found.B[:, 1].any()
    assert error((found.A, found.B[:, :1], found.C, found.D[:, :1]), system) < 1e-9
    assert found.D[0, 1] == pytest.approx(3.0, abs=1e-8)
