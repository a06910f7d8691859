"""Analysis of a fitted model and of its uncertainty: figure, residuals, bands, bounds."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lfrtorch.analysis.canonical_form import Canonical, canonical
from lfrtorch.analysis.confidence_bands import Band, Uncertainty, spread, uncertainty
from lfrtorch.analysis.dead_times import DeadTime, dead_times
from lfrtorch.analysis.linear_bands import PoleBand, ResponseBand, pole_bands, response_band
from lfrtorch.analysis.linearisation import linearise
from lfrtorch.analysis.lpv_form import LPV, lpv
from lfrtorch.analysis.physical_parameters import PhysicalParameters, physical_parameters
from lfrtorch.analysis.residual_analysis import Residuals, residuals
from lfrtorch.analysis.trim import Trim, trim

if TYPE_CHECKING:
    from lfrtorch.analysis.model_plots import plot
    from lfrtorch.guarantees import Bound, Contraction, bound, contraction

__all__ = [
    "LPV",
    "Band",
    "Bound",
    "Canonical",
    "Contraction",
    "DeadTime",
    "PhysicalParameters",
    "PoleBand",
    "Residuals",
    "ResponseBand",
    "Trim",
    "Uncertainty",
    "bound",
    "canonical",
    "contraction",
    "dead_times",
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


_LATER = {"plot": "lfrtorch.analysis.model_plots"} | {  # importing matplotlib takes time
    name: "lfrtorch.guarantees" for name in ("Bound", "Contraction", "bound", "contraction")
}


def __getattr__(name: str) -> Any:
    """Load the module of proofs or figures at the first use of one of its names."""
    if name not in _LATER:
        raise AttributeError(name)
    return getattr(import_module(_LATER[name]), name)
