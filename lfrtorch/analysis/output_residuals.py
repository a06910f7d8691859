"""The residuals of one output in one record, and what they say in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfrtorch._support.tables import number
from lfrtorch._support.types import Array, Integers
from lfrtorch.analysis.correlation import Correlation
from lfrtorch.analysis.densities import Densities
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Channel

LEVEL = 0.01
"""Significance level of the tests of independence."""

ROUNDING = 1e-12
"""Errors, and means of errors, below this part of the output's rms are rounding errors."""

SLIGHT = 0.1
"""Correlations below this have at most 1 % of the power; only long records show them."""


FINDINGS = {
    "inputs": ("depends on {} still", "the inputs"),
    "even": ("an even nonlinearity of {} is left", "the squares of the inputs"),
    "odd": ("an odd nonlinearity or a gain of {} is left", "the inputs by an odd nonlinearity"),
}
"""By test: the verdict on an input, and the quantity that the residuals depend on."""


@dataclass(frozen=True, eq=False)
class OutputResiduals:
    """Residuals of one output in one record, in its unit.

    Args:
        record: its name.
        output: the channel.
        inputs: channels of the inputs.
        error: measured less simulated output, after the skip window, (S,).
        fit: 100 (1 - |y - y_hat| / |y - mean y|) in %, as MATLAB's ``compare`` gives it; NaN for a
            constant output.
        whiteness: correlation of the error with its own past.
        linear: correlation of the error with each input.
        even: correlation of the error with the square of each input: missing even nonlinearities.
        odd: the same for the error times the simulated output: missing odd nonlinearities, or gain.
        densities: spectra of output, error and noise.
        noise: standard deviation of the noise, if the record repeats.
        exact: True if the error is a rounding error.
    """

    record: str
    output: Channel
    inputs: tuple[Channel, ...]
    error: Float[Array, " S"]
    fit: float
    whiteness: Correlation
    linear: tuple[Correlation, ...]
    even: tuple[Correlation, ...]
    odd: tuple[Correlation, ...]
    densities: Densities
    noise: float | None
    exact: bool = False

    @property
    def rms(self) -> float:
        """Root mean square of the error."""
        return float(rms(self.error))

    @property
    def bias(self) -> float:
        """Mean of the error; 0 if it is a rounding error."""
        mean = float(np.mean(self.error))
        return 0.0 if abs(mean) <= ROUNDING * self.rms else mean

    @property
    def diverges(self) -> bool:
        """True if the simulation is not finite."""
        return not bool(np.isfinite(self.error).all())

    @property
    def p(self) -> dict[str, float]:
        """Probabilities of the tests ``white``, ``inputs``, ``even`` and ``odd``.

        For several inputs they are the smallest one, times the number of inputs.
        """
        return {"white": self.whiteness.p} | {
            name: min(1.0, len(each) * min(c.p for c in each)) for name, each in self.tests.items()
        }

    @property
    def tests(self) -> dict[str, tuple[Correlation, ...]]:
        """Correlations with each input, by the test's name."""
        return {"inputs": self.linear, "even": self.even, "odd": self.odd}

    @property
    def verdict(self) -> str:
        """Result of the tests of the error, as a sentence."""
        if self.diverges:
            return "the simulation diverges"
        if self.exact:
            return "no error beyond rounding"
        found = []
        white = self.whiteness.p > LEVEL
        if not white:
            found.append(f"not white: {_where(self.whiteness)}")
        found += [
            f"{FINDINGS[name][0].format(channel.name)}: {_where(c)}"
            for name, each in self.tests.items()
            for channel, c in zip(self.inputs, each, strict=True)
            if len(each) * c.p <= LEVEL
        ]
        beside = ""
        if self.noise:
            beside = f"{number(self.rms / self.noise)} times the noise; "
        if not found:
            return f"{beside}white, and independent of the inputs"
        if white:
            found.insert(0, "white")
        elif len(found) == 1:
            found.append("independent of the inputs")
        return beside + "; ".join(found)


def _where(found: Correlation) -> str:
    """The largest correlation with its lag, and the lags beyond the bounds."""
    value, bound = found.at(found.largest)
    beyond = f"; beyond it at lags {_runs(found.outside)}" if len(found.outside) > 1 else ""
    slight = "slightly, " if abs(value) < SLIGHT else ""
    return f"{slight}{value:.2f} at lag {found.largest} (bound {bound:.2f}{beyond})"


def _runs(lags: Integers) -> str:
    """Ascending numbers as runs, the first three."""
    parts = np.split(lags, 1 + np.flatnonzero(np.diff(lags) > 1))
    said = [f"{p[0]} to {p[-1]}" if len(p) > 1 else f"{p[0]}" for p in parts[:3] if len(p)]
    return ", ".join(said + ["..."] * (len(parts) > 3))
