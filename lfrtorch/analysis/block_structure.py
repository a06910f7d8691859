"""Which blocks a model is made of: where its nonlinearity stands between linear dynamics.

All is measured on the canonical form, whose w is the nonlinearity alone, over the data:

- the loop: the part of z that w makes. It is 0 if the nonlinearity is fed forward;
- dynamics before it: the part of z that is no combination of the inputs of the same sample;
- dynamics after it: the part of what w adds to y that is no combination of w of the same sample;
- coupling: the part of the map's changing slope that no sum of branches W_i g_i(V_i z) explains.

Directions of z and w that have next to no part in the nonlinearity do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lfrtorch._support.arguments import typed
from lfrtorch._support.tables import percent
from lfrtorch._support.types import Array, Booleans
from lfrtorch.analysis.canonical_form import MOST_SAMPLES, Canonical, canonical, nearest_affine
from lfrtorch.metrics import rms
from lfrtorch.model import Model
from lfrtorch.records import Record, as_records

_SMALL = 0.1
"""Parts of an rms below this count as none."""

_MINOR = 0.01
"""Directions of z and w with less than this part of the nonlinearity do not count."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Of which blocks a model is made.

    Args:
        name: ``"static"``, ``"Wiener"``, ``"Hammerstein"``, ``"Wiener-Hammerstein"``,
            ``"parallel"`` (several branches), ``"coupled"`` (fed forward through a map that is no
            sum of branches) or ``"feedback"``.
        loop, before, after: parts of an rms, as the module says; ``loop`` is infinite if the linear
            block is unstable, which only a loop keeps at bay.
        coupling: part of the rms of the changing slope that branches leave.
        V, W: of the branches: w is about the sum of W[:, i] g_i(V[i] · z), in the canonical form.

    Example:
        >>> _ = model.lfr.cell.static.Ww.data.normal_()
        >>> lfrtorch.analysis.structure(model, record).V.shape
        (1, 1)
    """

    name: str
    loop: float
    before: float
    after: float
    coupling: float
    V: Float[Array, "n nz"]
    W: Float[Array, "nw n"]

    def __str__(self) -> str:
        loop = percent(self.loop) if np.isfinite(self.loop) else "the linear block is unstable"
        return "\n".join(
            [
                f"{self.name}, {len(self.V)} branch(es)",
                f"made by w, of z                        {loop}",
                f"dynamics before the map, of z          {percent(self.before)}",
                f"dynamics after it, of what it adds     {percent(self.after)}",
                f"coupling of the branches               {percent(self.coupling)}",
            ]
        )


@typed()
def structure(model: Model, records: Record | Sequence[Record]) -> Structure:
    """Is a model Wiener, Hammerstein, Wiener-Hammerstein, parallel, or a feedback loop?

    A part of an rms below 10 % counts as none. The model is fitted, so the answer is as good as
    the fit: a free model of a Wiener system has a loop if the data leave room for one.

    Args:
        model: nonlinear.
        records: data that say what is small.

    Raises:
        ValueError: as ``lfrtorch.analysis.canonical``.

    References:
        The branches: Dreesen, Ishteva and Schoukens, "Decoupling multivariate polynomials using
        first-order information and tensor decompositions", SIAM J. Matrix Anal. Appl. 36(2), 2015.

    Example:
        >>> _ = model.lfr.cell.static.Ww.data.normal_()
        >>> found = lfrtorch.analysis.structure(model, record)
        >>> 0 <= found.before <= 1, found.coupling
        (True, 0.0)
    """
    form = canonical(model, records)
    bent, adds = form.bends >= _MINOR, form.shares >= _MINOR
    A, _, Bw, Cz, _, Cy, _, Dyw = form.matrices
    stable = float(np.abs(np.linalg.eigvals(A)).max()) < 1.0
    parts: list[tuple[Array, ...]] = []
    for record in as_records(records):
        z = model.signals(record).z[0, -MOST_SAMPLES:].double().numpy() @ form.Z.T
        w = form.static(z)
        w = (w - w.mean(axis=0)) * adds
        x = _states(A, w @ Bw.T) if stable else np.zeros((len(w), len(A)))
        u = model.scaler.normalise_u(record.u)[-MOST_SAMPLES:]
        parts.append((u, z[:, bent], w[:, adds], x @ Cz[bent].T, x @ Cy.T + w @ Dyw.T))
    u, z, w, of_w, added = (np.concatenate(each) for each in zip(*parts, strict=True))
    spread = float(rms(z - z.mean(axis=0)))
    loop = float(rms(of_w)) / spread if stable else float("inf")
    before = _left(z, u)
    after = _left(added, w) if stable else 1.0
    V, W, coupling = _branches(_slopes(form, z, bent)[:, adds], form.shares[adds])
    whole_V, whole_W = np.zeros((len(V), len(bent))), np.zeros((len(adds), len(V)))
    whole_V[:, bent], whole_W[adds] = V, W
    name = _name(loop, before, after, coupling, len(V))
    return Structure(name, loop, before, after, coupling, whole_V, whole_W)


def _name(loop: float, before: float, after: float, coupling: float, branches: int) -> str:
    if loop >= _SMALL:
        return "feedback"
    if before < _SMALL:
        return "static" if after < _SMALL else "Hammerstein"
    if after < _SMALL:
        return "Wiener"
    if branches == 1:
        return "Wiener-Hammerstein"
    return "parallel" if coupling < _SMALL else "coupled"


def _states(A: Array, driven: Float[Array, "T nx"]) -> Float[Array, "T nx"]:
    """States of x+ = A x + driven, from 0."""
    x = np.zeros_like(driven)
    for k in range(len(driven) - 1):
        x[k + 1] = A @ x[k] + driven[k]
    return x


def _left(signal: Float[Array, "T n"], regressors: Float[Array, "T m"]) -> float:
    """Part of the rms of a signal that an affine map of others at the same sample leaves."""
    slope, constant = nearest_affine(regressors, signal)
    left = signal - regressors @ slope.T - constant
    return float(rms(left) / max(float(rms(signal - signal.mean(axis=0))), 1e-300))


def _slopes(
    form: Canonical, z: Float[Array, "T n"], bent: Bool[Booleans, " nz"]
) -> Float[Array, "S nw n"]:
    """dw/dz of the canonical map at some samples, by the z that bend it."""
    points = np.zeros((len(z), len(bent)))
    points[:, bent] = z
    points = points[:: 1 + len(points) // 400]  # as many slopes tell the branches
    return form.slopes(points)[:, :, bent]


def _branches(
    J: Float[Array, "S nw nz"], shares: Float[Array, " nw"]
) -> tuple[Float[Array, "n nz"], Float[Array, "nw n"], float]:
    """V, W and the part left of J(s) = W diag(g(s)) V, by alternating least squares.

    There are as many branches as z or w, whatever are more. Each w counts by its share.
    """
    _, nw, nz = J.shape
    weight = np.sqrt(shares)
    # Samples matter by their products alone: nw nz of them hold all.
    R: Array = np.linalg.qr((weight[:, None] * J).reshape(len(J), -1)).R
    T = R.reshape(-1, nw, nz)
    n, size, generator = max(nw, nz), float(np.linalg.norm(T)), np.random.default_rng(0)
    best = (np.eye(n, nz), np.eye(nw, n), 0.0 if size == 0 else np.inf)
    for _ in range(5 if size > 0 else 0):  # random starts
        W, V = generator.standard_normal((nw, n)), generator.standard_normal((n, nz))
        left = np.inf
        for _ in range(300):
            G = _solved(T.reshape(len(T), -1), _products(W.T, V))
            W = _solved(T.transpose(1, 0, 2).reshape(nw, -1), _products(G.T, V))
            V = _solved(T.transpose(2, 0, 1).reshape(nz, -1), _products(G.T, W.T)).T
            W, V = W / np.linalg.norm(W, axis=0), V / np.linalg.norm(V, axis=1)[:, None]
            G = _solved(T.reshape(len(T), -1), _products(W.T, V))
            before, left = left, float(np.linalg.norm(T - np.einsum("si,wi,iz->swz", G, W, V)))
            if before - left < 1e-9 * size:
                break
        if left / size < best[2]:
            best = (V, W / weight[:, None], left / size)
    V, W, coupling = best
    return V, W, coupling if coupling > 1e-6 else 0.0


def _products(a: Float[Array, "n p"], b: Float[Array, "n q"]) -> Float[Array, "n pq"]:
    """All products of the entries of two rows, for each row."""
    return (a[:, :, None] * b[:, None, :]).reshape(len(a), -1)


def _solved(T: Float[Array, "m k"], rows: Float[Array, "n k"]) -> Float[Array, "m n"]:
    """X with X rows = T in the least squares."""
    return np.asarray(np.linalg.lstsq(rows.T, T.T, rcond=None)[0].T, dtype=np.float64)


__all__ = ["Structure", "structure"]
