"""The console command ``lfrtorch NAME ...``."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.metadata import version

COMMANDS = {
    "preview": "look at measurements before any fit",
    "linear": "frequency response and best linear approximation",
    "fit": "identify a nonlinear LFR model, from records to report",
    "evaluate": "score a saved model on a dataset",
    "simulate": "run a saved model on the inputs of files",
}
"""Modules of this room, in the order in which a user meets them, and what they do."""


def main() -> None:
    """Start the command that the first word names; its own words follow."""
    word = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if word == "--version":
        print(f"lfrtorch {version('lfrtorch')}")
    elif word in ("--help", "-h"):
        print(usage())
    elif word in COMMANDS:
        sys.argv[:2] = [f"lfrtorch {word}"]
        import_module(f"lfrtorch.cli.{word}").launch()
    else:
        sys.exit(f"error: there is no command '{word}'.\n{usage()}")


def usage() -> str:
    """All commands, a line each."""
    lines = [f"  lfrtorch {name:10}{what}" for name, what in COMMANDS.items()]
    return "\n".join(["usage: lfrtorch COMMAND --help", *lines])
