"""Simulation of an input that is longer than memory: block by block, from state to state."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfrtorch.model import Model
from lfrtorch.records import as_signal


def simulate_blocks(
    model: Model, blocks: Iterable[ArrayLike], *, x0: ArrayLike | None = None
) -> Iterator[NDArray[np.float64]]:
    """Simulated output of an input that comes in blocks, as if it were simulated in one go.

    The state at the end of a block is that at the start of the next: the numbers are the same to
    the bit where the model is linear or a ``Network`` on the CPU, and to rounding elsewhere. No
    more than a block is in memory.

    Args:
        model: what is simulated; ``LinearModel.to_model`` gives that of a linear one.
        blocks: the input, physical units, one block after another, of any lengths.
        x0: start state in the model's coordinates; 0 where left out. That of a measurement is
            ``model.signals(record, start="estimated").x[0, 0]``.

    Shape:
        blocks: (n, nu) or (n,), x0: (nx,) -> (n, ny) for each block, physical units.

    Raises:
        ValueError: in the block where it is found: an input of the wrong shape or with NaN, or a
            model that diverges; the message says at which sample of the whole input.
    """
    first, state = 0, np.zeros(model.lfr.cell.nx) if x0 is None else x0
    for block in blocks:
        u = as_signal(block, model.inputs, "input", first=first)
        trajectory = model.signals(u, start="given", x0=state)
        y = model.scaler.restore_y(trajectory.y[0].double().numpy())
        lost = ~np.isfinite(y).all(axis=1)
        if lost.any():
            raise ValueError(
                f"the model diverges: its output is not finite at sample {first + lost.argmax()}; "
                "check the units of the inputs and whether they are louder than those it was "
                "fitted to, or start from another state."
            )
        yield y
        first, state = first + len(u), trajectory.x[0, -1].numpy()
