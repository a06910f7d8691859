"""SpectralData: the same sum of squares as the simulation error, its slope, and its covariance."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import reference
import torch
from reference import System, random_system, refined

from lfrtorch._support.types import Array, Complex
from lfrtorch.data.records import Channel, NormalisedRecord, Record
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.resolvent import frequency_response
from lfrtorch.linear.response_fit import ResponseFit, ResponseProblem
from lfrtorch.linear.spectral_data import (
    SpectralData,
    spectral_data_of_records,
    spectral_data_of_response,
)

pytestmark = pytest.mark.numeric


def records_of(
    nx: int, nu: int, ny: int, lengths: tuple[int, ...] = (64, 64, 64, 45), noise: float = 0.3
) -> list[Record]:
    """Noisy steady-state records of several lengths, one of two periods."""
    system, rng = random_system(nx, nu, ny), np.random.default_rng(1)
    found = []
    for T in lengths:
        u = rng.normal(size=(T, nu)) + 1.0
        y = reference.periodic_response(system, u) + noise * rng.normal(size=(T, ny))
        found.append(Record(u, y, start="periodic"))
    u, y = found[0].u, found[0].y + noise * rng.normal(size=found[0].y.shape)
    period = len(u)
    return [*found, Record(np.tile(u, (2, 1)), np.vstack([found[0].y, y]), 1.0, "periodic",
                           period=period)]  # fmt: skip


def lines(records: list[Record], *, offset: bool) -> SpectralData:
    found = spectral_data_of_records(
        [NormalisedRecord(r.u, r.y, r) for r in records], offset=offset
    )
    assert found is not None
    return found


def simulation_cost(system: System, records: list[Record], *, offset: bool) -> float:
    """Mean squared simulation error, with the best constant in the output taken off or not."""
    errors = [r.y - reference.periodic_response(system, r.u) for r in records]
    roots = [np.sqrt(np.max(r.weight)) * np.ones((len(r.u), 1)) for r in records]
    e, one = np.concatenate(errors), np.concatenate(roots)
    constant = (one**2 * e).sum(axis=0) / (one**2).sum() if offset else 0.0
    return float(((one * (e - constant)) ** 2).sum() / len(e))


@pytest.mark.parametrize("offset", [True, False])
@pytest.mark.parametrize(("nu", "ny"), [(1, 1), (2, 3)])
def test_cost_is_the_simulation_error_up_to_a_constant(nu: int, ny: int, offset: bool):
    records = records_of(3, nu, ny)
    problem = ResponseProblem(lines(records, offset=offset), 3)
    costs = []
    for seed in (1, 2):
        system = random_system(3, nu, ny, seed=seed)
        theta = torch.as_tensor(np.concatenate([m.ravel() for m in system]))
        by_lines = problem.cost(problem.residual(theta))
        costs.append((by_lines, simulation_cost(system, records, offset=offset)))
    (a, b), (c, d) = costs
    assert a - c == pytest.approx(b - d, rel=1e-10)


def test_more_records_than_inputs_are_as_many_columns_as_inputs():
    assert lines(records_of(2, 2, 1), offset=True).U.shape[2] == 2


def test_weights_of_records_count():
    plain = records_of(2, 1, 1, lengths=(64, 64))
    weighted = [Record(r.u, r.y, start="periodic", weight=w) for r, w in zip(plain, (1, 9))]  # noqa: B905
    problem = ResponseProblem(lines(weighted, offset=True), 2)
    costs = []
    for seed in (1, 2):
        system = random_system(2, seed=seed)
        theta = torch.as_tensor(np.concatenate([m.ravel() for m in system]))
        by_lines = problem.cost(problem.residual(theta))
        costs.append(by_lines - simulation_cost(system, weighted, offset=True))
    assert costs[0] == pytest.approx(costs[1], rel=1e-10)


def test_weights_of_lines_are_those_of_the_whole_record():
    """Of three periods every third line counts; line 0 is taken up by the offset."""
    rng, N = np.random.default_rng(0), 32
    u, y = (np.tile(rng.normal(size=(N, 1)), (3, 1)) for _ in range(2))
    weight = rng.uniform(0.5, 2.0, size=3 * N // 2 + 1)
    one = lines([Record(u[:N], y[:N], start="periodic")], offset=True)
    three = Record(u, y, start="periodic", period=N, line_weight=weight)
    found = lines([three], offset=True)
    root = np.sqrt(weight[3::3])[:, None, None]
    np.testing.assert_allclose(found.z, one.z, rtol=1e-12)
    np.testing.assert_allclose(found.U, root * one.U, rtol=1e-10)
    np.testing.assert_allclose(found.Y, root * one.Y, rtol=1e-10)


def test_offset_is_the_mean_by_the_weights_of_line_0():
    """Of means of 1 and 4 with weights of 1 and 3 it is 3.25, which leaves a mean square of 3.375.

    A half of 1 · 2.25² and 3 · 0.75², at both the input and the output.
    """
    records = []
    for mean, weight in ((1.0, 1.0), (4.0, 3.0)):
        u = mean + np.cos(2 * np.pi * np.arange(16) / 16)
        line_weight = np.r_[weight, np.full(8, 2.0)]
        records.append(Record(u, 2 * u, start="periodic", line_weight=line_weight))
    found = lines(records, offset=True)
    np.testing.assert_allclose(found.z[0], 1.0)
    assert float((np.abs(found.U[0]) ** 2).sum()) == pytest.approx(3.375, rel=1e-10)
    assert float((np.abs(found.Y[0]) ** 2).sum()) == pytest.approx(4 * 3.375, rel=1e-10)


def test_other_records_are_no_lines():
    record = records_of(1, 1, 2)[0]
    for other in (
        Record(record.u, record.y),
        Record(record.u, record.y, start="periodic", skip=1),
        Record(record.u, record.y, start="periodic", weight=np.array([1.0, 2.0])),
    ):
        signals = NormalisedRecord(record.u, record.y, other)
        assert spectral_data_of_records([signals], offset=True) is None


def test_lines_without_input_are_left_out():
    N = 64
    u = np.cos(2 * np.pi * np.arange(N) * 5 / N) + np.cos(2 * np.pi * np.arange(N) * 9 / N)
    y = np.random.default_rng(0).normal(size=N)
    found = lines([Record(u, y, start="periodic")], offset=True)
    np.testing.assert_allclose(np.angle(found.z), 2 * np.pi * np.array([5, 9]) / N, rtol=1e-12)
    assert found.equations == 4


@pytest.mark.parametrize("N", [8, 9])
@pytest.mark.parametrize(("nu", "ny"), [(1, 1), (2, 3)])
def test_samples_of_a_period_are_equations_of_its_lines(N: int, nu: int, ny: int):
    """SpectralData 0 and N / 2 are real; what has no weight, or a constant takes up, is none."""
    rng = np.random.default_rng(0)
    records = [
        Record(rng.normal(size=(N, nu)), rng.normal(size=(N, ny)), start="periodic")
        for _ in range(nu)
    ]
    found = lines(records, offset=False)
    assert found.equations == N * nu * ny
    assert lines(records[:1], offset=True).equations == (N - 1) * ny
    weight = np.ones(found.Y.shape)
    weight[0] = 0.0
    weight[1, 0] = 0.0
    left = SpectralData(found.z, found.U, found.Y, weight).equations
    assert left == ((N - 1) * ny - 2) * nu


def response_of(variance: np.ndarray, name: str, **settings) -> FRF:
    """A static gain of 4 of one input and output with a variance (F,) and offsets of 2 and 3."""
    F = len(variance)
    covs = {"noise": None, "total": None, name: variance[:, None, None].astype(complex)}
    return FRF(
        frequencies=np.arange(1, F + 1) / (3 * F),
        G=np.full((F, 1, 1), 4.0, dtype=complex),
        fs=1.0,
        u_offset=np.array([2.0]),
        y_offset=np.array([3.0]),
        inputs=(Channel("u"),),
        outputs=(Channel("y"),),
        cov_noise=covs["noise"],
        cov_total=covs["total"],
        **({"experiments": 1, "periods": 1, "method": "robust"} | settings),
    )


@pytest.mark.parametrize(
    ("F", "name", "settings", "width"),
    [
        *((60, "total", {"experiments": R}, w) for R, w in ((2, 21), (3, 11), (11, 3), (41, 1))),
        (60, "total", {"experiments": 6}, 5),
        (60, "noise", {"experiments": 2, "periods": 6}, 3),
        (60, "total", {"experiments": 41, "method": "local_polynomial"}, 21),
        (9, "total", {"experiments": 2}, 9),
        (8, "total", {"experiments": 2}, 7),
    ],
)
def test_weights_are_inverse_variances_of_some_20_degrees_of_freedom(
    F: int, name: Literal["total", "noise"], settings: dict, width: int
):
    """From means over so many lines about each one, at most over those there are."""
    variance = 1e-20 * np.random.default_rng(0).uniform(0.5, 2.0, size=F)
    frf = response_of(variance, name, **settings)
    found, scaler, known, _ = spectral_data_of_response(frf, name, offset=True)
    assert known == (name == "total")  # distortion adds to noise
    assert found.weight is not None
    np.testing.assert_allclose(found.Y, 1.0, rtol=1e-12)
    np.testing.assert_allclose([scaler.u_offset[0], scaler.y_offset[0]], [2.0, 3.0])
    means = np.convolve(variance, np.full(width, 1 / width), "valid")
    inside = found.weight[width // 2 : F - width // 2, 0, 0]
    np.testing.assert_allclose(inside, 4.0**2 / means, rtol=1e-12)


def under_feedback(seed: int, T: int) -> Record:
    """A pole at 0.7 with output noise and u = r - y / 2, and its reference."""
    rng = np.random.default_rng(seed)
    r, e, u, y, x = rng.normal(size=T), 0.3 * rng.normal(size=T), np.zeros(T), np.zeros(T), 0.0
    for k in range(T):
        y[k] = x + e[k]
        u[k] = r[k] - y[k] / 2
        x = 0.7 * x + 0.3 * u[k]
    return Record(u, y, start="estimated", reference=r)


def test_a_weight_does_not_know_the_noise_of_the_error_that_it_weighs():
    """Noise in a window moves the variance of its line, and the weights of other windows."""

    def variance_and_weight(record: Record) -> tuple[Array, Array]:
        frf = estimate_frf(record)
        data, scaler, _, _ = spectral_data_of_response(frf, None, offset=True)
        assert frf.var_total is not None
        assert data.weight is not None
        size = scaler.y_scale / scaler.u_scale
        return frf.var_total[:, 0, 0], data.weight[:, 0, 0] / size**2

    record, line = under_feedback(0, 400), 100
    errors = estimate_frf(record).errors
    assert errors is not None
    spectrum, lines = np.zeros(201, dtype=complex), errors.weights.shape[3]
    within = errors.first[line] + 1 + np.arange(lines)
    spectrum[within] = 20 * np.random.default_rng(1).normal(size=lines)
    louder = np.fft.irfft(spectrum, 400)[:, None]
    other = replace(record, y=record.y + louder, u=record.u - louder / 2)
    (variance, weight), (changed, same) = variance_and_weight(record), variance_and_weight(other)
    assert abs(np.log(changed[line] / variance[line])) > 0.5
    assert same[line] == pytest.approx(weight[line], rel=1e-9)
    assert abs(np.log(same[line + lines] / weight[line + lines])) > 0.5


def test_errors_of_lines_that_share_a_window_are_known_together():
    """Deviation of a pole over that of 30 fits; as if lines were independent it is a half."""
    one = np.ones((1, 1))
    poles, variances = [], []
    for seed in range(30):
        frf = estimate_frf(under_feedback(seed, 300))
        data, _, known, _ = spectral_data_of_response(frf, None, offset=True)
        fit = ResponseFit(data, known=known, feedthrough=False)
        found = refined(fit, (0.7 * one, one, one, 0 * one), 4)
        assert found.covariance is not None
        poles.append(found.A[0, 0])
        variances.append(found.covariance[0, 0])
    # The root of a mean square of 30 draws deviates by √(1 / 58) = 13 %: two and a half times that.
    assert 0.7 < np.sqrt(np.mean(variances)) / np.std(poles) < 1.4


@pytest.mark.parametrize(("method", "weighted"), [("robust", False), ("local_polynomial", True)])
def test_lines_count_alike_unless_the_input_is_random(method: str, weighted: bool):
    frf = response_of(np.linspace(0.5, 2.0, 60), "total", experiments=41, method=method)
    assert (spectral_data_of_response(frf, None, offset=True)[0].weight is not None) == weighted


def test_line_without_variance_has_a_large_and_finite_weight():
    variance = np.ones(60)
    variance[30] = 0.0
    frf = response_of(variance, "total", experiments=41)
    weight = spectral_data_of_response(frf, "total", offset=True)[0].weight
    assert weight is not None
    assert np.isfinite(weight).all()
    assert weight[30, 0, 0] > 1e6 * np.delete(weight, 30).max()


def some_problem() -> tuple[ResponseProblem, torch.Tensor]:
    rng = np.random.default_rng(2)
    z = np.exp(1j * np.linspace(0.1, 3.0, 20))
    U, Y = (rng.normal(size=(20, n, 2)) + 1j * rng.normal(size=(20, n, 2)) for n in (2, 3))
    problem = ResponseProblem(SpectralData(z, U, Y, rng.uniform(0.5, 2.0, size=Y.shape)), 4)
    system = random_system(4, 2, 3)
    return problem, torch.as_tensor(np.concatenate([m.ravel() for m in system]))


def test_slope_is_a_central_difference():
    problem, theta = some_problem()
    jacobian = problem.linearise(theta)
    h = 1e-6
    rng = np.random.default_rng(3)
    for _ in range(5):
        d = torch.as_tensor(rng.normal(size=len(theta)))
        difference = (problem.residual(theta + h * d) - problem.residual(theta - h * d)) / (2 * h)
        # h² times the third derivative, and eps / h, relative to entries of order 1 to 100
        np.testing.assert_allclose(jacobian.tangent(d), difference, rtol=1e-6, atol=1e-6)
        r = torch.as_tensor(rng.normal(size=len(difference)))
        # Sums of some hundred products of size 100 at most, which may cancel.
        product = float(r @ jacobian.tangent(d))
        assert float(jacobian.adjoint(r) @ d) == pytest.approx(product, rel=1e-9, abs=1e-9)


def test_coordinates_have_no_columns():
    problem, theta = some_problem()
    system, gradient = problem.linearise(theta).system(0.0, 1e-12)
    assert system.rank == 4 * (2 + 3) + 2 * 3
    expected = problem.linearise(theta).adjoint(problem.residual(theta))
    # By the same rows, whose sums may cancel.
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-10 * float(expected.abs().max()))


def test_pole_beyond_the_limit_is_refused():
    problem, theta = some_problem()
    A = problem.matrices(theta)[0]
    radius = np.abs(np.linalg.eigvals(A)).max()
    limited = ResponseProblem(problem.data, 4, largest_pole=0.999 * radius)
    assert torch.isinf(limited.residual(theta)).all()
    assert torch.isfinite(ResponseProblem(problem.data, 4, 1.001 * radius).residual(theta)).all()


def test_search_finds_the_system_of_the_lines():
    system = random_system(4, 2, 3, seed=1)
    z = np.exp(1j * np.linspace(0.1, 3.0, 60))
    U = np.broadcast_to(np.eye(2, dtype=complex), (60, 2, 2))
    G = frequency_response(*system, z)
    problem = ResponseProblem(SpectralData(z, U, G), 4)
    theta = torch.as_tensor(np.concatenate([m.ravel() for m in system]))
    theta = theta + 0.03 * torch.as_tensor(np.random.default_rng(4).normal(size=len(theta)))
    optimiser = LevenbergMarquardt(max_iter=100)
    state = optimiser.init(problem, theta)
    while not state.reason:
        state = optimiser.step(problem, state)
    assert state.reason == "converged: the residual vanishes"


@pytest.mark.parametrize("known", [True, False])
def test_covariance_is_that_of_the_errors_or_of_each_line_by_itself(known: bool):
    """By central differences of the weighted errors, of several columns and outputs a line."""
    F, m, nx, nu, ny = 14, 3, 2, 2, 2
    rng = np.random.default_rng(6)
    system, omega = random_system(nx, nu, ny), np.linspace(0.1, 3.0, F)
    U, E = (rng.normal(size=(F, 2, m)) + 1j * rng.normal(size=(F, 2, m)) for _ in range(2))
    Y, weight = reference.frf(system, omega) @ U + 0.3 * E, rng.uniform(0.5, 2.0, size=(F, ny, m))
    found = refined(
        ResponseFit(SpectralData(np.exp(1j * omega), U, Y, weight), known=known), system, 3
    )
    assert found.covariance is not None
    theta = np.concatenate([part.ravel() for part in found.matrices])

    def errors(theta: Array) -> Complex:
        parts = np.split(theta, np.cumsum([nx * nx, nx * nu, ny * nx]))
        A, B, C, D = (p.reshape(-1, n) for p, n in zip(parts, (nx, nu, nx, nu), strict=True))
        return (np.sqrt(weight) * (reference.frf((A, B, C, D), omega) @ U - Y)).ravel()

    h = 1e-6  # rounding leaves 1e-10 and the step 1e-12, times conditions of 1e3 at most
    J = np.stack(
        [(errors(theta + h * d) - errors(theta - h * d)) / (2 * h) for d in np.eye(len(theta))],
        axis=1,
    )
    r = errors(theta)
    assert found.rmse == pytest.approx(np.sqrt(np.mean(np.abs(r) ** 2)), rel=1e-9)
    inverse = np.linalg.pinv((J.conj().T @ J).real, rcond=1e-9)
    expected = inverse / 2  # a complex error of variance 1 has real parts of variance 1 / 2
    if not known:
        scores = (J.conj() * r[:, None]).real.reshape(F, ny * m, -1).sum(axis=1)
        equations, unknowns = 2 * len(r), nx * (nu + ny) + nu * ny
        expected = inverse @ scores.T @ scores @ inverse * equations / (equations - unknowns)
    # What the coordinates leave alone: the variances of the fitted lines.
    spread, wanted = (np.diag(J @ c @ J.conj().T).real for c in (found.covariance, expected))
    np.testing.assert_allclose(spread, wanted, rtol=1e-5)


def test_covariance_of_window_errors_is_that_of_all_lines_together():
    """Cov(Re Σ aᵀδG) with the whole covariance of δG, of two records, inputs and outputs."""
    rng = np.random.default_rng(0)
    records = [
        Record(rng.normal(size=(60, 2)), rng.normal(size=(60, 2)), name=f"r{r}") for r in range(2)
    ]
    frf = estimate_frf(records)
    errors = frf.errors
    assert errors is not None
    assert frf.cov_total is not None
    F, nu, R, width = errors.weights.shape
    noise = np.broadcast_to(np.array([[2.0, 0.5j], [-0.5j, 1.0]]), errors.noise.shape)
    M = np.zeros((F, 2, nu, R, F, 2), dtype=complex)  # δG = M V
    for k, o in np.ndindex(F, 2):
        M[k, o, :, :, errors.first[k] : errors.first[k] + width, o] = errors.weights[k]
    whole = np.einsum("kyurlo,op,KYUrlp->kyuKYU", M, noise[0], M.conj(), optimize=True)
    a = rng.normal(size=(F, 2, nu, 3)) + 1j * rng.normal(size=(F, 2, nu, 3))
    expected = np.einsum("kyui,kyuKYU,KYUj->ij", a, whole, a.conj(), optimize=True).real / 2
    found = errors._replace(noise=noise).covariance(lambda e: np.einsum("kyui,kyu->ki", a, e), 3)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    # The blocks of one line are the covariances of the response.
    own = np.einsum("kurl,kvrl,kop->koupv", errors.weights, errors.weights.conj(), errors.noise)
    np.testing.assert_allclose(own.reshape(F, 4, 4), frf.cov_total, rtol=0, atol=1e-9)


def test_a_state_that_nothing_sees_has_no_input():
    """Its column underflows, and is no column that a huge input makes up for."""
    data = lines(records_of(2, 1, 1), offset=True)
    problem = ResponseFit(data, known=False, feedthrough=True)
    A, C = np.diag([0.5, 0.3]), np.array([[1.0, 1e-290]])
    cost, (_, B, _, _) = problem.with_input_matrices(A, C)
    assert np.isfinite(cost)
    assert np.abs(B).max() < 1e10
