"""Poles and zeros as an engineer reads them: frequency, damping, radius."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lfrtorch._support.types import Complex


def frequency_and_damping(values: Complex, fs: float) -> list[dict[str, float | None]]:
    """Poles or zeros z = exp(s / fs) as frequency |s| / 2π in Hz, damping ratio and radius of z.

    A conjugate pair counts once. The frequency is at most fs / 2, that of a negative root, which
    alternates from sample to sample; of a root at 0 it is not known.

    Example:
        >>> from lfrtorch._support.roots import frequency_and_damping
        >>> s = 2 * np.pi * 5.0 * np.array([-0.1 + 0.995j, -0.1 - 0.995j])  # 5 Hz, 10 % damping
        >>> (pole,) = frequency_and_damping(np.exp(s / 100.0), fs=100.0)
        >>> round(pole["frequency"], 1), round(pole["damping"], 2)
        (5.0, 0.1)
    """
    listed = []
    for z in sorted(values[values.imag >= 0], key=lambda z: (abs(np.angle(z)), abs(z))):
        radius = float(abs(z))
        s = complex(math.log(radius), np.angle(z)) * fs if radius > 0 else complex(-math.inf)
        frequency = abs(s) / (2 * math.pi)
        damping = 1.0 if math.isinf(frequency) else -s.real / abs(s) if s else None
        listed.append(
            {
                "real": float(z.real),
                "imag": float(z.imag),
                "frequency": min(frequency, fs / 2) if math.isfinite(frequency) else None,
                "damping": damping,
                "radius": radius,
            }
        )
    return listed


def remark(root: Mapping[str, Any], *, pole: bool) -> str:
    """Whether a root stands for two, and whether it is an unstable pole.

    Example:
        >>> from lfrtorch._support.roots import frequency_and_damping, remark
        >>> roots = frequency_and_damping(np.array([1.1 + 0.1j, 1.1 - 0.1j]), fs=1.0)
        >>> [remark(root, pole=True) for root in roots]
        ['pair, unstable']
    """
    unstable = pole and root["radius"] > 1.0
    return ", ".join(["pair"] * bool(root["imag"]) + ["unstable"] * unstable)
