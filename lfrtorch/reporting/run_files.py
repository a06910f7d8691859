"""The folder of a run: checkpoints, scores, figures, report, TensorBoard."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

from lfrtorch._support.atomic import whole_file
from lfrtorch.reporting import figures, html, plots, scores
from lfrtorch.reporting.monitor import TensorBoard
from lfrtorch.reporting.origin import origin
from lfrtorch.reporting.run import Run


def write(
    run: Run,
    folder: str | Path,
    *,
    command: str = "",
    config: str = "",
    draw: bool = True,
    board: TensorBoard | None = None,
) -> None:
    """Write the files of a run into a folder; make the folder if it is missing.

    ``model/`` and ``linear/`` are checkpoints for :func:`lfrtorch.load` and
    ``LinearModel.load``. ``figures/`` contains the figures, ``report.html`` figures and numbers,
    and ``metrics.json``, which is written last, the numbers. ``tensorboard --logdir FOLDER`` shows
    the history.

    Args:
        run: result of :func:`lfrtorch.identify`.
        folder: folder of the files; files of an earlier run there are replaced.
        command, config: command line and settings of the run, for ``metrics.json`` and
            ``report.html``.
        draw: make figures and ``report.html``.
        board: TensorBoard that has the history, if it has begun. Default: a new one.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    result = run.fit
    run.model.save(folder / "model")
    run.linear.save(folder / "linear")
    metrics = {**run.metrics, "command": command, **origin(run.dataset)}
    board = TensorBoard(folder) if board is None else board
    if not board.begun:
        for earlier in folder.glob("events.out.tfevents.*"):
            earlier.unlink()
        board.history(result.history)
    texts = {
        "report": "\n\n".join(map(str, [run.verdict, *run.advice])),
        "scores": scores.table(run.evaluation, result.averaged),
        "settings": config,
        "sizes": "" if run.choice is None else run.choice.table(),
    }
    for name, text in texts.items():
        if text:
            board.text(name, text, result.iterations)
    settings = {item.name: getattr(run.settings, item.name) for item in fields(run.settings)}
    board.hyperparameters(
        {**settings, **run.model.sizes},
        {
            "validation": metrics["validation"]["rmse"],
            **{f"test_{name}": score["rmse"] for name, score in metrics["scores"].items()},
            "parameters": metrics["parameters_net"],
            "seconds": result.seconds,
        },
        result.iterations,
    )
    if draw:
        drawn, views = figures.of_run(run)
        images = plots.save(drawn, folder / "figures")
        for name, image in images.items():
            board.image(f"summary/{name}", image, result.iterations)
        page = html.render(run, images, views=views, command=command, config=config)
        with whole_file(folder / "report.html") as path:
            path.write_text(page, encoding="utf-8")
    board.close()
    with whole_file(folder / "metrics.json") as fresh:
        fresh.write_text(json.dumps(metrics, indent=2, allow_nan=False) + "\n")
