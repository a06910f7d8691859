"""Local polynomials against plain least squares in a window of lines."""

import numpy as np
import pytest
from experiments import FS, SEEDS, check_covariance, coloured, slow_system, true_frf, vec
from reference import dlsim

from lfrtorch.data.excitation import multisine
from lfrtorch.data.records import Record
from lfrtorch.linear.frf import estimate_frf
from lfrtorch.linear.local_polynomial import half_width

pytestmark = pytest.mark.numeric


def test_local_polynomial_beats_the_ratio_under_a_transient():
    u = np.random.default_rng(0).normal(size=(4000, 1))
    system = slow_system()
    u[-60:] *= 5  # what rings out after the record is large
    estimate = estimate_frf(Record(u + 2.0, dlsim(system, u) + 1.0, FS))
    assert estimate.method == "local_polynomial"
    assert np.allclose(estimate.u_offset, 2.0 + u.mean())
    assert len(estimate.frequencies) == 1999
    G = true_frf(system, estimate)
    ratio = (np.fft.rfft(dlsim(system, u), axis=0) / np.fft.rfft(u, axis=0))[1:2000]

    def rms(error: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.abs(error) ** 2)))

    # The resonance is some 40 lines wide and the window 13: third derivatives are left.
    assert rms(estimate.G - G) < 0.01 * rms(ratio[:, :, None] - G)
    assert rms(estimate.G - G) < 5e-3 * rms(G)
    assert estimate.cov_noise is None
    assert estimate.notes[0].startswith("noise: not told apart from nonlinear distortion")


@pytest.mark.parametrize("order", [0, 1, 2, 3, 10])
def test_local_polynomial_is_exact_for_polynomials(order: int):
    """A static gain, and the transient of a system of finite memory less than the order."""
    u = np.random.default_rng(1).normal(size=(300, 2))
    D = np.array([[1.0, -2.0], [0.5, 3.0]])
    system = (np.zeros((1, 1)), np.zeros((1, 2)), np.zeros((2, 1)), D)
    estimate = estimate_frf(Record(u, dlsim(system, u)), order=order)
    assert np.abs(estimate.G - D).max() < 1e-11
    assert len(estimate.frequencies) == 149  # the ends too
    assert estimate.var_total is not None
    assert estimate.var_total.max() < 1e-22  # the error squared


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize(("nu", "R"), [(1, 1), (2, 1), (1, 3), (2, 50)])
def test_windows_are_the_smallest_that_leave_the_freedom(order: int, nu: int, R: int):
    def left(n: int) -> int:
        return R * (2 * n + 1) - (order + 1) * (nu + R)

    n = half_width(order, 5, nu, R)
    assert left(n) >= 5 > left(n - 1)


@pytest.mark.parametrize(("nu", "ny", "R", "order"), [(1, 1, 1, 2), (2, 2, 1, 0), (2, 3, 3, 1)])
def test_local_polynomials_are_least_squares_in_the_nearest_lines(
    nu: int, ny: int, R: int, order: int
):
    """Of G and the transients at once; windows that would leave the lines are the first or last."""
    rng, N = np.random.default_rng(0), 101
    u, y = rng.normal(size=(R, N, nu)), rng.normal(size=(R, N, ny))
    records = [Record(a, b, name=f"r{r}") for r, (a, b) in enumerate(zip(u, y, strict=True))]
    estimate = estimate_frf(records, order=order)
    assert len(estimate.frequencies) == 50
    assert estimate.cov_total is not None
    U, Y = (np.fft.rfft(x, axis=1) * np.sqrt(2) / N for x in (u, y))
    n = half_width(order, ny + 4, nu, R)
    for i, line in enumerate(range(1, 51)):
        window = np.clip(line - n, 1, 50 - 2 * n) + np.arange(2 * n + 1)
        powers = ((window - line) / n)[:, None] ** np.arange(order + 1)
        gains = (powers[None, :, :, None] * U[:, window, None]).reshape(R * len(window), -1)
        X = np.hstack([gains, np.kron(np.eye(R), powers)])
        inverse, wanted = np.linalg.pinv(X), Y[:, window].reshape(len(X), ny)
        rest = wanted - X @ inverse @ wanted
        C = rest.T @ rest.conj() / (len(X) - X.shape[1])
        cov = np.kron(C, inverse[:nu] @ inverse[:nu].conj().T)
        # Windows have conditions of 1e3.
        np.testing.assert_allclose(estimate.G[i], (inverse[:nu] @ wanted).T, rtol=0, atol=1e-10)
        atol = 1e-10 * np.abs(cov).max()
        np.testing.assert_allclose(estimate.cov_total[i], cov, rtol=0, atol=atol)


