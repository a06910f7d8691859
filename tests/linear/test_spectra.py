"""The lines of periodic records: which of them are used."""

import numpy as np
import pytest
from experiments import FS, recorded, steady, true_frf
from reference import dlsim, random_system

from lfrtorch.data.excitation import multisine
from lfrtorch.data.records import Record
from lfrtorch.linear.frf import estimate_frf

pytestmark = pytest.mark.numeric


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
    assert np.abs(estimate.G - true_frf(system, estimate)).max() < 1e-10
    assert not any("first sample" in note for note in estimate.notes)
    estimate = estimate_frf(record[:400])
    assert estimate.notes[-1].startswith("noise: record 'record' is used from its first sample on;")


# --- excited lines -----------------------------------------------------------------------


def test_excited_lines_are_found_among_the_noise_of_the_input():
    """No line of noise among 400 is taken, in 20 seeds, and none of the multisine is missed.

    In one period the noise has 0.1² / 500 and a line 1 / 10 of the power: 37 dB.
    """
    design = multisine(1000, lines=np.arange(10, 101, 10))
    y = steady(random_system(2), design.u)
    for seed in range(20):
        noise = 0.05 * np.random.default_rng(seed).normal(size=(1, 2000, 2))
        estimate = estimate_frf(recorded(y, design.u, periods=2, noise=noise), method="robust")
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
        estimate = estimate_frf(recorded(u[None], u[None], periods=P, noise=noise))
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
    records = recorded(steady(random_system(2), u), u)
    assert estimate_frf(records, lines=[7, 3]).frequencies.tolist() == [1.5, 3.5]
    assert estimate_frf(records, band=(1.0, 2.0)).frequencies.tolist() == [1.0, 1.5, 2.0]
    estimate = estimate_frf(records, lines=[3, 7], band=(3.0, 9.0))
    assert estimate.frequencies.tolist() == [3.5]


@pytest.mark.parametrize("N", [16, 17])
def test_lines_end_below_half_the_sampling_frequency(N: int):
    """An even number of samples has a line there, of power in an input like this one."""
    u = np.tile(np.eye(N)[0], 2)
    response = estimate_frf(Record(u, u, 1.0, "periodic", period=N))
    assert response.frequencies.max() == pytest.approx((N - 1) // 2 / N)
    assert response.frequencies.max() < 0.5
