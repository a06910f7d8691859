"""Information of the data of a fit on the parameters, kept for later updates."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Information:
    """The information matrix RᵀR = JᵀJ / σ² of the parameters θ that a fit does not hold, at one θ.

    Args:
        theta: θ at which it was computed; a model with other parameters has no use for it.
        R: root of the matrix.
        rmse: σ, the rms of the normalised errors over these data.
        samples: number of samples and outputs of these data, weighted.

    Shape:
        theta: (P,), with the held entries; R: (K, free), K <= free <= P.
    """

    theta: Float[Tensor, " P"]
    R: Float[Tensor, "K free"]
    rmse: float
    samples: float
