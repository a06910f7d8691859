"""Options of the searches, without their code, for the help of the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from lfrtorch._support.errors import InputError
from lfrtorch._support.settings import check_settings, setting

_GUARANTEE: Any = setting(
    None,
    'property that the model keeps at every iteration. ``"stable"``: the eigenvalues of A stay '
    "within the unit circle, or within the smallest circle that has them at the start. With a "
    "bounded static map no bounded input then makes the model run away. "
    '``"contracting"``: the model is proven to contract for all inputs, as the start must be, see '
    "``lfrtorch.analysis.contraction``. A number below 1, such as 0.98: the model is proven to "
    "contract at this rate. Default: none.",
)  # used by both searches


def check_guarantee(given: object) -> None:
    """Refuse a rate that is not between 0 and 1."""
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
        1e-7, "relative decrease of the cost up to which a step is no progress.", positive=False
    )
    patience: int = setting(
        5, "number of steps in a row without progress that ends the search.", least=1
    )
    floor: float = setting(
        1e-13,
        "root mean square of the residual that counts as zero; the search ends one step later.",
        positive=False,
    )
    truncation: float = setting(
        1e-12,
        "part of the largest singular value below which others are left out as gauge directions. "
        "They are computed only if the damping is not far above rounding errors.",
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
        "relative λ down to which the first iteration may lower it, in trials from one Jacobian. "
        "The first iteration does not lower λ if this is ``damping`` or more.",
        positive=True,
    )
    guarantee: Literal["stable", "contracting"] | float | None = _GUARANTEE

    def __post_init__(self) -> None:
        check_settings(self)
        check_guarantee(self.guarantee)


@dataclass(frozen=True)
class AdamOptions:
    """Options of :class:`lfrtorch.Adam`."""

    max_iter: int = setting(2000, "largest number of epochs over all the data.", least=0)
    learning_rate: float = setting(1e-3, "step size, in normalised units.", positive=True)
    guarantee: Literal["stable", "contracting"] | float | None = _GUARANTEE

    def __post_init__(self) -> None:
        check_settings(self)
        check_guarantee(self.guarantee)
