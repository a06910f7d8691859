"""The figure of the README: the loop, and the errors of both models on a simulated record.

python docs/figure.py
"""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

import lfrtorch
from lfrtorch.reporting.plots import LINEAR as LINEAR_COLOUR
from lfrtorch.reporting.plots import NL_LFR, OUTPUT

OUT = Path(__file__).with_suffix(".png")

LINEAR = (
    r"$x^+ = A\,x + B_u u + B_w w$",
    r"$y = C_y x + D_{yu} u + D_{yw} w$",
    r"$z = C_z x + D_{zu} u$",
)


def loop(ax: Axes) -> None:
    """A linear system in feedback with a static map."""
    ax.set(xlim=(0, 10), ylim=(0, 6))
    ax.axis("off")
    arrow = {"arrowstyle": "-|>", "color": "black", "shrinkA": 0, "shrinkB": 0}
    for x, y, width, height, lines in (
        (2.0, 3.0, 6.0, 2.8, LINEAR),
        (3.4, 0.4, 3.2, 1.4, (r"$w = f(z)$",)),
    ):
        box = FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=0.2")
        box.set(facecolor="#f4f6f8", edgecolor="black")
        ax.add_patch(box)
        for line, text in enumerate(lines):
            at = y + height * (1 - (line + 0.5) / len(lines))
            ax.text(x + width / 2, at, text, ha="center", va="center")
    for start, end in (((0.4, 4.9), (2.0, 4.9)), ((8.0, 4.9), (9.6, 4.9))):
        ax.annotate("", end, start, arrowprops=arrow)
    for points, end in (
        (((8.0, 3.6), (9.0, 3.6), (9.0, 1.1)), (6.6, 1.1)),
        (((3.4, 1.1), (1.0, 1.1), (1.0, 3.6)), (2.0, 3.6)),
    ):
        ax.plot(*zip(*points, strict=True), color="black", lw=1)
        ax.annotate("", end, points[-1], arrowprops=arrow)
    for x, y, name in ((0.2, 4.9, "u"), (9.8, 4.9, "y"), (9.3, 2.4, "z"), (0.7, 2.4, "w")):
        ax.text(x, y, f"${name}$", ha="center", va="center")


def errors(ax: Axes) -> None:
    """Half a second of a test record of the Bouc-Wen system, which is simulated."""
    data = lfrtorch.datasets.boucwen.load(seed=0)
    settings = lfrtorch.Settings(nx=3, nz=2, nw=1, nn=15, ridge=1e-3, linear={"offset": False})
    run = lfrtorch.identify(data, settings)
    record = data.tests[0]
    part = slice(0, 180)
    t = np.arange(180) / record.fs
    ax.plot(t, 1e3 * record.y[part, 0], color=OUTPUT, lw=1.2, label="displacement")
    for name, model, colour in (
        ("linear", run.linear, LINEAR_COLOUR),
        ("NL-LFR", run.model, NL_LFR),
    ):
        y_hat = model.simulate(record)
        rmse = 1e6 * lfrtorch.rmse(record, y_hat)
        error = 1e3 * (record.y - y_hat)[part, 0]
        ax.plot(t, error, color=colour, lw=1.2, label=f"error, {name}: {rmse:.3g} µm rms")
    ax.set(xlabel="time (s)", ylabel="mm", xlim=(0, t[-1]))
    ax.legend(loc="upper right", fontsize=8, ncols=3, columnspacing=1, handlelength=1)
    ax.set_ylim(top=1.35 * ax.get_ylim()[1])
    ax.set_title(f"Bouc-Wen hysteresis, test multisine ({record.source})", fontsize=9)


def main() -> None:
    """Fit, draw, write."""
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 3))
    loop(left)
    errors(right)
    figure.savefig(OUT, dpi=130)


if __name__ == "__main__":
    main()
