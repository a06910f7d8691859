"""What lines tell of poles."""

from __future__ import annotations

import numpy as np
import pytest

from lfrtorch import Record, estimate_bla
from lfrtorch.linear.pole_limits import PoleLimits
from lfrtorch.linear.spectra import carrying

N, FS = 2048, 400.0
LINES = np.arange(41, 308)


def pole(frequency: float, width: float) -> np.complex128:
    """At a line number, of a half width in lines."""
    return np.complex128(np.exp(2 * np.pi / N * (-width + 1j * frequency)))


def test_pole_is_as_wide_as_the_lines_are_apart_or_a_third_of_the_band_is_away():
    limits = PoleLimits(np.exp(2j * np.pi * LINES / N))
    within = [pole(100.3, 0.51), pole(-100.3, 0.51), pole(29, 4.1), pole(327, 6.8), pole(0, 13.7)]
    e, _ = limits.excess(np.array(within))
    assert not e.any()
    beyond = [pole(100.3, 0.25), pole(-29, 2.0), pole(328, 3.5), pole(0, 41 / 6)]
    e, _ = limits.excess(np.array(beyond))
    np.testing.assert_allclose(e, 0.5, rtol=1e-9)


def test_excess_has_the_slope_of_a_central_difference():
    limits = PoleLimits(np.exp(2j * np.pi * LINES / N))
    poles = np.array([pole(100.3, 0.25), pole(-29, 2.0), pole(328, 3.5), pole(0.5, 41 / 6)])
    _, slope = limits.excess(poles)
    h = 1e-7
    for d in (1.0, 1j, 0.6 - 0.8j):
        up, down = (limits.excess(poles * (1 + sign * h * d))[0] for sign in (1, -1))
        np.testing.assert_allclose((slope * d).real, (up - down) / (2 * h), rtol=1e-5, atol=1e-5)


def test_hum_and_noise_below_the_input_are_not_excited():
    rng = np.random.default_rng(0)
    power = 1e-5 * rng.exponential(size=N // 2 + 1)
    power[LINES] = rng.uniform(0.2, 1.0, size=len(LINES))
    power[400] = 1e-3  # hum, 23 dB below the weakest line of the input
    assert np.flatnonzero(carrying(power)).tolist() == LINES.tolist()


def test_all_lines_of_a_random_input_are_excited():
    for seed in range(20):
        assert carrying(np.random.default_rng(seed).exponential(size=500)).all()


def test_no_power_is_no_line():
    assert not carrying(np.zeros(5)).any()
    assert carrying(np.array([0.0, 1.0, 1e-30, 1.0])).tolist() == [False, True, False, True]


@pytest.mark.slow
@pytest.mark.numeric
def test_a_measured_input_gives_no_pole_outside_its_band():
    """Two resonances and two orders too many, a force with noise, and drift."""
    rng = np.random.default_rng(1)
    spectrum = np.zeros(N // 2 + 1, dtype=complex)
    spectrum[LINES] = np.exp(2j * np.pi * rng.random(len(LINES)))
    u = np.fft.irfft(spectrum)
    u /= u.std()
    z = np.exp(2j * np.pi * np.arange(N // 2 + 1) / N)
    G = sum(1 / (z - p) + 1 / (z - p.conjugate()) for p in (pole(130, 3), pole(250, 4)))
    y = np.fft.irfft(G * np.fft.rfft(u))
    drift = np.linspace(-1, 1, N)
    record = Record(
        u + 1e-3 * rng.normal(size=N),
        y + 0.02 * y.std() * rng.normal(size=N) + 0.1 * y.std() * drift,
        fs=FS,
        start="periodic",
    )
    bla = estimate_bla(record, 8)
    width = -np.log(np.abs(bla.poles)) * N / (2 * np.pi)
    line = np.abs(np.angle(bla.poles)) * N / (2 * np.pi)
    away = np.abs(line[:, None] - LINES).min(axis=1)
    assert (width > 0.5 * np.maximum(0.5, away / 3)).all()
    assert bla.fit is not None
    assert bla.fit.reason.startswith("converged")
    assert any("8.008 to 59.96 Hz" in note for note in bla.fit.notes)
