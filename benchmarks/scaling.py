"""Cost of an iteration against the sizes of a problem: operation count and figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

AXES = {
    "samples": ("samples $N$ of one record", [2**k for k in range(10, 19)]),
    "nx": ("states $n_x$", [2, 3, 4, 6, 8, 12, 16]),
    "nn": ("neurons $n_n$", [5, 8, 15, 30, 60]),
    "count": ("records of 2048 samples", [1, 2, 4, 8, 16, 32]),
}
TANH = 25
"""Operations of the exponential and the quotient."""


def operations(point: dict) -> dict[str, float]:
    """Floating-point operations of an iteration with one accepted trial from rest, part by part.

    K of the P columns of the Jacobian are computed, and the residual beside them.
    """
    N, nx, nz, nw, nn, P, K = (point[key] for key in ("samples", "nx", "nz", "nw", "nn", "P", "K"))
    nu = ny = 1
    network = 2 * nn * (nz + nw) + TANH * nn
    linear = 2 * ((nx + ny) * (nx + nu + nw) + nz * (nx + nu))
    return {
        "two simulations": 2 * N * (network + linear),
        "slopes": N * (network + 2 * nn * nw * nz + 2 * nw * nz * nx * (nx + ny)),
        "rows": 2 * N * (nx + ny) * (nx + nw) * K,
        "normal equations": 2 * N * ny * (K + 1) ** 2,
        "tangent and adjoint": 4 * N * ny * K,
        "expansion": 2 * P * K * (K + P),
        "eigenvalues": 4 / 3 * P**3,
        "two Cholesky solutions": 2 * P**3 / 3,
    }


def speed(points: list[dict]) -> float:
    """Operations a second: one number for all points, in the middle of them on a log scale."""
    return float(
        np.exp(np.mean([np.log(sum(operations(point).values()) / point["s"]) for point in points]))
    )


def figure(panels: dict[str, list[dict]], file: Path) -> None:
    """Time of an iteration against each size, log-log, and the operation count scaled once."""
    rate = speed([point for points in panels.values() for point in points])
    drawing = Figure(figsize=(7.0, 5.2), layout="constrained")
    grid = drawing.subplots(2, 2, sharey=True)
    for ax, letter, (axis, points) in zip(grid.flat, "abcd", panels.items(), strict=False):
        values = [point["value"] for point in points]
        counted = [1e3 * sum(operations(point).values()) / rate for point in points]
        measured = [1e3 * point["s"] for point in points]
        ax.loglog(values, counted, color="0.45", lw=1.2, label="operation count, scaled")
        ax.loglog(values, measured, "o", ms=4.5, color="tab:blue", label="measured")
        few = [v for v in values if axis != "samples" or np.log2(v) % 2 == 0]
        ax.set_xticks(few, [f"{v}" if v < 1e4 else f"{v // 1024}k" for v in few])
        ax.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
        ax.set_xlabel(AXES[axis][0])
        ax.set_title(f"({letter})", loc="left", fontsize=10)
        ax.grid(True, which="major", alpha=0.3)
    for ax in grid[:, 0]:
        ax.set_ylabel("time of an iteration (ms)")
    grid[0, 0].legend(frameon=False, title=f"one core, {rate / 1e9:.1f}·10⁹ operations/s")
    drawing.savefig(file, dpi=200)
