"""Slow, obvious oracles for the fast code, and small random systems to try it on."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import scipy.signal
import torch
from hypothesis import strategies as st
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call, jacfwd
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from lfrtorch._support.types import Array, Complex
from lfrtorch.data.records import Channel, Record, Scaler, Start
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.simulation import Trajectory
from lfrtorch.least_squares.linear_systems import SVDSystem
from lfrtorch.linear.refinement import Refined
from lfrtorch.linear.response_fit import ResponseFit
from lfrtorch.linear.signal_fit import SignalFit
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.model.model import Model

Weights = dict[str, Tensor]

SIGMA = {
    "tanh": torch.tanh,
    "sigmoid": lambda v: 1 / (1 + torch.exp(-v)),
    "relu": lambda v: torch.where(v > 0, v, torch.zeros_like(v)),
    "rbf": lambda v: torch.exp(-(v**2)),
    "softplus": lambda v: torch.log(1 + torch.exp(v)),
}

# --- the NL-LFR equations -------------------------------------------------------------------


def nl_lfr(cell: LFRCell, theta: Weights, u: Tensor, x0: Tensor) -> Trajectory:
    """Equations (1) and (2) of the paper, one sample after another.

    Shape:
        u: (T, nu), x0: (nx,) -> x: (T + 1, nx), z: (T, nz), w: (T, nw), y: (T, ny).
    """
    A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw = (
        theta[name] for name in ("A", "Bu", "Bw", "Cz", "Dzu", "Cy", "Dyu", "Dyw")
    )
    xs, zs, ws, ys = [x0], [], [], []
    for u_k in u:
        x = xs[-1]
        z = Cz @ x + Dzu @ u_k
        w = f(cell, theta, z)
        zs.append(z)
        ws.append(w)
        ys.append(Cy @ x + Dyu @ u_k + Dyw @ w)
        xs.append(A @ x + Bu @ u_k + Bw @ w)
    return Trajectory(torch.stack(xs), torch.stack(zs), torch.stack(ws), torch.stack(ys))


def f(cell: LFRCell, theta: Weights, z: Tensor) -> Tensor:
    """w = Ww σ(Wz z + bz) + bw, or the user's own module."""
    if cell.static is None:
        return z
    own = {k.removeprefix("static."): p for k, p in theta.items() if k.startswith("static.")}
    if not isinstance(cell.static, Network):
        return functional_call(cell.static, own, (z,))
    h = SIGMA[cell.static.activation](own["Wz"] @ z + own["bz"])
    return own["Ww"] @ h + own["bw"]


def weights(cell: LFRCell) -> Weights:
    return {name: p.detach() for name, p in cell.named_parameters()}


def simulate(cell: LFRCell, u: Tensor, x0: Tensor, periods: int = 1) -> Trajectory:
    """The last of many periods, for u (R, T, nu) and x0 (R, nx)."""
    runs = []
    for u_r, x_r in zip(u, x0, strict=True):
        run = nl_lfr(cell, weights(cell), u_r.repeat(periods, 1), x_r)
        T = len(u_r)
        runs.append((run.x[-T - 1 :], run.z[-T:], run.w[-T:], run.y[-T:]))
    return Trajectory(*(torch.stack(signal) for signal in zip(*runs, strict=True)))


def output_jacobian(cell: LFRCell, u: Tensor, x0: Tensor, periods: int = 1) -> Tensor:
    """dy/dθ (R, T, ny, P) in the last of many periods, by jacfwd through the loop."""
    free = {name: p.detach() for name, p in cell.named_parameters() if p.requires_grad}
    T = u.shape[1]

    def last_period(theta: Weights, u_r: Tensor, x_r: Tensor) -> Tensor:
        return nl_lfr(cell, weights(cell) | theta, u_r.repeat(periods, 1), x_r).y[-T:]

    def one(u_r: Tensor, x_r: Tensor) -> Tensor:
        by_name = jacfwd(last_period)(free, u_r, x_r)
        return torch.cat([d.reshape(T, cell.ny, -1) for d in by_name.values()], dim=-1)

    with warnings.catch_warnings():  # torch itself scripts code at its first forward derivative
        warnings.filterwarnings("ignore", "`torch.jit.script`", DeprecationWarning)
        return torch.stack([one(u_r, x_r) for u_r, x_r in zip(u, x0, strict=True)])


def linear_loop(F: Tensor, g: Tensor, s0: Tensor) -> Tensor:
    """All states (R, T + 1, n, m) of s(k+1) = F(k) s(k) + g(k), one sample after another."""
    states = [s0]
    for k in range(F.shape[1]):
        states.append(F[:, k] @ states[-1] + g[:, k])
    return torch.stack(states, dim=1)


