"""The method on one page, in plain torch: linear approximation, start, Levenberg-Marquardt.

The model is a linear system in feedback with a network of one hidden layer::

    x(k+1) = A  x(k) + Bu  u(k) + Bw  w(k)
    y(k)   = Cy x(k) + Dyu u(k) + Dyw w(k)
    z(k)   = Cz x(k) + Dzu u(k)
    w(k)   = Ww tanh(Wz z(k) + bz) + bw

and is fitted as in Schoukens and Tóth (IFAC-PapersOnLine 53(2), 2020, arXiv 2004.05040).
``lfrtorch.identify`` does the same, faster and on more kinds of data.

    python examples/minimal.py
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd

from lfrtorch import Record

Weights = dict[str, Tensor]


def measured(samples: int, seed: int) -> Record:
    """Simulate a mass on a hardening spring from rest: position y under a force u, with noise."""
    rng = np.random.default_rng(seed)
    u, y = 2.0 * rng.standard_normal(samples), np.zeros(samples)
    position = velocity = 0.0
    for k in range(samples):
        y[k] = position + 0.02 * rng.standard_normal()
        velocity += 0.3 * (u[k] - 0.5 * velocity - position - 0.5 * position**3)
        position += 0.3 * velocity
    return Record(u, y)


def simulate(weights: Weights, u: Tensor) -> tuple[Tensor, Tensor]:
    """Simulate all records from x = 0: u (R, T, nu) -> y (R, T, ny) and x (R, T, nx)."""
    A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw, Wz, bz, Ww, bw = weights.values()
    x, states, outputs = u.new_zeros(len(u), len(A)), [], []
    for u_k in u.unbind(1):
        w = torch.tanh((x @ Cz.mT + u_k @ Dzu.mT) @ Wz.mT + bz) @ Ww.mT + bw
        states.append(x)
        outputs.append(x @ Cy.mT + u_k @ Dyu.mT + w @ Dyw.mT)
        x = x @ A.mT + u_k @ Bu.mT + w @ Bw.mT
    return torch.stack(outputs, dim=1), torch.stack(states, dim=1)


def subspace(u: Tensor, y: Tensor, nx: int, rows: int = 10) -> tuple[Tensor, Tensor]:
    """Estimate A and Cy by PO-MOESP (Verhaegen, Automatica 30, 1994)."""

    def hankel(signal: Tensor) -> Tensor:  # 2 rows of samples: a past and a future a column
        return signal.unfold(1, 2 * rows, 1).permute(3, 2, 0, 1).flatten(2).flatten(0, 1)

    (u_past, u_future), (y_past, y_future) = hankel(u).chunk(2), hankel(y).chunk(2)
    # Future outputs less the effect of future inputs, projected on the past: that of the states.
    L = torch.linalg.qr(torch.cat([u_future, u_past, y_past, y_future]).mT, mode="r").R.mT
    U, S, _ = torch.linalg.svd(L[-len(y_future) :, len(u_future) : -len(y_future)])
    observability, ny = U[:, :nx] * S[:nx].sqrt(), y.shape[-1]
    return torch.linalg.lstsq(observability[:-ny], observability[ny:]).solution, observability[:ny]


def embedded(A: Tensor, Cy: Tensor, nu: int, nz: int, nw: int, nn: int) -> Weights:
    """Write a linear model into an NL-LFR: w acts on nothing, and the network is random."""
    (ny, nx), uniform = Cy.shape, lambda *shape: A.new_empty(shape).uniform_(-1.0, 1.0)
    weights = {"A": A, "Bu": A.new_zeros(nx, nu), "Bw": A.new_zeros(nx, nw)}
    weights |= {"Cz": uniform(nz, nx), "Dzu": uniform(nz, nu)}
    weights |= {"Cy": Cy, "Dyu": A.new_zeros(ny, nu), "Dyw": A.new_zeros(ny, nw)}
    weights |= {"Wz": uniform(nn, nz), "bz": uniform(nn)}
    return weights | {"Ww": uniform(nw, nn), "bw": A.new_zeros(nw)}


def scaled(weights: Weights, u: Tensor) -> Weights:
    """Give each state and each z the standard deviation 1 over the data."""
    A, Bu, Cz, Dzu, Cy = (weights[name] for name in ("A", "Bu", "Cz", "Dzu", "Cy"))
    _, x = simulate(weights, u)
    T = 1.0 / x.std(dim=(0, 1))
    Tz = 1.0 / ((x * T) @ Cz.mT + u @ Dzu.mT).std(dim=(0, 1))[:, None]
    states = {"A": A / T * T[:, None], "Bu": Bu * T[:, None], "Cy": Cy / T}
    return weights | states | {"Cz": Tz * Cz, "Dzu": Tz * Dzu}


def fit(
    weights: Weights, free: Sequence[str], u: Tensor, y: Tensor, iterations: int
) -> tuple[Weights, list[float]]:
    """Minimise |y_hat - y|² over the free weights; return all weights, and the rms errors."""
    sizes = [weights[name].numel() for name in free]

    def written(theta: Tensor) -> Weights:
        parts = zip(free, theta.split(sizes), strict=True)
        return weights | {name: part.view_as(weights[name]) for name, part in parts}

    def residual(theta: Tensor) -> Tensor:
        return (simulate(written(theta), u)[0] - y).flatten()

    theta = torch.cat([weights[name].flatten() for name in free])
    r = residual(theta)
    errors, damping, growth = [r.square().mean().sqrt().item()], 0.0, 2.0
    for _ in range(iterations):
        U, S, Vt = torch.linalg.svd(jacfwd(residual)(theta), full_matrices=False)
        gradient, largest = S * (U.mT @ r), S[0].item() ** 2
        damping = damping or 1e-2 * largest  # Nielsen's rule from here on (IMM-REP-1999-05)
        while True:
            # Changes of coordinates (of x, z, w) keep the output: S is 0 there, and so is the step.
            step = -gradient / (S.square() + damping)
            ahead = residual(theta + Vt.mT @ step)
            predicted = damping * step @ step - gradient @ step
            gain = ((r @ r - ahead @ ahead) / predicted).item()
            if gain > 0.0:  # a trial that diverges has NaN
                break
            if damping > 1e12 * largest:
                return written(theta), errors
            damping, growth = growth * damping, 2.0 * growth
        theta, r = theta + Vt.mT @ step, ahead
        damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
        errors.append(r.square().mean().sqrt().item())
    return written(theta), errors


def main() -> None:
    """Identify the spring from eight records, and score the models on a ninth."""
    torch.manual_seed(0)
    records = [measured(125, seed) for seed in range(9)]
    u, y = (torch.as_tensor(np.stack(s)) for s in zip(*((r.u, r.y) for r in records), strict=True))

    # 1. Normalise by the first eight: the damping λI is for coordinates of one size.
    u, y = ((s - s[:8].mean(dim=(0, 1))) / s[:8].std(dim=(0, 1)) for s in (u, y))

    # 2. The best linear approximation, in an NL-LFR whose w acts on nothing.
    weights = embedded(*subspace(u[:8], y[:8], nx=2), nu=1, nz=1, nw=1, nn=6)
    weights, _ = fit(weights, ["Bu", "Dyu"], u[:8], y[:8], iterations=3)
    weights, _ = fit(weights, ["A", "Bu", "Cy", "Dyu"], u[:8], y[:8], iterations=8)

    # 3. The start: the linear model's output, with signals of one size inside.
    start = scaled(weights, u[:8])

    # 4. All weights at once.
    model, errors = fit(start, list(start), u[:8], y[:8], iterations=40)
    for iteration in range(0, len(errors), 10):
        print(f"iteration {iteration:2}: {100 * errors[iteration]:6.3f} % rms of the output")
    for name, found in (("linear", start), ("NL-LFR", model)):
        error = (simulate(found, u[8:])[0] - y[8:]).square().mean().sqrt()
        print(f"test, {name}: {100 * error:6.3f} %")


if __name__ == "__main__":
    main()
