"""The linear state-space model: a model without a static map, in physical units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.types import Array, Complex
from lfrtorch.data.records import Channel, Record, Scaler, without_coordinates
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.description import linear_text, listed
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.operating_point import StateSpace, linear_part
from lfrtorch.linear.control import control_system
from lfrtorch.linear.resolvent import (
    frequency_response,
    response_covariance,
    unit_circle,
)
from lfrtorch.linear.zeros import finite_zeros
from lfrtorch.model.checkpoint import MapMaker, read_model
from lfrtorch.model.model import Model, write_model


@dataclass(frozen=True)
class LinearFit:
    """Record of the fit of a linear model.

    Args:
        criterion: ``"simulation"``, ``"prediction"`` or ``"frequency"``.
        rmse: root mean squared error of the criterion over the data, in normalised units: of
            outputs of unit rms, or of weighted responses.
        iterations: iterations of the refinement.
        reason: why the refinement ended.
        seconds: duration of the estimation.
        singular_values: singular values of the subspace, relative to the outputs' size: they drop
            after the order that the data carry.
        notes: remarks on data and result for the user.

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

    ``to_model`` returns it as a ``Model`` without static map, which simulates, predicts and saves.

    Args:
        A, B, C, D: system matrices.
        fs: sampling frequency in Hz.
        u_offset, y_offset: operating point.
        inputs, outputs: channel names and units.
        K: gain of the innovations e. Default: no noise model.
        innovation_covariance: covariance of e. Default: no noise model.
        state_covariance: E x xᵀ over the training data, about 0. Default: not known.
        covariance: covariance of the P = (nx + ny) (nx + nu) entries of A, B, C, D, row by row, one
            matrix after another. Default: not known.
        fit: record of the fit.
        x_offset: for a linearised nonlinear model, the state of that model at x = 0.
        outside: parts of that state and of its input that the data did not reach, in words.
        delay: whole samples by which each input acts later; the states do not include them.

    Example:
        >>> bla
        LinearModel(u -> y, 100 Hz, nx=1)
        >>> bla.poles.real.round(1), bla.zeros().shape, bla.frf([1.0, 2.0]).shape
        (array([0.7]), (1,), (2, 1, 1))
        >>> bla.simulate(record).shape, bla.to_model().sizes["nx"], bla.to_scipy().dt
        ((400, 1), 1, 0.01)
        >>> lfrtorch.LinearModel.load(bla.save("filter")).nx, bla.transformed(np.eye(1)).nx
        (1, 1)
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
    delay: tuple[int, ...] = ()

    @classmethod
    def of(cls, model: Model, system: StateSpace | None = None, **about: Any) -> Self:
        """The linear part of a model, or another system in its units, as a linear model."""
        s, own = model.scaler, linear_part(model.lfr.cell) if system is None else system
        K = None if model.K is None else model.K.double().cpu().numpy() / s.y_scale
        known: dict[str, Any] = {"u_offset": s.u_offset, "y_offset": s.y_offset, "K": K}
        known |= {"inputs": model.inputs, "outputs": model.outputs, "fs": model.fs}
        known |= {"delay": s.delay}
        return cls(*own.physical(s), **known | about)

    def __repr__(self) -> str:
        signals = f"{listed(self.inputs)} -> {listed(self.outputs)}"
        delay = f", delay={list(self.delay)}" * any(self.delay)
        return f"LinearModel({signals}, {self.fs:g} Hz, nx={self.nx}{delay})"

    def __str__(self) -> str:
        return linear_text(self)

    @property
    def nx(self) -> int:
        """Order."""
        return len(self.A)

    @property
    def poles(self) -> Complex:
        """Poles (nx,), in the z plane."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)

    def zeros(self, output: int | None = None, input: int | None = None) -> Complex:
        """Finite zeros in the z plane: those of one channel, or the transmission zeros of all."""
        of, by = (slice(None) if n is None else [n] for n in (output, input))
        return finite_zeros(self.A, self.B[:, by], self.C[of], self.D[of][:, by])

    def frf(self, frequencies: ArrayLike) -> Complex:
        """Frequency response C (zI - A)⁻¹ B + D, (F, ny, nu), at frequencies (F,) in Hz."""
        z = unit_circle(frequencies, self.fs)
        G = frequency_response(self.A, self.B, self.C, self.D, z)
        return G * z[:, None, None] ** -np.array(self.delay) if self.delay else G

    def frf_std(self, frequencies: ArrayLike) -> Array:
        """Standard deviation (F, ny, nu) of ``frf``, from the covariance of the parameters."""
        return np.sqrt(np.trace(self.frf_covariance(frequencies), axis1=-2, axis2=-1).clip(0.0))

    def frf_covariance(self, frequencies: ArrayLike) -> Array:
        """Covariance of the real and imaginary part of ``frf``, (F, ny, nu, 2, 2)."""
        z = unit_circle(frequencies, self.fs)
        found = response_covariance(self.A, self.B, self.C, self.covariance, z)
        turn = (z[:, None] ** -np.array(self.delay or (0,)))[:, None]
        turns = np.stack([turn.real, -turn.imag, turn.imag, turn.real], -1)
        R = turns.reshape(*turn.shape, 2, 2)
        return R @ found @ R.swapaxes(-1, -2) if self.delay else found

    def simulate(self, data: Record | ArrayLike) -> Array:
        """Simulated output (T, ny), see ``Model.simulate``; it does not use a record's x0."""
        if not isinstance(data, Record):
            return self.to_model().simulate(data)
        return _scaled(self, data).simulate(without_coordinates(data))

    def predict(self, record: Record) -> Array:
        """Output (T, ny) predicted one sample ahead, see ``Model.predict``."""
        return _scaled(self, record).predict(without_coordinates(record))

    def predictor(self) -> LinearModel:
        """The linear model of the output one sample ahead; its inputs are u, then y."""
        return LinearModel.of(self.to_model().predictor())

    def transformed(self, T: Array, inverse: Array | None = None) -> LinearModel:
        """The same system in the coordinates T x; ``inverse`` is T⁻¹, if it is known better."""
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
        """Put A, B, C, D into A, Bu, Cy, Dyu of a cell, in the scaler's normalised units."""
        u, y = scaler.u_scale, scaler.y_scale[:, None]
        _put(cell, self.A, self.B * u, self.C / y, self.D * u / y)
        if self.state_covariance is not None:
            cell.state_covariance.copy_(torch.as_tensor(self.state_covariance))

    def to_model(self, y_scale: Array | None = None) -> Model:
        """The same as a ``Model``, in the same coordinates; ``y_scale`` is 1 by default."""
        y_scale = np.ones(len(self.C)) if y_scale is None else y_scale
        unit = Scaler(self.u_offset, np.ones(self.B.shape[1]), self.y_offset, y_scale, self.delay)
        cell = LFRCell(self.B.shape[1], len(self.C), self.nx, dtype=torch.float64, random=False)
        self.write(cell, unit)
        K = None if self.K is None else torch.as_tensor(self.K * y_scale)
        return Model(LFR(cell), unit, self.fs, self.inputs, self.outputs, K=K)

    def with_delay_line(self) -> LinearModel:
        """The same system with its delays as states, see ``Model.with_delay_line``."""
        return LinearModel.of(self.to_model().with_delay_line()) if any(self.delay) else self

    def to_scipy(self) -> scipy.signal.StateSpace:
        """The deviations from the operating point as a ``scipy.signal.StateSpace``."""
        own = self.with_delay_line()
        return scipy.signal.StateSpace(own.A, own.B, own.C, own.D, dt=1.0 / self.fs)

    def to_control(self) -> Any:
        """The same as a ``control.StateSpace``; a ValueError if python-control is missing."""
        return control_system(self.with_delay_line())

    def save(self, folder: str | Path) -> Path:
        """Write a checkpoint folder as a model does, with the fit and its covariances."""
        fit = None if self.fit is None else asdict(self.fit)
        known = {name: torch.tensor(v) for name in _KNOWN if (v := getattr(self, name)) is not None}
        return write_model(folder, self.to_model(), {"fit": fit, "outside": self.outside}, known)

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Load the linear model of a checkpoint folder, or of a run's folder ``linear/``."""

        def maker_of(own: Any) -> MapMaker:
            if isinstance(own, dict):
                raise InputError(
                    f"'{folder}' holds no linear model; lfrtorch.load reads an NL-LFR."
                )
            return lambda *_: None

        model, about, known = read_model(folder, maker_of, ("linear", "model"))
        return replace(cls.of(model), **_known(folder, model, about, known))


