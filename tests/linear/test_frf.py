"""Frequency responses and their covariances, against what the data were made of."""

import re
from typing import Any

import numpy as np
import pytest
from experiments import FS, SEEDS, check_covariance, coloured, recorded, steady, true_frf, vec
from reference import random_system

from lfrtorch._support.types import Array
from lfrtorch.data.excitation import Multisine, multisine
from lfrtorch.data.records import Channel, Record
from lfrtorch.linear.frf import FRF, Method, estimate_frf

pytestmark = pytest.mark.numeric


@pytest.mark.parametrize(("nu", "ny", "R"), [(1, 1, 1), (1, 2, 3), (2, 1, 2), (2, 3, 4), (3, 2, 7)])
@pytest.mark.parametrize("orthogonal", [True, False])
def test_robust_is_exact_on_linear_data(nu: int, ny: int, R: int, orthogonal: bool):
    system = random_system(3, nu, ny)
    if orthogonal:
        u = multisine(120, nu=nu, realisations=-(-R // nu), fs=FS, band=(2.0, 20.0)).u[:R]
    else:
        each = [multisine(120, fs=FS, band=(2.0, 20.0), realisations=R, seed=i) for i in range(nu)]
        u = np.concatenate([design.u for design in each], axis=2)
    estimate = estimate_frf(recorded(steady(system, u), u, periods=2))
    # κ(U) reaches 1e3 by chance at a line of experiments that are not orthogonal.
    assert np.abs(estimate.G - true_frf(system, estimate)).max() < 1e-10
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
    estimate = estimate_frf(recorded(steady(random_system(2), u), u))
    assert estimate.cov_noise is estimate.cov_total is None
    assert estimate.var_noise is estimate.var_total is estimate.var_distortion is None
    assert estimate.notes[0].startswith("noise: not available from one period a record; two or")
    assert estimate.notes[1].startswith("total: not available, as 1 experiment(s) of 1 input(s)")


def test_one_input_at_a_time_is_an_orthogonal_design():
    u = np.zeros((4, 64, 2))
    u[0::2, :, :1] = u[1::2, :, 1:] = multisine(64, realisations=2).u
    system = random_system(2, 2, 2)
    estimate = estimate_frf(recorded(steady(system, u), u))
    assert np.abs(estimate.G - true_frf(system, estimate)).max() < 1e-12


@pytest.mark.parametrize("scale", [1e-13, 1e13])
@pytest.mark.parametrize("method", ["robust", "local_polynomial"])
def test_size_of_the_inputs_does_not_matter(scale: float, method: Method):
    """Neither to what they determine, nor to what they do not."""
    u = np.random.default_rng(0).normal(size=(2, 60, 2)) * [scale, 1.0]
    gain = [[1 / scale], [2.0]]
    records = [Record(x, x @ gain, period=60, name=f"r{r}") for r, x in enumerate(u)]
    estimate = estimate_frf(records, method=method)
    # Conditions of 1e2 by chance at a line, and of 1e3 in a window.
    np.testing.assert_allclose(estimate.G[:, 0] * [scale, 0.5], 1.0, rtol=0, atol=1e-10)
    same = [Record(np.repeat(r.u[:, :1], 2, axis=1), r.y, period=60, name=r.name) for r in records]
    with pytest.raises(ValueError, match=re.escape("depend on each other")):
        estimate_frf(same, method=method)


# --- covariances of the robust method -------------------------------------------------------

N = 64
LINES = np.arange(3, 29)
MIX = np.array([[1.0, 0.6], [0.0, 0.7]])  # of two outputs


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
        estimate = estimate_frf(recorded(y, u, periods=periods, noise=noise), lines=LINES)
        errors.append(vec(estimate, true_frf(system, estimate)))
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
        records = recorded(y, u, periods=2, noise=noise, distortion=0.1 * coloured(rng, (R, N), 2))
        estimate = estimate_frf(records)
        errors.append(vec(estimate, true_frf(system, estimate)))
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
        records = recorded(y, design.u, periods=2, noise=noise, distortion=distortion)
        estimate = estimate_frf(records)
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
        estimate = estimate_frf(recorded(y, u, periods=2, noise=noise), lines=LINES)
        errors.append(vec(estimate, true_frf(system, estimate)))
        noises.append(estimate.cov_noise)
        totals.append(estimate.cov_total)
    check_covariance(np.array(errors), np.array(noises), 6)
    check_covariance(np.array(errors), np.array(totals), 4)


def test_one_input_of_equal_magnitudes_gives_the_scatter_of_the_ratios():
    rng = np.random.default_rng(0)
    design = multisine(N, lines=LINES, realisations=5)
    noise = rng.normal(size=(5, N, 3)) * [1, 1, 0]
    records = recorded(steady(random_system(2, 1, 2), design.u), design.u, noise=noise)
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
    estimate = estimate_frf(recorded(y, design.u))
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
        records = recorded(y, design.u, periods=3, noise=noise)
        estimate = estimate_frf(records, method="fast", lines=design.lines)
        errors.append(vec(estimate, true_frf(system, estimate)))
        noises.append(estimate.cov_noise)
        totals.append(estimate.cov_total)
        assert estimate.distortion is not None
        both = estimate.distortion.odd, estimate.distortion.even
        levels.append([[b.power.mean() for b in both], [b.noise.mean() for b in both]])
    check_covariance(np.array(errors), np.array(noises), 2 * experiment)
    check_covariance(np.array(errors), np.array(totals), experiment, share=0.25)
    power, expected = np.mean(levels, axis=0)
    ratio = power / expected
    counts = np.array([design.odd_detection.size, design.even_detection.size])
    assert (np.abs(ratio - 1) < 4 * np.sqrt(1.5 / (SEEDS * experiment * counts))).all()


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


REST = np.ones((60, 1))
FAST = {"method": "fast"}


def twice(u: Array) -> Array:
    return np.concatenate([u, u])


def narrow(*lines: int) -> Record:
    return lab(multisine(400, lines=list(lines)).u[0], start="zero")


@pytest.mark.parametrize(
    ("records", "options", "message"),
    [
        ([], {}, "no record given"),
        (lab(FULL.u[0]), {"method": "etfe"}, "method is 'etfe'; give 'auto', 'robust', 'fast' or"),
        (lab(FULL.u[0]), {"order": -1}, "order is -1; give a whole number of at least 0"),
        (lab(FULL.u[0]), {"band": 0.2}, "band is 0.2; give two numbers, the lowest and the"),
        (lab(FULL.u[0]), {"band": (2, 1)}, "the band is 2 to 1 Hz; give a lower and an upper"),
        (lab(FULL.u[0]), {"band": (0.6, 1)}, "no line from 0.6 to 1 Hz is excited; the excited"),
        (lab(FULL.u[0]), {"lines": [0]}, "the lines go from 0 to 0; 60 samples have lines 1 to 29"),
        (lab(FULL.u[0]), {"lines": [30]}, "the lines go from 30 to 30; 60 samples have lines 1 to"),
        (lab(FULL.u[0]), {"lines": 3}, "lines is 3; give a list of whole numbers"),
        (lab(ODD.u[0]), {"lines": [3, 4]}, "input 'force' has no power at line 4; give lines"),
        (lab(REST, RNG.normal(size=60)), {}, "input 'force' is constant in each record: a spec"),
        (lab(REST, RNG.normal(size=60), start="zero"), {}, "input 'force' is constant in each rec"),
        (lab(np.ones((2, 1))), {}, "2 samples have no line between 0 and fs / 2; give more"),
        ([lab(GAP), lab(GAP[::-1])], {}, "in every input (lines excited: 2 in 'force', 2 in 'valv"),
        (lab(FULL.u[0], start="zero"), {"method": "robust"}, "record 'lab' has no period; give"),
        ([lab(FULL.u[0]), lab(ODD.u[0][:50], name="b")], {}, "'lab' and 'b' have periods of 60 an"),
        (lab(FULL.u[0], skip=1), {}, "record 'lab': skip=1 leaves less than one period of 60 out"),
        (lab(FULL.u[0], period=30), {}, "'lab': the periods of 30 samples of input 'force' devia"),
        (lab(TWO.u[0]), {}, "1 record(s) cannot tell 2 inputs apart at one line; give at least 2"),
        ([lab(SAME), lab(-SAME)], {}, "the inputs of the 2 experiments depend on each other at"),
        (lab(RANDOM.u[0]), FAST, "'lab' has one period of 60 samples after skip; method='fast' ne"),
        (lab(twice(FULL.u[0]), period=60), FAST, "line 2 is even and excited; method='fast' needs"),
        (lab(twice(ODD.u[0]), period=60), FAST, "no odd line is left out between the excited ones"),
        (lab(RNG.normal(size=(20, 1)), start="zero"), {}, "20 samples have 9 lines and a window"),
        (lab(twice(FULL.u[0]), start="zero"), {"lines": [1], "band": (0.1, 0.2)}, "0.2 Hz is exc"),
        (
            narrow(30, 31, 32, 33),
            {"lines": [30, 150]},
            "an input has no power about line 150; give",
        ),
        (narrow(30), {}, "the inputs determine the response at no line: they depend on each other"),
    ],
)
def test_door(records, options: dict, message: str):
    with pytest.raises(ValueError, match=re.escape(message)):
        estimate_frf(records, **options)