@pytest.mark.parametrize("beyond", [0, 1])
def test_input_has_power_within_half_a_window_of_its_lines(beyond: int):
    record = Record(multisine(400, lines=[100]).u[0], np.ones(400))
    n = half_width(2, 5, 1, 1)
    message = "an input has no power about line" if beyond else "determine the response at no line"
    for line in (100 - n - beyond, 100 + n + beyond):
        with pytest.raises(ValueError, match=message):
            estimate_frf(record, lines=[line])


@pytest.mark.parametrize(("nu", "R"), [(1, 1), (2, 1), (2, 3)])
def test_local_polynomial_covariance(nu: int, R: int):
    """White noise of two outputs about a static gain, in which there is no bias.

    A window has n = (3 (nu + R) + 6 - R) / 2 R lines to each side, so that lines farther apart
    are independent: one line in 2 n + 1 counts. It has 6 degrees of freedom or more.
    """
    D = np.random.default_rng(0).normal(size=(2, nu))
    system = (np.zeros((1, 1)), np.zeros((1, nu)), np.zeros((2, 1)), D)
    u = np.random.default_rng(1).normal(size=(R, 200, nu))
    errors, covs = [], []
    for seed in range(SEEDS):
        noise = 0.1 * coloured(np.random.default_rng([2, seed]), (R, 200), 2)
        records = [
            Record(u_r, dlsim(system, u_r) + e, name=f"r{r}")
            for r, (u_r, e) in enumerate(zip(u, noise, strict=True))
        ]
        estimate = estimate_frf(records)
        errors.append(vec(estimate, D))
        covs.append(estimate.cov_total)
    width = {(1, 1): 13, (2, 1): 17, (2, 3): 9}[nu, R]
    check_covariance(np.array(errors), np.array(covs), 6, share=1 / width)


def test_records_share_the_response_and_not_the_transient():
    system = slow_system()
    rng = np.random.default_rng(3)
    records = []
    for r, T in enumerate((1500, 1400)):
        u = rng.normal(size=(T + 300, 1))
        records.append(Record(u, dlsim(system, u), FS, skip=300, name=f"r{r}"))
    both = estimate_frf(records)
    assert both.experiments == 2
    assert both.notes[-1] == (
        "frequency response: the records were cut to the shortest one, 1400 samples."
    )
    assert np.abs(both.G - true_frf(system, both)).mean() < 5e-3 * np.abs(both.G).mean()


def test_local_polynomial_leaves_out_what_the_input_does_not_determine():
    design = multisine(400, lines=np.arange(20, 101), nu=1)
    record = Record(design.u[0], 2 * design.u[0], 400.0)
    estimate = estimate_frf(record)
    assert estimate.frequencies.min() > 10
    assert estimate.frequencies.max() < 110
    inside = (estimate.frequencies >= 20.0) & (estimate.frequencies <= 100.0)
    assert inside.sum() == 81
    assert np.abs(estimate.G[inside] - 2).max() < 1e-10
    assert estimate.notes[-1].endswith("line(s) are left out: the inputs do not determine G.")
    part = estimate_frf(record, band=(30.0, 40.0))
    # Products of other lines at once may sum in another order.
    same = estimate.G[np.isin(estimate.frequencies, part.frequencies)]
    assert part.frequencies.tolist() == list(range(30, 41))
    np.testing.assert_allclose(part.G, same, rtol=0, atol=1e-10)
    assert estimate_frf(record, lines=[33, 31]).frequencies.tolist() == [31.0, 33.0]


def test_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch):
    u = np.random.default_rng(0).normal(size=(300, 1))
    record = Record(u, dlsim(slow_system(), u))
    whole = estimate_frf(record)
    monkeypatch.setattr("lfrtorch.linear.local_polynomial.CHUNK", 1000)
    parts = estimate_frf(record)
    assert whole.cov_total is not None
    assert parts.cov_total is not None
    # Products of other lines at once may sum in another order; windows have conditions of 1e3.
    for a, b in ((whole.G, parts.G), (whole.cov_total, parts.cov_total)):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * float(np.abs(a).max()))
