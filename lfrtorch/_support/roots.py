"""Frequency, damping and radius of poles and zeros."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lfrtorch._support.types import Complex


def frequency_and_damping(values: Complex, fs: float) -> list[dict[str, float | None]]:
    """Frequency |s| / 2π in Hz, damping ratio and radius of poles or zeros z = exp(s / fs).

    A conjugate pair counts once. The frequency is at most fs / 2, the value for a negative root,
    which alternates from sample to sample; a root at 0 has none.
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


def beyond(root: Mapping[str, Any]) -> bool:
    """Tell if the true frequency is above fs / 2, the value that stands for it."""
    z = complex(root["real"], root["imag"])
    return z != 0 and abs(cmath.log(z)) > math.pi


def remark(root: Mapping[str, Any], *, pole: bool) -> str:
    """Remark on a root that is one of a pair or above fs / 2, or on an unstable pole."""
    said = {
        "pair": bool(root["imag"]),
        "above fs / 2": beyond(root),
        "unstable": pole and root["radius"] > 1.0,
    }
    return ", ".join(text for text, holds in said.items() if holds)
