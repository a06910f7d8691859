"""The words of the command ``lfrtorch preview``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ABOUT = """Look at measurements before any fit: a table, what will hurt a model, and a figure.

    lfrtorch preview x.csv
    lfrtorch preview x.csv data.inputs=[force] data.outputs=[displacement] data.fs=750
    lfrtorch preview data=file data.path='runs/*.mat' 'data.inputs=[Force (N)]' data.outputs=[acc]

The words are those of the other commands; a path may stand without data.path.

  data.inputs, data.outputs   names of columns, or numbers from 0. Without them all columns of
                              numbers are shown, and nothing is said of what lies between them
  data.fs, data.time          Hz, or the column of the time. Default: found
"""


def parser() -> argparse.ArgumentParser:
    """Reads the command line."""
    found = argparse.ArgumentParser(
        prog=sys.argv[0], description=ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("paths", nargs="*", metavar="PATH", help="file, or pattern in quotes")
    found.set_defaults(inputs=[], outputs=[], fs=None, time=None)  # words of data set them
    found.add_argument(
        "--out", type=Path, metavar="FIGURE.png", help="default: FOLDER_FILE_preview.png"
    )
    return found
