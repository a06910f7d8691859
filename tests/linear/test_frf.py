"""Frequency responses and their covariances, against what the data were made of."""

import re
from typing import Any

import numpy as np
import pytest
from reference import System, dlsim, frf, periodic_response, random_system

from lfrtorch._types import Array
from lfrtorch.excitation import Multisine, multisine
from lfrtorch.linear.frf import FRF, Method, estimate_frf
from lfrtorch.linear.local_polynomial import half_width
from lfrtorch.records import Channel, Record

pytestmark = pytest.mark.numeric

FS = 50.0


def true(system: System, estimate: FRF) -> np.ndarray:
    return frf(system, 2 * np.pi * estimate.frequencies / estimate.fs)


def steady(system: System, u: Array) -> Array:
    """Steady-state responses (R, N, ny) to periods u (R, N, nu)."""
    return np.stack([periodic_response(system, u_r) for u_r in u])


def experiments(
    y: Array,  # (R, N, ny)
    u: Array,  # (R, N, nu)
    *,
    periods: int | list[int] = 1,
    noise: Array | None = None,  # (R, all samples, ny + nu), of output and input
    distortion: Array | None = None,  # (R, N, ny), the same in every period
) -> list[Record]:
    """Records of the periods y and u with offsets of 3 and 5, and what is added.

    Each channel has 1 more than the one before it, and each record than the one before it.
    """
    counts = [periods] * len(u) if isinstance(periods, int) else periods
    records = []
    for r, (y_r, u_r, P) in enumerate(zip(y, u, counts, strict=True)):
        if distortion is not None:
            y_r = y_r + distortion[r]
        ny = y_r.shape[1]
        offset = np.concatenate([3.0 + np.arange(ny), 5.0 + np.arange(u_r.shape[1])]) + r
        signals = np.tile(np.concatenate([y_r, u_r], axis=1) + offset, (P, 1))
        if noise is not None:
            signals = signals + noise[r][: len(signals)]
        y, u_m = signals[:, :ny], signals[:, ny:]
        records.append(Record(u_m, y, FS, "periodic", period=len(u_r), name=f"r{r}"))
    return records


def check_covariance(errors: np.ndarray, covs: np.ndarray, freedom: float, share: float = 1.0):
    """The estimated covariances are, in the mean, that of the errors.

    For S seeds, F lines and a circular normal error d of n entries. A mean of |d|² has a relative
    variance of 1 / S, the mean of variances with as many degrees of freedom as ``freedom`` one of
    1 / (freedom S), and the F n entries add up to a sum of at least F independent ones (``share``
    of F, where neighbouring lines depend on each other). Entry by entry the difference of mean
    d dᴴ and mean covariance C has the variance C_ii C_jj (1 + 1 / freedom) / S at most; the mean
    square of it relative to that is 1 +- 1 / √(F) or less.

    Shape:
        errors: (S, F, n), covs: (S, F, n, n).
    """
    S, F = errors.shape[:2]
    C = covs.mean(axis=0)
    sample = np.einsum("sfi,sfj->fij", errors, errors.conj()) / S
    variances = np.einsum("fii->fi", C).real
    scatter = (1 + 1 / freedom) / S
    ratio = (np.einsum("fii->fi", sample).real / variances).mean()
    assert abs(ratio - 1) < 4 * np.sqrt(scatter / (F * share))
    bound = variances[:, :, None] * variances[:, None, :] * scatter
    relative = (np.abs(sample - C) ** 2).sum() / bound.sum()
    assert relative < 1 + 4 * np.sqrt(F / share) / F


def vec(estimate: FRF, G: np.ndarray) -> np.ndarray:
    return (estimate.G - G).reshape(len(estimate.G), -1)


# --- exact on linear data without noise -----------------------------------------------------


