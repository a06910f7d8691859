"""Lines, rms, amplitudes and orthogonality of the multisines, and what is refused."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lfrtorch
from lfrtorch.data.excitation import Multisine, multisine

pytestmark = pytest.mark.numeric


def spectra(design: Multisine) -> np.ndarray:
    """Complex rms amplitudes (experiment, line 0 to N / 2, input)."""
    return np.fft.rfft(design.u, axis=1) * np.sqrt(2) / design.u.shape[1]


def power_elsewhere(design: Multisine) -> float:
    U = spectra(design)
    return float(np.abs(np.delete(U, design.lines, axis=1)).max())


def test_function_is_a_name_of_the_package():
    assert lfrtorch.multisine is multisine


# --- lines ----------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [100, 101])
def test_full_grid_is_all_lines_between_0_and_half_the_rate(samples: int):
    design = multisine(samples, realisations=2)
    assert design.u.shape == (2, samples, 1)
    assert design.lines.tolist() == list(range(1, (samples + 1) // 2))
    assert design.odd_detection.size == design.even_detection.size == 0
    assert power_elsewhere(design) < 1e-13


def test_band_in_hertz_takes_its_ends():
    design = multisine(1000, fs=100.0, band=(16.1, 32.3))  # lines 161.00...2 and 322.99...4
    assert design.lines.tolist() == list(range(161, 324))
    assert np.allclose(design.frequencies, np.arange(161, 324) / 10, atol=0, rtol=1e-15)
    assert power_elsewhere(design) < 1e-13


def test_band_may_be_an_array():
    assert np.array_equal(
        multisine(64, band=np.array([0.1, 0.2])).lines,  # pyright: ignore[reportArgumentType]
        multisine(64, band=(0.1, 0.2)).lines,
    )


def test_odd_grid_leaves_the_even_lines():
    design = multisine(64, grid="odd", band=(4 / 64, 10 / 64))
    assert design.lines.tolist() == [5, 7, 9]
    assert design.even_detection.tolist() == [6, 8]
    assert design.odd_detection.size == 0


@pytest.mark.parametrize("group", [2, 4])
def test_random_odd_grid_leaves_one_line_out_of_every_group(group: int):
    design = multisine(1000, grid="random_odd", group=group, realisations=2, nu=2, seed=3)
    odd = np.arange(1, 500, 2)
    excited = np.isin(odd, design.lines)
    groups = excited[: odd.size // group * group].reshape(-1, group)
    assert np.all(groups.sum(axis=1) == group - 1)
    assert excited[odd.size // group * group :].all()
    assert np.unique(np.argmin(groups, axis=1)).size == group  # at random
    assert np.all(design.odd_detection % 2 == 1)
    assert not np.isin(design.odd_detection, design.lines).any()
    assert power_elsewhere(design) < 1e-12  # the same lines in every experiment and input


def test_given_lines_go_through_the_grid():
    assert multisine(64, lines=[9, 3, 4]).lines.tolist() == [3, 4, 9]
    assert multisine(64, lines=[9, 3, 4], grid="odd").lines.tolist() == [3, 9]


# --- amplitudes and phases ------------------------------------------------------------------


def test_rms_is_exact_for_every_input_and_experiment():
    design = multisine(300, nu=3, realisations=2, rms=[1.0, 2.0, 0.5], band=(0.02, 0.3))
    rms = np.sqrt(np.mean(design.u**2, axis=1))
    assert np.abs(rms - [1.0, 2.0, 0.5]).max() < 1e-13
    assert np.abs(design.u.mean(axis=1)).max() < 1e-13
    amplitudes = np.abs(spectra(design)[:, design.lines])
    assert np.ptp(amplitudes, axis=1).max() < 1e-13  # uniform


def test_amplitudes_are_taken_by_line():
    amplitude = np.zeros(51)
    amplitude[3:8] = [1, 2, 3, 4, 5]
    design = multisine(100, lines=[3, 5, 7], amplitude=amplitude, rms=2.0, nu=2)
    U = np.abs(spectra(design)[:, design.lines])
    expected = 2 * np.array([1, 3, 5]) / np.sqrt(35)
    assert np.abs(U - expected[:, None]).max() < 1e-13
    each = np.stack([amplitude, np.ones(51)], axis=1)
    U = np.abs(spectra(multisine(100, lines=[3, 5, 7], amplitude=each, nu=2)))
    assert np.allclose(U[:, [3, 5, 7], 1], 1 / np.sqrt(3), atol=1e-13)


@pytest.mark.parametrize("nu", [1, 2, 3])
def test_experiments_of_a_realisation_are_orthogonal(nu: int):
    design = multisine(256, nu=nu, realisations=3)
    U = spectra(design)[:, design.lines].reshape(3, nu, -1, nu)  # (block, experiment, line, input)
    products = np.einsum("mefi,mefj->mfij", U, U.conj())
    power = nu / design.lines.size
    assert np.abs(products - power * np.eye(nu)).max() < 1e-14


def test_phases_are_uniform_and_independent():
    """First circular moments of phases, and of their differences, are 0 within 4 / √n."""
    design = multisine(4000, nu=2, realisations=5, seed=1)
    U = spectra(design)[:, design.lines].reshape(5, 2, -1, 2)
    unit = U / np.abs(U)
    bound = 4 / np.sqrt(5 * design.lines.size)
    one, two = unit[:, 0, :, 0], unit[:, 1, :, 0]  # experiments of one input
    for phases in (one, two, one * two.conj(), one * unit[:, 0, :, 1].conj()):
        assert abs(phases.mean()) < bound
        assert abs((phases[:, 1:] * phases[:, :-1].conj()).mean()) < bound
    assert abs((one[1:] * one[:-1].conj()).mean()) < 4 / np.sqrt(4 * design.lines.size)


def test_same_seed_same_bits():
    first, second = (multisine(64, grid="random_odd", nu=2, seed=5) for _ in range(2))
    assert np.array_equal(first.u, second.u)
    assert not np.array_equal(first.u, multisine(64, grid="random_odd", nu=2, seed=6).u)
    again = multisine(64, grid="random_odd", nu=2, seed=np.random.default_rng(5))
    assert np.array_equal(first.u, again.u)


# --- what is refused ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 2}, "samples is 2; give a whole number of at least 3"),
        ({"nu": 0}, "nu is 0; give a whole number of at least 1"),
        ({"realisations": 0}, "realisations is 0; give a whole number of at least 1"),
        ({"group": 1}, "group is 1; give a whole number of at least 2"),
        ({"fs": 0.0}, "fs is 0.0; give a positive number"),
        ({"band": (0.1, 0.2), "lines": [3]}, "both lines and band are given; give one"),
        ({"lines": [1.5]}, "lines is [1.5]; give a list of whole numbers"),
        ({"lines": []}, "lines is []; give a list of whole numbers"),
        ({"lines": [3, 32]}, "the lines go from 3 to 32; 64 samples have lines 1 to 31"),
        ({"lines": [0, 5]}, "the lines go from 0 to 5; 64 samples have"),
        ({"band": (0.3, 0.2)}, "the band is 0.3 to 0.2 Hz; give a lower and an upper frequency"),
        ({"band": 0.2}, "band is 0.2; give two numbers, the lowest and the highest in Hz"),
        ({"band": ("a", "b")}, "band is ('a', 'b'); give two numbers"),
        ({"fs": np.inf}, "fs is inf; give a positive number"),
        ({"band": (0.3, 0.6)}, "between 0 and fs / 2 = 0.5 Hz"),
        ({"band": (0.1, 0.1)}, "the band 0.1 to 0.1 Hz holds no line of a period of 64 samples"),
        ({"grid": "even"}, "grid is 'even'; give 'full', 'odd' or 'random_odd'"),
        ({"grid": "odd", "lines": [2, 4]}, "grid 'odd' needs 1 odd line(s) and there are 0"),
        ({"grid": "random_odd", "lines": [1, 3, 5]}, "needs 4 odd line(s) and there are 3"),
        ({"amplitude": np.ones(31)}, "amplitude has shape (31,); a period of 64 samples has 33"),
        ({"amplitude": np.zeros(33)}, "amplitude must be finite and positive at every excited"),
        ({"rms": 0.0}, "rms is 0.0; give a positive number, or one for each of 1 input(s)"),
        ({"rms": [1.0, 1.0]}, "rms is [1.0, 1.0]; give a positive number, or one for each of 1"),
    ],
)
def test_door(options: dict, message: str):
    settings: dict[str, Any] = {"samples": 64} | options
    with pytest.raises(ValueError, match=re.escape(message)):
        multisine(**settings)


@given(
    samples=st.integers(3, 60),
    nu=st.integers(1, 3),
    grid=st.sampled_from(["full", "odd", "random_odd"]),
    ends=st.tuples(st.integers(1, 29), st.integers(1, 29)),
    fs=st.floats(-6.0, 6.0),
    rms=st.lists(st.floats(-12.0, 12.0), min_size=3, max_size=3),
)
@settings(max_examples=40)
def test_any_design_has_its_rms_at_its_lines(
    samples: int, nu: int, grid: Any, ends: tuple[int, int], fs: float, rms: list[float]
):
    """Or its band has no lines; one that ends at two of them has them, whatever their rounding."""
    first, last = min(ends), max(ends)
    rate, wanted = 10.0**fs, 10.0 ** np.array(rms[:nu])
    band = first * rate / samples, last * rate / samples
    try:
        design = multisine(samples, fs=rate, band=band, grid=grid, nu=nu, rms=wanted)
    except lfrtorch.InputError:
        between = np.arange(first, min(last, (samples - 1) // 2) + 1)
        assert 2 * last > samples or (grid != "full" and (between % 2).sum() < 4)
        return
    found = np.sqrt(np.mean(design.u**2, axis=1))
    np.testing.assert_allclose(found, np.tile(wanted, (nu, 1)), rtol=1e-9)
    assert (np.abs(np.delete(spectra(design), design.lines, axis=1)) < 1e-12 * wanted).all()
    if grid == "full":
        assert design.lines.tolist() == list(range(first, design.lines[-1] + 1))
        assert design.lines[-1] == min(last, (samples - 1) // 2)
    for U in spectra(design)[:, design.lines].swapaxes(0, 1):  # (experiment, input)
        size = np.linalg.norm(U, axis=0)
        assert np.abs((U / size).conj().T @ (U / size) - np.eye(nu)).max() < 1e-9
