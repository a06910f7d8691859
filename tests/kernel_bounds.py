"""Random shapes and dtypes at every way into machine code, with its bounds checks on.

A process of its own: NUMBA_BOUNDSCHECK=1 must be set before numba is imported, and NUMBA_CACHE_DIR
must be empty, as kernels from a cache have no checks.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numba import config

import lfrtorch
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.sensitivity import Linearisation, output_jacobian
from lfrtorch.engine.simulation_kernel import simulate_records
from lfrtorch.maps.activations import ACTIVATIONS
from lfrtorch.maps.direct_sum import DirectSum
from lfrtorch.model.extended_kalman_filter import NoiseCovariance

MANY_STATES = 9
"""Rows of so many states go through other kernels."""


def known(draw: random.Random, ny: int) -> lfrtorch.Known:
    """Two states and a parameter, in one of the integrations."""
    method: Any = draw.choice(["rk4", "euler", "discrete"])
    discrete = method == "discrete"
    return lfrtorch.Known(
        lambda x, u, p: (0.1 * torch.sin(x.a) + 0.1 * u[-1], p.c * x.a - 0.5 * x.b),
        states=["a", "b"],
        parameters={"c": 0.2},
        outputs=lambda x, u, p: [x.b + 0.1 * u[0]] * ny,
        method=method,
        substeps=1 if discrete else draw.randint(1, 3),
        intersample="zoh" if discrete else draw.choice(["zoh", "bl"]),
    )


def model(draw: random.Random) -> lfrtorch.Model:
    """A stable model of random sizes."""
    nu, ny, nz, nw = (draw.randint(1, 3) for _ in range(4))
    nx, nn = draw.choice([1, 2, 3, MANY_STATES]), draw.randint(1, 6)
    dtype = draw.choice([torch.float64, torch.float64, torch.float32])
    static: torch.nn.Module | None = draw.choice(
        [
            lfrtorch.Network(nz, nw, nn, draw.choice(sorted(ACTIVATIONS)), dtype=dtype),
            lfrtorch.Polynomial(nz, nw, draw.randint(1, 3), dtype=dtype),
            None,
        ]
    )
    nz, nw = (nz, nw) if static else (0, 0)
    if isinstance(static, lfrtorch.Network) and dtype == torch.float64 and draw.random() < 0.5:
        own = known(draw, ny).map(nu, ["y"] * ny, 1.0)
        static = DirectSum([own, static], [(own.nz, own.nw), (nz, nw)])
        nx, nz, nw = max(nx, 2), own.nz + nz, own.nw + nw
    cell = LFRCell(nu, ny, nx, nz, nw, static, dtype=dtype, random=False)
    generator = torch.Generator().manual_seed(draw.randrange(1 << 30))
    with torch.no_grad():
        for weight in cell.parameters(recurse=False):
            weight.uniform_(-0.3, 0.3, generator=generator)
        cell.A.mul_(0.5 / nx)
    inputs, outputs = (
        tuple(lfrtorch.Channel(f"{side}{n}") for n in range(size))
        for side, size in (("u", nu), ("y", ny))
    )
    scaler = lfrtorch.Scaler(np.zeros(nu), np.ones(nu), np.zeros(ny), np.ones(ny))
    K = torch.zeros(nx, ny, dtype=dtype) if draw.random() < 0.5 else None
    return lfrtorch.Model(LFR(cell), scaler, 1.0, inputs, outputs, "", K)


def allowed(made: lfrtorch.Model, draw: random.Random) -> None:
    """Signals that fit go through every kernel."""
    lfr, cell = made.lfr, made.lfr.cell
    dtype = cell.A.dtype
    R, T = draw.randint(1, 4), draw.choice([1, 2, 7, 40])
    u = torch.randn(R, T, cell.nu, dtype=dtype).requires_grad_()
    x0 = torch.zeros(R, cell.nx, dtype=dtype).requires_grad_()
    for start in ("zero", "periodic"):
        lfr(u, x0, start).square().sum().backward()
        trajectory = lfr.trajectory(u.detach(), x0.detach(), start)
        output_jacobian(Linearisation(cell, u.detach(), trajectory, periodic=start == "periodic"))
    if R == 1:
        assert lfr(u[0], x0[0]).shape == (T, cell.ny)
    signals = u[0].detach().double().numpy(), lfr(u)[0].detach().double().numpy()
    record = lfrtorch.Record(*signals, start="estimated", inputs=made.inputs, outputs=made.outputs)
    made.simulate(record)
    observers: list[Any] = [made.observer(noise=NoiseCovariance(1e-3, 1e-2), after=record)]
    if made.K is not None:
        observers.append(made.observer(after=record))
    for observer in observers:
        observer.predict(record.u[0])
        observer.update(record.y[0])
    if T > 1:
        lfrtorch.fit(
            made, record, trainer=lfrtorch.LevenbergMarquardt(max_iter=1), monitors=[silent]
        )


def silent(*_: object) -> None:
    """Show nothing."""


def refused(made: lfrtorch.Model, draw: random.Random) -> None:
    """Signals and weights that do not fit end in a message, before any kernel."""
    cell, dtype = made.lfr.cell, made.lfr.cell.A.dtype
    other = torch.float32 if dtype == torch.float64 else torch.float64

    def signal(*shape: int, kind: torch.dtype = dtype) -> torch.Tensor:
        return torch.zeros(*shape, dtype=kind)

    R, T, more = draw.randint(1, 3), draw.randint(1, 5), draw.choice([-1, 1, 7])
    u, x, wrong = signal(R, T, cell.nu), signal(R, cell.nx), max(0, cell.nu + more)
    lfr, K = made.lfr, signal(cell.nx + 1, cell.ny)
    scaler = replace(made.scaler, u_scale=np.ones(cell.nu + 1))
    cases: list[Callable[[], Any]] = [
        lambda: lfr(signal(R, T, wrong)),
        lambda: lfr(signal(T, wrong)),
        lambda: lfr(signal(cell.nu)),
        lambda: lfr(signal(0, T, cell.nu)),
        lambda: lfr(signal(R, 0, cell.nu)),
        lambda: lfr(u, signal(R, cell.nx + 1)),
        lambda: lfr(u, signal(R + 1, cell.nx)),
        lambda: lfr(u, signal(cell.nx)),
        lambda: lfr(signal(R, T, cell.nu, kind=other)),
        lambda: lfr(signal(R, T, cell.nu, kind=torch.bfloat16)),
        lambda: lfr(signal(R, T, cell.nu, kind=torch.int64)),
        lambda: lfr(u, x.to(other)),
        lambda: lfr(u.numpy()),  # pyright: ignore[reportArgumentType]
        lambda: lfr.trajectory(u, x, guess=signal(R + 1, T + 1, cell.nx)),
        lambda: lfr.trajectory(u[0], x),
        lambda: cell(signal(R, wrong), x),
        lambda: cell(signal(R, cell.nu), signal(R, cell.nx + 1)),
        lambda: cell(signal(R, cell.nu), x.to(other)),
        lambda: made.simulate(np.zeros((T, wrong))),
        lambda: made.simulate(np.zeros((T, cell.nu)), start="given", x0=np.zeros(cell.nx + 1)),
        lambda: made.observer(noise=NoiseCovariance(1, 1)).predict(np.zeros(wrong)),
        lambda: made.observer(noise=NoiseCovariance(np.ones(cell.nx + 1), 1)),
        lambda: made.observer(noise=NoiseCovariance(1, 1), P0=np.eye(cell.nx + 1)),
        lambda: replace(made, K=K),
        lambda: replace(made, scaler=scaler),
        lambda: replace(made, lfr=broken(made)),
        lambda: broken(made)(u),
    ]
    for number, case in enumerate(cases):
        try:
            found = case()
        except lfrtorch.InputError:
            continue
        raise AssertionError(f"case {number} with {made!r} was taken: {found!r}")


def broken(made: lfrtorch.Model) -> LFR:
    """A copy with one weight of another shape, put in by hand."""
    cell = LFRCell(made.lfr.cell.nu, made.lfr.cell.ny, made.lfr.cell.nx, random=False).to(
        made.lfr.cell.A
    )
    cell.Bu = torch.nn.Parameter(cell.A.new_zeros(cell.nx, cell.nu + 1))
    return LFR(cell)


def planted() -> None:
    """A wrong index: an input that has no channel for the kernel's second column."""
    channel, lfr = (
        (lfrtorch.Channel("a"),),
        LFR(LFRCell(1, 1, 1, dtype=torch.float64, random=False)),
    )
    one = np.ones(1)
    made = lfrtorch.Model(lfr, lfrtorch.Scaler(one, one, one, one), 1.0, channel, channel)
    observer = made.observer(noise=NoiseCovariance(1, 1))
    call = observer._call  # pyright: ignore[reportAttributeAccessIssue]
    assert call is not None
    call[6] = np.zeros((1, 1, 2))
    try:
        simulate_records(*call)
    except IndexError:
        return
    raise AssertionError("an index beyond an array was not noticed")


def main(cases: int) -> None:
    """So many random models."""
    assert vars(config)["BOUNDSCHECK"], "set NUMBA_BOUNDSCHECK=1"
    torch.set_num_threads(1)
    planted()
    for seed in range(cases):
        draw = random.Random(seed)
        torch.manual_seed(seed)
        made = model(draw)
        refused(made, draw)
        allowed(made, draw)
    print(f"{cases} models, no index left its array")


if __name__ == "__main__":
    main(int(sys.argv[1]))
