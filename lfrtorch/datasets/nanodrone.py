"""NanoDrone: flights of a Crazyflie 2.1, an unstable system with four inputs and twelve outputs.

Inputs are the speeds of the four motors (rad/s), outputs position (m) and velocity (m/s) in the
frame of the room, roll, pitch and yaw (rad) and the body's rates (rad/s), at 100 Hz. A row holds
inputs and outputs of the same instant; the inputs of a row act on the outputs of the next one. The
first inputs of a flight are missing and replaced by the second ones. Angles are unwrapped.

The outputs 1 to 50 samples ahead of each sample are predicted from the inputs. A score is the sum
over these 50 samples of the mean error: Euclidean for position, velocity and rates, the angle
between the two attitudes for the attitude.

Four flights each of three kinds (squares, chirps and random flights) are for estimation, three of a
fourth kind, melon, for the test. The files are those of the release,
``train/chirp_20251017_run1.csv`` and so on, with quaternions for the attitude, or
``train_chirp_run1.npz`` with arrays u (N, 4) and y (N, 12) and the sampling frequency fs. The
reader of CSV files follows the description of the release; it was tested on files of that form, not
on the release itself.

A submission to the site has the four sums of ``melon``, each a mean over its flights.

References:
    Busetto et al., "NanoDrone: a benchmark for the identification of an aerial robot", Control
    Engineering Practice 172, 2026, 106871.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from jaxtyping import Float

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Channel, Record
from lfrtorch.datasets import official

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

__all__ = ["load"]

_FOLDER = "nanodrone"
_KINDS = ("chirp", "random", "square")  # kinds of flights for estimation
_TEST = "melon"  # kind of the test flights
_HOLDS = {
    ".npz": "arrays u, y and fs",
    ".csv": "columns t, x, y, z, qx to qw, vx to vz, wx to wz and m1_rads to m4_rads",
}
HORIZON = 50
"""Number of predicted samples that are scored."""

INPUTS = tuple(Channel(f"motor{i}", "rad/s") for i in range(1, 5))
OUTPUTS = tuple(
    Channel(name, unit)
    for names, unit in (
        (("x", "y", "z"), "m"),
        (("vx", "vy", "vz"), "m/s"),
        (("roll", "pitch", "yaw"), "rad"),
        (("p", "q", "r"), "rad/s"),
    )
    for name in names
)
_ANGLES = slice(6, 9)
_WEIGHT = np.repeat([1.0, 1.0, 4.0, 1.0], 3)
"""Weights of squared errors in a fit: attitude counts twice (``benchmarks/nanodrone.md``)."""

_ALL: Any = {"source": "official", "inputs": INPUTS, "outputs": OUTPUTS, "weight": _WEIGHT}
"""Source, channels and weights of all flights."""


def _euclidean(first: int) -> Callable[[Array, Array], Array]:
    """Euclidean error of three outputs from ``first`` on."""

    def error(y_hat: Float[Array, "n h 12"], y: Float[Array, "n h 12"]) -> Float[Array, "n h"]:
        return np.linalg.norm((y_hat - y)[..., first : first + 3], axis=-1)

    return error


def _geodesic(y_hat: Float[Array, "n h 12"], y: Float[Array, "n h 12"]) -> Float[Array, "n h"]:
    """Angle of the rotation between two attitudes, rad."""

    def attitude(signal: Array) -> Rotation:
        angles = signal[..., _ANGLES].reshape(-1, 3)
        return scipy.spatial.transform.Rotation.from_euler("xyz", angles)

    there = np.asarray(np.isfinite(y_hat).all(axis=-1))
    y_hat = np.where(np.expand_dims(there, -1), y_hat, 0.0)
    angle = (attitude(y_hat) * attitude(y).inv()).magnitude().reshape(y.shape[:2])
    return np.where(there, angle, np.inf)


MEASURES = {
    "position": _euclidean(0), "velocity": _euclidean(3), "attitude": _geodesic,
    "rates": _euclidean(9),
}  # fmt: skip
"""Errors (n, h) of predictions, by the names of the benchmark."""


def load(
    *, validation: int = 1, left_out: str | None = None, root: str | Path | None = None
) -> Dataset:
    """Flights for estimation by kind, and those of the test if their files exist.

    Args:
        validation: number of last flights of each kind that choose the iterate.
        left_out: a kind of flight, ``"chirp"``, ``"random"`` or ``"square"``, that replaces the
            official test and is not used for estimation.
        root: folder that holds ``nanodrone/train_*.npz`` and ``nanodrone/test_*.npz``, or the
            folders ``nanodrone/train/`` and ``nanodrone/test/`` of the release.

    Shape:
        u: (T, 4), y: (T, 12), T about 6000, or 1900 for squares.

    Example:
        >>> data = lfrtorch.datasets.nanodrone.load(root="benchmarks")  # doctest: +SKIP
    """
    integer("validation", validation, 0)
    if left_out is not None and left_out not in _KINDS:
        raise InputError(f"left_out is {left_out!r}; give one of {', '.join(_KINDS)}, or None.")
    folder = official.folder(root) / _FOLDER
    flights = {kind: _files(folder, "train", kind) for kind in _KINDS}
    missing = [kind for kind, found in flights.items() if len(found) <= validation]
    if missing:
        raise FileNotFoundError(
            f"'{folder}' holds {', '.join(f'{len(flights[k])} flights {k}' for k in missing)} "
            f"and {validation} of each kind validate; give the folder above nanodrone/ with "
            "train_chirp_run1.npz or train/chirp_..._run1.csv as root=DIR."
        )
    tests = _files(folder, "test", "")
    notes: tuple[str, ...] = ()
    if left_out is not None:
        tests = flights.pop(left_out)
        notes = (f"no official test: the flights {left_out} are left out of the estimation",)
    elif not tests:
        notes = ("no flight of the test is here (test_*.npz or test/*.csv): nothing is scored",)
    records = {kind: [_flight(path) for path in found] for kind, found in flights.items()}
    scored = [_flight(path) for path in tests]
    last = {kind: len(found) - validation for kind, found in records.items()}
    return Dataset(
        name="nanodrone",
        train=[r for kind, found in records.items() for r in found[: last[kind]]],
        validation=[r for kind, found in records.items() for r in found[last[kind] :]],
        tests=scored,
        groups={left_out or _TEST: tuple(r.name for r in scored)} if scored else {},
        ahead=MEASURES,
        published=() if left_out else official.published("nanodrone"),
        notes=notes,
    )


def _files(folder: Path, use: str, kind: str) -> list[Path]:
    """Files of the flights of one kind, as arrays or as in the release."""
    arrays = sorted(folder.glob(f"{use}_{kind}*.npz"))
    return arrays or sorted((folder / use).glob(f"{kind}*.csv"))


def _flight(path: Path) -> Record:
    """Read one file as a record."""
    read = _released if path.suffix == ".csv" else _arrays
    with official.readable(path, _HOLDS[path.suffix]):
        u, y, fs = (np.array(part, dtype=np.float64) for part in read(path))
    if u.ndim != 2 or y.ndim != 2 or u.shape[1:] != (4,) or y.shape != (len(u), 12) or len(u) < 2:
        raise InputError(
            f"'{path}' holds u of shape {u.shape} and y of shape {y.shape}; expected (N, 4) and "
            f"(N, 12): {official.again(path)}"
        )
    u[0] = np.where(np.isfinite(u[0]), u[0], u[1])
    y[:, _ANGLES] = np.unwrap(y[:, _ANGLES], axis=0)
    name = path.stem.removeprefix("train_").removeprefix("test_")
    return Record(u, y, float(fs), "measured", name=name, **_ALL)


def _arrays(path: Path) -> tuple[Array, Array, Array]:
    """Read u, y and fs from an archive of arrays."""
    with np.load(path, allow_pickle=False) as file:
        return file["u"], file["y"], file["fs"]


def _released(path: Path) -> tuple[Array, Array, float]:
    """Read u, y and fs from a file of the release."""
    table: Any = np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True, dtype=np.float64))

    def columns(*wanted: str) -> Array:
        return np.column_stack([table[name] for name in wanted])

    quaternions = columns("qx", "qy", "qz", "qw")
    attitude = scipy.spatial.transform.Rotation.from_quat(quaternions).as_euler("xyz")
    y = [columns("x", "y", "z", "vx", "vy", "vz"), attitude, columns("wx", "wy", "wz")]
    u = columns(*(f"m{i}_rads" for i in range(1, 5)))
    return u, np.hstack(y), float(1.0 / np.median(np.diff(columns("t"), axis=0)))