def _scaled(model: LinearModel, record: Record) -> Model:
    """The model with outputs of unit standard deviation in a record, if there are several."""
    if len(model.outputs) == 1 or record.y.shape[1] != len(model.outputs):
        return model.to_model()
    deviation = np.std(record.y, axis=0)
    return model.to_model(np.where(deviation > 0, deviation, 1.0))


_KNOWN = {
    "covariance": "PP", "innovation_covariance": "yy", "state_covariance": "xx", "x_offset": "x",
}  # fmt: skip
"""Further arrays of a linear model in its checkpoint, with their axes."""


def _known(
    folder: str | Path, model: Model, about: Any, known: Mapping[str, Tensor]
) -> dict[str, Any]:
    """Return what a checkpoint says about a linear model, besides its system matrices."""
    cell = model.lfr.cell
    try:
        fit = None if about is None else about["fit"]
        if fit is not None:
            fit = LinearFit(**fit | {n: tuple(fit[n]) for n in ("singular_values", "notes")})
        sizes = {"x": cell.nx, "u": cell.nu, "y": cell.ny}
        sizes["P"] = (cell.nx + cell.ny) * (cell.nx + cell.nu)
        arrays = {name: known[name].numpy() for name in _KNOWN if name in known}
        for name, array in arrays.items():
            shape = tuple(sizes[axis] for axis in _KNOWN[name])
            if array.shape != shape:
                raise InputError(f"{name} is {array.shape}, not {shape}")
        return {"fit": fit, "outside": str((about or {}).get("outside", "")), **arrays}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"'{folder}' is damaged: its description and weights do not fit ({brief(error)})."
        ) from None


def linear_cell(A: Array, B: Array, C: Array, D: Array) -> LFRCell:
    """Return a cell without static nonlinearity."""
    cell = LFRCell(B.shape[1], C.shape[0], len(A), dtype=torch.float64, random=False)
    _put(cell, A, B, C, D)
    return cell


@torch.no_grad()
def _put(cell: LFRCell, *matrices: Array) -> None:
    for name, value in zip(("A", "Bu", "Cy", "Dyu"), matrices, strict=True):
        cell.get_parameter(name).copy_(torch.as_tensor(np.ascontiguousarray(value)))
