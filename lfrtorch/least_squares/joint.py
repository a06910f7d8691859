"""Several models of one structure, simulated and linearised together.

A search from several restarts has many small models. One model a time would leave a GPU idle. So
their weights are stacked along the axis of the records: every record then has a model of its own,
and the engine treats all records of all models alike. Each model keeps its own least-squares
system.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Parameter

from lfrtorch._support.errors import InputError
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.nonlinearity import Stacked, known
from lfrtorch.engine.sensitivity import Linearisation, Rows
from lfrtorch.engine.simulation import Trajectory
from lfrtorch.least_squares.jacobian import Jacobian, OutputRows
from lfrtorch.least_squares.problem import Problem


def stacked(cells: Sequence[LFRCell], repeat: int) -> LFRCell:
    """One cell whose weights have a leading axis: the weights of each cell, ``repeat`` times."""
    first = cells[0]
    weights = {
        name: torch.stack([cell.get_parameter(name).detach() for cell in cells])
        for name, _ in first.named_parameters()
    }
    weights = {name: w.repeat_interleave(repeat, dim=0) for name, w in weights.items()}
    own = {n.removeprefix("static."): w for n, w in weights.items() if n.startswith("static.")}
    if first.static is None:
        static = None
    elif known(first.static) is not None:
        static = copy.deepcopy(first.static)
        for name, w in own.items():  # vectors get an axis for time
            setattr(static, name, Parameter(w if w.ndim == 3 else w.unsqueeze(1)))
    else:
        static = Stacked(first.static, own)
    stack = LFRCell(first.nu, first.ny, first.nx, first.nz, first.nw, static)
    for name, w in weights.items():
        if not name.startswith("static."):
            setattr(stack, name, Parameter(w))
    for mine, theirs in zip(stack.parameters(), first.parameters(), strict=True):
        mine.requires_grad_(theirs.requires_grad)
    return stack


class JointProblem:
    """Simulation problems of several models of one structure over the same records."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = list(problems)
        first = self.problems[0]
        if len({id(problem.lfr) for problem in problems}) < len(self.problems):
            raise InputError("two problems share one model; give each a model of its own.")
        for problem in self.problems:
            alike = len(problem.theta) == len(first.theta)
            alike &= len(problem.errors.groups) == len(first.errors.groups)
            for mine, other in zip(problem.errors.groups, first.errors.groups, strict=False):
                alike &= torch.equal(mine.u, other.u) and torch.equal(mine.y, other.y)
            if not alike:
                raise InputError(
                    "the problems differ in records, scaling or free parameters; "
                    "a stack is of models of one structure over the same records."
                )

    def residuals(
        self, models: Sequence[int], thetas: Sequence[Float[Tensor, " P"]]
    ) -> list[Float[Tensor, " M"]]:
        """r of some of the models (by their numbers), each at its own θ."""
        problems = [self.problems[i] for i in models]
        errors = [problem.errors for problem in problems]
        found: list[list[Trajectory]] = [[] for _ in problems]
        for i, group in enumerate(errors[0].groups):
            R = len(group.u)
            pairs = list(zip(errors, thetas, strict=True))
            lfr = LFR(stacked([each.cell_at(theta) for each, theta in pairs], R))
            u = group.u.repeat(len(problems), 1, 1)
            states = [x for each, theta in pairs if (x := each.initial_state(i, theta)) is not None]
            x0 = torch.cat(states) if states else None
            near = [x for each in errors if (x := each.guess(i)) is not None]
            trajectory = lfr.trajectory(
                u,
                x0,
                "periodic" if group.start == "periodic" else "zero",
                guess=torch.cat(near) if len(near) == len(problems) else None,
            )
            for mine, signals in zip(
                found, zip(*(s.split(R) for s in trajectory), strict=True), strict=True
            ):
                mine.append(Trajectory(*signals))
        for each, theta, trajectories in zip(errors, thetas, found, strict=True):
            each.remember(theta, trajectories)
        return [problem.residual(theta) for problem, theta in zip(problems, thetas, strict=True)]

    def linearise(
        self, models: Sequence[int], thetas: Sequence[Float[Tensor, " P"]]
    ) -> list[Jacobian]:
        """dr/dθ of some of the models, their rows computed together."""
        problems = [self.problems[i] for i in models]
        # Rows are computed together, so all models need the same columns: none is left out.
        jacobians = [
            p.linearise(theta, reduce=False) for p, theta in zip(problems, thetas, strict=True)
        ]
        for i, group in enumerate(problems[0].errors.groups):
            parts = [cast(OutputRows, jacobian.parts[i]) for jacobian in jacobians]
            R, T, ny = group.y.shape
            each = [part.linearisation.trajectory for part in parts]
            trajectory = Trajectory(*(torch.cat(signals) for signals in zip(*each, strict=True)))
            linearisation = Linearisation(
                stacked([p.errors.cell_at(t) for p, t in zip(problems, thetas, strict=True)], R),
                group.u.repeat(len(problems), 1, 1),
                trajectory,
                periodic=group.start == "periodic",
            )
            everything = torch.arange(linearisation.parameters)
            initial_state = parts[0].has_initial_state
            columns = len(everything) + initial_state * trajectory.x.shape[2] + 1
            rows = trajectory.y.new_empty(len(trajectory.y), T, ny, columns)
            blocks = linearisation.rows(everything, initial_state=initial_state, spare=1, out=rows)
            end = torch.cat([block.end for block in blocks])
            for part, own, own_end in zip(parts, rows.split(R), end.split(R), strict=True):
                part.computed = Rows(slice(0, R), slice(0, T), own, own_end)
        return jacobians
