"""Official measurements: found on disk, read, and cut in time."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from lfrtorch.checks import number
from lfrtorch.records import Record


def cache() -> Path:
    """Where the package nonlinear_benchmarks keeps its downloads."""
    if sys.platform == "win32":
        folder = os.environ.get("LOCALAPPDATA", "~/AppData/Local") + "/nonlinear_benchmarks"
    elif sys.platform == "darwin":
        folder = "~/Library/Application Support/nonlinear_benchmarks"
    else:
        folder = "~/.nonlinear_benchmarks"
    return Path(os.path.expanduser(folder))


def find(root: str | Path | None, file: str, loader: str) -> Path:
    """The path of a benchmark's file.

    Args:
        root: folder of the benchmarks; the cache folder of nonlinear_benchmarks where left out.
        file: below ``root``, with the benchmark's folder first.
        loader: function of nonlinear_benchmarks that downloads it.

    Raises:
        FileNotFoundError: it is not there.
    """
    folder = cache() if root is None else Path(root).expanduser()
    path = folder / file
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no '{file}' in '{folder}'. Give the folder that holds "
            f"'{file.split('/')[0]}' with data.root=DIR, or download the file into the default "
            f"folder: pip install nonlinear_benchmarks, then in Python "
            f"nonlinear_benchmarks.{loader}()."
        )
    return path


def read_mat(
    path: Path, names: Sequence[str], samples: int, advice: str = "download the file again."
) -> list[NDArray[np.float64]]:
    """Signals (samples,) that a .mat file holds as rows or columns, in the order of their names.

    Args:
        path: the file.
        names: of the signals.
        samples: of each.
        advice: what to do about a file that cannot be used.

    Raises:
        ValueError: a file that cannot be read, or another shape or type, or NaN.
    """
    signals = []
    for name in names:
        try:
            signal = np.asarray(loadmat(path, variable_names=[name])[name])
        except Exception as error:  # a damaged file makes loadmat raise any of a dozen kinds
            raise ValueError(
                f"'{path}' holds no readable '{name}' ({error!r}); {advice}"
            ) from error
        if (
            signal.dtype.kind not in "iuf"
            or signal.shape not in ((1, samples), (samples, 1))
            or not np.isfinite(signal).all()
        ):
            raise ValueError(
                f"'{path}': '{name}' has shape {signal.shape} and type {signal.dtype}; expected "
                f"(1, {samples}) or ({samples}, 1) and real numbers without NaN; {advice}"
            )
        signals.append(signal.ravel().astype(np.float64))
    return signals


def held_out(samples: int, validation: float, least: int = 1) -> int:
    """How many of the estimation samples, the last of them, validate.

    Args:
        samples: of the estimation part.
        validation: the fraction.
        least: samples that training needs.

    Raises:
        ValueError: a fraction that leaves too little to train or nothing to validate on.
    """
    number("data.validation", validation, positive=True)
    count = round(samples * min(validation, 1))
    if not 0 < count <= samples - least:
        raise ValueError(
            f"data.validation is {validation}, which leaves {samples - count} of the {samples} "
            f"estimation samples for training, and {count} to validate on; it needs {least} and 1 "
            "at least: give a fraction like 0.2."
        )
    return count


def part(whole: Record, first: int, last: int, *, warm_up: int, name: str) -> Record:
    """Samples ``first`` to ``last`` as a record that begins ``warm_up`` unscored samples earlier.

    It is simulated from zero state, and its transient falls into the warm-up: no state has to be
    estimated from outputs that are scored.
    """
    return replace(whole[first - warm_up : last], name=name, skip=warm_up)
