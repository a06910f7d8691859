"""Start of a nonlinear fit from what the linear model leaves unexplained: inference and learning.

With A, Bu, Cy and Dyu those of the best linear approximation, w is all that is missing. Line by
line, E = Y - G_yu U is the part of the output that w made: E = G_yw W, with G_yw = L B,
L = [Cy (zI - A)⁻¹ I] and B = [Bw; Dyw]. That infers w, with it the states, and with them z::

    W* = G_ywᴴ (G_yw G_ywᴴ + λI)⁻¹ E        x* = x_u + (zI - A)⁻¹ Bw W*        z* = N [x*; u]

N = [Cz Dzu]. What is learnt is the map from z* to w, w_hat = βᵀ φ(z*) with polynomials φ. Its
weights β are linear in the output and follow from B and N, which alone are searched for::

    minimise |E - G_yw W_hat|²

More signals w than outputs cannot be inferred. Then x* = x_u, and what w would do to z is to be
small, so that the model behaves the same if w acts back on z::

    minimise |E - G_yw W_hat|² + μ² |G_zw W_hat|²        G_zw = Cz (zI - A)⁻¹ Bw

No simulation in time is needed.

References:
    Floren, Noël and Swevers, "Inference and Learning of Nonlinear LFR State-Space Models", IEEE
    Control Systems Letters 9, 2025 (the idea; there the maps are learnt by alternation).
    Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems
    whose variables separate", SIAM J. Numer. Anal. 10, 1973 (variable projection).
    Kaufman, "A variable projection method for solving separable nonlinear least squares problems",
    BIT 15, 1975 (its Jacobian).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor
from torch.nn import Module

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Complex, Integers
from lfrtorch.engine.nonlinearity import is_network
from lfrtorch.fitting.chebyshev import chebyshev, chebyshev_slope
from lfrtorch.fitting.starts import OUTPUT_WEIGHTS, initialise
from lfrtorch.least_squares.levenberg_marquardt import (
    DenseJacobian,
    LeastSquares,
    LevenbergMarquardt,
)
from lfrtorch.least_squares.simulation_problem import SimulationProblem
from lfrtorch.least_squares.static_problem import StaticProblem
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.resolvent import solve_resolvent
from lfrtorch.metrics import rms
from lfrtorch.model import Model
from lfrtorch.records import Record, as_records

LINES, SAMPLES = 1024, 32768
"""Most lines of a record whose errors count, and about as many samples of all records as are looked
at: a start need not be efficient."""

REGULARISATION = 1e-2
"""λ relative to the mean square of G_yw over the lines; 1e-3 and 1e-1 do as well."""

FEEDBACK = 0.3
"""μ: weight of what w does to z, relative to errors of y; both have unit deviation. On the parallel
Wiener-Hammerstein stand-in, nz = nw = 2, two starts were at 1.2 and 1.0 mV after 15 iterations with
0.3, at 1.8 and 5.4 with 0, and at 3.3 and 19 with an inferred w, of which half is a guess there."""

ROUNDS, STEPS, TOLERANCE = 3, 5, 1e-3
"""Searches, each from z of unit covariance, most iterations of one, and the relative decrease of
its cost that counts as none."""

MAP_SAMPLES, MAP_STEPS, MAP_ERROR = 2000, 40, 0.3
"""Samples that the static map is fitted to, most iterations, and the relative error of w at which a
network is left alone. Fitted closer it starts lower and ends higher: Bouc-Wen, medians of eight
starts at two data realisations after 50 iterations: 7.6 and 7.6e-6 m with 0.3, 7.9 and 7.8 with
0.1."""

OUTPUT_SIZE = 0.05
"""Root mean square of the columns of B, which sets the size of w: with 0.5 (a small w) the parallel
Wiener-Hammerstein stand-in was at 1.9 .. 4.4 mV after 15 iterations, with 0.05 at 0.9 .. 2.9."""

FRACTIONS = (1.0, 0.5, 0.25, 0.125)
"""Factors of the learnt w, tried in this order."""

CONDITION, VANISHING = 1e-8, 1e-12
"""Added to the unit diagonal of the normal equations of β, and the least size of a column of theirs
relative to the largest."""


@dataclass(frozen=True, eq=False)
class Residual:
    """What the linear model leaves of one periodic record, in normalised units.

    Args:
        u: input over one period.
        x: states of the linear model.
        E: spectrum of the output less that of the linear model, all lines F = T // 2 + 1.
        R: (zI - A)⁻¹.
        L: [Cy (zI - A)⁻¹ I], n = nx + ny columns.
        chosen: lines whose errors count.
        weight: of these errors, so that the sum of squares is the mean square over the period.

    Shape:
        u: (T, nu), x: (T, nx), E: (F, ny), R: (F, nx, nx), L: (F, ny, n), chosen: (K,),
        weight: (K, 1).
    """

    u: Array
    x: Array
    E: Complex
    R: Complex
    L: Complex
    chosen: Integers
    weight: Array


def residual_of(model: Model, record: Record, generator: np.random.Generator) -> Residual:
    """E and the states of the linear part of a model."""
    cell = model.lfr.cell
    A, Bu, Cy, Dyu = (
        weight.detach().double().numpy() for weight in (cell.A, cell.Bu, cell.Cy, cell.Dyu)
    )
    T = record.period or record.samples
    normalised = model.scaler.normalise(record)
    u, y = (
        signal.reshape(-1, T, signal.shape[1]).mean(axis=0)
        for signal in (normalised.u, normalised.y)
    )
    U, Y = np.fft.rfft(u, axis=0), np.fft.rfft(y, axis=0)
    F = len(U)
    R = solve_resolvent(A, np.eye(len(A)), np.exp(2j * np.pi * np.arange(F) / T))
    X = (R @ (U @ Bu.T)[:, :, None])[:, :, 0]
    identity = np.broadcast_to(np.eye(len(Cy), dtype=complex), (F, len(Cy), len(Cy)))
    # Line 0 always: an offset of w that no error sees put the start at 3 times the linear error.
    others = generator.choice(F - 1, min(F - 1, LINES), replace=False)
    weight = np.full((1 + len(others), 1), np.sqrt(2.0 * (F - 1) / max(1, len(others))) / T)
    weight[0] = 1.0 / T
    return Residual(
        u=u,
        x=np.fft.irfft(X, T, axis=0),
        E=Y - X @ Cy.T - U @ Dyu.T,
        R=R,
        L=np.concatenate([Cy.astype(complex) @ R, identity], axis=2),
        chosen=np.concatenate([[0], 1 + np.sort(others)]),
        weight=weight,
    )


@dataclass(frozen=True, eq=False)
class Inferred:
    """What B and N make of one record.

    Args:
        xu: [x*; u].
        z: z*.
        phi: spectra of φ(z*) at the chosen lines, weighted.
        H, GH: [L; μ Cz (zI - A)⁻¹ 0] at the chosen lines, and H B: from w to the errors.
        G, W, V: G_yw, W* = G_ywᴴ V and V = (G_yw G_ywᴴ + λI)⁻¹ E, at all lines.

    Shape:
        xu: (T, nx + nu), z: (T, nz), phi: (K, nf), H: (K, nh, n), GH: (K, nh, nw), nh = ny or
        ny + nz, G: (F, ny, nw), W: (F, nw), V: (F, ny).
    """

    xu: Array
    z: Array
    phi: Complex
    H: Complex
    GH: Complex
    G: Complex
    W: Complex | None
    V: Complex | None


class InferenceError(LeastSquares):
    """The cost of the module's head as a function of B and N, for ``LevenbergMarquardt``.

    θ are the entries of B and then of N, by rows.

    Args:
        residuals: of the records.
        B, N: where the search starts; λ is relative to G_yw there.
        degree: of the polynomials φ.

    Shape:
        B: (nx + ny, nw), N: (nz, nx + nu).
    """

    def __init__(self, residuals: Sequence[Residual], B: Array, N: Array, degree: int) -> None:
        self.residuals, self.degree, self.shapes = residuals, degree, (B.shape, N.shape)
        self.nx, self.ny = residuals[0].x.shape[1], residuals[0].E.shape[1]
        size = np.mean([np.square(np.abs(r.L @ B)).sum(axis=(1, 2)).mean() for r in residuals])
        self.damping = REGULARISATION * size / self.ny
        self.theta = torch.from_numpy(np.concatenate([B.ravel(), N.ravel()]))

    def matrices(self, theta: Tensor) -> tuple[Array, Array]:
        """B and N."""
        B, N = np.split(theta.numpy(), [int(np.prod(self.shapes[0]))])
        return B.reshape(self.shapes[0]), N.reshape(self.shapes[1])

    def learnt(self, theta: Tensor) -> tuple[Array, Array]:
        """[x*; u] and w_hat of all records, one after another."""
        inferred, _, beta, _ = self._project(theta)
        z = np.concatenate([i.z for i in inferred])
        return np.concatenate([i.xu for i in inferred]), chebyshev(z, self.degree) @ beta

    def cost(self, residual: Tensor) -> float:
        """|r|²."""
        return float(residual.square().sum())

    def residual(self, theta: Tensor) -> Tensor:
        """r (M,) at θ, with the best β there."""
        return torch.from_numpy(self._project(theta)[1])

    def linearise(self, theta: Tensor) -> DenseJacobian:
        """dr/dθ at θ, in the space that β leaves (Kaufman's approximation)."""
        inferred, r, beta, M = self._project(theta)
        B, N = self.matrices(theta)
        pairs = zip(self.residuals, inferred, strict=True)
        J = _real([self._slope(record, i, B, N, beta) for record, i in pairs])
        J -= M @ _least_squares(M, J)
        return DenseJacobian(torch.from_numpy(J), torch.from_numpy(r))

    def _project(self, theta: Tensor) -> tuple[list[Inferred], Array, Array, Array]:
        """What is inferred, r = target - M β, β (nf, nw), and M."""
        B, N = self.matrices(theta)
        inferred = [self._infer(record, B, N) for record in self.residuals]
        rows, targets = [], []
        for record, i in zip(self.residuals, inferred, strict=True):
            K, nh = i.GH.shape[:2]
            rows.append((i.phi[:, None, :, None] * i.GH[:, :, None, :]).reshape(K * nh, -1))
            E = record.E[record.chosen] * record.weight
            targets.append(np.pad(E, ((0, 0), (0, nh - self.ny))).ravel())
        M, target = _real(rows), _real(targets)
        beta = _least_squares(M, target)
        return inferred, target - M @ beta, beta.reshape(-1, B.shape[1]), M

    def _infer(self, record: Residual, B: Array, N: Array) -> Inferred:
        nx, chosen, G = self.nx, record.chosen, record.L @ B
        x, H, W, V = record.x, record.L[chosen], None, None
        if B.shape[1] <= self.ny:
            S = G @ G.conj().swapaxes(1, 2) + self.damping * np.eye(self.ny)
            V = np.asarray(np.linalg.solve(S, record.E[:, :, None])[:, :, 0], dtype=complex)
            W = (G.conj().swapaxes(1, 2) @ V[:, :, None])[:, :, 0]
            X = (record.R @ (W @ B[:nx].T)[:, :, None])[:, :, 0]
            x = x + np.fft.irfft(X, len(x), axis=0)
        else:
            Hz = np.zeros((len(chosen), len(N), len(B)), dtype=complex)
            Hz[:, :, :nx] = FEEDBACK * (N[:, :nx] @ record.R[chosen])
            H = np.concatenate([H, Hz], axis=1)
        xu = np.hstack([x, record.u])
        z = xu @ N.T
        phi = np.fft.rfft(chebyshev(z, self.degree), axis=0)[chosen] * record.weight
        return Inferred(xu, z, phi, H, H @ B.astype(complex), G, W, V)

    def _slope(self, record: Residual, i: Inferred, B: Array, N: Array, beta: Array) -> Complex:
        """Slope (K nh, P) of the error of one record with θ, β held."""
        (K, nh, n), nw, nx, ny = i.H.shape, B.shape[1], self.nx, self.ny
        T, W_hat = len(i.xu), i.phi @ beta
        J = beta.T @ chebyshev_slope(i.z, self.degree)  # ∂w_hat/∂z (T, nw, nz)

        def error(dw: Array) -> Complex:
            """dr of dw (T, nw, ...)."""
            lines = np.fft.rfft(dw.reshape(T, -1), axis=0)[record.chosen] * record.weight
            return -i.GH @ lines.reshape(K, nw, -1)

        dB = -(i.H[:, :, :, None] * W_hat[:, None, None, :]).reshape(K, nh, n * nw)
        if i.W is not None:
            dB += error(J @ self._slope_of_z(record, i, B, N))
        dN = error(J[:, :, :, None] * i.xu[:, None, None, :])
        if nh > ny:  # G_zw has Cz in it
            X = FEEDBACK * (record.R[record.chosen] @ (W_hat @ B[:nx].T)[:, :, None])[:, :, 0]
            for j in range(len(N)):
                first = j * N.shape[1]
                dN[:, ny + j, first : first + nx] -= X
        return np.concatenate([dB, dN], axis=2).reshape(K * nh, -1)

    def _slope_of_z(self, record: Residual, i: Inferred, B: Array, N: Array) -> Array:
        """Slope (T, nz, n nw) of z* with the entries of B, by way of W*::

        dW* = (I - G⁺G) dGᴴ V - G⁺ dG W*        dG = L dB        G⁺ = Gᴴ (G Gᴴ + λI)⁻¹
        dZ* = Cz (zI - A)⁻¹ (dBw W* + Bw dW*)
        """
        assert i.W is not None
        assert i.V is not None
        nx, (F, ny, nw), n = self.nx, i.G.shape, len(B)
        GH = i.G.conj().swapaxes(1, 2)
        plus = GH @ np.linalg.inv(i.G @ GH + self.damping * np.eye(ny))
        seen = np.einsum("fyn,fy->fn", record.L.conj(), i.V)
        dW = (np.eye(nw) - plus @ i.G)[:, :, None, :] * seen[:, None, :, None]
        dW -= (plus @ record.L)[:, :, :, None] * i.W[:, None, None, :]  # (F, nw, n, nw)
        CR = N[:, :nx] @ record.R
        dZ = ((CR @ B[:nx]) @ dW.reshape(F, nw, -1)).reshape(F, len(N), n, nw)
        dZ[:, :, :nx] += CR[:, :, :, None] * i.W[:, None, None, :]
        return np.fft.irfft(dZ, len(i.xu), axis=0).reshape(len(i.xu), len(N), -1)


def _real(parts: Sequence[Complex]) -> Array:
    """Complex equations of all records as real ones."""
    rows = np.concatenate(parts)
    return np.concatenate([rows.real, rows.imag])


def _least_squares(M: Array, b: Array) -> Array:
    """argmin |M β - b| by normal equations with unit columns, a little damped."""
    size = np.sqrt(np.square(M).sum(axis=0))
    size = np.maximum(size, VANISHING * size.max())
    gram = M.T @ M / size / size[:, None]
    factor = scipy.linalg.cho_factor(gram + CONDITION * np.eye(len(gram)))
    right = M.T @ b
    scale = size if right.ndim == 1 else size[:, None]
    return scipy.linalg.cho_solve(factor, right / scale) / scale


@typed("dtype")
def infer(
    bla: LinearModel,
    records: Record | Sequence[Record],
    *,
    nz: int,
    nw: int,
    nn: int | None = None,
    activation: str = "tanh",
    layers: int = 1,
    static: Module | None = None,
    degree: int = 4,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> Model:
    """NL-LFR model that starts better than the linear model, whose A, Bu, Cy and Dyu it keeps.

    (But for slow modes that explain nothing, see ``initialise``.)

    From a random draw of B and N as ``initialise`` makes it, w and the states are inferred from
    what the linear model leaves of periodic records, and a polynomial map from z to w is learnt
    with B and N (see the head of this module). The static map of the model is fitted to the
    samples of z and w. At last, w is scaled by the fraction that simulates the records best, which
    is the one place where their weights count; if none does better than the linear model, the
    start is that of ``initialise``: the linear model itself.

    Args:
        bla: stable linear model, best in balanced coordinates.
        records: the data that are to be fitted, in steady state (``start="periodic"``).
        nz, nw: inputs and outputs of the static nonlinearity.
        nn, activation, layers: neurons of each hidden layer, their function, and how many layers.
        static: the map z -> w in the network's place, copied: a ``Network``, a ``Polynomial`` or
            any module from (..., nz) to (..., nw) whose weights a search can find.
        degree: of the polynomial that is learnt.
        seed: of the random weights, and of the choice of lines and samples.
        dtype: of the weights.

    Raises:
        ValueError: records that are not periodic, sizes below 1, or a static map of other sizes or
            without weights.

    Example:
        >>> model = lfrtorch.infer(bla, record, nz=1, nw=1, nn=4)
        >>> error = lfrtorch.rmse(record, model.simulate(record))
        >>> error < lfrtorch.rmse(record, bla.simulate(record))
        True
    """
    integer("degree", degree, 1)
    data = as_records(records)
    for record in data:
        if record.start != "periodic":
            raise InputError(
                f"record '{record.name}' has start={record.start!r}; inference needs steady state "
                "(start='periodic'): use initialise(method='zero_output'), init=zero_output."
            )
    plain = initialise(
        bla,
        data,
        nz=nz,
        nw=nw,
        nn=nn,
        activation=activation,
        layers=layers,
        static=static,
        seed=seed,
        dtype=dtype,
    )
    assert plain.lfr.cell.static is not None
    if not list(plain.lfr.cell.static.parameters()):
        raise InputError(
            "static has no weights that could be fitted; use initialise(method='paper')."
        )
    model, generator = deepcopy(plain), np.random.default_rng(seed)
    residuals = [residual_of(plain, record, generator) for record in _largest(plain, data)]
    B, N, z, w = _search(plain, residuals, degree, generator)
    chosen = generator.permutation(len(z))[:MAP_SAMPLES]
    _write(model, B, N, z[chosen], w[chosen], generator)
    return _safest(model, plain, data)


def _largest(plain: Model, records: list[Record]) -> list[Record]:
    """The records of the largest errors, up to the number of samples to look at."""
    errors = [np.square(plain.simulate(record) - record.y).mean() for record in records]
    chosen: list[Record] = []
    samples = 0
    for i in np.argsort(errors)[::-1]:
        samples += records[i].period or records[i].samples
        if chosen and samples > SAMPLES:
            break
        chosen.append(records[i])
    return chosen


def _search(
    plain: Model, residuals: Sequence[Residual], degree: int, generator: np.random.Generator
) -> tuple[Array, Array, Array, Array]:
    """B and N from those of the plain start, and samples of z, of unit covariance, and of w."""
    cell = plain.lfr.cell
    B, N = (
        torch.cat(pair, dim=dim).detach().double().numpy()
        for pair, dim in (((cell.Bw, cell.Dyw), 0), ((cell.Cz, cell.Dzu), 1))
    )
    if not B.any():  # the plain start with a map of the caller's own
        B = generator.uniform(-1.0, 1.0, B.shape)
    xu = np.concatenate([np.hstack([r.x, r.u]) for r in residuals])
    w = np.empty(0)
    for _ in range(ROUNDS):
        B, N = B / rms(B, axis=0), _whitened(N, xu)
        problem = InferenceError(residuals, B, N, degree)
        theta = _minimised(problem, STEPS, tolerance=TOLERANCE, patience=2)
        B, N = problem.matrices(theta)
        xu, w = problem.learnt(theta)
    # Whitened once more, as z has drifted from unit covariance: without this the fit was at 2.6 and
    # 3.5 mV after 15 iterations, with it at 0.9 and 2.8 (parallel Wiener-Hammerstein stand-in, two
    # starts).
    N, size = _whitened(N, xu), OUTPUT_SIZE / rms(B, axis=0)
    return B * size, N, xu @ N.T, w / size


def _whitened(N: Array, xu: Array) -> Array:
    """N with z of unit covariance."""
    covariance = np.cov((xu @ N.T).T).reshape(len(N), len(N))
    floor = CONDITION * max(float(np.trace(covariance)), np.finfo(float).tiny)
    root = np.linalg.cholesky(covariance + floor * np.eye(len(N)))
    return scipy.linalg.solve_triangular(root, N, lower=True)


def _minimised(problem: InferenceError | StaticProblem, steps: int, **options: Any) -> Tensor:
    """θ after some steps of Levenberg-Marquardt.

    The first one does not search its damping: of 32 starts on planted systems 31 were as good with
    that, and one had 0.97 of the linear model's error instead of 0.19.
    """
    search = LevenbergMarquardt(max_iter=steps, least_damping=1.0, **options)
    state = search.init(problem, problem.theta)
    while not state.reason:
        state = search.step(problem, state)
    return state.theta


def _write(
    model: Model, B: Array, N: Array, z: Array, w: Array, generator: np.random.Generator
) -> None:
    """Put B and N into a model and fit its static map, from where it is, to samples z and w."""
    cell = model.lfr.cell
    assert cell.static is not None
    nx = cell.nx
    with torch.no_grad():
        for weight, value in (
            (cell.Bw, B[:nx]),
            (cell.Dyw, B[nx:]),
            (cell.Cz, N[:, :nx]),
            (cell.Dzu, N[:, nx:]),
        ):
            weight.copy_(torch.from_numpy(value.copy()))
        if is_network(cell.static):
            drawn = torch.Generator().manual_seed(int(generator.integers(2**31)))
            cell.static.Ww.uniform_(-1.0, 1.0, generator=drawn)
    problem = StaticProblem(cell.static, *(torch.from_numpy(s).to(cell.A) for s in (z, w)))
    error = MAP_ERROR if is_network(cell.static) else 0.0
    floor = error * float(rms(w))
    problem.write(_minimised(problem, MAP_STEPS, floor=floor))


def _safest(model: Model, plain: Model, records: list[Record]) -> Model:
    """The model with the fraction of w that simulates the records best, or else the plain one."""
    cell = model.lfr.cell
    assert cell.static is not None
    names = OUTPUT_WEIGHTS.get(type(cell.static))
    scaled = [cell.Bw, cell.Dyw] if names is None else [cell.static.get_parameter(n) for n in names]
    whole = [weight.detach().clone() for weight in scaled]

    def put(fraction: float) -> None:
        with torch.no_grad():
            for weight, value in zip(scaled, whole, strict=True):
                weight.copy_(fraction * value)

    def cost(candidate: Model) -> float:
        problem = SimulationProblem.of(candidate, records)
        return problem.cost(problem.residual(problem.theta))

    best, kept = cost(plain), 0.0
    for fraction in FRACTIONS:
        put(fraction)
        found = cost(model)
        if found < best:  # False for the NaN of a model that diverges
            best, kept = found, fraction
    put(kept)
    return model if kept else plain
