"""The vector θ of a problem: where each parameter of a model stands in it."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.checks import number
from lfrtorch._support.errors import InputError
from lfrtorch.engine.cell import LFRCell

Ridge = float | Mapping[str, float]

LARGEST_RIDGE = 1e100
"""Largest ridge: its square does not overflow."""


class Parameters:
    """θ: the parameters of a cell that require a gradient, then initial states of records.

    Args:
        cell: the model.
        states: number of records whose initial state is a parameter.
    """

    def __init__(self, cell: LFRCell, states: int) -> None:
        free = [(name, p) for name, p in cell.named_parameters() if p.requires_grad]
        self.names = [name for name, _ in free]
        self._sizes = [p.numel() for _, p in free]
        self.states, self._nx = states, cell.nx
        self.own = sum(self._sizes)
        """Entries before the initial states."""

    def of(self, cell: LFRCell, initial_states: Float[Tensor, "states nx"]) -> Float[Tensor, " P"]:
        """θ of the weights of a cell and initial states."""
        own = [cell.get_parameter(name).detach().flatten() for name in self.names]
        return torch.cat([*own, initial_states.flatten()])

    def initial_states(self, theta: Float[Tensor, " P"]) -> Float[Tensor, "states nx"]:
        """The initial states in θ."""
        return theta[self.own :].view(self.states, self._nx)

    def write(self, cell: LFRCell, theta: Float[Tensor, " P"]) -> None:
        """Put θ into a cell, whose weights are views of it from then on."""
        theta = theta.detach().to(cell.A)
        for name, part in zip(self.names, theta[: self.own].split(self._sizes), strict=True):
            parameter = cell.get_parameter(name)
            parameter.data = part.view(parameter.shape)

    def ridge(self, ridge: Ridge) -> Float[Tensor, " P"]:
        """The weight of every entry of θ.

        Args:
            ridge: one number, or one for each group of parameters by the beginning of their names,
                ``{"static": 1e-3, "A": 1e-2, "x0": 0}``; other groups get 0.

        Raises:
            ValueError: a negative ridge, one above ``LARGEST_RIDGE``, or an unknown group.
        """
        groups = ridge if isinstance(ridge, Mapping) else {"": ridge}
        names, sizes = list(self.names), list(self._sizes)
        if self.states:
            names.append("x0")
            sizes.append(self.states * self._nx)
        weights = [0.0] * len(names)
        for group, value in groups.items():
            name = f"ridge of '{group}'" if group else "ridge"
            number(name, value)
            if value > LARGEST_RIDGE:
                raise InputError(f"{name} is {value}; give {LARGEST_RIDGE} at most.")
            own = [i for i, name in enumerate(names) if _belongs(name, group)]
            if not own:
                raise InputError(
                    f"ridge has a group '{group}', and no parameter's name begins so; "
                    f"the parameters are {', '.join(dict.fromkeys(names))}."
                )
            for i in own:
                weights[i] = float(value)
        return torch.tensor(weights, dtype=torch.float64).repeat_interleave(torch.tensor(sizes))


def _belongs(name: str, group: str) -> bool:
    return not group or name == group or name.startswith(f"{group}.")
