"""Linear fits to signals: exact without noise, efficient and with the right covariance with it."""

import numpy as np
import pytest
import reference
import scipy.linalg
from reference import Array, System, random_system, refined

from lfrtorch.linear.signal_fit import SignalFit
from lfrtorch.records import Record

pytestmark = pytest.mark.numeric

OMEGA = np.linspace(0.05, 3.0, 40)


def fit_of(records: list[Record], **options: bool) -> SignalFit:
    options = {"offset": False, "prediction": False} | options
    return SignalFit([r.u for r in records], [r.y for r in records], records, **options)


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


@pytest.mark.parametrize("kind", ["white", "coloured", "prediction"])
@pytest.mark.slow
def test_covariance_is_that_of_many_fits(kind: str):
    """The pole of a first-order system, over 60 records: simulation errors of any spectrum."""
    prediction = kind == "prediction"
    system = np.array([[0.8]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]])
    K = np.array([[0.0 if kind == "white" else 0.7]])
    poles, predicted = [], []
    for seed in range(60):
        record, _ = innovations(system, K, 300, seed=100 + seed)
        found = refined(fit_of([record], prediction=prediction), system, 15)
        poles.append(found.A[0, 0])
        assert found.covariance is not None
        predicted.append(found.covariance[0, 0])
    # The gauge of one state scales B and C and leaves A alone; √(2 / 59) = 0.18, four of them.
    assert np.mean(predicted) == pytest.approx(np.var(poles, ddof=1), rel=0.73)


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

    assert ratio(1e-6) > 100.0 * ratio(0.05)
    assert ratio(0.05) < 1.1
    # From rest there is no start state, and nothing to add.
    at_rest = fit_of([Record(u, drift, fs=1.0)])
    search = at_rest.search((0.9 * np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1))))
    assert at_rest.improbability(search) == search.state.cost
