"""The figures of the guide, of the motor of the tutorial: ``python docs/guide/figures.py``."""

from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import lfrtorch
from lfrtorch import Record, Run, analysis
from lfrtorch.reporting import linear_plots, plots

HERE = Path(__file__).parent
COLOURS = 48  # of a file: lines and text need no more
NOISE = 10.0  # mrad/s, of the tutorial's file


def write(figure: Figure, name: str, width: float, height: float) -> None:
    """Write a figure of some inches on white, in few colours."""
    figure.set_size_inches(width, height)
    stream = BytesIO()
    figure.savefig(stream, dpi=100, facecolor="white")
    Image.open(stream).convert("RGB").quantize(COLOURS).save(HERE / f"{name}.png", optimize=True)


def motor() -> Record:
    """The record of the tutorial, by its own lines."""
    page = (HERE / "tutorial.md").read_text(encoding="utf-8")
    names: dict = {}
    code = page.split("```python\n")[1].split("```")[0].split("table, header")[0]
    exec(code, names)
    inputs, outputs = (lfrtorch.Channel("voltage", "V"),), (lfrtorch.Channel("speed", "rad/s"),)
    return Record(names["u"], names["speed"], fs=100, name="motor", inputs=inputs, outputs=outputs)


def starts(run: Run) -> Figure:
    """Training errors of all starts, beside the linear model's and the noise."""
    figure = Figure(layout="constrained")
    ax = figure.subplots()
    most = max(each.iterations for each in run.fit.starts)
    for place, each in enumerate(run.fit.starts, 1):
        face = plots.NL_LFR if each.iterations == most else "white"
        ax.plot(place, 1e3 * each.train, "o", color=plots.NL_LFR, markerfacecolor=face)
        where = {"xytext": (-6, -14), "textcoords": "offset points", "fontsize": "small"}
        ax.annotate(str(each.iterations), (place, 1e3 * each.train), **where)
    linear = 1e3 * lfrtorch.rmse(run.dataset.train[0], run.linear.simulate(run.dataset.train[0]))
    ax.axhline(linear, color=plots.LINEAR, ls="--", label="linear model")
    ax.axhline(NOISE, color="0.5", ls=":", label="noise")
    ax.set(xlabel="starts, the best first", ylabel="training RMSE (mrad/s)", ylim=0)
    ax.grid(True, alpha=0.2)
    ax.legend(loc="center left", fontsize="small")
    return figure


def bands(run: Run, record: Record) -> Figure:
    """Band and surprise for the input of a test, the second half twice as large."""
    u = record.u * np.where(np.arange(record.samples) < record.samples // 2, 1, 2)[:, None]
    band = analysis.uncertainty(run.model, run.dataset.train).simulate(u)
    figure = Figure(layout="constrained")
    above, below = figure.subplots(2, sharex=True)
    t = np.arange(record.samples) / record.fs
    low, high = (edge[:, 0] for edge in band.interval())
    above.fill_between(t, 1e3 * (low - band.y[:, 0]), 1e3 * (high - band.y[:, 0]), alpha=0.4)
    above.set_ylabel("band (mrad/s)")
    below.plot(t, band.surprises)
    below.axhline(1, color="0.5", ls=":")
    below.set(xlabel="time (s)", ylabel="surprise", xlim=(0, t[-1]))
    for ax in (above, below):
        ax.grid(True, alpha=0.2)
    return figure


def response() -> Figure:
    """A saturation before a low-pass filter: response, noise and distortion, linear model."""
    rng = np.random.default_rng(0)
    design = lfrtorch.multisine(1024, fs=100, band=(0.5, 40), realisations=4, seed=0)
    records = []
    for u in design.u:
        x, y = 0.0, np.zeros(3 * 1024)
        for k, v in enumerate(np.tile(u[:, 0], 3)):
            y[k], x = x, 0.8 * x + 0.2 * np.tanh(v)
        y += 0.005 * rng.standard_normal(len(y))
        records.append(Record(np.tile(u, (2, 1)), y[1024:], fs=100, start="periodic", period=1024))
    frf = lfrtorch.estimate_frf(records)
    return linear_plots.frequency_response(lfrtorch.estimate_bla(frf, nx=1), frf)


def main() -> None:
    """Fit, draw, write."""
    record = motor()
    write(lfrtorch.preview(record).figure, "preview", 8, 4)
    settings = lfrtorch.Settings(nx=1, nz=1, nw=1, nn=4)
    run = lfrtorch.identify(record, settings)
    (test,) = run.dataset.tests
    simulated = {"linear": run.linear.simulate(test), "NL-LFR": run.model.simulate(test)}
    write(plots.response(test, simulated), "outputs", 8, 4.5)
    write(analysis.residuals(run.linear, test).plot(), "residuals", 8, 3.2)
    write(starts(run), "starts", 6, 2.8)
    write(bands(run, test), "bands", 7, 3.2)
    write(response(), "response", 7, 4)


if __name__ == "__main__":
    main()
