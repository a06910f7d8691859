"""Options of the searches, without what computes: the help of the command line reads them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from lfrtorch._support.errors import InputError
from lfrtorch._support.settings import check_settings, setting

_GUARANTEE: Any = setting(
    None,
    'what every model on the way keeps. ``"stable"``: A\'s eigenvalues stay within the unit '
    "circle, so that no bounded input makes a model with a bounded static map run away; if "
    "they are not inside at the start, they stay within the circle that they are in. "
    '``"contracting"``: the model is proven to contract, for all inputs, see '
    "``lfrtorch.analysis.contraction``; the start must be. A number below 1, as 0.98: it is proven "
    "to contract by that rate. Default: nothing.",
)  # the field of both searches


def check_guarantee(given: object) -> None:
    """Refuse a rate that is none."""
    if isinstance(given, int | float) and not 0.0 < given < 1.0:
        raise InputError(f"guarantee is {given!r}; give a rate above 0 and below 1, or a name.")


@dataclass(frozen=True)
class LevenbergMarquardtOptions:
    """Options of :class:`lfrtorch.LevenbergMarquardt`."""

    max_iter: int = setting(200, "most steps.", least=0)
    acceleration: bool = setting(True, "geodesic acceleration, one more residual a trial.")
    damping: float = setting(
        1e-2,
        "first λ relative to the largest squared singular value of the Jacobian.",
        positive=True,
    )
    tolerance: float = setting(
        1e-7, "relative decrease of the cost that counts as no progress ...", positive=False
    )
    patience: int = setting(
        5, "... and the number of such steps in a row that ends the search.", least=1
    )
    floor: float = setting(
        1e-13,
        "root mean square of the residual that counts as zero: the search ends one step later.",
        positive=False,
    )
    truncation: float = setting(
        1e-12,
        "singular values below this part of the largest are left out as gauge. They are computed "
        "only if the damping is not far above rounding errors.",
        positive=True,
    )
    finite_step: float = setting(
        0.1, "h of the directional second derivative (Transtrum et al. use 0.1).", positive=True
    )
    acceleration_limit: float = setting(
        0.75, "largest 2|a| / |δ| at which the acceleration is trusted.", positive=True
    )
    max_damping: float = setting(
        1e12,
        "λ relative to the largest squared singular value that ends the search.",
        positive=True,
    )
    least_damping: float = setting(
        1e-8,
        "to which the first step may lower λ, in trials from the same Jacobian; with ``damping`` "
        "or more it does not.",
        positive=True,
    )
    guarantee: Literal["stable", "contracting"] | float | None = _GUARANTEE

    def __post_init__(self) -> None:
        check_settings(self)
        check_guarantee(self.guarantee)


@dataclass(frozen=True)
class AdamOptions:
    """Options of :class:`lfrtorch.Adam`."""

    max_iter: int = setting(2000, "most epochs; each sees all the data.", least=0)
    learning_rate: float = setting(1e-3, "step size, in normalised units.", positive=True)
    guarantee: Literal["stable", "contracting"] | float | None = _GUARANTEE

    def __post_init__(self) -> None:
        check_settings(self)
        check_guarantee(self.guarantee)
