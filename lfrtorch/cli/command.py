"""The console command ``lfrtorch NAME ...``."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from typing import Any

from lfrtorch.cli import CONF
from lfrtorch.cli.interrupts import at_once, handled

COMMANDS = {
    "preview": "look at measurements before any fit",
    "linear": "frequency response and best linear approximation",
    "fit": "identify a nonlinear LFR model, from records to report",
    "evaluate": "score a saved model on a dataset",
    "simulate": "run a saved model on the inputs of files",
    "export": "write a saved model as C, CasADi, ONNX, MATLAB, Python or FMU",
}
"""Commands in the order in which a user meets them, and what they do."""


def main() -> None:
    """Start the command that the first word names, with the words after it."""
    word = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if word == "--version":
        print(versions())
    elif word in ("--help", "-h"):
        print(usage())
    elif word in COMMANDS:
        sys.argv[:2] = [f"lfrtorch {word}"]
        with handled(at_once):
            start(word)
    else:
        sys.exit(f"error: there is no command '{word}'.\n{usage()}")


def start(command: str) -> None:
    """Start a command; help and refusals come before imports that take seconds."""
    if {"--help", "-h"}.isdisjoint(sys.argv):
        from lfrtorch.cli import early

        early.take_words(config_name(command))
        logging.getLogger("numexpr").setLevel(logging.WARNING)  # else it prints its threads
        gc.disable()  # off until all is imported: imports make many objects, and no garbage
        task = import_module(f"lfrtorch.cli.{command}").main
        gc.freeze()
        gc.enable()
    else:
        from lfrtorch.cli import declared

        declared.register()
        task = _nothing
    run(command, task)


def run(command: str, task: Callable[[Any], object]) -> None:
    """Have Hydra compose the completed words of the program, and start the task."""
    import hydra

    from lfrtorch.cli.errors import user_errors
    from lfrtorch.cli.hydra_versions import MAIN

    with user_errors():  # errors of several runs, when all have ended
        hydra.main(**MAIN, config_path=str(CONF), config_name=config_name(command))(task)()


def _nothing(_: Any) -> None:
    """Do nothing: Hydra prints its help and ends the program before."""


def config_name(command: str) -> str:
    """The file in ``conf/`` of a command."""
    return "config" if command == "fit" else command


def versions() -> str:
    """Versions of lfrtorch and of the libraries below it, for a report of a fault."""
    import numpy as np

    built: Any = np.show_config(mode="dicts")  # pyright: ignore[reportCallIssue]
    blas = built["Build Dependencies"]["blas"]
    others = ", ".join(f"{name} {version(name)}" for name in ("torch", "numba", "numpy", "scipy"))
    python = ".".join(map(str, sys.version_info[:3]))
    library = f"{blas['name']} {blas['version']}"
    return f"lfrtorch {version('lfrtorch')} ({others}, {library}, Python {python})"


def usage() -> str:
    """A line for each command."""
    lines = [f"  lfrtorch {name:10}{what}" for name, what in COMMANDS.items()]
    example = "for example: lfrtorch fit x.csv inputs=force outputs=disp fs=750 nx=3"
    return "\n".join(["usage: lfrtorch COMMAND --help", *lines, example])
