"""Records of one realisation of the input are periods of one experiment."""

import numpy as np
import pytest
from experiments import FS, coloured, recorded, steady
from reference import random_system

from lfrtorch._support.types import Array
from lfrtorch.data.excitation import multisine
from lfrtorch.data.records import Record
from lfrtorch.linear.frf import estimate_frf
from lfrtorch.linear.realisations import delay

pytestmark = pytest.mark.numeric

N = 128


def cubic(u: Array, noise: float, seed: int) -> Record:
    """Two periods of a filter with a cubic behind it, from periods u (N, 1) in steady state."""
    (v,) = steady(random_system(2), u[None])
    y = np.tile(v + 0.3 * v**3, (2, 1))
    y = y + noise * np.random.default_rng(seed).normal(size=y.shape)
    return Record(np.tile(u, (2, 1)), y, FS, "periodic", period=N, name=f"r{seed}")


def shifted(u: Array, tau: float) -> Array:
    turn = np.exp(-2j * np.pi * np.arange(N // 2 + 1) * tau / N)[:, None]
    return np.asarray(np.fft.irfft(np.fft.rfft(u, axis=0) * turn, N, axis=0), dtype=np.float64)


@pytest.mark.parametrize("taus", [(0, 0, 0), (0, 37, 5), (0, 20.4, 77.5)])
def test_copies_tell_noise_and_no_distortion(taus: tuple[float, ...]):
    u = multisine(N, seed=1).u[0]
    copies = [cubic(shifted(u, tau), 1e-3, seed) for seed, tau in enumerate(taus)]
    found = estimate_frf(copies)
    assert (found.realisations, found.periods) == (1, 6)
    assert found.cov_total is found.var_distortion is None
    assert any("3 records have 1 different input(s)" in note for note in found.notes)
    assert found.notes[0].startswith("total: not available, as 1 experiment(s)")
    # Six periods of one record: the shifts change where they begin, and nothing else.
    y = [shifted(period, -tau) for r, tau in zip(copies, taus, strict=True) for period in
         r.y.reshape(2, N, 1)]  # fmt: skip
    one = estimate_frf(Record(np.tile(u, (6, 1)), np.concatenate(y), FS, "periodic", period=N))
    assert found.cov_noise is not None
    assert one.cov_noise is not None
    # A shift is found to 1e-6 samples, by the phases of 63 lines.
    np.testing.assert_allclose(found.G, one.G, rtol=1e-6)
    np.testing.assert_allclose(found.cov_noise, one.cov_noise, rtol=1e-4)


def test_distortion_is_that_of_the_realisations_and_not_of_their_copies():
    design = multisine(N, realisations=4, seed=1)
    each = [cubic(u, 0.0, r) for r, u in enumerate(design.u)]
    copies = [cubic(shifted(u, 10.0 * r), 0.0, 4 + r) for r, u in enumerate(design.u)]
    plain, found = estimate_frf(each), estimate_frf([*each, *copies, *copies])
    assert found.realisations == plain.realisations == 4
    assert plain.var_total is not None
    assert found.var_total is not None
    np.testing.assert_allclose(found.var_total, plain.var_total, rtol=1e-4)
    assert found.notes == (
        "realisations: 12 records have 4 different input(s); those of one input count as periods "
        "of one experiment.",
    )


def test_experiments_of_two_inputs_repeat_together():
    """Of orthogonal experiments one is the other with the sign of one input changed."""
    system, u = random_system(2, 2, 2), multisine(N, nu=2, realisations=3).u
    rng = np.random.default_rng(0)
    noise = np.concatenate([0.1 * coloured(rng, (12, 2 * N), 2), np.zeros((12, 2 * N, 2))], axis=2)
    twice = np.concatenate([u, u])
    found = estimate_frf(recorded(steady(system, twice), twice, periods=2, noise=noise))
    assert (found.experiments, found.realisations, found.periods) == (6, 3, 4)


def test_arbitrary_records_of_one_input_are_one():
    """Local polynomials: the mean of two records has the distortion of one."""
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=(300, 1)), 1e-3 * rng.normal(size=(2, 300, 1))
    y = u + 0.3 * u**3
    same, other = [Record(u, y + each, name="a") for each in e], Record(u, y, name="b")
    found, one = estimate_frf(same), estimate_frf(other)
    assert found.experiments == 1
    assert found.var_total is not None
    assert one.var_total is not None
    assert np.mean(found.var_total) == pytest.approx(np.mean(one.var_total), rel=0.01)
    assert "2 records have 1 different" in found.notes[1]
    late = Record(np.roll(u, 20), np.roll(y, 20), name="late")  # is no shift of the same record
    assert estimate_frf([other, late]).experiments == 2


@pytest.mark.parametrize("strong", [1.0, 30.0])
def test_realisations_of_one_strong_line_are_told_apart(strong: float):
    """Their strong lines can be shifted to agree."""
    rng = np.random.default_rng(0)
    lines = np.arange(3, 40)
    size = np.where(lines == 3, strong, 1.0)[:, None]
    U, V = size * np.exp(2j * np.pi * rng.uniform(size=(2, len(lines), 1)))
    assert delay(U, V, lines, N) is None
    late = U * np.exp(-2j * np.pi * lines * 11.3 / N)[:, None]
    noise = 0.03 * rng.normal(size=(2, len(lines), 1))
    assert delay(U, late + noise[0] + 1j * noise[1], lines, N) == pytest.approx(11.3, abs=0.05)
    assert delay(U, 2 * late, lines, N) is None  # another level


def test_two_lines_that_can_be_shifted_to_agree_are_two_realisations():
    lines = np.array([10, 11])
    U = np.ones((2, 1), dtype=complex)
    V = np.exp(-2j * np.pi * lines * 7 / N)[:, None]
    assert delay(U, V, lines, N) is None
    assert delay(U, U, lines, N) == 0.0
