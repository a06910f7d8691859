"""Residual analysis: are the errors of a simulation white, and independent of the inputs?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch._support.powers import near_one
from lfrtorch._support.tables import in_lines, number, quantity, table
from lfrtorch._support.types import Array
from lfrtorch.analysis.correlation import autocorrelation, cross_correlation, lags_for, whitened
from lfrtorch.analysis.densities import Densities, noise_density, power_density
from lfrtorch.analysis.output_residuals import ROUNDING, OutputResiduals
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Record, as_records
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEAST = 1e-4
"""Smallest probability that is printed as a number."""

SHORTEST = 20
"""Smallest number of scored samples of a record."""

_MOST_ROWS = 24
"""Largest number of rows of a printed table; the rows of the worst fit are kept."""

LEGEND = (
    "fit: 100 (1 - |y - y_hat| / |y - mean y|), of the scored samples.\n"
    "white, inputs, even, odd: probability of such correlations by chance, of the errors with "
    "themselves,\nthe inputs and their squares, and of errors times outputs with the squares."
)


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a model; ``print(residuals)`` shows them as a table with a verdict for each.

    Args:
        parts: one for each output of each record.

    Example:
        >>> found = lfrtorch.analysis.residuals(bla, record)
        >>> part = found.parts[0]
        >>> bool(70 < part.fit < 100), part.whiteness.values.shape, part.linear[0].values.shape
        (True, (10,), (21,))
    """

    parts: tuple[OutputResiduals, ...]

    @property
    def worst(self) -> str:
        """Name of the record with the worst fit of an output; one that diverges comes first."""
        return min(self.parts, key=_goodness).record

    def of(self, record: str) -> tuple[OutputResiduals, ...]:
        """The parts of one record.

        Raises:
            ValueError: there is no record of that name.
        """
        found = tuple(part for part in self.parts if part.record == record)
        if not found:
            names = ", ".join(dict.fromkeys(part.record for part in self.parts))
            raise InputError(f"there is no record '{record}' among the residuals; give {names}.")
        return found

    @property
    def _shown(self) -> list[OutputResiduals]:
        kept = {id(part) for part in sorted(self.parts, key=_goodness)[:_MOST_ROWS]}
        return [part for part in self.parts if id(part) in kept]

    def rows(self) -> tuple[list[str], list[list[str | int | float]]]:
        """Head and rows of the table, the parts in order; if there are many, the worst fits."""
        shown = self._shown
        known = any(part.noise is not None for part in shown)
        head = ["record", "output", "samples", "fit (%)", "rms", "bias", *["noise"] * known]
        rows = [
            [
                part.record,
                part.output.name,
                len(part.error),
                part.fit,
                *(
                    quantity(v, part.output.unit)
                    for v in [part.rms, part.bias, part.noise][: 2 + known]
                ),
                *(probability(p) for p in part.p.values()),
            ]
            for part in shown
        ]
        return [*head, "white", "inputs", "even", "odd"], rows

    def sentences(self) -> list[str]:
        """A verdict for each row of the table."""
        return [f"{part.record}, {part.output.name}: {part.verdict}." for part in self._shown]

    def entries(self) -> dict[str, dict[str, Any]]:
        """The numbers by record and output, for ``metrics.json``."""
        found: dict[str, dict[str, Any]] = {}
        names = "fit", "rms", "bias", "noise", "p", "verdict"
        for part in self.parts:
            entry = {name: getattr(part, name) for name in names}
            found.setdefault(part.record, {})[part.output.name] = entry
        return found

    def __str__(self) -> str:
        head, rows = self.rows()
        left = len(self.parts) - len(rows)
        more = [f"{left} more of a better fit."] if left else []
        said = [in_lines(sentence) for sentence in (*more, *self.sentences(), LEGEND)]
        return "\n".join([table(head, rows), "", *said])

    def __repr__(self) -> str:
        return f"Residuals(parts: {len(self.parts)}, worst record: '{self.worst}')"

    def plot(self, record: str | None = None) -> Figure:
        """Figure of a record: correlations with their bounds, and spectra, a row an output.

        Args:
            record: its name. Default: the record with the worst fit.

        Example:
            >>> figure = lfrtorch.analysis.residuals(bla, record).plot()
            >>> figure.savefig("residuals.png")
        """
        from lfrtorch.analysis.residual_plots import residual_figure  # importing it takes time

        return residual_figure(self.of(self.worst if record is None else record))


