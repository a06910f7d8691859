"""Experiments made of known parts, and what their estimated covariances must be."""

import numpy as np
from reference import System, frf, periodic_response

from lfrtorch._support.types import Array
from lfrtorch.linear.frf import FRF
from lfrtorch.records import Record

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
