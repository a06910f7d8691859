"""The words of the command ``lfrtorch preview``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ABOUT = """Look at measurements before any fit: a table, what will hurt a model, and a figure.

    lfrtorch preview x.csv --inputs force --outputs displacement --fs 750
    lfrtorch preview 'runs/*.mat' --inputs u --outputs y

    lfrtorch preview data.path=x.mat 'data.inputs=[Force (N)]' data.outputs=[acc]

A file is any that data.path takes; the words data.path, data.inputs, data.outputs, data.fs and
data.time of the other commands are understood. Without --inputs and --outputs all columns of
numbers are shown, and nothing is said of what lies between them.
"""


def parser() -> argparse.ArgumentParser:
    """Reads the command line."""
    found = argparse.ArgumentParser(
        prog=sys.argv[0], description=ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("paths", nargs="*", metavar="PATH", help="file, or pattern in quotes")
    found.add_argument("--inputs", nargs="+", default=[], metavar="NAME", type=column)
    found.add_argument("--outputs", nargs="+", default=[], metavar="NAME", type=column)
    found.add_argument("--fs", type=float, metavar="HZ", help="sampling frequency")
    found.add_argument("--time", type=column, metavar="COLUMN", help="of times; found if not given")
    found.add_argument("--out", type=Path, metavar="FIGURE.png", help="default: FILE_preview.png")
    return found


def column(word: str) -> str | int:
    """A column's name or number."""
    return int(word) if word.isdecimal() else word