# --- small random models --------------------------------------------------------------------

SIZES = st.fixed_dictionaries(
    {"nu": st.integers(1, 3), "ny": st.integers(1, 3), "nx": st.integers(1, 4)}
    | {"nz": st.integers(1, 3), "nw": st.integers(1, 3), "nn": st.integers(1, 4)}
    | {"seed": st.integers(0, 1000)}
)


def random_cell(
    nu: int = 1,
    ny: int = 1,
    nx: int = 2,
    nz: int = 1,
    nw: int = 1,
    nn: int = 3,
    *,
    seed: int = 0,
    radius: float = 0.8,
    feedback: float = 0.1,
    activation: str = "tanh",
    static: torch.nn.Module | None = None,
    dtype: torch.dtype = torch.float64,
) -> LFRCell:
    """Cell with normal weights that contracts: |A| = radius, |Bw| |Ww| |Wz| |Cz| = feedback.

    The slopes of all σ are at most 1, so |∂x+/∂x| <= radius + feedback. Linear for nz = nw = 0.
    """
    if static is None and nw:
        static = Network(nz, nw, nn, activation)
    cell = LFRCell(nu, ny, nx, nz, nw, static, random=False).to(torch.float64)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in cell.parameters():
            p.normal_(generator=generator)
        cell.A.mul_(radius / torch.linalg.matrix_norm(cell.A, 2))
        if nw:
            loop = [cell.Bw, cell.Cz]
            if isinstance(cell.static, Network):
                loop += [cell.static.Ww, cell.static.Wz]
            for p in loop:
                p.div_(torch.linalg.matrix_norm(p, 2))
            cell.Bw.mul_(feedback)
    return cell.to(dtype)


def polynomial_cell(
    nz: int,
    nw: int,
    degree: int,
    *,
    seed: int = 0,
    radius: float = 0.5,
    dtype: torch.dtype = torch.float64,
) -> LFRCell:
    """Cell with two inputs, outputs and states, and a polynomial of a z of about unit size."""
    static = Polynomial(nz, nw, degree)
    cell = random_cell(2, 2, 2, nz, nw, seed=seed, static=static, radius=radius, feedback=0.05)
    with torch.no_grad():
        cell.Cz.mul_(0.3)
        cell.Dzu.mul_(0.3)
    return cell.to(dtype)


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)


def random_model(cell: LFRCell, *, seed: int = 0, fs: float = 100.0) -> Model:
    """Model about the cell, with a scaling that is not the identity."""
    generator = np.random.default_rng(seed)
    scaler = Scaler(
        generator.normal(size=cell.nu),
        generator.uniform(0.5, 2.0, cell.nu),
        generator.normal(size=cell.ny),
        generator.uniform(0.5, 2.0, cell.ny),
    )
    inputs = tuple(Channel(f"u{i + 1}", "N") for i in range(cell.nu))
    outputs = tuple(Channel(f"y{i + 1}", "mm") for i in range(cell.ny))
    return Model(LFR(cell), scaler, fs, inputs, outputs)


def measure(model: Model, T: int, *, seed: int = 0, start: Start = "zero", skip: int = 0) -> Record:
    """Noise-free record of a model under white noise about its input offset."""
    scaler = model.scaler
    u = normal(T, len(model.inputs), seed=seed).numpy() * scaler.u_scale + scaler.u_offset
    return Record(
        u, model.simulate(u, start=start), model.fs, start, skip,
        inputs=model.inputs, outputs=model.outputs,
    )  # fmt: skip


# --- special cases --------------------------------------------------------------------------

MATRICES = ["normal", "zero", "repeated", "rank 1", "graded", "sparse"]
"""What ``special_matrix`` makes."""


def special_matrix(kind: str, rows: int, columns: int, rng: np.random.Generator) -> Array:
    """Normal numbers; or with zeros, dependent columns, or columns of 1e-9 to 1e9."""
    M = rng.normal(size=(rows, columns))
    if kind == "zero":
        M *= 0.0
    if kind == "repeated":
        M[:, -1] = M[:, 0]
    if kind == "rank 1":
        M = M[:, :1] * rng.normal(size=columns)
    if kind == "graded":
        M *= 10.0 ** rng.uniform(-9.0, 9.0, columns)
    if kind == "sparse":
        M[rng.random(M.shape) < 0.5] = 0.0
    return M


