"""Cost of an iteration against the sizes of a problem: operation count and figure."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import least_squares

from lfrtorch.engine.blocked_kernel import SAMPLES
from lfrtorch.engine.sensitivity import MANY_STATES


class Axis(NamedTuple):
    """What changes along an axis, and the sizes that are others than usual there."""

    label: str
    values: list[int]
    sizes: dict[str, int]


AXES = {
    "samples": Axis(
        "samples of one record, 3 outputs", [2**k for k in range(10, 21, 2)], {"ports": 3}
    ),
    "count": Axis("records of 2048 samples", [1, 2, 4, 8, 16, 32], {"samples": 2048}),
    "nx": Axis("states $n_x$", [2, 4, 8, 15, 30, 60], {}),
    "ports": Axis("inputs, and outputs", [1, 2, 3, 5, 8], {}),
    "nz": Axis("$n_z$", [1, 2, 4, 8, 16], {}),
    "nw": Axis("$n_w$", [1, 2, 4, 8, 16], {}),
    "nn": Axis("parameters, by 5 to 500 neurons", [5, 15, 50, 150, 500], {}),
}
TANH = 25
"""Operations of the exponential and the quotient."""


def operations(point: dict) -> dict[str, float]:
    """Floating-point operations of an iteration with one accepted trial from rest, part by part.

    K of the P columns of the Jacobian are computed, and the residual beside them; Kx and Ky of them
    belong to the weights of the next state and of the output.
    """
    N, nx, nz, nw, nn, P, K = (point[key] for key in ("samples", "nx", "nz", "nw", "nn", "P", "K"))
    nu, ny = point.get("inputs", point["ports"]), point["ports"]
    v = nx + nu + nw
    network = 2 * nn * (nz + nw) + TANH * nn
    linear = 2 * ((nx + ny) * v + nz * (nx + nu))
    # F = A + Bw J Cz is applied factor by factor to a vector, and formed for the rows.
    applied = 2 * (nx * nx + nx * (nz + nw) + nz * nw)
    formed = 2 * (nx + ny) * nz * (nw + nx)
    product = 4 * ny * K if point["cached"] else 2 * (linear + network + applied)
    # Columns of the output's weights are signals; they are not made if no rows are kept.
    made = K if point["cached"] else K - point["Ky"]
    of_signals = 2 * v * (ny * made + v) if made < K else 0
    counts = {
        "two simulations": 2 * N * (network + linear),
        "slopes": N * (network + 2 * nn * nw * nz),
        "normal equations": N * (ny * (made + 1) ** 2 + of_signals),  # one triangle
        "tangent and adjoint": N * product,
        "gauge": 2 / 3 * (P - K) ** 3 + 2 * (P - K) ** 2 * K,
        "reduced coordinates": 2 * P * K**2 + 4 * K**3,
        "two Cholesky solutions": 2 * K**3 / 3,
    }
    if nx < MANY_STATES:
        return counts | {"rows": N * (formed + 2 * (nx + ny) * (nx + nw) * made)}
    # The responses of a block of samples, and what they make of its columns.
    by_x, by_w, wide = point["Kx"], K - point["Kx"] - point["Ky"], nx + SAMPLES * ny
    block = SAMPLES * (formed + 2 * (nx + nw) * nx * (nx + SAMPLES * ny / 2))
    block += 2 * wide * ((nx + SAMPLES) * by_x + (nx + SAMPLES * nw) * by_w)
    return counts | {"rows in blocks": N / SAMPLES * block}


PRODUCTS = (
    "rows in blocks",
    "normal equations",
    "gauge",
    "reduced coordinates",
    "two Cholesky solutions",
)
"""Parts that are products of large matrices; the others go from sample to sample."""


class Speed(NamedTuple):
    """Operations a second, from sample to sample and of large products, and seconds of calls."""

    recurrences: float
    products: float
    calls: float

    def seconds(self, point: dict) -> float:
        """Those of an iteration, by its operation count."""
        counts = operations(point)
        products = sum(counts.get(part, 0.0) for part in PRODUCTS)
        return (
            self.calls
            + (sum(counts.values()) - products) / self.recurrences
            + (products / self.products)
        )


def speed(points: list[dict]) -> Speed:
    """One speed for all points: the ratios of their times to the count are close to 1."""

    def misfit(logarithms: np.ndarray) -> list[float]:
        found = Speed(*np.exp(logarithms))
        return [np.log(found.seconds(point) / point["s"]) for point in points]

    return Speed(*np.exp(least_squares(misfit, np.log([5e9, 3e10, 3e-3]), loss="soft_l1").x))


def figure(panels: dict[str, list[dict]], file: Path) -> None:
    """Time of an iteration against each size, log-log, and that by the operation count."""
    found = speed([point for points in panels.values() for point in points])
    drawing = Figure(figsize=(10.0, 5.2), layout="constrained")
    grid = drawing.subplots(2, 4, sharey=True)
    for ax, letter, (axis, points) in zip(grid.flat, "abcdefg", panels.items(), strict=False):
        values = [point["P" if axis == "nn" else "value"] for point in points]
        counted = [1e3 * found.seconds(point) for point in points]
        measured = [1e3 * point["s"] for point in points]
        ax.loglog(values, counted, color="0.45", lw=1.2, label="operation count")
        ax.loglog(values, measured, "o", ms=4.5, color="tab:blue", label="measured")
        short = [f"{v}" if v % 1024 else f"{v // 1024}k" for v in values]
        ax.set_xticks(values, [label.replace("1024k", "1M") for label in short])
        ax.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
        ax.set_xlabel(AXES[axis].label)
        ax.set_title(f"({letter})", loc="left", fontsize=10)
        ax.grid(True, which="major", alpha=0.3)
    for ax in grid[:, 0]:
        ax.set_ylabel("time of an iteration (ms)")
    grid[-1, -1].axis("off")
    title = (
        f"one core, operations a second:\n{found.recurrences / 1e9:.1f}·10⁹ from sample to sample\n"
        f"{found.products / 1e9:.0f}·10⁹ in large products\nand {1e3 * found.calls:.1f} ms of calls"
    )
    handles, labels = grid[0, 0].get_legend_handles_labels()
    grid[-1, -1].legend(handles, labels, frameon=False, title=title, loc="center")
    drawing.savefig(file, dpi=200)
