"""The console command ``lfrtorch NAME ...``."""

from __future__ import annotations

import gc
import logging
import sys
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
"""Modules of this room, in the order in which a user meets them, and what they do."""


def main() -> None:
    """Start the command that the first word names; its own words follow."""
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
    """Start a command; its help comes without what computes, which takes seconds to import."""
    if {"--help", "-h"}.isdisjoint(sys.argv):
        logging.getLogger("numexpr").setLevel(logging.WARNING)  # pandas has it tell its threads
        if command in ("fit", "linear"):
            from lfrtorch.cli import early

            early.check("config" if command == "fit" else command)
        gc.disable()  # until all is imported: there is much of it, and nothing in it is garbage
        module = import_module(f"lfrtorch.cli.{command}")
        gc.freeze()
        gc.enable()
        module.launch()
    else:
        import hydra

        from lfrtorch.cli import declared
        from lfrtorch.cli.hydra_versions import MAIN

        declared.register()
        name = "config" if command == "fit" else command
        hydra.main(**MAIN, config_path=str(CONF), config_name=name)(lambda _: None)()


def versions() -> str:
    """Versions of lfrtorch and of what computes for it, as a report of a fault needs them."""
    import numpy as np

    built: Any = np.show_config(mode="dicts")  # pyright: ignore[reportCallIssue]
    blas = built["Build Dependencies"]["blas"]
    others = ", ".join(f"{name} {version(name)}" for name in ("torch", "numba", "numpy", "scipy"))
    python = ".".join(map(str, sys.version_info[:3]))
    library = f"{blas['name']} {blas['version']}"
    return f"lfrtorch {version('lfrtorch')} ({others}, {library}, Python {python})"


def usage() -> str:
    """All commands, a line each."""
    lines = [f"  lfrtorch {name:10}{what}" for name, what in COMMANDS.items()]
    example = "for example: lfrtorch fit x.csv inputs=force outputs=disp fs=750 nx=3"
    return "\n".join(["usage: lfrtorch COMMAND --help", *lines, example])