@typed()
def residuals(
    model: Model | LinearModel, records: Record | Sequence[Record], *, lags: int | None = None
) -> Residuals:
    """Residual analysis of simulations: fit, whiteness, dependence of the errors on the inputs.

    Each output of each record has its own tests: records of several levels show at which level a
    model fails. Samples that a record skips are left out. Correlations with inputs are computed
    from whitened signals, as slow signals correlate by chance. Records that the model was not
    fitted to say most.

    Args:
        model: nonlinear or linear.
        records: one or several.
        lags: lags of the correlations. Default: 25, fewer in less than 1000 samples.

    Raises:
        ValueError: a record of other channels or another rate than the model's, or with fewer than
            20 scored samples.

    References:
        Ljung, "System Identification: Theory for the User", 2nd ed., 1999, section 16.6.
        Billings and Voon, "Correlation based model validity tests for non-linear models",
        International Journal of Control 44(1), 1986 (even).
        Billings and Zhu, "Nonlinear model validation using correlation tests", International
        Journal of Control 60(6), 1994 (odd).

    Example:
        >>> print(lfrtorch.analysis.residuals(bla, record))  # the record saturates
        record    output      samples  fit (%)  rms ...
    """
    listed = as_records(records)
    return Residuals(
        tuple(
            part
            for record in listed
            for part in of_simulation(record, model.simulate(record), lags=lags)
        )
    )


def of_simulation(
    record: Record, y_hat: Float[Array, "T ny"], *, lags: int | None = None
) -> tuple[OutputResiduals, ...]:
    """The residuals of each output of a record, from its simulated output."""
    y, u = record.y[record.skip :], record.u[record.skip :]
    if len(y) < SHORTEST:
        raise InputError(
            f"record '{record.name}' has {len(y)} scored samples; residuals need {SHORTEST} at "
            "least: give a longer record, or skip less."
        )
    errors = record.errors(y_hat)  # 0 where y is not valid: such errors correlate with nothing
    K = lags_for(len(y), lags)
    linear = [whitened(near_one(channel)) for channel in u.T]
    squares = [whitened(near_one(channel) ** 2) for channel in (u - u.mean(axis=0)).T]
    deviation = np.std(y, axis=0)
    f, of_y = power_density(y, record.fs)
    of_noise = noise_density(record)
    found = []
    for i, output in enumerate(record.outputs):
        error = errors[:, i]
        finite, size = np.isfinite(error).all(), float(rms(error))
        exact = bool(finite and size <= ROUNDING * float(rms(y[:, i])))
        simulated, tested = y_hat[record.skip :, i], error
        if exact or not finite:
            simulated, tested = np.zeros((2, len(y)))
        tested = near_one(tested - tested.mean())
        product = tested * near_one(simulated - simulated.mean())
        e, ey = whitened(tested), whitened(product)
        spread = float(deviation[i])
        fit = 100.0 * (1.0 - size / spread) if spread > 0 else math.nan
        found.append(
            OutputResiduals(
                record=record.name,
                output=output,
                inputs=record.inputs,
                error=error,
                fit=fit if finite else -math.inf,
                whiteness=autocorrelation(tested, K),
                linear=tuple(cross_correlation(e, x, K) for x in linear),
                even=tuple(cross_correlation(e, x, K) for x in squares),
                odd=tuple(cross_correlation(ey, x, K) for x in squares),
                densities=Densities(
                    f,
                    of_y[:, i],
                    power_density(error[:, None], record.fs)[1][:, 0] if finite else np.nan * f,
                    *(() if of_noise is None else (of_noise[0], of_noise[1][:, i])),
                ),
                noise=None if of_noise is None else float(of_noise[2][i]),
                exact=exact,
            )
        )
    return tuple(found)


def probability(p: float) -> str:
    """A probability in two digits, or that it is below the smallest printed one."""
    return number(p, 2) if p >= _LEAST else f"< {_LEAST:.4f}"


def _goodness(part: OutputResiduals) -> float:
    return part.fit if not math.isnan(part.fit) else math.inf
