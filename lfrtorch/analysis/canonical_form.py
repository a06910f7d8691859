"""A model in coordinates that two fits of one system share, its static map without a linear part.

The linear part of the static map can be moved into the linear block, and z, w and x can be scaled
and mixed: many sets of weights are one model. The canonical form is the set for which

- the affine map nearest to w(z) over the data has slope 0: its slope is in A, Bu, Cy and Dyu;
- z, w and x have unit covariance over the data (w about that constant);
- the first w adds the most to the output, the first z bends the map the most, the first x is seen
  the most in y and z;
- the largest entry of the impulse response from u to each z and from each w to y is positive.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Complex128, Float

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Complex
from lfrtorch.data.records import Record, as_records
from lfrtorch.engine.cell import LFRCell, Matrices
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.linearised import fed_back, static_slope
from lfrtorch.engine.operating_point import double
from lfrtorch.linear.resolvent import frequency_response
from lfrtorch.model.data_reach import whitening
from lfrtorch.model.model import Model

MOST_SAMPLES = 16_384
"""Largest number of samples of a record, the last ones, for covariances and responses to w."""

_ANGLES = 1024
"""Frequencies of impulse responses and of the observability Gramian."""

_FLAT = 1e-12
"""Smallest variance, relative to the largest, of a direction that is scaled to 1."""


@dataclass(frozen=True, eq=False)
class Canonical:
    """A model in its canonical form, and what its coordinates mean.

    Args:
        model: the same model in the canonical x = X x_before, with its static map f as it was.
        matrices: the linear block in the canonical x, z and w.
        slope: L, of the affine map nearest to f over the data.
        X, Z, W: transformations from the former coordinates; the map of the canonical z is
            w = W (f(Z⁻¹ z) - L Z⁻¹ z), see ``static``.
        shares: share of each w in the power that the nonlinearity adds to the normalised output, if
            all w had the mean of their spectra; 0 if it adds nothing.
        bends: share of each z in the mean squared change of the map's slope; each w is weighted by
            its share.

    Shape:
        slope: (nw, nz), X: (nx, nx), Z: (nz, nz), W: (nw, nw), shares: (nw,), bends: (nz,).

    Example:
        >>> _ = model.lfr.cell.static.Ww.data.normal_()
        >>> found = lfrtorch.analysis.canonical(model, record)
        >>> found.shares.tolist(), found.bends.tolist()
        ([1.0], [1.0])
    """

    model: Model
    matrices: Matrices
    slope: Float[Array, "nw nz"]
    X: Float[Array, "nx nx"]
    Z: Float[Array, "nz nz"]
    W: Float[Array, "nw nw"]
    shares: Float[Array, " nw"]
    bends: Float[Array, " nz"]

    @torch.no_grad()
    def static(self, z: Float[Array, "S nz"]) -> Float[Array, "S nw"]:
        """Return w for canonical z: the map beyond its linear part."""
        z = z @ _inverse(self.Z).T
        w = double(self.model.lfr.cell).map(torch.as_tensor(z)).numpy()
        return (w - z @ self.slope.T) @ self.W.T

    def slopes(self, z: Float[Array, "S nz"]) -> Float[Array, "S nw nz"]:
        """∂w/∂z of ``static``."""
        back = _inverse(self.Z)
        J = static_slope(double(self.model.lfr.cell), torch.as_tensor(z @ back.T)[None])[0].numpy()
        return self.W @ (J - self.slope) @ back


@typed()
def canonical(model: Model, records: Record | Sequence[Record]) -> Canonical:
    """Return a model in its canonical form, which all weights of the same model share.

    Its static map is the model's map less the nearest affine map over the records, which goes into
    the matrices. ``model`` of the result is in these x as well, to simulate and to save, but keeps
    the linear part in its map: between u, x and y that changes nothing.

    Args:
        model: nonlinear.
        records: data that define x and z. Compare two models on the same data.

    Directions of z or x that the data do not visit stay small, and are not unique. Neither are
    directions that add the same power.

    Raises:
        ValueError: a linear model, a map that is affine over the records, or a model that diverges
            on them.

    Example:
        >>> _ = model.lfr.cell.static.Ww.data.normal_()
        >>> found = lfrtorch.analysis.canonical(model, record)
        >>> np.allclose(found.model.simulate(record), model.simulate(record))
        True
        >>> z = model.signals(record).z[0].numpy() @ found.Z.T
        >>> round(float(z.var()), 6), round(float(found.static(z).var()), 6)
        (1.0, 1.0)
    """
    cell = double(model.lfr.cell)
    if cell.static is None:
        raise InputError("the model is linear: it has no static map to take apart.")
    found = [model.signals(record) for record in as_records(records)]
    x, z, w = (
        [getattr(one, name)[0, -MOST_SAMPLES:].double().numpy() for one in found] for name in "xzw"
    )
    x_all, z_all, w_all = (np.concatenate(parts) for parts in (x, z, w))
    if not all(np.isfinite(part).all() for part in (x_all, w_all)):
        raise InputError("the model diverges on the records; give others.")
    slope, constant = nearest_affine(z_all, w_all)
    beyond = [w_r - z_r @ slope.T - constant for w_r, z_r in zip(w, z, strict=True)]
    left = np.concatenate(beyond)
    if not np.sum(left**2) > _FLAT * np.sum(w_all**2):
        raise InputError(
            "the static map is affine over the records: it has no nonlinear part. "
            "Give a model that was fitted, or records of larger inputs."
        )
    A, Bu, Cy, Dyu = fed_back(cell.matrices(), slope)
    block = cell.matrices()._replace(A=A, Bu=Bu, Cy=Cy, Dyu=Dyu)
    # w in coordinates of unit covariance, turned to the directions of its response in y.
    W = whitening(left)
    responses = [_response(_turned(block, W=W), one @ W.T) for one in beyond]
    power, turn = _ordered(sum(responses, np.zeros((len(W), len(W)))))
    W = turn.T @ W
    # z, turned to the directions in which the slope of w changes the most.
    Z = whitening(z_all)
    J = static_slope(cell, torch.as_tensor(z_all)[None])[0].numpy()
    bent = np.sqrt(power)[:, None] * (W @ (J - slope) @ _inverse(Z))
    bends, turn = _ordered(np.einsum("swi,swj->ij", bent, bent) / len(bent))
    Z = turn.T @ Z
    circle = np.exp(2j * np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES)
    M = _turned(block, Z=Z, W=W)
    Z = _signs(frequency_response(M.A, M.Bu, M.Cz, M.Dzu, circle), 1)[:, None] * Z
    W = _signs(frequency_response(M.A, M.Bw, M.Cy, M.Dyw, circle), 2)[:, None] * W
    # x, turned to the axes of the observability Gramian.
    X = whitening(x_all)
    M = _turned(block, X, Z, W)
    seen = np.vstack([M.Cy, M.Cz])
    G = frequency_response(M.A, np.eye(len(A)), seen, np.zeros_like(seen), circle)
    _, turn = _ordered(np.einsum("fsi,fsj->ij", G.conj(), G).real)
    X = turn.T @ X
    seen = seen @ turn
    largest = np.take_along_axis(seen, np.abs(seen).argmax(axis=0)[None], 0)
    X = np.where(largest < 0, -1.0, 1.0).T * X  # a state that no output sees keeps its sign
    K = None if model.K is None else torch.as_tensor(X) @ model.K.double().cpu()
    same = replace(model, lfr=LFR(_in_coordinates(cell, X)), K=K)
    shares, bends = (part / max(part.sum(), 1e-300) for part in (power, bends))
    return Canonical(same, _turned(block, X, Z, W), slope, X, Z, W, shares, bends)


def _turned(
    M: Matrices, X: Array | None = None, Z: Array | None = None, W: Array | None = None
) -> Matrices:
    """The linear block in the coordinates X x, Z z and W w; None leaves a signal as it is."""
    sizes = len(M.A), len(M.Cz), M.Bw.shape[1]
    X, Z, W = (np.eye(n) if T is None else T for n, T in zip(sizes, (X, Z, W), strict=True))
    back, out = _inverse(X), _inverse(W)
    return Matrices(
        A=X @ M.A @ back, Bu=X @ M.Bu, Bw=X @ M.Bw @ out, Cz=Z @ M.Cz @ back, Dzu=Z @ M.Dzu,
        Cy=M.Cy @ back, Dyu=M.Dyu, Dyw=M.Dyw @ out,
    )  # fmt: skip


@torch.no_grad()
def _in_coordinates(cell: LFRCell, X: Float[Array, "nx nx"]) -> LFRCell:
    """The cell with the states X x."""
    sizes = cell.nu, cell.ny, cell.nx, cell.nz, cell.nw
    found = LFRCell(*sizes, deepcopy(cell.static), dtype=torch.float64, random=False)
    for name, value in _turned(cell.matrices(), X)._asdict().items():
        found.get_parameter(name).copy_(torch.as_tensor(value))
    P = torch.as_tensor(X)
    found.state_covariance.copy_(P @ cell.state_covariance @ P.mT)
    return found


def nearest_affine(
    z: Float[Array, "S nz"], w: Float[Array, "S nw"]
) -> tuple[Float[Array, "nw nz"], Float[Array, " nw"]]:
    """Slope and constant of the affine map nearest to w(z)."""
    affine = np.hstack([z, np.ones((len(z), 1))])
    solution: Array = np.asarray(np.linalg.lstsq(affine, w, rcond=None)[0], dtype=np.float64)
    return solution[:-1].T, solution[-1]


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _ordered(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues of a symmetric matrix, the largest first, and its eigenvectors."""
    values, vectors = np.linalg.eigh(matrix)
    return np.maximum(values[::-1], 0.0), vectors[:, ::-1]