@pytest.mark.parametrize(("nu", "ny", "R"), [(1, 1, 1), (1, 2, 3), (2, 1, 2), (2, 3, 4), (3, 2, 7)])
@pytest.mark.parametrize("orthogonal", [True, False])
def test_robust_is_exact_on_linear_data(nu: int, ny: int, R: int, orthogonal: bool):
    system = random_system(3, nu, ny)
    if orthogonal:
        u = multisine(120, nu=nu, realisations=-(-R // nu), fs=FS, band=(2.0, 20.0)).u[:R]
    else:
        each = [multisine(120, fs=FS, band=(2.0, 20.0), realisations=R, seed=i) for i in range(nu)]
        u = np.concatenate([design.u for design in each], axis=2)
    estimate = estimate_frf(experiments(steady(system, u), u, periods=2))
    # κ(U) reaches 1e3 by chance at a line of experiments that are not orthogonal.
    assert np.abs(estimate.G - true(system, estimate)).max() < 1e-10
    assert np.allclose(estimate.frequencies, np.arange(5, 49) * FS / 120)
    assert (estimate.method, estimate.periods, estimate.experiments) == ("robust", 2, R)
    mean = (R - 1) / 2  # of what the records have more than the first
    np.testing.assert_allclose(estimate.u_offset, 5.0 + np.arange(nu) + mean, rtol=1e-12)
    np.testing.assert_allclose(estimate.y_offset, 3.0 + np.arange(ny) + mean, rtol=1e-12)
    assert estimate.var_noise is not None
    assert estimate.var_noise.max() < 1e-20  # the error squared
    assert (estimate.var_total is None) == (nu == R)
    assert (estimate.var_distortion is None) == (nu == R)
    assert len(estimate.notes) == (nu == R)
    assert estimate.realisations == R // nu


def test_one_period_gives_no_noise_and_one_experiment_no_total():
    u = multisine(64).u
    estimate = estimate_frf(experiments(steady(random_system(2), u), u))
    assert estimate.cov_noise is estimate.cov_total is None
    assert estimate.var_noise is estimate.var_total is estimate.var_distortion is None
    assert estimate.notes[0].startswith("noise: not available from one period a record; two or")
    assert estimate.notes[1].startswith("total: not available, as 1 experiment(s) of 1 input(s)")


def test_one_input_at_a_time_is_an_orthogonal_design():
    u = np.zeros((4, 64, 2))
    u[0::2, :, :1] = u[1::2, :, 1:] = multisine(64, realisations=2).u
    system = random_system(2, 2, 2)
    estimate = estimate_frf(experiments(steady(system, u), u))
    assert np.abs(estimate.G - true(system, estimate)).max() < 1e-12


@pytest.mark.parametrize("scale", [1e-13, 1e13])
@pytest.mark.parametrize("method", ["robust", "local_polynomial"])
def test_size_of_the_inputs_does_not_matter(scale: float, method: Method):
    """Neither to what they determine, nor to what they do not."""
    u = np.random.default_rng(0).normal(size=(2, 60, 2)) * [scale, 1.0]
    records = [
        Record(x, x @ [[1 / scale], [2.0]], period=60, name=f"r{r}") for r, x in enumerate(u)
    ]
    estimate = estimate_frf(records, method=method)
    # Conditions of 1e2 by chance at a line, and of 1e3 in a window.
    np.testing.assert_allclose(estimate.G[:, 0] * [scale, 0.5], 1.0, rtol=0, atol=1e-10)
    same = [Record(np.repeat(r.u[:, :1], 2, axis=1), r.y, period=60, name=r.name) for r in records]
    with pytest.raises(ValueError, match=re.escape("depend on each other")):
        estimate_frf(same, method=method)


def test_three_samples_have_one_line():
    estimate = estimate_frf(Record(u := np.array([1.0, 2.0, -3.0]), 2 * u, 3.0, "periodic"))
    assert estimate.frequencies.tolist() == [1.0]
    assert abs(estimate.G[0, 0, 0] - 2) < 1e-14


def test_skip_and_the_last_whole_periods_are_used():
    system, N = random_system(2), 80
    u = np.tile(multisine(N).u[0], (6, 1))[:410]
    y = dlsim(system, u)  # from rest: 0.9^171 = 1e-8 is left after skip, 0.9^250 = 4e-12 at last
    record = Record(u, y, skip=171, period=N)
    estimate = estimate_frf(record)
    assert estimate.periods == 2
    assert np.abs(estimate.G - true(system, estimate)).max() < 1e-10
    assert not any("first sample" in note for note in estimate.notes)
    estimate = estimate_frf(record[:400])
    assert estimate.notes[-1].startswith("noise: record 'record' is used from its first sample on;")
    assert len(estimate.notes) == len(estimate_frf(record[:400], transient=True).notes) + 1


# --- lines ----------------------------------------------------------------------------------


def test_excited_lines_are_found_among_the_noise_of_the_input():
    """No line of noise among 400 is taken, in 20 seeds, and none of the multisine is missed.

    In one period the noise has 0.1² / 500 and a line 1 / 10 of the power: 37 dB.
    """
    design = multisine(1000, lines=np.arange(10, 101, 10))
    y = steady(random_system(2), design.u)
    for seed in range(20):
        noise = 0.05 * np.random.default_rng(seed).normal(size=(1, 2000, 2))
        estimate = estimate_frf(experiments(y, design.u, periods=2, noise=noise), method="robust")
        assert np.array_equal(np.rint(estimate.frequencies * 1000 / FS), design.lines)


def test_lines_of_the_input_stand_out_of_their_noise_by_15_db():
    """30 times the noise of the mean: of 100 and of 8 times it the line of 100 is found.

    With 8 periods the mean over 21 lines, and over 11 at the last line, has a relative deviation
    of √(1 / 77) = 0.11 at most; a line of 100 or 8 times the noise has 100 ± 4 · 14, 8 ± 4 · 4.
    """
    N, P, deviation = 1000, 8, 0.05
    strong = multisine(N, lines=np.arange(10, 101, 10))
    one = deviation * np.sqrt(2 / (N * P))  # rms of the noise of the mean at a line
    for seed in range(5):
        u = strong.u[0] + multisine(N, lines=[250], rms=np.sqrt(8) * one, seed=seed).u[0]
        for line in (300, 499):
            u += multisine(N, lines=[line], rms=10 * one, seed=seed).u[0]
        noise = deviation * np.random.default_rng(seed).normal(size=(1, P * N, 2)) * [0, 1]
        estimate = estimate_frf(experiments(u[None], u[None], periods=P, noise=noise))
        found = np.rint(estimate.frequencies * N / FS)
        assert found.tolist() == [*strong.lines, 300, 499]


def test_lines_of_40_db_below_the_best_of_their_input_are_not_excited():
    parts = [
        multisine(100, lines=[line], rms=10 ** (level / 20)).u[0]
        for line, level in ((10, 0), (20, -39), (30, -41), (40, -20))
    ]
    u = 1e3 * np.sum(parts, axis=0)
    estimate = estimate_frf(Record(u, u, 100.0, "periodic"))
    assert estimate.frequencies.tolist() == [10, 20, 40]


@pytest.mark.parametrize(("deviation", "refused"), [(0.08, False), (0.12, True)])
def test_input_may_deviate_by_a_tenth_from_period_to_period(deviation: float, refused: bool):
    """Per channel and record, relative to the rms of the channel over all records."""
    u = np.tile(multisine(4000, nu=2).u * [0.1, 100.0], (1, 2, 1))
    u[1] += np.random.default_rng(0).normal(size=u[1].shape) * [0.1 * deviation, 0.0]
    records = [Record(x, x, start="periodic", period=4000, name=f"r{r}") for r, x in enumerate(u)]
    if not refused:
        assert len(estimate_frf(records, lines=[1, 2]).frequencies) == 2
        return
    message = (
        "record 'r1': the periods of 4000 samples of input 'u1' deviate from their mean by 12 %"
    )
    with pytest.raises(ValueError, match=message):
        estimate_frf(records)


def test_given_lines_and_band():
    u = multisine(100).u
    records = experiments(steady(random_system(2), u), u)
    assert estimate_frf(records, lines=[7, 3]).frequencies.tolist() == [1.5, 3.5]
    assert estimate_frf(records, band=(1.0, 2.0)).frequencies.tolist() == [1.0, 1.5, 2.0]
    estimate = estimate_frf(records, lines=[3, 7], band=(3.0, 9.0))
    assert estimate.frequencies.tolist() == [3.5]


def test_restricted_to_a_band():
    design = multisine(200, grid="random_odd", fs=FS)
    estimate = estimate_frf(
        experiments(steady(random_system(2), design.u), design.u, periods=2), method="fast"
    )
    part = estimate.restricted(5.0, 10.0)
    inside = (estimate.frequencies >= 5) & (estimate.frequencies <= 10)
    assert 0 < len(part.frequencies) < len(estimate.frequencies)
    assert np.array_equal(part.G, estimate.G[inside])
    assert part.cov_total is not None
    assert part.cov_noise is not None
    assert part.cov_total.shape == part.cov_noise.shape == (inside.sum(), 1, 1)
    assert part.distortion is not None
    assert part.distortion.even.frequencies.tolist() == np.arange(5, 10.1, 0.5).tolist()
    with pytest.raises(ValueError, match="no line from 50 to 60 Hz; the lines go from"):
        estimate.restricted(50, 60)


# --- covariances of the robust method -------------------------------------------------------

N, SEEDS = 64, 80
LINES = np.arange(3, 29)
MIX = np.array([[1.0, 0.6], [0.0, 0.7]])  # of two outputs


def coloured(rng: np.random.Generator, shape: tuple[int, ...], channels: int) -> Array:
    """Normal noise whose second channel holds the first, a sample late: complex covariances."""
    e = rng.normal(size=(*shape, channels))
    e[:, :, -1] += 0.8 * np.roll(e[:, :, 0], 1, axis=1)
    return e


def random_inputs(R: int, nu: int, seed: int = 0) -> Array:
    """Multisines that are not orthogonal, with lines of different amplitudes in every experiment.

    Shape:
        (R, N, nu).
    """
    rng = np.random.default_rng(seed)
    U = rng.normal(size=(R, N // 2 + 1, nu)) + 1j * rng.normal(size=(R, N // 2 + 1, nu))
    U += 1.5 * np.exp(2j * np.pi * rng.uniform(size=U.shape))
    U[:, np.setdiff1d(np.arange(N // 2 + 1), LINES)] = 0
    return np.asarray(np.fft.irfft(U * N / 20, N, axis=1), dtype=np.float64)


@pytest.mark.parametrize("nu", [1, 2])
@pytest.mark.parametrize("orthogonal", [True, False])
@pytest.mark.parametrize("periods", [[2] * 6, [2, 3, 2, 4, 1, 2]])
def test_noise_covariance(nu: int, orthogonal: bool, periods: list[int]):
    """Of two outputs with complex off-diagonal elements; Σ (P_r - 1) degrees of freedom."""
    system = random_system(2, nu, 2)
    u = multisine(N, lines=LINES, nu=nu, realisations=6 // nu).u if orthogonal else None
    u = random_inputs(6, nu) if u is None else u
    y = steady(system, u)
    errors, covs = [], []
    for seed in range(SEEDS):
        noise = 0.1 * coloured(np.random.default_rng(seed), (6, 4 * N), 2)
        noise = np.concatenate([noise, np.zeros((6, 4 * N, nu))], axis=2)
        estimate = estimate_frf(experiments(y, u, periods=periods, noise=noise), lines=LINES)
        errors.append(vec(estimate, true(system, estimate)))
        covs.append(estimate.cov_noise)
    check_covariance(np.array(errors), np.array(covs), sum(periods) - 6)


@pytest.mark.parametrize(("nu", "R"), [(1, 4), (2, 6), (2, 7)])
@pytest.mark.parametrize("orthogonal", [True, False])
def test_total_covariance(nu: int, R: int, orthogonal: bool):
    """Of noise and of a distortion that repeats in every period, known by construction."""
    system = random_system(2, nu, 2)
    design = multisine(N, lines=LINES, nu=nu, realisations=-(-R // nu))
    u = design.u[:R] if orthogonal else random_inputs(R, nu)
    y = steady(system, u)
    errors, covs = [], []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        noise = 0.1 * coloured(rng, (R, 2 * N), 2)
        noise = np.concatenate([noise, np.zeros((R, 2 * N, nu))], axis=2)
        records = experiments(
            y, u, periods=2, noise=noise, distortion=0.1 * coloured(rng, (R, N), 2)
        )
        estimate = estimate_frf(records)
        errors.append(vec(estimate, true(system, estimate)))
        covs.append(estimate.cov_total)
    blocks = orthogonal and nu > 1 and R % nu == 0
    check_covariance(np.array(errors), np.array(covs), R / nu - 1 if blocks else R - nu)


@pytest.mark.parametrize("nu", [1, 2])
def test_distortion_is_what_was_added_to_each_realisation(nu: int):
    """White distortion of rms s has 2 s² / N at a line, and nu experiments of 1 / F each."""
    system, s, M = random_system(2, nu, 1), 0.3, 4
    design = multisine(N, lines=LINES, nu=nu, realisations=M)
    y = steady(system, design.u)
    distortion_variances, noise_variances = [], []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        noise = 0.13 * rng.normal(size=(M * nu, 2 * N, 1 + nu)) * ([1] + [0] * nu)
        distortion = s * rng.normal(size=(M * nu, N, 1))
        estimate = estimate_frf(
            experiments(y, design.u, periods=2, noise=noise, distortion=distortion)
        )
        assert estimate.realisations == M
        distortion_variances.append(estimate.var_distortion)
        noise_variances.append(estimate.var_noise)
    power = nu / LINES.size
    averaged = SEEDS * LINES.size * nu
    # Noise adds 0.13² / 2 to 0.3², 9 %: the scatter of M - 1 blocks is once in 300 below it.
    ratio = np.mean(distortion_variances) / (2 * s**2 / N / power)
    assert abs(ratio - 1) < 4 * 1.1 / np.sqrt(averaged * (M - 1))
    ratio = np.mean(noise_variances) / (2 * 0.13**2 / N / 2 / power / M)
    assert abs(ratio - 1) < 4 / np.sqrt(averaged / nu * M * nu)


def test_noise_of_the_input_counts():
    """Noise of 40 dB below the input, so that G is biased by 1e-4 of itself only."""
    system = random_system(2, 2, 2)
    u = multisine(N, lines=LINES, nu=2, realisations=3).u
    y = steady(system, u)
    errors, noises, totals = [], [], []
    for seed in range(SEEDS):
        noise = 0.01 * coloured(np.random.default_rng(seed), (6, 2 * N), 4)
        estimate = estimate_frf(experiments(y, u, periods=2, noise=noise), lines=LINES)
        errors.append(vec(estimate, true(system, estimate)))
        noises.append(estimate.cov_noise)
        totals.append(estimate.cov_total)
    check_covariance(np.array(errors), np.array(noises), 6)
    check_covariance(np.array(errors), np.array(totals), 4)


def test_one_input_of_equal_magnitudes_gives_the_scatter_of_the_ratios():
    rng = np.random.default_rng(0)
    design = multisine(N, lines=LINES, realisations=5)
    noise = rng.normal(size=(5, N, 3)) * [1, 1, 0]
    records = experiments(steady(random_system(2, 1, 2), design.u), design.u, noise=noise)
    estimate = estimate_frf(records)
    Y, U = (np.fft.rfft([getattr(r, letter) for r in records], axis=1)[:, LINES] for letter in "yu")
    ratios = Y / U
    d = ratios - ratios.mean(axis=0)
    expected = np.einsum("mfi,mfj->fij", d, d.conj()) / (5 * 4)
    assert np.abs(estimate.G[:, :, 0] - ratios.mean(axis=0)).max() < 1e-12
    assert estimate.cov_total is not None
    assert np.abs(estimate.cov_total - expected).max() < 1e-12 * np.abs(expected).max()


def test_orthogonal_blocks_give_the_scatter_of_their_responses():
    rng = np.random.default_rng(0)
    design = multisine(N, lines=LINES, nu=2, realisations=3)
    y = rng.normal(size=(6, N, 2))
    estimate = estimate_frf(experiments(y, design.u))
    Y, U = (np.fft.rfft(x, axis=1)[:, LINES].reshape(3, 2, -1, 2) for x in (y, design.u))
    blocks = np.einsum("mefy,mfeu->mfyu", Y, np.linalg.inv(U.transpose(0, 2, 3, 1)))
    d = (blocks - blocks.mean(axis=0)).reshape(3, -1, 4)
    expected = np.einsum("mfi,mfj->fij", d, d.conj()) / (3 * 2)
    assert np.abs(estimate.G - blocks.mean(axis=0)).max() < 1e-12
    assert estimate.cov_total is not None
    assert np.abs(estimate.cov_total - expected).max() < 1e-12 * np.abs(expected).max()


def test_static_cubic_is_distortion_and_no_noise():
    """y = u³: linear approximation 3 E[u²] for normal inputs, and odd distortion about it."""
    design = multisine(512, realisations=20)
    records = [Record(u, u**3, start="periodic", period=512) for u in np.tile(design.u, (1, 2, 1))]
    estimate = estimate_frf(records)
    assert estimate.var_noise is not None
    assert estimate.var_total is not None
    assert estimate.var_distortion is not None
    assert estimate.var_noise.max() < 1e-25
    assert np.allclose(estimate.var_distortion, 20 * estimate.var_total, rtol=1e-9)
    # 4 standard deviations of a mean over 255 lines.
    assert abs(estimate.G.mean() - 3) < 4 * np.sqrt(estimate.var_total.mean() / 255) + 3 / 255
    scatter = np.mean(np.abs(estimate.G - estimate.G.mean()) ** 2) / estimate.var_total.mean()
    assert abs(scatter - 1) < 4 * np.sqrt((1 + 1 / 19) / 255)


# --- fast method ----------------------------------------------------------------------------


def fast(power: int, gain: float) -> FRF:
    design = multisine(400, grid="random_odd", fs=FS, band=(0.0, 5.0))
    u = np.tile(design.u[0], (2, 1))
    return estimate_frf(Record(u, u + gain * u**power, FS, "periodic", period=400), method="fast")


def test_fast_tells_even_from_odd():
    for power, gain in ((2, 0.1), (3, 0.1)):
        estimate = fast(power, gain)
        assert estimate.distortion is not None
        assert estimate.var_total is not None
        even, odd = (estimate.distortion.even.distortion, estimate.distortion.odd.distortion)
        there, none = (even, odd) if power == 2 else (odd, even)
        assert none.max() < 1e-24  # rounding of numbers of size 1, squared: 1e-30 or so
        assert there.mean() > 1e-5
        assert (estimate.var_total.mean() > 1e-4) == (power == 3)


def test_fast_levels_are_mean_squares_of_the_lines():
    """Every line of u² but line 0 is even, and below twice the band: the powers add up."""
    design = multisine(400, grid="random_odd", fs=FS, band=(0.0, 5.0))
    u = np.tile(design.u[0], (3, 1))
    estimate = estimate_frf(Record(u, 7 * u, FS, "periodic", period=400), method="fast")
    assert estimate.distortion is not None
    output = estimate.distortion.output
    assert abs(output.power.sum() - 49 * np.mean(u**2)) < 1e-11
    lines = np.fft.rfftfreq(400, 1 / FS)
    assert np.isin(np.round(output.frequencies, 9), np.round(lines[design.lines], 9)).all()
    assert np.allclose(estimate.distortion.odd.frequencies, lines[design.odd_detection])
    assert np.allclose(estimate.distortion.even.frequencies, lines[design.even_detection])


def test_fast_takes_the_linear_response_to_the_input_off():
    """Input of -50 dB at the lines left out, and a gain that is interpolated exactly."""
    u = multisine(400, grid="random_odd").u[0] + multisine(400, rms=0.003, seed=1).u[0]
    gain = 2 + np.arange(201) / 40
    y = np.fft.irfft(gain[:, None] * np.fft.rfft(u, axis=0), 400, axis=0)
    record = Record(np.tile(u, (2, 1)), np.tile(y, (2, 1)), 400.0, "periodic", period=400)
    estimate = estimate_frf(record, method="fast")
    assert estimate.distortion is not None
    for level in (estimate.distortion.odd, estimate.distortion.even):
        assert level.frequencies.size > 10
        assert level.power.max() < 1e-24  # rounding squared, and not 4 · 0.003² / 200
    G = np.interp(estimate.frequencies, np.arange(201), gain)
    assert np.abs(estimate.G[:, 0, 0] - G).max() < 1e-12


def test_fast_interpolates_the_distortion_between_the_odd_lines_left_out():
    """Straight from line to line, and constant before the first and after the last one."""
    design = multisine(400, grid="random_odd", lines=np.arange(41, 160))
    u = np.tile(design.u[0], (2, 1))
    estimate = estimate_frf(Record(u, u + 0.1 * u**3, 400.0, "periodic", period=400), method="fast")
    assert estimate.distortion is not None
    assert estimate.var_total is not None
    odd = estimate.distortion.odd
    assert estimate.frequencies[0] < odd.frequencies[0]
    assert odd.frequencies[-1] < estimate.frequencies[-1]
    power = 1 / len(design.lines)  # of the input at a line
    expected = np.interp(estimate.frequencies, odd.frequencies, odd.power[:, 0]) / power
    np.testing.assert_allclose(estimate.var_total[:, 0, 0], expected, rtol=1e-9)


@pytest.mark.parametrize(("nu", "experiment"), [(1, 1), (2, 4)])
def test_fast_covariances_and_noise_levels(nu: int, experiment: int):
    """Noise alone: both covariances, and the levels at the lines left out.

    The total has R degrees of freedom or more, from the outputs of one or two detection lines,
    shared by some four excited ones.
    """
    system = random_system(2, nu, 2)
    design = multisine(200, grid="random_odd", nu=nu, realisations=experiment // nu)
    y = steady(system, design.u)
    errors, noises, totals, levels = [], [], [], []
    for seed in range(SEEDS):
        noise = 0.01 * coloured(np.random.default_rng(seed), (experiment, 600), 2)
        noise = np.concatenate([noise, np.zeros((experiment, 600, nu))], axis=2)
        records = experiments(y, design.u, periods=3, noise=noise)
        estimate = estimate_frf(records, method="fast", lines=design.lines)
        errors.append(vec(estimate, true(system, estimate)))
        noises.append(estimate.cov_noise)
        totals.append(estimate.cov_total)
        assert estimate.distortion is not None
        levels.append(
            [
                [
                    level.power.mean()
                    for level in (estimate.distortion.odd, estimate.distortion.even)
                ],
                [
                    level.noise.mean()
                    for level in (estimate.distortion.odd, estimate.distortion.even)
                ],
            ]
        )
    check_covariance(np.array(errors), np.array(noises), 2 * experiment)
    check_covariance(np.array(errors), np.array(totals), experiment, share=0.25)
    power, expected = np.mean(levels, axis=0)
    ratio = power / expected
    counts = np.array([design.odd_detection.size, design.even_detection.size])
    assert (np.abs(ratio - 1) < 4 * np.sqrt(1.5 / (SEEDS * experiment * counts))).all()


# --- local polynomial method ----------------------------------------------------------------


def slow_system() -> System:
    """Two poles of radius 0.97 at 0.3 rad: a transient of some 100 samples."""
    pole = 0.97 * np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    return pole, np.array([[0.3], [0.2]]), np.array([[1.0, 0.5]]), np.array([[0.1]])


def test_local_polynomial_beats_the_ratio_under_a_transient():
    u = np.random.default_rng(0).normal(size=(4000, 1))
    system = slow_system()
    u[-60:] *= 5  # what rings out after the record is large
    estimate = estimate_frf(Record(u + 2.0, dlsim(system, u) + 1.0, FS))
    assert estimate.method == "local_polynomial"
    assert np.allclose(estimate.u_offset, 2.0 + u.mean())
    assert len(estimate.frequencies) == 1999
    G = true(system, estimate)
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


def test_windows_leave_ny_and_four_degrees_of_freedom():
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(100, 1)), rng.normal(size=(100, 2))

    def same(ny: int, freedom: int) -> bool:
        record = Record(u, y[:, :ny])
        left = estimate_frf(record).G, estimate_frf(record, degrees_of_freedom=freedom).G
        return np.array_equal(*left)

    # Windows grow by two lines: 4 degrees of freedom take that of 5, and 6 that of 7.
    assert [same(1, freedom) for freedom in (3, 4, 5, 6)] == [False, True, True, False]
    assert [same(2, freedom) for freedom in (4, 5, 6, 7, 8)] == [False, False, True, True, False]


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
    assert both.notes[-1] == "the records were cut to the shortest one, 1400 samples."
    assert np.abs(both.G - true(system, both)).mean() < 5e-3 * np.abs(both.G).mean()


def test_local_polynomial_leaves_out_what_the_input_does_not_determine():
    design = multisine(400, lines=np.arange(20, 101), nu=1)
    record = Record(design.u[0], 2 * design.u[0], 400.0)
    estimate = estimate_frf(record)
    assert estimate.frequencies.min() > 10
    assert estimate.frequencies.max() < 110
    inside = estimate.restricted(20.0, 100.0)
    assert len(inside.frequencies) == 81
    assert np.abs(inside.G - 2).max() < 1e-10
    assert estimate.notes[-1].endswith("line(s) are left out: the inputs do not determine G.")
    part = estimate_frf(record, band=(30.0, 40.0))
    # Products of other lines at once may sum in another order.
    np.testing.assert_allclose(part.G, estimate.restricted(30.0, 40.0).G, rtol=0, atol=1e-10)
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


# --- transients of periodic records ---------------------------------------------------------


@pytest.mark.parametrize("periods", [2, 3])
@pytest.mark.parametrize("method", ["robust", "fast"])
def test_transient_is_removed_between_the_lines(periods: int, method: Method):
    system = slow_system()
    design = multisine(1000, grid="random_odd", realisations=2)
    records = [
        Record(x + 2, dlsim(system, x) + 1, start="zero", period=1000, name=f"r{r}")
        for r, x in enumerate(np.tile(design.u, (1, periods, 1)))
    ]

    def rms_error(transient: bool) -> float:
        estimate = estimate_frf(records, method=method, transient=transient)
        assert np.allclose([estimate.u_offset[0], estimate.y_offset[0]], [2.0, 1.0], atol=0.01)
        assert len(estimate.frequencies) == len(design.lines)
        return float(np.sqrt(np.mean(np.abs(estimate.G - true(system, estimate)) ** 2)))

    # Poles of 0.03 rad, lines of 2 π / 2000 and windows of 15 of them: a fifth of the width at 3.
    assert rms_error(True) < 0.02 * rms_error(False)


@pytest.mark.parametrize("periods", [2, 3])
@pytest.mark.parametrize(("order", "error"), [(2, 1e-4), (4, 1e-6), (8, 1e-10)])
def test_transient_removal_converges_with_the_order(periods: int, order: int, error: float):
    """A transient of 10 samples turns by 10 · 2 π / 800 from line to line, 1 in a window.

    It is some 0.1 of the input, and a polynomial of even order in a window about its line leaves
    the term of order + 2: 0.1 · 0.5⁴ / 4!, 0.1 · 0.7⁶ / 6!, 0.1 / 10!, less by 2^order or so.
    """
    u = np.tile(multisine(400).u[0], (periods, 1))
    y = dlsim((np.eye(10, k=-1), np.eye(10, 1), np.eye(1, 10, 9), np.ones((1, 1))), u)
    estimate = estimate_frf(Record(u, y, period=400), transient=True, order=order)
    z = np.exp(2j * np.pi * estimate.frequencies)
    assert np.abs(estimate.G[:, 0, 0] - (1 + z**-10)).max() < error


@pytest.mark.parametrize("periods", [2, 3])
def test_transient_removal_keeps_the_covariances(periods: int):
    """Noise alone; neighbouring lines share the lines between them, at most 6 of theirs."""
    design = multisine(100, realisations=2)
    D = np.array([[2.0], [1.0]])
    errors, noises = [], []
    for seed in range(SEEDS):
        noise = 0.1 * coloured(np.random.default_rng(seed), (2, 100 * periods), 2)
        noise = np.concatenate([noise, np.zeros((2, 100 * periods, 1))], axis=2)
        records = experiments(design.u @ D.T, design.u, periods=periods, noise=noise)
        estimate = estimate_frf(records, transient=True)
        errors.append(vec(estimate, D))
        noises.append(estimate.cov_noise)
    check_covariance(np.array(errors), np.array(noises), 2 * 6, share=1 / 6)


# --- auto -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("starts", "method"),
    [(("periodic", "periodic"), "robust"), (("periodic", "zero"), "local_polynomial")],
)
def test_auto_is_robust_where_every_record_has_periods(starts: tuple, method: Method):
    u = multisine(100, realisations=2).u
    records = [Record(x, x, start=start) for x, start in zip(u, starts, strict=True)]
    assert estimate_frf(records).method == method
    same = estimate_frf(records, method=method)
    assert np.array_equal(estimate_frf(records).G, same.G)


# --- what is refused ------------------------------------------------------------------------


def lab(u: Array, y: Array | None = None, **options) -> Record:
    channels = tuple(Channel(name) for name in ("force", "valve")[: u.shape[1]])
    y = u.sum(axis=1) if y is None else y
    settings: dict[str, Any] = {"start": "periodic", "name": "lab", "inputs": channels} | options
    return Record(u, np.asarray(y, dtype=np.float64), **settings)


FULL: Multisine = multisine(60)
ODD = multisine(60, grid="odd")
RANDOM = multisine(60, grid="random_odd")
TWO = multisine(60, nu=2)
RNG = np.random.default_rng(0)
GAP = np.concatenate([multisine(60, lines=[k, k + 1]).u[0] for k in (3, 8)], axis=1)
SAME = np.repeat(FULL.u[0], 2, axis=1)


def twice(u: Array) -> Array:
    return np.concatenate([u, u])


@pytest.mark.parametrize(
    ("records", "options", "message"),
    [
        ([], {}, "no record given"),
        (lab(FULL.u[0]), {"method": "etfe"}, "method is 'etfe'; use 'auto', 'robust', 'fast' or"),
        (lab(FULL.u[0]), {"order": -1}, "order is -1; give a whole number of at least 0"),
        (lab(FULL.u[0]), {"degrees_of_freedom": 0}, "degrees_of_freedom is 0; give a whole"),
        (
            lab(FULL.u[0]),
            {"band": 0.2},
            "band is 0.2; give two numbers, the lowest and the highest",
        ),
        (lab(FULL.u[0]), {"band": (2, 1)}, "the band is 2 to 1 Hz; give a lower and an upper"),
        (lab(FULL.u[0]), {"band": (0.6, 1)}, "no line from 0.6 to 1 Hz is excited; the excited"),
        (lab(FULL.u[0]), {"lines": [0]}, "the lines go from 0 to 0; 60 samples have lines 1 to 29"),
        (
            lab(FULL.u[0]),
            {"lines": [30]},
            "the lines go from 30 to 30; 60 samples have lines 1 to 29",
        ),
        (lab(FULL.u[0]), {"lines": 3}, "lines is 3; give a list of whole numbers"),
        (lab(ODD.u[0]), {"lines": [3, 4]}, "input 'force' has no power at line 4; give lines"),
        (
            lab(np.ones((60, 1)), RNG.normal(size=60)),
            {},
            "input 'force' is constant in all records; leave it out",
        ),
        (
            lab(np.ones((60, 1)), RNG.normal(size=60), start="zero"),
            {},
            "input 'force' is constant in all records; leave it out",
        ),
        (lab(np.ones((2, 1))), {}, "2 samples have no line between 0 and fs / 2; give more"),
        (
            [lab(GAP), lab(GAP[::-1])],
            {},
            "no line is excited in every input (lines excited: 2 in 'force', 2 in 'valve'); give",
        ),
        (lab(FULL.u[0], start="zero"), {"method": "robust"}, "record 'lab' has no period; give"),
        (
            [lab(FULL.u[0]), lab(ODD.u[0][:50], name="b")],
            {},
            "records 'lab' and 'b' have periods of 60 and 50 samples; give records of one period",
        ),
        (
            lab(FULL.u[0], skip=1),
            {},
            "record 'lab': skip=1 leaves less than one period of 60 out of 60 samples; skip less",
        ),
        (
            lab(FULL.u[0], period=30),
            {},
            "record 'lab': the periods of 30 samples of input 'force' deviate from their mean by",
        ),
        (lab(TWO.u[0]), {}, "1 record(s) cannot tell 2 inputs apart at one line; give at least 2"),
        ([lab(SAME), lab(-SAME)], {}, "the inputs of the 2 experiments depend on each other at"),
        (
            lab(RANDOM.u[0]),
            {"method": "fast"},
            "record 'lab' has one period of 60 samples after skip; method='fast' needs two or more",
        ),
        (
            lab(FULL.u[0]),
            {"transient": True},
            "record 'lab' has one period of 60 samples after skip; transient=True needs two or",
        ),
        (
            lab(twice(multisine(7).u[0]), period=7),
            {"transient": True},
            "14 samples have no 15 lines to remove a transient by; use longer records",
        ),
        (
            lab(twice(FULL.u[0]), period=60),
            {"method": "fast"},
            "line 2 is even and excited; method='fast' needs a random odd multisine",
        ),
        (
            lab(twice(ODD.u[0]), period=60),
            {"method": "fast"},
            "no odd line is left out between the excited ones; method='fast' needs",
        ),
        (
            lab(RNG.normal(size=(20, 1)), start="zero"),
            {},
            "20 samples have 9 lines and a window of local polynomials takes",
        ),
        (
            lab(twice(FULL.u[0]), start="zero"),
            {"lines": [1], "band": (0.1, 0.2)},
            "no line from 0.1 to 0.2 Hz is excited",
        ),
        (
            lab(multisine(400, lines=[30, 31, 32, 33]).u[0], start="zero"),
            {"lines": [30, 150]},
            "an input has no power about line 150; give lines about which all inputs are excited",
        ),
        (
            lab(multisine(400, lines=[30]).u[0], start="zero"),
            {},
            "the inputs determine the response at no line: they depend on each other, or excite",
        ),
    ],
)
def test_door(records, options: dict, message: str):
    with pytest.raises(ValueError, match=re.escape(message)):
        estimate_frf(records, **options)


@pytest.mark.parametrize("N", [16, 17])
def test_lines_end_below_half_the_sampling_frequency(N: int):
    """An even number of samples has a line there, of power in an input like this one."""
    u = np.tile(np.eye(N)[0], 2)
    response = estimate_frf(Record(u, u, 1.0, "periodic", period=N))
    assert response.frequencies.max() == pytest.approx((N - 1) // 2 / N)
    assert response.frequencies.max() < 0.5
