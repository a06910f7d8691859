"""Test for a nonlinearity at the input (Hammerstein) or at the output (Wiener) of a system."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from lfrtorch._support.types import Array
from lfrtorch.data.records import Record
from lfrtorch.engine.simulation import Trajectory
from lfrtorch.model.model import Model

SAMPLES = 1 << 16
"""Largest number of samples that are used, evenly spread."""

_DEGREE = 7
"""Degree of the polynomials; degree 3 separates Wiener and Hammerstein systems less well."""


def nonlinear_end(
    linear: Model, data: Sequence[Record], found: Sequence[Trajectory]
) -> Literal["input", "output"] | None:
    """The end of the linear model where a static map explains most of its error, or None."""
    # At the output, the map is a sum of polynomials of each output. At the input, the linear model
    # responds to polynomials of each input. The part that affine terms explain does not count.
    responses: dict[Literal["input", "output"], list[Array]] = {"input": [], "output": []}
    step, errors = -(-sum(record.samples for record in data) // SAMPLES), []
    for record, trajectory in zip(data, found, strict=True):
        own = record.factors > 0
        own[np.arange(record.samples) % step > 0] = False
        u, y_hat = linear.scaler.normalise_u(record.u), trajectory.y[0].double().numpy()
        errors.append((linear.scaler.normalise_y(record.y) - y_hat)[own])
        start = "periodic" if record.start == "periodic" else "zero"
        # One response at a time: all together would take a hundred times the memory of a record.
        of_input = []
        for each in _powers(u):
            driven = torch.as_tensor(each).to(trajectory.y).unsqueeze(0)
            y = linear.lfr.trajectory(driven, None, start).y[0]
            of_input.append(y.double().numpy()[own])
        responses["input"].append(np.stack(of_input))
        responses["output"].append(np.stack([each[own] for each in _powers(y_hat)]))
    error, explained = torch.as_tensor(np.concatenate(errors)), {}
    for end, parts in responses.items():
        columns = torch.as_tensor(np.concatenate(parts, axis=1)).mT
        if len(error) < 20 * columns.shape[1]:  # too few samples for so many coefficients
            return None
        R = torch.linalg.qr(torch.cat([columns, error.unsqueeze(1)], dim=1), mode="r").R
        # |error|² has three parts: explained by affine terms, by higher degrees, and unexplained.
        affine = 2 * columns.shape[1] // (_DEGREE + 1)
        _, bent, left = R[:, -1].square().split([affine, columns.shape[1] - affine, 1])
        explained[end] = float(bent.sum() / (bent.sum() + left))  # NaN if the model is exact
    best = max(explained, key=lambda end: explained[end])
    # The explained part is at least 0.96 for simulated Wiener and Hammerstein systems without
    # noise, and at most 0.80 for the benchmarks (benchmarks/starts.md).
    return best if explained[best] >= 0.85 else None


def _powers(signals: Float[Array, "T n"]) -> Iterator[Float[Array, "T n"]]:
    """Yield Chebyshev polynomials of each signal, alone in its channel, by rising degree."""
    t = signals / 3.0  # signals have unit standard deviation; for |t| > 1 the polynomials grow
    now, after = np.ones_like(t), t
    for _ in range(_DEGREE + 1):
        for i in range(t.shape[1]):
            alone = np.zeros_like(t)
            alone[:, i] = now[:, i]
            yield alone
        now, after = after, 2.0 * t * after - now
