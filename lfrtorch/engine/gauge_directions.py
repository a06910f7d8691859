"""Gauge directions: changes of a model's numbers that leave its output unchanged.

Many sets of matrices describe the same model. A change of coordinates x -> T x changes A, Bu, Bw,
Cz and Cy, but no output. The same holds for z and w if the static map is a network, whose weights
absorb the change. To first order each such change is a direction: a column of G.
"""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.held import held_parameters
from lfrtorch.engine.weights import Weights

ROUNDING = 1e-10
"""A pivot below this part of the largest pivot, or of the norm of G, counts as a rounding error."""


def free_directions(cell: LFRCell) -> int:
    """Number of gauge directions that change no held entry.

    The count is made with random numbers in all free entries. A start, whose static map has no
    output, has more directions.
    """
    count = cell.nx**2 + sum((s.place.stop - s.place.start) ** 2 for s in cell.map.symmetries)
    if not cell.held:
        return count
    other = deepcopy(cell).to(device="cpu", dtype=torch.float64).requires_grad_()
    held, numbers = held_parameters(other).numpy(), other.weights()
    numbers.flat[torch.as_tensor(~held)] = torch.as_tensor(
        np.random.default_rng(0).standard_normal(int((~held).sum()))
    )
    G = gauge_directions(numbers, numbers.flat.new_zeros(0, cell.nx))[held]
    # Columns of zeros are left out: directions of z and w that change no held entry.
    G = G[:, G.any(axis=0)]
    diagonal = np.abs(np.diag(scipy.linalg.qr(G, mode="r", pivoting=True)[0]))
    return count - int((diagonal > ROUNDING * diagonal.max(initial=0.0)).sum())


def gauge_directions(
    W: Weights, initial_states: Float[Tensor, "S nx"]
) -> Float[Array, "numbers directions"]:
    """Gauge directions G of all numbers, then of the initial states."""
    # T stacks all matrices with a single entry 1, each of which gives a direction. x -> (I + εT) x
    # changes A to A + ε (TA - AT), and so on; likewise z -> (I + εT) z and w -> (I + εT)⁻¹ w.
    T = _units(W.nx, W.flat)
    of_x = {"A": T @ W.A - W.A @ T, "Bu": T @ W.Bu, "Bw": T @ W.Bw, "Cz": -W.Cz @ T}
    groups = [_flat(W, of_x | {"Cy": -W.Cy @ T, "x0": initial_states @ T.mT}, initial_states)]
    weights = W.map.named_weights(W.phi)
    for symmetry in W.map.symmetries:
        own = symmetry.place
        T = _units(own.stop - own.start, W.flat)
        changes: dict[str, Tensor] = dict(symmetry.changes(T, weights))
        for name in ("Cz", "Dzu") if symmetry.signal == "z" else ("Bw", "Dyw"):
            matrix = getattr(W, name)
            change = changes[name] = matrix.new_zeros(len(T), *matrix.shape)
            if symmetry.signal == "z":
                change[:, own] = T @ matrix[own]
            else:
                change[:, :, own] = -matrix[:, own] @ T
        groups.append(_flat(W, changes, initial_states))
    return to_float64(torch.cat(groups).mT)


def _flat(W: Weights, changes: dict[str, Tensor], initial_states: Tensor) -> Tensor:
    """Changes by name as rows of all numbers, then the initial states."""
    rows = len(next(iter(changes.values())))
    found = W.flat.new_zeros(rows, len(W.flat) + initial_states.numel())
    for name, change in changes.items():
        place = slice(len(W.flat), None) if name == "x0" else W.layout.place(name)
        found[:, place] = change.flatten(1)
    return found


def _units(n: int, like: Tensor) -> Float[Tensor, "{n}*{n} {n} {n}"]:
    """The n² matrices with one entry 1."""
    return torch.eye(n * n, dtype=like.dtype, device=like.device).reshape(n * n, n, n)