def _response(M: Matrices, w: Float[Array, "T nw"]) -> Float[Array, "nw nw"]:
    """Products of the responses in y to the entries of w, weighted by the power of w there.

    They are computed from frequency responses, which exist for an unstable linear block, too.
    """
    lines = np.asarray(np.fft.rfftfreq(len(w)), dtype=np.float64)
    z = np.exp(2j * np.pi * (lines + 0.5 / len(w)))  # between the lines: no pole at 1 is hit
    G = frequency_response(M.A, M.Bw, M.Cy, M.Dyw, z)
    power = np.sum(np.abs(np.fft.rfft(w, axis=0)) ** 2, axis=1)
    return np.einsum("fyi,fyj,f->ij", G.conj(), G, power).real


def _signs(G: Complex128[Complex, "F n m"], axis: int) -> Float[Array, " K"]:
    """The sign of the largest impulse-response sample of each row (axis 1) or column (axis 2)."""
    turned = np.exp(-1j * np.pi * (np.arange(len(G)) / len(G)))  # frequencies lie between lines
    impulse = (np.fft.ifft(G, axis=0) / turned[:, None, None]).real
    each = np.moveaxis(impulse, axis, 0).reshape(G.shape[axis], -1)
    largest = each[np.arange(len(each)), np.abs(each).argmax(axis=1)]
    return np.where(largest < 0, -1.0, 1.0)
