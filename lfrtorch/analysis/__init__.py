"""What a fitted model is, and how far it may be trusted: figure, residuals, bands, bounds."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

from lfrtorch._support.arguments import typed
from lfrtorch.analysis.canonical_form import Canonical, canonical
from lfrtorch.analysis.confidence_bands import Band, Uncertainty, spread, uncertainty
from lfrtorch.analysis.linear_bands import PoleBand, ResponseBand, pole_bands, response_band
from lfrtorch.analysis.linearisation import linearise
from lfrtorch.analysis.lpv_form import LPV, lpv
from lfrtorch.analysis.physical_parameters import PhysicalParameters, physical_parameters
from lfrtorch.analysis.residual_analysis import Residuals, residuals
from lfrtorch.analysis.trim import Trim, trim
from lfrtorch.data.records import Record
from lfrtorch.model.model import Model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from lfrtorch.guarantees import Bound, Contraction, bound, contraction

__all__ = [
    "LPV",
    "Band",
    "Bound",
    "Canonical",
    "Contraction",
    "PhysicalParameters",
    "PoleBand",
    "Residuals",
    "ResponseBand",
    "Trim",
    "Uncertainty",
    "bound",
    "canonical",
    "contraction",
    "linearise",
    "lpv",
    "physical_parameters",
    "plot",
    "pole_bands",
    "residuals",
    "response_band",
    "spread",
    "trim",
    "uncertainty",
]


def __getattr__(name: str) -> Any:
    """Load the room of proofs with the first use of one of them."""
    if name not in ("Bound", "Contraction", "bound", "contraction"):
        raise AttributeError(name)
    return getattr(import_module("lfrtorch.guarantees"), name)


@typed()
def plot(model: Model, records: Record | Sequence[Record] | None = None) -> Figure:
    """Figure of a model: frequency responses, poles, and the nonlinearity of its static map.

    Responses and poles are those of the linear part and of the model linearised at rest at the
    inputs' offsets. The static map is drawn less the affine map that is nearest to it over the
    data, as that belongs to the linear part: over z1, over the plane of z1 and z2, or of more z
    along the direction in which it is the least linear.

    Args:
        model: nonlinear.
        records: data that say where z is. Default: white noise of the rms of the training inputs.

    Raises:
        ValueError: records of other channels than the model's, or a model that diverges on them.

    Example:
        >>> figure = lfrtorch.analysis.plot(model, record)
        >>> figure.savefig("model.png")
    """
    from lfrtorch.analysis.model_plots import model_figure  # matplotlib takes its time

    return model_figure(model, records)
