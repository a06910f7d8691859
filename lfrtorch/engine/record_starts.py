"""Starts of records: five objects that define initial states.

``STARTS`` has an object for each name of ``Record.start``. Signals are normalised, and of records
with the same start. Simulations and fits call the object, and never compare names.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from lfrtorch.engine.initial_state import estimated_start, measured_start, start_from_beginning
from lfrtorch.engine.simulation import Numbers, Trajectory, simulate, steady_state


class AtRest:
    """Start ``"zero"``: x = 0, at rest at the inputs' offset."""

    periodic = False
    """True if a record is a period of a steady state."""
    fitted = False
    """True if the initial state is a parameter of a fit."""

    def known(
        self,
        model: Numbers,
        u: Float[Tensor, "R T nu"],
        y: Float[Tensor, "R T ny"],
        x0: Float[Tensor, "R nx"] | None,
    ) -> Float[Tensor, "R nx"] | None:
        """Initial states that depend on no parameter; None at rest, or if there are none."""
        return None

    def solved(
        self,
        model: Numbers,
        u: Float[Tensor, "R T nu"],
        y: Float[Tensor, "R T ny"],
        weight: Float[Tensor, "R T ny"],
        near: Float[Tensor, "R nx"] | None = None,
    ) -> Float[Tensor, "R nx"] | None:
        """Initial states that a model estimates from the outputs; None if they are known."""
        return None

    def guess(self, model: Numbers, u: Tensor, y: Tensor, weight: Tensor) -> Tensor:
        """First guess of a fit for initial states that are parameters."""
        raise NotImplementedError

    def trajectory(
        self,
        model: Numbers,
        u: Float[Tensor, "R T nu"],
        x0: Float[Tensor, "R nx"] | None,
        near: Float[Tensor, "R _ nx"] | None = None,
    ) -> Trajectory:
        """All signals from initial states; ``near`` has the states of a nearby trajectory."""
        return simulate(model, u, x0, guess=near)


class Given(AtRest):
    """Start ``"given"``: from the state x0 of the record."""

    def known(self, model: Numbers, u: Tensor, y: Tensor, x0: Tensor | None) -> Tensor | None:
        """State x0 of each record."""
        return x0


class Measured(AtRest):
    """Start ``"measured"``: the first output determines the state; its equation is held."""

    def known(self, model: Numbers, u: Tensor, y: Tensor, x0: Tensor | None) -> Tensor | None:
        """State that has the first output."""
        return measured_start(model, u[:, 0], y[:, 0])


class Estimated(AtRest):
    """Start ``"estimated"``: the most probable state given the outputs; a parameter of a fit."""

    fitted = True

    def solved(
        self, model: Numbers, u: Tensor, y: Tensor, weight: Tensor, near: Tensor | None = None
    ) -> Tensor | None:
        """Most probable state given the outputs."""
        return estimated_start(model, u, y, weight, near)

    def guess(self, model: Numbers, u: Tensor, y: Tensor, weight: Tensor) -> Tensor:
        """State that fits the beginning of each record best."""
        return start_from_beginning(model, u, y, weight)


class Periodic(AtRest):
    """Start ``"periodic"``: in periodic steady state, x(T) = x(0)."""

    periodic = True

    def trajectory(
        self,
        model: Numbers,
        u: Tensor,
        x0: Tensor | None,
        near: Float[Tensor, "R _ nx"] | None = None,
    ) -> Trajectory:
        """Periodic steady state; ``x0`` is a first guess."""
        return steady_state(model, u, x0 if near is None else near)


STARTS: dict[str, AtRest] = {
    "zero": AtRest(), "given": Given(), "measured": Measured(), "estimated": Estimated(),
    "periodic": Periodic(),
}  # fmt: skip
"""Starts by their names in ``Record.start``."""


def begun(name: str, model: Numbers, u: Tensor, y: Tensor, weight: Tensor) -> Trajectory:
    """All signals of records that a model simulates from any start but ``"given"``."""
    start = STARTS[name]
    x0 = start.known(model, u, y, None)
    x0 = start.solved(model, u, y, weight) if x0 is None else x0
    return start.trajectory(model, u, x0)
