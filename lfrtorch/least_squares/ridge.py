"""A ridge: the penalty on the distance of parameters to their start."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.checks import number
from lfrtorch._support.errors import InputError
from lfrtorch.least_squares.term import PenaltyRows, Seen, Term

Ridge = float | Mapping[str, float]
"""One number, or a number for each group of parameters whose names begin alike,
``{"static": 1e-3, "A": 1e-2, "x0": 0}``; other parameters get 0."""

LARGEST_RIDGE = 1e100
"""Largest ridge, whose square does not overflow."""


class RidgePenalty(Term):
    """A term of a problem: √ridge (θ - θ_0)."""

    # The ridge is a prior on each parameter: noise variance over prior variance, both normalised.

    def __init__(self, ridge: Float[Tensor, " P"], theta_0: Float[Tensor, " P"]) -> None:
        self._root, self._theta_0 = ridge.to(theta_0).sqrt(), theta_0

    def evaluate(self, theta: Float[Tensor, " P"], near: Seen | None = None) -> tuple[Tensor, Seen]:
        """r at θ."""
        return self._root * (theta - self._theta_0), ()

    def linearise(
        self, theta: Float[Tensor, " P"], seen: Seen, *, eliminate: bool
    ) -> list[PenaltyRows]:
        """The rows of dr/dθ, a diagonal matrix."""
        return [PenaltyRows(self._root, self._root * (theta - self._theta_0))]

    def part(self, count: int) -> RidgePenalty:
        """The share of the penalty for one of ``count`` parts of the data."""
        return RidgePenalty(self._root.square() / count, self._theta_0)


def ridge_by_entry(ridge: Ridge, sizes: Mapping[str, int]) -> Float[Tensor, " P"]:
    """The ridge of every entry of θ, from the sizes of its parameters by name."""
    weights = dict.fromkeys(sizes, 0.0)
    for group, value in (ridge if isinstance(ridge, Mapping) else {"": ridge}).items():
        name = f"ridge of '{group}'" if group else "ridge"
        number(name, value)
        if value > LARGEST_RIDGE:
            raise InputError(f"{name} is {value}; give at most {LARGEST_RIDGE}.")
        own = [each for each in sizes if not group or f"{each}.".startswith(f"{group}.")]
        if group and not own:
            raise InputError(
                f"ridge has a group '{group}', but no parameter's name begins with it; "
                f"the parameters are {', '.join(sizes)}."
            )
        weights |= dict.fromkeys(own, float(value))
    every = [weight for name, weight in weights.items() for _ in range(sizes[name])]
    return torch.tensor(every, dtype=torch.float64)