POLES = ["normal", "repeated", "near", "defective", "nilpotent", "zero", "slow"]
"""What ``special_poles`` makes."""


def special_poles(kind: str, nx: int, rng: np.random.Generator) -> Array:
    """A with |poles| < 1, which may be equal, almost equal, without eigenvectors, 0 or near 1."""
    turn = np.linalg.qr(rng.normal(size=(nx, nx)))[0]
    if kind == "normal":
        A = rng.normal(size=(nx, nx))
        return 0.9 * A / np.abs(np.linalg.eigvals(A)).max()
    poles = {
        "repeated": np.full(nx, 0.5),
        "near": 0.5 + 10.0 ** rng.uniform(-16.0, -2.0) * np.arange(nx),
        "slow": 1.0 - 10.0 ** rng.uniform(-6.0, -2.0, nx),
        "defective": np.full(nx, 0.5),
    }.get(kind, np.zeros(nx))
    A = np.diag(poles) + np.eye(nx, k=1) * (kind in ("defective", "nilpotent"))
    return turn @ A @ turn.T if rng.random() < 0.5 else A


# --- linear systems -------------------------------------------------------------------------

System = tuple[Array, Array, Array, Array]  # A, B, C, D


def random_system(nx: int, nu: int = 1, ny: int = 1, *, seed: int = 0) -> System:
    """Stable system whose slowest pole has radius 0.9."""
    generator = np.random.default_rng([nx, nu, ny, seed])
    A = generator.normal(size=(nx, nx))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    B, C, D = (generator.normal(size=shape) for shape in ((nx, nu), (ny, nx), (ny, nu)))
    return A, B, C, D


def dlsim(system: System, u: Array) -> Array:
    """Response (T, ny) from zero state."""
    return scipy.signal.dlsim((*system, 1.0), u)[1]


def frf(system: System, omega: Array) -> Complex:
    """C (zI - A)⁻¹ B + D at the angles omega (F,) -> (F, ny, nu)."""
    A, B, C, D = system
    return np.stack([C @ np.linalg.inv(np.exp(1j * w) * np.eye(len(A)) - A) @ B + D for w in omega])


def periodic_response(system: System, u: Array) -> Array:
    """Steady-state response (T, ny) to the periodic repetition of u (T, nu), in frequency."""
    omega = np.asarray(2 * np.pi * np.fft.rfftfreq(len(u)), dtype=np.float64)
    Y = np.einsum("fyu,fu->fy", frf(system, omega), np.fft.rfft(u, axis=0))
    return np.fft.irfft(Y, len(u), axis=0)


def refined(fit: ResponseFit | SignalFit, system: System, max_iter: int) -> Refined:
    """What a linear fit finds from one start."""
    return fit.refined(fit.search(system).advance(max_iter))


def theta(model: Model) -> Tensor:
    return parameters_to_vector(model.lfr.parameters()).detach()


def unscaled(model: Model) -> Tensor:
    """The weights that keep their bits when states are scaled."""
    cell = model.lfr.cell
    others = [p for name, p in cell.named_parameters() if name.startswith(("D", "static"))]
    return torch.cat([p.detach().flatten() for p in (cell.A.diagonal(), *others)])


def planted(T: int = 300, **sizes: Any) -> tuple[Model, list[Record], Record]:
    """A model some way off, a record from zero and one in steady state of the true one, a test."""
    truth, start = (random_model(random_cell(**sizes, radius=0.7)) for _ in range(2))
    train = [measure(truth, T), measure(truth, T, seed=1, start="periodic")]
    move(start, 0.05)
    return start, train, measure(truth, T, seed=2)


def move(model: Model, far: float):
    vector = theta(model)
    vector_to_parameters(
        vector + far * normal(len(vector), seed=9, dtype=vector.dtype), model.lfr.parameters()
    )


class DenseJacobian:
    """A Jacobian that is held as one matrix, and the residual there."""

    def __init__(self, jacobian: Float[Tensor, "M P"], residual: Float[Tensor, " M"]) -> None:
        self.jacobian, self.residual = jacobian, residual

    def system(self, damping: float, truncation: float) -> tuple[SVDSystem, Tensor]:
        """The system and the gradient."""
        R = torch.linalg.qr(self.jacobian, mode="r").R
        return SVDSystem(R, truncation), self.jacobian.mT @ self.residual

    def tangent(self, d_theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """J dθ."""
        return self.jacobian @ d_theta

    def adjoint(self, residual: Float[Tensor, " M"]) -> Float[Tensor, " P"]:
        """Jᵀ residual."""
        return self.jacobian.mT @ residual
