"""Experiments made of known parts, and what their estimated covariances must be."""

import numpy as np
import scipy.signal
from reference import System, frf, periodic_response

from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel, Record
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.model import LinearModel

FS, SEEDS = 50.0, 80


def true_frf(system: System, estimate: FRF) -> np.ndarray:
    return frf(system, 2 * np.pi * estimate.frequencies / estimate.fs)


def steady(system: System, u: Array) -> Array:
    """Steady-state responses (R, N, ny) to periods u (R, N, nu)."""
    return np.stack([periodic_response(system, u_r) for u_r in u])


def recorded(
    y: Array,  # (R, N, ny)
    u: Array,  # (R, N, nu)
    *,
    periods: int | list[int] = 1,
    noise: Array | None = None,  # (R, all samples, ny + nu), of output and input
    distortion: Array | None = None,  # (R, N, ny), the same in every period
) -> list[Record]:
    """Records of the periods y and u with offsets of 3 and 5, and what is added.

    Each channel has 1 more than the one before it, and each record than the one before it.
    """
    counts = [periods] * len(u) if isinstance(periods, int) else periods
    records = []
    for r, (plain, u_r, P) in enumerate(zip(y, u, counts, strict=True)):
        y_r = plain if distortion is None else plain + distortion[r]
        ny = y_r.shape[1]
        offset = np.concatenate([3.0 + np.arange(ny), 5.0 + np.arange(u_r.shape[1])]) + r
        signals = np.tile(np.concatenate([y_r, u_r], axis=1) + offset, (P, 1))
        if noise is not None:
            signals = signals + noise[r][: len(signals)]
        y, u_m = signals[:, :ny], signals[:, ny:]
        records.append(Record(u_m, y, FS, "periodic", period=len(u_r), name=f"r{r}"))
    return records


def check_covariance(errors: np.ndarray, covs: np.ndarray, freedom: float, share: float = 1.0):
    """The estimated covariances are, in the mean, that of the errors.

    For S seeds, F lines and a circular normal error d of n entries. A mean of |d|² has a relative
    variance of 1 / S, the mean of variances with as many degrees of freedom as ``freedom`` one of
    1 / (freedom S), and the F n entries add up to a sum of at least F independent ones (``share``
    of F, where neighbouring lines depend on each other). Entry by entry the difference of mean
    d dᴴ and mean covariance C has the variance C_ii C_jj (1 + 1 / freedom) / S at most; the mean
    square of it relative to that is 1 +- 1 / √(F) or less.

    Shape:
        errors: (S, F, n), covs: (S, F, n, n).
    """
    S, F = errors.shape[:2]
    C = covs.mean(axis=0)
    sample = np.einsum("sfi,sfj->fij", errors, errors.conj()) / S
    variances = np.einsum("fii->fi", C).real
    scatter = (1 + 1 / freedom) / S
    ratio = (np.einsum("fii->fi", sample).real / variances).mean()
    assert abs(ratio - 1) < 4 * np.sqrt(scatter / (F * share))
    bound = variances[:, :, None] * variances[:, None, :] * scatter
    relative = (np.abs(sample - C) ** 2).sum() / bound.sum()
    assert relative < 1 + 4 * np.sqrt(F / share) / F


def vec(estimate: FRF, G: np.ndarray) -> np.ndarray:
    return (estimate.G - G).reshape(len(estimate.G), -1)


def coloured(rng: np.random.Generator, shape: tuple[int, ...], channels: int) -> Array:
    """Normal noise whose second channel holds the first, a sample late: complex covariances."""
    e = rng.normal(size=(*shape, channels))
    e[:, :, -1] += 0.8 * np.roll(e[:, :, 0], 1, axis=1)
    return e


def slow_system() -> System:
    """Two poles of radius 0.97 at 0.3 rad: a transient of some 100 samples."""
    pole = 0.97 * np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    return pole, np.array([[0.3], [0.2]]), np.array([[1.0, 0.5]]), np.array([[0.1]])


# --- parts of long measurements -------------------------------------------------------------


def resonance(radius: float, angle: float, ny: int = 1) -> LinearModel:
    """A pole pair, seen in ``ny`` outputs."""
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    C = np.array([[1.0, 0.0], [0.5, 1.0]])[:ny]
    names = [tuple(Channel(f"{s}{i}") for i in range(n)) for s, n in (("u", 1), ("y", ny))]
    return LinearModel(
        A, np.array([[1.0], [0.3]]), C, np.zeros((ny, 1)), fs=1.0,
        u_offset=np.zeros(1), y_offset=np.zeros(ny), inputs=names[0], outputs=names[1],
    )  # fmt: skip


def noise_of(T: int, memory: float, seed: int, ny: int = 1) -> Array:
    """(T, ny), of unit variance, with a first-order spectrum."""
    e = np.random.default_rng([3, seed]).standard_normal((T, ny))
    e[1:] *= np.sqrt(1 - memory**2)
    return scipy.signal.lfilter([1.0], [1.0, -memory], e, axis=0)


def cut_from(
    model: LinearModel, T: int, memory: float, seed: int, level: float = 1.0
) -> tuple[Record, Array]:
    """A part of a longer measurement, with an estimated start, and its errors."""
    u = np.random.default_rng([1, seed]).standard_normal(T + 500)
    e = level * noise_of(T, memory, seed, len(model.outputs))
    y = model.simulate(u)[500:] + e
    record = Record(u[500:], y, start="estimated", inputs=model.inputs, outputs=model.outputs)
    return record, e


def scored(record: Record) -> tuple[int, int]:
    """First and last scored input sample, of records whose samples are their numbers."""
    return int(record.u[record.skip, 0]), int(record.u[-1, 0])
