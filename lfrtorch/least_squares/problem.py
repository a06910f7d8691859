"""A problem: the sum of squared terms that a search minimises over θ, under a guarantee."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Self, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.errors import InputError
from lfrtorch.data.records import Record, as_records, of_one_unit
from lfrtorch.least_squares.fit_memory import check_fit_memory
from lfrtorch.least_squares.gauge import Reduction, everything, reduction
from lfrtorch.least_squares.held_steps import HeldSteps
from lfrtorch.least_squares.jacobian import Jacobian
from lfrtorch.least_squares.prior import PriorPenalty
from lfrtorch.least_squares.record_groups import EVERY
from lfrtorch.least_squares.residual import LeastSquares, Point
from lfrtorch.least_squares.ridge import Ridge, RidgePenalty, ridge_by_entry
from lfrtorch.least_squares.simulation_errors import SimulationErrors
from lfrtorch.least_squares.term import Term

if TYPE_CHECKING:
    from lfrtorch.engine.cell import LFRCell
    from lfrtorch.engine.lfr import LFR
    from lfrtorch.least_squares.guarantee import Guarantee
    from lfrtorch.model.model import Model

State = TypeVar("State")

BATCH = 32
"""Approximate number of records in a minibatch."""

REDUCING = 2e7
"""Dependent columns of J are left out if they would take more products than this."""


class Problem(LeastSquares):
    """r(θ): the residuals of all terms in a row; a ridge is the last term."""

    # θ has the free numbers of an LFR, then the initial states of the records whose start is
    # ``"estimated"``; θ_0 is θ at the start. The LFR is read once; only ``write`` changes it.

    def __init__(
        self,
        lfr: LFR,
        errors: SimulationErrors,
        others: Sequence[Term] = (),
        *,
        ridge: Ridge = 0.0,
        guarantee: Guarantee | None = None,
    ) -> None:
        self.lfr, self.errors = lfr, errors
        self._terms: list[Term] = [errors, *others]
        self.theta = self._first_theta()
        """θ_0."""
        self.weigh(ridge)
        self._guarantee = guarantee
        self._held = HeldSteps(lfr.cell, errors.parameters, len(self.theta))
        self._reduced: Reduction | None = None
        self._checked: set[bool] = set()  # whether the memory of these systems was checked

    @classmethod
    def of(
        cls,
        model: Model,
        records: Record | Sequence[Record],
        *,
        ridge: Ridge = 0.0,
        guarantee: Callable[[LFRCell], Guarantee | None] = lambda cell: None,
    ) -> Self:
        """The simulation errors of a model over records of its channels and rate."""
        data = as_records(records)
        errors = errors_of(model, data, own=cls._share(model, data))
        return cls(model.lfr, errors, ridge=ridge, guarantee=guarantee(model.lfr.cell))

    @classmethod
    def judge(cls, model: Model, records: Record | Sequence[Record]) -> Self:
        """The errors on records that are not fitted, from the initial states that fit best."""
        return cls(model.lfr, errors_of(model, records, solve_initial_states=True))

    # ``shared_problem`` overrides the methods up to ``_jacobian`` for several processes.

    shared = False
    """True if other processes have some of the records."""

    def total(self, part: Tensor) -> Tensor:
        """The sum of the parts of all processes."""
        return part

    def agreed(self, part: Tensor) -> Tensor:
        """The numbers of the first process, so that all processes have the same rounding errors."""
        return part

    def of_own_records(self, state: State) -> State:
        """A search's state with the residual of this process's records."""
        return state

    @classmethod
    def _share(cls, model: Model, records: Sequence[Record]) -> slice:
        return EVERY

    def _first_theta(self) -> Float[Tensor, " P"]:
        return self.errors.first_theta()

    def _jacobian(self, *parts: Any) -> Jacobian:
        return Jacobian(*parts)

    @property
    def size(self) -> int:
        """Number of scored samples and outputs."""
        return self.errors.size

    def read(self) -> Float[Tensor, " P"]:
        """θ from the weights of the LFR; its initial states are those of θ_0."""
        own = self.errors.parameters.read(self.lfr.cell)
        return torch.cat([own, self.theta[len(own) :]])

    def write(self, theta: Float[Tensor, " P"]) -> None:
        """Write θ to the weights of the LFR."""
        self.errors.parameters.write(self.lfr.cell, theta)

    def weigh(self, ridge: Ridge | Tensor) -> None:
        """Give the ridge another weight, or the rows of a prior; both pull towards θ_0."""
        penalties = RidgePenalty, PriorPenalty
        self._terms = [term for term in self._terms if not isinstance(term, penalties)]
        if isinstance(ridge, Tensor):
            self._terms.append(PriorPenalty(ridge, self.theta))
            return
        weight = ridge_by_entry(ridge, self.errors.parameters.sizes)
        if weight.any():
            self._terms.append(RidgePenalty(weight, self.theta))

    def rmse(self, theta: Float[Tensor, " P"]) -> float:
        """RMSE at θ over scored samples and outputs, unweighted, as in a score.

        It is in the unit of the outputs. If outputs have several units, each is normalised by about
        its rms.
        """
        return self.rmse_at(self.evaluate(theta))

    def rmse_at(self, point: Point) -> float:
        """RMSE at a point."""
        return math.sqrt(self.total(self.errors.squares(point.seen[0])) / self.size)

    def cost(self, residual: Float[Tensor, " M"]) -> float:
        """|r|²."""
        return float(self.total(residual @ residual))

    def evaluate(self, theta: Float[Tensor, " P"], near: Point | None = None) -> Point:
        """r at θ, infinite or NaN if the model diverges, and the trajectories.

        ``near`` is a nearby point, whose trajectories are the first guess.
        """
        before = [None] * len(self._terms) if near is None else near.seen
        terms = zip(self._terms, before, strict=True)
        residuals, seen = zip(*[term.evaluate(theta, own) for term, own in terms], strict=True)
        residual = residuals[0] if len(residuals) == 1 else torch.cat(residuals)
        return Point(theta, residual, self.cost(residual), seen)

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """r at θ; infinite or NaN if the model diverges."""
        return self.evaluate(theta).residual

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ, or a nearby θ that keeps held entries and the guarantee."""
        found = self._held.admissible(theta)
        if self._guarantee is None:
            return found
        return self.agreed(self._guarantee.admissible(found))

    def linearise(self, theta: Float[Tensor, " P"], *, eliminate: bool = True) -> Jacobian:
        """dr/dθ at θ."""
        return self.linearise_at(self.evaluate(theta), eliminate=eliminate)

    def linearise_at(
        self, point: Point, *, reduce: bool = True, eliminate: bool = True
    ) -> Jacobian:
        """dr/dθ at a point; ``reduce`` leaves out columns that gauge directions make dependent."""
        # Initial states are eliminated if they outnumber the parameters. A caller that solves
        # without damping needs all columns, and sets ``eliminate`` to False.
        theta, own = point.theta, self.errors.parameters.own
        states = len(theta) - own
        eliminate = eliminate and states > own and not self.shared
        if eliminate not in self._checked:  # the same at every θ
            spectral = sum(group.y.numel() for group in self.errors.groups if group.spectral)
            check_fit_memory(self.lfr.cell, 0 if eliminate else states, spectral)
            self._checked.add(eliminate)
        rows = [
            part
            for term, seen in zip(self._terms, point.seen, strict=True)
            for part in term.linearise(theta, seen, eliminate=eliminate)
        ]
        shared = own if eliminate else len(theta)
        reduced = everything(shared)
        if reduce and not eliminate and self._worth_reducing:
            reduced = self._reduction(theta)
        bounded = None if self._guarantee is None else partial(self._guarantee.bounded, theta)
        rank = len(reduced.kept) if reduced.expand is not None else self.rank
        project = self._held.projection(theta)
        return self._jacobian(rows, reduced, project, shared, rank, bounded)

    @cached_property
    def _worth_reducing(self) -> bool:
        """Tell if it saves time to find the dependent columns and leave them out."""
        # The damping also handles gauge directions, so only time decides, but for a prior.
        if any(isinstance(term, PriorPenalty) for term in self._terms):
            return False
        W, P = self.lfr.cell.weights(), len(self.theta)
        sizes = [s.place.stop - s.place.start for s in W.map.symmetries]
        left = P - W.nx**2 - sum(n**2 for n in sizes)
        return (P**2 - left**2) * self.size * W.ny > REDUCING

    @cached_property
    def rank(self) -> int:
        """Number of directions of θ that change the outputs: all but the gauge directions."""
        return len(self._reduction(self.theta).kept)

    def _reduction(self, theta: Float[Tensor, " P"]) -> Reduction:
        """The columns that must be computed; the others follow by gauge directions."""
        held = any(group.x0 is not None for group in self.errors.groups)
        held = bool(self.total(theta.new_tensor(float(held))))
        found = reduction(
            self.errors.parameters.weights(theta),
            self.errors.parameters.initial_states(theta),
            coordinates=not held,
            before=self._reduced,
            fixed=self._held.entries,
        )
        # Rounding errors decide between equally good columns, so the first process decides.
        kept, expand = found
        expand = expand if expand is None else self.agreed(expand)
        self._reduced = Reduction(self.agreed(kept), expand)
        return self._reduced

    def jacobian(self, theta: Float[Tensor, " P"]) -> Float[Tensor, "M P"]:
        """dr/dθ as one matrix, for small problems."""
        return self.linearise(theta, eliminate=False).whole()

    def gradient(
        self, theta: Float[Tensor, " P"], near: Point | None = None
    ) -> tuple[Point, Float[Tensor, " P"]]:
        """r at θ and the gradient of |r|² / samples, by the adjoint recurrence.

        ``near`` is a nearby point, or the point at θ itself.
        """
        known = near is not None and near.theta is theta
        point = near if near is not None and known else self.evaluate(theta, near)
        return point, 2.0 / self.size * self.linearise_at(point, reduce=False).adjoint(
            point.residual
        )

    def minibatches(self, epoch: int) -> list[Problem]:
        """Problems of about ``BATCH`` records each, drawn anew in each epoch.

        Each has the gradient of the mean over its own records. If there are few records, this
        problem itself is the only one.
        """
        counts = [len(group.u) for group in self.errors.groups]
        parts = math.ceil(sum(counts) / BATCH)
        ridges = [term for term in self._terms if isinstance(term, RidgePenalty)]
        if sum(counts) < 2 * BATCH or self.shared or len(self._terms) > 1 + len(ridges):
            return [self]
        generator = torch.Generator().manual_seed(epoch)
        order = torch.randperm(sum(counts), generator=generator)  # of all records
        firsts, found = [0, *itertools.accumulate(counts)], []
        for i in range(parts):
            part, drawn = copy(self), order[i::parts]
            part.errors = self.errors.part(
                [drawn[(drawn >= a) & (drawn < b)] - a for a, b in itertools.pairwise(firsts)]
            )
            part._terms = [part.errors, *(ridge.part(parts) for ridge in ridges)]
            part._checked = set()
            found.append(part)
        return found

    def release(self) -> None:
        """Free memory that only speeds up the next evaluation."""
        for term in self._terms:
            term.release()

    def state_dict(self) -> dict[str, Tensor]:
        """State besides θ that further evaluations depend on, to the last bit."""
        kept = {} if self._reduced is None else {"kept": self._reduced.kept}
        return {"start": self.theta, **kept}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the state of the same problem."""
        start = tensors["start"]
        same = start.shape == self.theta.shape
        if not same or not torch.allclose(start, self.theta, 1e-6, 1e-6):
            raise InputError(
                "the interrupted fit had another start: the data, the settings or the package have "
                "changed since. Start a new fit from its best model: init_from=DIR."
            )
        self.theta.copy_(start)  # the ridge shares this tensor
        if "kept" in tensors:
            self._reduced = Reduction(tensors["kept"], None)


def errors_of(
    model: Model,
    records: Record | Sequence[Record],
    *,
    own: slice = EVERY,
    solve_initial_states: bool = False,
) -> SimulationErrors:
    """The errors of a model over records in physical units."""
    data = as_records(records)
    for record in data:
        model.check(record)
    if any(record.start == "measured" for record in data):
        _check_measured(model)
    estimated = any(record.start == "estimated" for record in data)
    free = any(p.requires_grad for p in model.lfr.parameters())
    if not free and not estimated and not solve_initial_states:
        raise InputError("all parameters of the model are frozen; there is nothing to fit.")
    return SimulationErrors(
        model.lfr.cell,
        [model.scaler.normalise(record) for record in data],
        own=own,
        y_scale=model.scaler.y_scale if of_one_unit(model.outputs) else 1.0,
        solve_initial_states=solve_initial_states,
    )


def _check_measured(model: Model) -> None:
    """Refuse a fit from measured starts if the model's output equation has free parameters."""
    cell = model.lfr.cell
    free = [
        name
        for name in ("Cy", "Dyu", "Dyw")
        if cell.get_parameter(name).numel()
        and not (name in cell.held and bool(cell.held[name].all()))
    ]
    if free or cell.map.outputs_have_parameters:
        raise InputError(
            "start='measured' computes states from outputs, but their equation has parameters.\n"
            "Give a known model whose outputs are states, without parameters, or the matrices "
            "fixed={'Cy': ..., 'Dyu': ..., 'Dyw': ...}; or start='estimated'."
        )
