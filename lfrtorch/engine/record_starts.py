"""How records begin: five objects, each with the state that a record begins in.

``STARTS`` has one for each name that ``Record.start`` may have. Signals are normalised, of records
that begin alike; whoever simulates or fits asks the object, and not its name.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from lfrtorch.engine.initial_state import estimated_start, measured_start, start_from_beginning
from lfrtorch.engine.simulation import Numbers, Trajectory, simulate, steady_state


class AtRest:
    """``"zero"``: x = 0, at rest at the inputs' offset."""

    periodic = False
    """Whether a record is a period of a steady state."""
    fitted = False
    """Whether the first state is a parameter of a fit."""

    def known(
        self,
        model: Numbers,
        u: Float[Tensor, "R T nu"],
        y: Float[Tensor, "R T ny"],
        x0: Float[Tensor, "R nx"] | None,
    ) -> Float[Tensor, "R nx"] | None:
        """First states that no parameter moves; None for rest, and if there are none such."""
        return None

    def solved(
        self,
        model: Numbers,
        u: Float[Tensor, "R T nu"],
        y: Float[Tensor, "R T ny"],
        weight: Float[Tensor, "R T ny"],
        near: Float[Tensor, "R nx"] | None = None,
    ) -> Float[Tensor, "R nx"] | None:
        """First states that a model and the outputs tell, from some nearby; None if known."""
        return None

    def guess(self, model: Numbers, u: Tensor, y: Tensor, weight: Tensor) -> Tensor:
        """Where a fit begins with first states that are parameters."""
        raise NotImplementedError

    def trajectory(
        self,
        model: Numbers,
        u: Float[Tensor, "R T nu"],
        x0: Float[Tensor, "R nx"] | None,
        near: Float[Tensor, "R _ nx"] | None = None,
    ) -> Trajectory:
        """All signals from first states; ``near`` are states of a trajectory close by."""
        return simulate(model, u, x0, guess=near)


class Given(AtRest):
    """``"given"``: from the state x0 of the record."""

    def known(self, model: Numbers, u: Tensor, y: Tensor, x0: Tensor | None) -> Tensor | None:
        """That state."""
        return x0


class Measured(AtRest):
    """``"measured"``: from the state that the first output tells, whose equation is not fitted."""

    def known(self, model: Numbers, u: Tensor, y: Tensor, x0: Tensor | None) -> Tensor | None:
        """The state of the first output."""
        return measured_start(model, u[:, 0], y[:, 0])


class Estimated(AtRest):
    """``"estimated"``: from the most probable state, given the outputs; a parameter of a fit."""

    fitted = True

    def solved(
        self, model: Numbers, u: Tensor, y: Tensor, weight: Tensor, near: Tensor | None = None
    ) -> Tensor | None:
        """The most probable state."""
        return estimated_start(model, u, y, weight, near)

    def guess(self, model: Numbers, u: Tensor, y: Tensor, weight: Tensor) -> Tensor:
        """The state that fits the beginning best."""
        return start_from_beginning(model, u, y, weight)


class Periodic(AtRest):
    """``"periodic"``: in the steady state, whose first state is its last."""

    periodic = True

    def trajectory(
        self,
        model: Numbers,
        u: Tensor,
        x0: Tensor | None,
        near: Float[Tensor, "R _ nx"] | None = None,
    ) -> Trajectory:
        """The steady state; ``x0`` is a first guess."""
        return steady_state(model, u, x0 if near is None else near)


STARTS: dict[str, AtRest] = {
    "zero": AtRest(), "given": Given(), "measured": Measured(), "estimated": Estimated(),
    "periodic": Periodic(),
}  # fmt: skip
"""By the names that records have for them."""


def begun(name: str, model: Numbers, u: Tensor, y: Tensor, weight: Tensor) -> Trajectory:
    """All signals of records that a given model simulates from a start but ``"given"``."""
    start = STARTS[name]
    x0 = start.known(model, u, y, None)
    x0 = start.solved(model, u, y, weight) if x0 is None else x0
    return start.trajectory(model, u, x0)
