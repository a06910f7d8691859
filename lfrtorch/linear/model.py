"""The linear state-space model in physical units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike

from lfrtorch._support import checkpoint
from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.optional import imported
from lfrtorch._support.tables import number
from lfrtorch._support.types import Array, Complex
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.description import in_columns, levels, listed, system_lines
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.operating_point import StateSpace
from lfrtorch.linear.resolvent import frequency_response, gain_jacobian
from lfrtorch.model import Model
from lfrtorch.records import (
    Channel,
    Record,
    Scaler,
    described_channels,
    with_past_outputs,
    without_coordinates,
)


@dataclass(frozen=True)
class LinearFit:
    """How a linear model was found.

    Args:
        criterion: ``"simulation"``, ``"prediction"`` or ``"frequency"``.
        rmse: root mean squared error of the criterion over the data, in normalised units: of
            outputs of unit rms, or of weighted responses.
        iterations: of the refinement.
        reason: why it ended.
        seconds: duration of the estimation.
        singular_values: of the subspace, relative to the size of the outputs: they drop after the
            order that the data carry.
        notes: what a user should know about data and result.

    Example:
        >>> fit = bla.fit
        >>> fit.criterion, fit.rmse < 0.3, len(fit.singular_values) > 1
        ('simulation', True, True)
    """

    criterion: str
    rmse: float
    iterations: int
    reason: str
    seconds: float
    singular_values: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Linear state-space model in physical units, about an operating point::

        x+ = A x + B (u - u_offset) + K e
        y  = C x + D (u - u_offset) + y_offset + e

    Args:
        A, B, C, D: system matrices.
        fs: sampling frequency in Hz.
        u_offset, y_offset: operating point.
        inputs, outputs: channel names and units.
        K: gain of the innovations e. Default: no noise model.
        innovation_covariance: of e. Default: no noise model.
        state_covariance: E x xᵀ over the training data, about 0: what is known of a start state
            before its outputs are. Default: not known; that of the states which the record's input
            excites from rest takes its place.
        covariance: of the P = (nx + ny) (nx + nu) entries of A, B, C and D, row by row, one matrix
            after another. Default: not known.
        fit: how the model was found.
        x_offset: state of the nonlinear model that x = 0 stands for, if it is linearised.
        outside: what the data did not reach of that state and of its input, in words.

    Example:
        >>> bla.nx, bla.A.shape, bla.fs
        (1, (1, 1), 100.0)
        >>> bla
        LinearModel(u -> y, 100 Hz, nx=1)
        >>> slow = lfrtorch.LinearModel(
        ...     np.array([[0.9]]), np.array([[1.0]]), np.array([[0.1]]), np.array([[0.0]]), fs=10.0,
        ...     u_offset=np.zeros(1), y_offset=np.zeros(1), inputs=bla.inputs, outputs=bla.outputs,
        ... )
        >>> slow.simulate(np.ones(3)).round(2).ravel().tolist()
        [0.0, 0.1, 0.19]
    """

    A: Float[Array, "nx nx"]
    B: Float[Array, "nx nu"]
    C: Float[Array, "ny nx"]
    D: Float[Array, "ny nu"]
    fs: float
    u_offset: Float[Array, " nu"]
    y_offset: Float[Array, " ny"]
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    K: Float[Array, "nx ny"] | None = None
    innovation_covariance: Float[Array, "ny ny"] | None = None
    state_covariance: Float[Array, "nx nx"] | None = None
    covariance: Float[Array, "P P"] | None = None
    fit: LinearFit | None = None
    x_offset: Float[Array, " nx"] | None = None
    outside: str = ""

    def __repr__(self) -> str:
        signals = f"{listed(self.inputs)} -> {listed(self.outputs)}"
        return f"LinearModel({signals}, {self.fs:g} Hz, nx={self.nx})"

    def __str__(self) -> str:
        fit = self.fit
        facts = [
            ("sampled at", f"{self.fs:g} Hz"),
            ("inputs", levels(self.inputs, self.u_offset)),
            ("outputs", levels(self.outputs, self.y_offset)),
            ("order", f"{self.nx}"),
            ("outside of the data", self.outside),
            ("fit", fit and f"{fit.criterion} error {number(fit.rmse)} (normalised), {fit.reason}"),
        ]
        system = {"": StateSpace(self.A, self.B, self.C, self.D)}
        lines = [
            "Linear model",
            *in_columns(facts),
            *system_lines(system, self.fs, self.inputs, self.outputs),
        ]
        return "\n".join(lines)

    @property
    def nx(self) -> int:
        """Order."""
        return len(self.A)

    @property
    def poles(self) -> Complex:
        """Poles (nx,), in the z plane."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)

    def zeros(self, output: int | None = None, input: int | None = None) -> Complex:
        """Finite zeros in the z plane: those of one channel, or the transmission zeros of all.

        Args:
            output, input: number of a channel. Default: all, as many outputs as inputs.

        Raises:
            ValueError: different numbers of outputs and inputs (there are no zeros in general).

        Example:
            >>> bla.zeros().shape
            (1,)
        """
        B, C, D = self.B, self.C, self.D
        if output is not None:
            C, D = C[[output]], D[[output]]
        if input is not None:
            B, D = B[:, [input]], D[:, [input]]
        if D.shape[0] != D.shape[1]:
            raise InputError(
                f"a model of {D.shape[1]} input(s) and {D.shape[0]} output(s) has no transmission "
                "zeros in general; ask for those of a channel: zeros(output, input)."
            )
        return _zeros(self.A, B, C, D)

    def frf(self, frequencies: ArrayLike) -> Complex:
        """Frequency response C (zI - A)⁻¹ B + D.

        Shape:
            frequencies: (F,) in Hz -> (F, ny, nu).

        Example:
            >>> G = bla.frf([0.0, 10.0, 50.0])
            >>> G.shape, bool(abs(G[0, 0, 0]) > abs(G[2, 0, 0]))  # a low-pass filter
            ((3, 1, 1), True)
        """
        return frequency_response(self.A, self.B, self.C, self.D, self._z(frequencies))

    def frf_std(self, frequencies: ArrayLike) -> Array:
        """Standard deviation of the frequency response from the covariance of the parameters.

        Shape:
            frequencies: (F,) in Hz -> (F, ny, nu); physical units.

        Raises:
            ValueError: a model without covariance.

        Example:
            >>> bool(bla.frf_std([0.0])[0, 0, 0] < 0.1 * abs(bla.frf([0.0])[0, 0, 0]))
            True
        """
        variance = np.trace(self.frf_covariance(frequencies), axis1=-2, axis2=-1)
        return np.sqrt(np.maximum(variance, 0.0))

    def frf_covariance(self, frequencies: ArrayLike) -> Array:
        """Covariance of the real and the imaginary part of the frequency response.

        Shape:
            frequencies: (F,) in Hz -> (F, ny, nu, 2, 2); physical units.

        Raises:
            ValueError: a model without covariance.

        Example:
            >>> bla.frf_covariance([0.0, 10.0]).shape
            (2, 1, 1, 2, 2)
        """
        J = gain_jacobian(self.A, self.B, self.C, self._z(frequencies))
        parts, of = np.stack([J.real, J.imag], axis=-2), self.known_covariance
        return np.einsum("...ip,pq,...jq->...ij", parts, of, parts, optimize=True)

    @property
    def known_covariance(self) -> Array:
        """The covariance of the matrices' entries.

        Raises:
            ValueError: it is not known.
        """
        if self.covariance is None:
            raise InputError(
                "the covariance of this model is not known: take one of estimate_bla, or of "
                "lfrtorch.analysis.uncertainty(model, records).linearise()."
            )
        return self.covariance

    def simulate(self, data: Record | ArrayLike) -> Array:
        """Simulated output (T, ny) in physical units, from the record's kind of initial state.

        A bare input (T, nu) is simulated from rest. A given ``x0`` of a record is in other
        coordinates; the initial state that fits best takes its place. In that fit all outputs count
        alike, whatever their units.

        Example:
            >>> y_hat = bla.simulate(record)
            >>> y_hat.shape, lfrtorch.nrmse(record, y_hat) < 0.3
            ((400, 1), True)
        """
        if not isinstance(data, Record):
            return self.to_model().simulate(data)
        deviation = np.std(data.y, axis=0) if len(self.outputs) > 1 else np.zeros(1)
        y_scale = np.where(deviation > 0, deviation, 1.0)
        return self._in_units(y_scale).simulate(without_coordinates(data))

    def predict(self, record: Record) -> Array:
        """Output (T, ny) predicted one sample ahead from the outputs before, physical units.

        A record in steady state is predicted from the state that fits best: noise does not repeat.

        Raises:
            ValueError: a model without K, or a record of other channels or another rate.

        Example:
            >>> predictor = lfrtorch.estimate_bla(record, nx=1, refine="prediction")
            >>> predictor.predict(record).shape
            (400, 1)
        """
        self.to_model().check(without_coordinates(record))
        return self.predictor().simulate(with_past_outputs(record))

    def predictor(self) -> LinearModel:
        """The linear model of the output one sample ahead; its inputs are u, then y.

        Raises:
            ValueError: a model without K.

        Example:
            >>> linear = lfrtorch.estimate_bla(record, nx=1, refine="prediction")
            >>> linear.predictor().inputs
            (Channel(name='u', unit=''), Channel(name='y', unit=''))
        """
        if self.K is None:
            raise InputError(
                "this model has no innovation gain K: estimate it with refine='prediction'."
            )
        ny = len(self.outputs)
        return replace(
            self,
            A=self.A - self.K @ self.C,
            B=np.hstack([self.B - self.K @ self.D, self.K]),
            D=np.hstack([self.D, np.zeros((ny, ny))]),
            K=None,
            covariance=None,
            u_offset=np.concatenate([self.u_offset, self.y_offset]),
            inputs=(*self.inputs, *self.outputs),
        )

    def transformed(self, T: Array, inverse: Array | None = None) -> LinearModel:
        """The same system in the coordinates T x.

        Args:
            T: the transformation (nx, nx).
            inverse: T⁻¹, if it is known better than by inverting T.

        Example:
            >>> scaled = bla.transformed(np.array([[10.0]]))
            >>> np.allclose(scaled.B, 10 * bla.B), np.allclose(scaled.frf([1.0]), bla.frf([1.0]))
            (True, True)
        """
        back = np.asarray(np.linalg.inv(T) if inverse is None else inverse, dtype=np.float64)
        covariance, P = self.covariance, self.state_covariance
        if covariance is not None:
            nu, ny = np.eye(len(self.inputs)), np.eye(len(self.outputs))
            blocks = np.kron(T, back.T), np.kron(T, nu), np.kron(ny, back.T), np.kron(ny, nu)
            change = scipy.linalg.block_diag(*blocks)
            covariance = change @ covariance @ change.T
        return replace(
            self,
            A=T @ self.A @ back,
            B=T @ self.B,
            C=self.C @ back,
            K=None if self.K is None else T @ self.K,
            covariance=covariance,
            state_covariance=None if P is None else T @ P @ T.T,
            x_offset=None if self.x_offset is None else T @ self.x_offset,
        )

    def write(self, cell: LFRCell, scaler: Scaler) -> None:
        """Put A, B, C, D into A, Bu, Cy, Dyu of a cell, in the scaler's normalised units.

        What is known of a start state goes with them.

        Example:
            >>> cell = lfrtorch.LFRCell(nu=1, ny=1, nx=1, dtype=torch.float64)
            >>> bla.write(cell, lfrtorch.Scaler.of([record]))
            >>> bool(cell.A.item() == bla.A[0, 0])
            True
        """
        with torch.no_grad():
            for weight, value in (
                (cell.A, self.A),
                (cell.Bu, self.B * scaler.u_scale),
                (cell.Cy, self.C / scaler.y_scale[:, None]),
                (cell.Dyu, self.D * scaler.u_scale / scaler.y_scale[:, None]),
            ):
                weight.copy_(torch.as_tensor(np.ascontiguousarray(value)))
            if self.state_covariance is not None:
                cell.state_covariance.copy_(torch.as_tensor(self.state_covariance))

    def to_model(self) -> Model:
        """The same as a ``Model`` without static nonlinearity, in the same coordinates.

        Example:
            >>> bla.to_model().sizes["nx"]
            1
        """
        return self._in_units(np.ones(len(self.outputs)))

    def _in_units(self, y_scale: Array) -> Model:
        """The same, whose normalised outputs have these units."""
        nu, ny = len(self.inputs), len(self.outputs)
        unit = Scaler(self.u_offset, np.ones(nu), self.y_offset, y_scale)
        cell = LFRCell(nu, ny, self.nx, dtype=torch.float64, random=False)
        self.write(cell, unit)
        K = None if self.K is None else torch.as_tensor(self.K * y_scale)
        return Model(LFR(cell), unit, self.fs, self.inputs, self.outputs, K=K)

    def to_scipy(self) -> scipy.signal.StateSpace:
        """The deviations from the operating point as a ``scipy.signal.StateSpace``.

        Example:
            >>> bla.to_scipy().dt
            0.01
        """
        return scipy.signal.StateSpace(self.A, self.B, self.C, self.D, dt=1.0 / self.fs)

    def to_control(self) -> Any:
        """The deviations from the operating point as a ``control.StateSpace``.

        Dots in channel names, which that package does not allow, become underscores; of two names
        that are the same then, the second one has one more.

        Raises:
            ValueError: the package ``control`` is not installed.

        Example:
            >>> bla.to_control().dt
            0.01
        """
        return imported("control", "control").ss(
            self.A, self.B, self.C, self.D, 1.0 / self.fs,
            inputs=control_labels(self.inputs), outputs=control_labels(self.outputs),
        )  # fmt: skip

    def save(self, folder: str | Path) -> Path:
        """Write a checkpoint folder; ``LinearModel.load`` reads it back to the same bits.

        Example:
            >>> folder = bla.save("filter")
            >>> bool(lfrtorch.LinearModel.load(folder).A[0, 0] == bla.A[0, 0])
            True
        """
        description = {
            "linear": {"fs": self.fs, "fit": None if self.fit is None else asdict(self.fit)}
            | ({"outside": self.outside} if self.outside else {}),
            "inputs": [c._asdict() for c in self.inputs],
            "outputs": [c._asdict() for c in self.outputs],
        }
        arrays = {name: getattr(self, name) for name in _SHAPES}
        weights = {k: torch.tensor(v) for k, v in arrays.items() if v is not None}
        return checkpoint.write(folder, description, weights)

    @classmethod
    def load(cls, folder: str | Path) -> LinearModel:
        """The linear model in a checkpoint folder, or in the ``linear/`` folder of a run's folder.

        Raises:
            ValueError: no checkpoint, a damaged one, or one that holds another kind of model.

        Example:
            >>> _ = bla.save("filter")
            >>> lfrtorch.LinearModel.load("filter").nx
            1
        """
        description, weights = checkpoint.read(folder, ("linear", "model"))
        if "linear" not in description:
            raise InputError(f"'{folder}' holds no linear model; lfrtorch.load reads an NL-LFR.")
        try:
            made, fit = description["linear"], description["linear"]["fit"]
            if fit is not None:
                fit = LinearFit(
                    **fit | {name: tuple(fit[name]) for name in ("singular_values", "notes")}
                )
            inputs, outputs = (
                described_channels(description[side]) for side in ("inputs", "outputs")
            )
            known = [name for name in _SHAPES if name in _ALWAYS or name in weights]
            arrays = {name: weights[name].numpy() for name in known}
            sizes = {"x": len(arrays["A"]), "u": len(inputs), "y": len(outputs)}
            sizes["P"] = (sizes["x"] + sizes["y"]) * (sizes["x"] + sizes["u"])
            for name, array in arrays.items():
                shape = tuple(sizes[axis] for axis in _SHAPES[name])
                if array.shape != shape:
                    raise InputError(f"{name} is {array.shape}, not {shape}")
            lost = [name for name in _ALWAYS if not np.isfinite(arrays[name]).all()]
            if lost:
                raise InputError(f"{', '.join(lost)} have numbers that are not finite")
            fs = float(made["fs"])
            if not (np.isfinite(fs) and fs > 0):
                raise InputError(f"fs is {fs}")
            outside = str(made.get("outside", ""))
            found: dict[str, Any] = {"inputs": inputs, "outputs": outputs, "outside": outside}
            return cls(**arrays, fs=fs, fit=fit, **found)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"'{folder}' is damaged: its description and weights do not fit ({brief(error)})."
            ) from None

    def _z(self, frequencies: ArrayLike) -> Complex:
        f = np.atleast_1d(reals("frequencies", frequencies))
        if f.ndim != 1:
            raise InputError(f"the frequencies have shape {f.shape}; give one dimension, in Hz.")
        return np.exp(2j * np.pi * f / self.fs)


def control_labels(channels: Sequence[Channel]) -> list[str]:
    """Make labels of python-control from channel names: without dots, and each another one."""
    labels: list[str] = []
    for channel in channels:
        label = channel.name.replace(".", "_")
        while label in labels:
            label += "_"
        labels.append(label)
    return labels


_ALWAYS = ("A", "B", "C", "D", "u_offset", "y_offset")
_SHAPES = {
    "A": "xx", "B": "xu", "C": "yx", "D": "yu", "u_offset": "u", "y_offset": "y", "K": "xy",
    "innovation_covariance": "yy", "state_covariance": "xx", "covariance": "PP",
    "x_offset": "x",
}  # fmt: skip


def linear_cell(A: Array, B: Array, C: Array, D: Array) -> LFRCell:
    """Return a cell without static nonlinearity."""
    cell = LFRCell(B.shape[1], C.shape[0], len(A), dtype=torch.float64, random=False)
    with torch.no_grad():
        for parameter, value in ((cell.A, A), (cell.Bu, B), (cell.Cy, C), (cell.Dyu, D)):
            parameter.copy_(torch.as_tensor(np.ascontiguousarray(value)))
    return cell


def _zeros(A: Array, B: Array, C: Array, D: Array) -> Complex:
    """Finite invariant zeros, after those at infinity are taken out one by one.

    The eigenvalues of the pencil [A - zI, B; C, D] will not do: rounding moves one at infinity of
    multiplicity k to a radius of eps^(-1/k), 2e7 for a delay of five samples.

    References:
        Emami-Naeini and Van Dooren, "Computation of zeros of linear multivariable systems",
        Automatica 18, 1982.
    """
    for _ in range(2):  # an input in tiny units makes its outputs tiny the first time
        by_y = np.linalg.norm(np.hstack([C, D]), axis=1)
        C, D = (M / np.where(by_y > 0, by_y, 1.0)[:, None] for M in (C, D))
        by_u = np.linalg.norm(np.vstack([B, D]), axis=0)
        B, D = (M / np.where(by_u > 0, by_u, 1.0) for M in (B, D))
    limit = 1e-12 * float(np.linalg.norm(np.block([[A, B], [C, D]]), 2))
    A, B, C, D = _outputs_reduced(A, B, C, D, limit)
    A, C, B, D = (M.T for M in _outputs_reduced(A.T, C.T, B.T, D.T, limit))
    zeros = np.linalg.eigvals(A - B @ np.linalg.solve(D, C))  # D is square and regular now
    return np.asarray(zeros, dtype=np.complex128)


def _outputs_reduced(
    A: Array, B: Array, C: Array, D: Array, limit: float
) -> tuple[Array, Array, Array, Array]:
    """Return a system with the same finite zeros whose D has full row rank."""
    while True:
        U, rank = _range(D, limit)
        C, D = U.T @ C, (U.T @ D)[:rank]
        V, free = _range(C[rank:].T, limit)
        C = C[:rank]
        if not free:
            return A, B, C, D
        # At a zero, an output without direct term is 0, and so are the states that it sees.
        V = np.roll(V, -free, axis=1)
        A, B, C = V.T @ A @ V, V.T @ B, C @ V
        n = len(A) - free
        C, D = np.vstack([C[:, :n], A[n:, :n]]), np.vstack([D, B[n:]])
        A, B = A[:n, :n], B[:n]


def _range(M: Array, limit: float) -> tuple[Array, int]:
    """Return an orthogonal matrix, and how many of its first columns span the range of M."""
    U, s, _ = np.linalg.svd(M)
    return U, int((s > limit).sum())


def balancing(A: Array, B: Array, C: Array) -> tuple[Array, Array]:
    """Return T and T⁻¹ to balanced coordinates, by the square-root method (Laub et al. 1987).

    An unstable system has none, and keeps its own.
    """
    controllable, observable = _gramian(A, B @ B.T), _gramian(A.T, C.T @ C)
    if controllable is None or observable is None:
        return np.eye(len(A)), np.eye(len(A))
    Lp, Lq = _square_root(controllable), _square_root(observable)
    U, s, Vh = np.linalg.svd(Lq.T @ Lp)
    if not s.any():  # no input reaches an output: all coordinates are balanced
        return np.eye(len(A)), np.eye(len(A))
    # A state that is almost uncontrollable or unobservable would be scaled by its rounding error.
    root = np.sqrt(np.maximum(s, s[0] * np.finfo(float).eps))
    return (U / root).T @ Lq.T, Lp @ (Vh.T / root)


_DOUBLINGS = 60
"""Poles nearer to the unit circle than rounding have not ended then."""


def _gramian(A: Array, Q: Array) -> Array | None:
    """P = A P Aᵀ + Q by Smith's doubling.

    scipy's solver forms I - A ⊗ A, which is singular to rounding if two poles are close to the unit
    circle; the sum of A^k Q A^kᵀ stays positive semidefinite there. None if rounding puts a pole on
    or beyond the circle.
    """
    P, eps = Q, np.finfo(float).eps
    for _ in range(_DOUBLINGS):
        if np.abs(A).max() <= eps:
            return P
        if np.abs(A).max() >= 1.0 / eps:
            break
        P = P + A @ P @ A.T
        A = A @ A
    return None


def _square_root(gramian: Array) -> Array:
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
