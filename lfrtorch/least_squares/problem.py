"""A problem: the sum of squared terms that a search minimises over θ, under a guarantee."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from copy import copy
from functools import partial
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lfrtorch._support.errors import InputError
from lfrtorch.distributed import Ranks
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.nonlinearity import known_parts
from lfrtorch.least_squares.exact_integrators import fixed_parameters
from lfrtorch.least_squares.fit_memory import check_fit_memory
from lfrtorch.least_squares.gauge import Reduction, everything, reduction
from lfrtorch.least_squares.guarantee import Guarantee, Name, guarantee_of
from lfrtorch.least_squares.jacobian import Jacobian
from lfrtorch.least_squares.levenberg_marquardt import LeastSquares
from lfrtorch.least_squares.ridge import Ridge, RidgePenalty, ridge_by_entry
from lfrtorch.least_squares.simulation_errors import SimulationErrors, SystemErrors
from lfrtorch.least_squares.term import Term
from lfrtorch.model import Model
from lfrtorch.records import Record, as_records, of_one_unit

BATCH = 32
"""Records in a minibatch, about."""


class Problem(LeastSquares):
    """r(θ): the residual of each term, one after another; a ridge is the last."""

    # θ are the free parameters of an LFR, then the initial states of the records whose start is
    # ``"estimated"``; θ_0 is θ now. The LFR gets a θ by ``write`` alone.

    def __init__(
        self,
        lfr: LFR,
        errors: SimulationErrors,
        others: Sequence[Term] = (),
        *,
        ridge: Ridge = 0.0,
        guarantee: Guarantee | None = None,
        fixed: Bool[Tensor, " free"] | None = None,
    ) -> None:
        self.lfr, self.errors, self.ranks = lfr, errors, errors.ranks
        self._terms: list[Term] = [errors, *others]
        self._initial_states = errors.first_initial_states()
        self._theta_0 = self.theta
        self.weigh(ridge)
        self._guarantee = guarantee
        self.fixed = torch.zeros_like(self._theta_0, dtype=torch.bool)
        """Which entries of θ are constants: columns of zeros in J."""
        self.fixed[: errors.parameters.own] = fixed_parameters(lfr.cell) if fixed is None else fixed
        self._reduced: Reduction | None = None
        self._checked: set[bool] = set()  # whether the memory of these systems was checked

    @classmethod
    def of(
        cls,
        model: Model,
        records: Record | Sequence[Record],
        *,
        ridge: Ridge = 0.0,
        guarantee: Name | None = None,
        longest: int | None = None,
        ranks: Ranks | None = None,
    ) -> Self:
        """The simulation errors of a model over records of its channels and rate."""
        # ``longest``: samples of the longest record before they were cut into windows, which
        # ``"stable"`` goes by. Processes share the records: all have the same θ, cost and gradient,
        # each the residual of its own records.
        errors = _errors_of(model, records, Ranks() if ranks is None else ranks)
        longest = longest or max(record.samples for record in as_records(records))
        kept = guarantee_of(guarantee, model.lfr.cell, longest, errors.ranks)
        return cls(model.lfr, errors, ridge=ridge, guarantee=kept)

    @classmethod
    def of_predictor(
        cls,
        model: Model,
        records: Record | Sequence[Record],
        simulation: float,
        *,
        ridge: Ridge = 0.0,
        ranks: Ranks | None = None,
    ) -> Self:
        """The errors of a predictor and, with a weight, those of the simulations of its system."""
        # Predictions lean on the measured outputs: a model that predicts well may simulate badly,
        # or run away. ``simulation`` is the weight if both errors were as large at the start.
        errors = _errors_of(model, records, Ranks() if ranks is None else ranks)
        found = cls(model.lfr, errors, ridge=ridge)
        normalised = [model.scaler.normalise(record) for record in as_records(records)]
        system = SystemErrors(model.lfr.cell, normalised, errors.ranks)
        theta = found.theta
        costs = [found.cost(term.residual(theta)) for term in (errors, system)]
        weight = simulation * math.sqrt(costs[0] / costs[1]) if costs[1] > 0 else 0.0
        system.weight = weight if math.isfinite(weight) else 0.0
        found._terms.insert(1, system)
        return found

    @classmethod
    def judge(
        cls, model: Model, records: Record | Sequence[Record], like: Problem | None = None
    ) -> Self:
        """The errors on records that are not fitted, each from its most probable initial state."""
        errors = _errors_of(model, records, Ranks(), solve_initial_states=True)
        normalised = [model.scaler.normalise(record) for record in as_records(records)]
        others = [
            SystemErrors(
                model.lfr.cell,
                normalised,
                errors.ranks,
                solve_initial_states=True,
                weight=term.weight,
            )
            for term in ([] if like is None else like._terms)
            if isinstance(term, SystemErrors)
        ]
        return cls(model.lfr, errors, others)

    @property
    def theta(self) -> Float[Tensor, " P"]:
        """Parameters as they stand in the module, then the estimated initial states."""
        return self.errors.parameters.of(self.lfr.cell, self._initial_states)

    @property
    def size(self) -> int:
        """Number of scored samples and outputs."""
        return self.errors.size

    def write(self, theta: Float[Tensor, " P"]) -> None:
        """Put θ into the module."""
        theta = theta.detach().to(self._theta_0, copy=True)  # the module's weights are its own
        self.errors.parameters.write(self.lfr.cell, theta)
        self._initial_states = self.errors.parameters.initial_states(theta)

    def weigh(self, ridge: Ridge) -> None:
        """Give the ridge another weight; it still pulls to where the search began."""
        weight = ridge_by_entry(ridge, self.errors.parameters.sizes)
        self._terms = [term for term in self._terms if not isinstance(term, RidgePenalty)]
        if weight.any() and self.ranks.rank == 0:
            self._terms.append(RidgePenalty(weight, self._theta_0))

    def rmse(self, theta: Float[Tensor, " P"]) -> float:
        """RMSE at θ over scored samples and outputs, unweighted, as in a score.

        In the unit of the outputs; of several units each in that of the scaling, about its rms.
        """
        return self.errors.rmse(theta)

    def cost(self, residual: Float[Tensor, " M"]) -> float:
        """|r|² of all processes."""
        return float(self.ranks.sum(residual.square().sum()))

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """r at θ; infinite or NaN if the model diverges."""
        return torch.cat([term.residual(theta) for term in self._terms])

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ, or one near it that keeps the guarantee."""
        if self._guarantee is None:
            return theta
        return self.ranks.first(self._guarantee.admissible(theta))

    def linearise(
        self, theta: Float[Tensor, " P"], *, reduce: bool = True, eliminate: bool = True
    ) -> Jacobian:
        """dr/dθ at θ; ``reduce``: without columns that gauge directions make dependent."""
        # Initial states are eliminated if they outnumber the parameters; a system without damping
        # needs them all.
        own = self.errors.parameters.own
        states = len(theta) - own
        eliminate = eliminate and states > own and self.ranks.world == 1
        eliminate = eliminate and all(term.eliminates for term in self._terms)
        if eliminate not in self._checked:  # the same at every θ
            spectral = sum(group.y.numel() for group in self.errors.groups if group.spectral)
            check_fit_memory(self.lfr.cell, 0 if eliminate else states, spectral)
            self._checked.add(eliminate)
        rows = [part for t in self._terms for part in t.linearise(theta, eliminate=eliminate)]
        if eliminate:
            reduced = everything(theta[:own])
        elif reduce:
            reduced = self._reduction(theta)
        else:
            reduced = everything(theta)
        if self._guarantee is None:
            return Jacobian(rows, reduced, self.fixed, self.ranks)
        bounded = partial(self._guarantee.bounded, theta)
        return Jacobian(rows, reduced, self.fixed, self.ranks, bounded)

    def _reduction(self, theta: Float[Tensor, " P"]) -> Reduction:
        """The columns that gauge directions leave, the same ones on all processes."""
        held = any(group.x0 is not None for group in self.errors.groups)
        held = bool(self.ranks.sum(theta.new_tensor(float(held))))
        found = reduction(
            self.errors.cell_at(theta),
            self.errors.parameters.initial_states(theta),
            coordinates=not held,
            before=self._reduced,
            fixed=self.fixed,
        )
        # Rounding errors decide between columns that are as good; processes must agree.
        self._reduced = Reduction(*map(self.ranks.first, found))
        return self._reduced

    def jacobian(self, theta: Float[Tensor, " P"]) -> Float[Tensor, "M P"]:
        """dr/dθ as one matrix, for small problems."""
        return self.linearise(theta, eliminate=False).whole()

    def gradient(
        self, theta: Float[Tensor, " P"]
    ) -> tuple[Float[Tensor, " M"], Float[Tensor, " P"]]:
        """r and the gradient of |r|² / samples, by the adjoint recurrence."""
        r = self.residual(theta)
        return r, 2.0 / self.size * self.linearise(theta, reduce=False).adjoint(r)

    def minibatches(self, epoch: int) -> list[Problem]:
        """Problems of some ``BATCH`` records each, drawn anew in each epoch; of few records, this.

        Their gradients are those of the mean over their own records.
        """
        counts = [len(group.u) for group in self.errors.groups]
        parts = math.ceil(sum(counts) / BATCH)
        ridges = [term for term in self._terms if isinstance(term, RidgePenalty)]
        if sum(counts) < 2 * BATCH or self.ranks.world > 1 or len(self._terms) > 1 + len(ridges):
            return [self]
        generator = torch.Generator().manual_seed(epoch)
        order = torch.randperm(sum(counts), generator=generator)  # of all, and dealt out
        firsts, found = [0, *itertools.accumulate(counts)], []
        for i in range(parts):
            part, drawn = copy(self), order[i::parts]
            part.errors = self.errors.part(
                [drawn[(drawn >= a) & (drawn < b)] - a for a, b in itertools.pairwise(firsts)]
            )
            part._terms = [part.errors, *(ridge.part(parts) for ridge in ridges)]
            part._reduced, part._checked = None, set()
            found.append(part)
        return found

    def release(self) -> None:
        """Free the memory of what only speeds up the next evaluation."""
        for term in self._terms:
            term.release()

    def state_dict(self) -> dict[str, Tensor]:
        """What the next evaluations depend on besides θ, to the last bit."""
        tensors = {"start": self._theta_0}
        for number, term in enumerate(self._terms):
            tensors |= {f"{number}.{name}": part for name, part in term.state_dict().items()}
        if self._reduced is not None:
            tensors["kept"] = self._reduced.kept
        return tensors

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what the same problem had."""
        theta_0 = tensors["start"]
        if theta_0.shape != self._theta_0.shape or not torch.allclose(
            theta_0, self._theta_0, 1e-6, 1e-6
        ):
            raise InputError(
                "the fit that is to go on began elsewhere: the data, the settings or the package "
                "have changed since. Start a new one, from its best model: init_from=DIR."
            )
        for number, term in enumerate(self._terms):
            own = f"{number}."
            term.load_state_dict(
                {n.removeprefix(own): part for n, part in tensors.items() if n.startswith(own)}
            )
        if "kept" in tensors:
            self._reduced = Reduction(tensors["kept"], theta_0.new_zeros(0, len(theta_0)))


def _errors_of(
    model: Model,
    records: Record | Sequence[Record],
    ranks: Ranks,
    *,
    solve_initial_states: bool = False,
) -> SimulationErrors:
    """The errors of a model over records in physical units."""
    data = as_records(records)
    for record in data:
        model.check(record)
    if len(data) < ranks.world:
        raise InputError(
            f"{ranks.world} processes share {len(data)} record(s); each needs one: start "
            "fewer processes, or cut the data into more records."
        )
    if any(record.start == "measured" for record in data):
        _check_measured(model)
    estimated = any(record.start == "estimated" for record in data)
    free = any(p.requires_grad for p in model.lfr.parameters())
    if not free and not estimated and not solve_initial_states:
        raise InputError("all parameters of the model are frozen; there is nothing to fit.")
    return SimulationErrors(
        model.lfr.cell,
        [model.scaler.normalise(record) for record in data],
        ranks,
        y_scale=model.scaler.y_scale if of_one_unit(model.outputs) else 1.0,
        solve_initial_states=solve_initial_states,
    )


def _check_measured(model: Model) -> None:
    """Refuse a fit from measured starts of a model whose output has an equation to be fitted."""
    cell = model.lfr.cell
    free = [
        name
        for name in ("Cy", "Dyu", "Dyw")
        if cell.get_parameter(name).numel()
        and not (name in cell.fixed and bool(cell.fixed[name].all()))
    ]
    parts = known_parts(cell.static)
    if free or (parts is not None and parts[0].outputs_have_parameters):
        raise InputError(
            "start='measured' takes the states from the output, whose equation is to be fitted.\n"
            "Give a known model whose outputs are states, without parameters, or the matrices "
            "fixed={'Cy': ..., 'Dyu': ..., 'Dyw': ...}; or start='estimated'."
        )
