"""Dead time of a linear model: the moment at which its step response leaves zero.

A sampled model with a held input has a continuous step response s(t) with the same samples. Its
first sample, at t = 0, is the feedthrough D, and s is continued to times before it by the logarithm
of the matrices: for a plant that begins to act a fraction of a sample before its first sample, s
crosses zero there. So a model with whole delays knows its dead time to fractions of a sample.

The times at which s(t) is zero within two standard errors are an interval; its middle is the dead
time, and a quarter of its length the standard error. (For a response that leaves zero with a slope
this is the error of s over the slope. A response that leaves zero as t² or t³, as behind several
lags, has no slope there, and a wide interval.) A model with one lag less and a longer dead time may
fit as well. So a few models that the data do not tell apart have the interval that spans theirs.

References:
    Franklin, Powell and Workman, "Digital Control of Dynamic Systems", 1998, section 4.3.
    Fieller, "Some problems in interval estimation", J. Royal Statistical Society B 16(2), 1954.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float

from lfrtorch._support.arguments import typed
from lfrtorch._support.tables import number
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel
from lfrtorch.linear.model import LinearModel

_FARTHEST = 3.0
"""Samples before and after the first sample of the response in which it is looked at: whole delays
are found to about two samples."""

_STEP = 0.002
"""Step of these times, in samples."""

_FASTEST = 1e-6
"""A pole nearer to 0 has no continuous response."""

_WITHIN = 0.5
"""Half a sample: the interval of a time within a sample that the model does not tell."""


@dataclass(frozen=True)
class DeadTime:
    """Time after which an input begins to act on the outputs.

    Args:
        input: the input.
        samples, std: dead time and its standard error, in samples.
        seconds: dead time in seconds.

    Example:
        >>> print(lfrtorch.analysis.dead_times(bla)[0])
        u: ... samples ...
    """

    input: Channel
    samples: float
    std: float
    seconds: float

    def __str__(self) -> str:
        own = f"{number(self.samples, 4)} ± {number(self.std, 2)} samples"
        return f"{self.input.name}: {own} ({number(self.seconds, 4)} s)"


@typed()
def dead_times(models: LinearModel | Sequence[LinearModel]) -> tuple[DeadTime, ...]:
    """Dead time of each input: the least over the outputs, with its standard error.

    A model without covariance or free feedthrough, or with a pole at 0, tells it to half a sample.

    Args:
        models: a model of ``Uncertainty.linearise`` or ``estimate_bla``, which have a covariance,
            or several of the same channels, of different orders for example.

    Example:
        >>> (found,) = lfrtorch.analysis.dead_times(bla)
        >>> bool(abs(found.samples) < 1), bool(found.std > 0)  # y(k+1) = 0.7 y(k) + u(k)
        (True, True)
    """
    every = [models] if isinstance(models, LinearModel) else list(models)
    ends = np.stack([_intervals(model) for model in every])
    early, late = ends[..., 0].min(0), ends[..., 1].max(0)
    pairs = zip(every[0].inputs, (early + late) / 2, (late - early) / 4, strict=True)
    fs = every[0].fs
    return tuple(DeadTime(u, float(t), float(std), float(t / fs)) for u, t, std in pairs)


def _intervals(model: LinearModel) -> Float[Array, "nu 2"]:
    """First and last time, in samples, at which the response to each input may leave zero."""
    covariance, (ny, nu) = model.covariance, model.D.shape
    delay = np.array(model.delay or (0,) * nu, float)
    found = np.stack([delay - _WITHIN, delay + _WITHIN], axis=1).clip(min=0.0)
    if covariance is None or np.abs(np.linalg.eigvals(model.A)).min() < _FASTEST:
        return found
    theta = np.concatenate([M.ravel() for M in (model.A, model.B, model.C, model.D)])
    free = np.diag(covariance)[-ny * nu :].reshape(ny, nu) > 0
    t = np.arange(-_FARTHEST, _FARTHEST + _STEP, _STEP)
    s, sizes = _steps(model, theta, t), 1e-6 * np.maximum(np.abs(theta), 1e-3 * np.abs(theta).max())
    changes = [h * e for h, e in zip(sizes, np.eye(len(theta)), strict=True)]
    J = np.stack([(_steps(model, theta + d, t) - _steps(model, theta - d, t)) for d in changes])
    J /= 2 * sizes[:, None, None, None]
    std = np.sqrt(np.einsum("itou,ij,jtou->tou", J, covariance, J).clip(np.finfo(float).tiny))
    for j in range(nu):
        own = [_interval(t, s[:, i, j], std[:, i, j]) for i in range(ny) if free[i, j]]
        if own:
            found[j] = delay[j] + np.array(min(own, key=lambda ends: ends[1]))
    return found.clip(min=0.0)


def _interval(t: Array, s: Array, std: Array) -> tuple[float, float]:
    """The interval in which s is zero within two standard errors, nearest to the first sample."""
    ratio, near = np.abs(s) / std, np.abs(t + _WITHIN)
    zero = ratio**2 <= ratio.min() ** 2 + 4.0
    best = np.flatnonzero(zero)[np.argmin(near[zero])]
    apart = np.flatnonzero(~zero)
    first = apart[apart < best].max(initial=-1) + 1
    last = apart[apart > best].min(initial=len(t)) - 1
    return float(t[first]) - _STEP / 2, float(t[last]) + _STEP / 2


def _steps(model: LinearModel, theta: Array, t: Float[Array, " t"]) -> Float[Array, "t ny nu"]:
    """Step response at times after its first sample, in samples, continued to times before it."""
    nx, nu, ny = model.nx, len(model.inputs), len(model.outputs)
    A, B, C, D = np.split(theta, np.cumsum([nx * nx, nx * nu, ny * nx]))
    M = np.eye(nx + nu)
    M[:nx, :nx], M[:nx, nx:] = A.reshape(nx, nx), B.reshape(nx, nu)
    # A pole on the negative real axis has a complex logarithm; its part is real at samples alone.
    G = np.asarray(scipy.linalg.logm(M))
    one, chunk = scipy.linalg.expm(_STEP * G), round(len(t) ** 0.5)
    fine = np.stack([np.linalg.matrix_power(one, k) for k in range(chunk)])
    coarse = np.stack([scipy.linalg.expm(begin * G) for begin in t[::chunk]])
    power = np.real(coarse[:, None] @ fine).reshape(-1, nx + nu, nx + nu)
    x = power[: len(t), :nx, nx:]
    return C.reshape(ny, nx) @ x + D.reshape(ny, nu)
