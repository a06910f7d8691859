"""One model in the place of a mean of several: fitted to the data and to what the mean simulates.

The mean of models that fit alike is better than each where the data tell little, and as large as
all of them. What it knows beyond the data are its outputs at other inputs. So its best member is
fitted again, to the data and to these outputs, at inputs like those of the data: of the same
amplitudes and nearly the same spectrum, in another order.

References:
    Hinton, Vinyals and Dean, "Distilling the knowledge in a neural network", 2015.
    Schreiber and Schmitz, "Improved surrogate data for nonlinearity tests", Physical Review Letters
    77, 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import numpy as np

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.distributed import Ranks
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.trainer import FitResult, Monitor, Stop, Trainer
from lfrtorch.least_squares.ridge import Ridge
from lfrtorch.records import Record, as_records


@typed()
def distil(
    result: FitResult,
    train: Record | Sequence[Record],
    validation: Record | Sequence[Record] = (),
    *,
    trainer: Trainer | None = None,
    ridge: Ridge = 0.0,
    seed: int = 0,
    monitor: Monitor | None = None,
    ranks: Ranks | None = None,
    stop: Stop | None = None,
) -> FitResult:
    """One model that simulates as the mean of several does.

    Args:
        result: of a fit with ``average`` above 1, whose model is a mean; its models are copied.
        train: records that were fitted.
        validation: records that choose among the iterates.
        trainer, ranks, stop: see :func:`lfrtorch.fit`.
        ridge: towards the best member.
        seed: of the inputs.
        monitor: called after every iteration. Default: a line on a terminal or in a notebook.

    Returns:
        The fit of a model of the sizes of one member.

    Raises:
        ValueError: a result whose model is no mean.

    Example:
        >>> models = [lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4, seed=i) for i in range(2)]
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=8)
        >>> mean = lfrtorch.fit(models, record, trainer=trainer, average=2)
        >>> lfrtorch.distil(mean, record, trainer=trainer).model.sizes
        {'nx': 1, 'nz': 1, 'nw': 1, 'nn': 4}
    """
    integer("seed", seed, 0)
    if not result.members:
        raise InputError("the model is no mean of several; fit several starts with average=4.")
    train, rng = as_records(train), np.random.default_rng(seed)
    copies = []
    for record in (record for record in train for _ in range(5)):  # inputs for each
        start = "periodic" if record.start == "periodic" else "zero"
        u = shuffled(record.u, rng)
        y = result.model.simulate(u, start=start)
        if np.isfinite(y).all():
            start = "periodic" if record.start == "periodic" else "estimated"
            made = record.with_signals(
                u=u, y=y, reference=None, valid=None, limits=None, start=start, skip=0,
                period=None, x0=None,
            )  # fmt: skip
            copies.append(made)
    records = [*train, *copies]
    return fit(
        deepcopy(result.members[0]),
        records,
        validation,
        trainer=trainer,
        ridge=ridge,
        monitors=None if monitor is None else [monitor],
        ranks=None if ranks is None else ranks.enough_for(len(records)),
        stop=stop,
    )


def shuffled(u: Array, rng: np.random.Generator) -> Array:
    """An input (T, nu) of the same amplitudes and nearly the same spectrum, in another order."""
    amplitudes, spectrum = np.sort(u, axis=0), np.abs(np.fft.rfft(u, axis=0))
    found = u[rng.permutation(len(u))]
    for _ in range(30):  # passes, after which the spectrum is nearly that of u
        phases = np.exp(1j * np.angle(np.fft.rfft(found, axis=0)))
        order = np.fft.irfft(spectrum * phases, len(u), axis=0).argsort(axis=0).argsort(axis=0)
        found = np.take_along_axis(amplitudes, order, axis=0)
    return found
