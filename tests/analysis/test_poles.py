"""Frequency and damping of poles and zeros."""

import numpy as np
import pytest

from lfrtorch._support.roots import frequency_and_damping, remark

OSCILLATOR = np.exp(2 * np.pi * 5.0 * np.exp(1j * np.arccos(-0.1)) / 100.0)
"""5 Hz of 100, damping 0.1."""


@pytest.mark.parametrize(
    ("z", "frequency", "damping"),
    [
        (0.5, np.log(2) / (2 * np.pi), 1.0),
        (-0.5, 0.5, np.log(2) / abs(np.log(-0.5 + 0j))),
        (1j, 0.25, 0.0),
        (2.0, np.log(2) / (2 * np.pi), -1.0),
        (1.0, 0.0, None),
        (0.0, None, 1.0),
        (OSCILLATOR, 0.05, 0.1),
    ],
)
def test_frequency_and_damping(z: complex, frequency: float | None, damping: float | None):
    (root,) = frequency_and_damping(np.array([z], dtype=complex), 1.0)
    assert root["frequency"] == (None if frequency is None else pytest.approx(frequency))
    assert root["damping"] == (None if damping is None else pytest.approx(damping))
    assert root["radius"] == pytest.approx(abs(z))


@pytest.mark.parametrize(
    ("z", "said"),
    [
        (np.exp(-2 * np.pi * 1.5), "above fs / 2"),  # 159 kHz of 100 kHz are not said as 50
        (-0.5, "above fs / 2"),
        (0.5, ""),
        (OSCILLATOR, "pair"),
        (1.2, "unstable"),
    ],
)
def test_a_frequency_that_is_cut_is_said(z: complex, said: str):
    (root,) = frequency_and_damping(np.array([z], dtype=complex), 1.0)
    assert remark(root, pole=True) == said
