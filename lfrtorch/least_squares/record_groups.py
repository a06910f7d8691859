"""Groups of records that are simulated together, and the weights of their errors."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from lfrtorch._support.types import Array
from lfrtorch.data.records import NormalisedRecord, Record, Start
from lfrtorch.engine.record_starts import STARTS, AtRest
from lfrtorch.engine.weights import Weights

EVERY = slice(None)


@dataclass
class RecordGroup:
    """Normalised records of the same length and start, and the weights of their errors."""

    u: Float[Tensor, "R T nu"]
    y: Float[Tensor, "R T ny"]
    x0: Float[Tensor, "R nx"] | None  # given initial states, the same at every θ
    estimated: Int[Tensor, " R"] | None  # numbers of the initial states that are parameters
    scored: Float[Tensor, "R T ny"]
    weight: Float[Tensor, "R m ny"]  # weights of samples, or of the m = T // 2 + 1 spectral lines
    start_weight: Float[Tensor, "R T ny"] | None  # weights in the estimate of initial states
    spectral: bool
    start: AtRest
    # 1 if the measurement is at the sensor's upper limit, -1 at the lower limit, otherwise 0.
    beyond: Float[Tensor, "R T ny"] | None = None
    limits: Float[Tensor, "R 2 1 ny"] | None = None

    def part(self, records: Int[Tensor, " n"]) -> RecordGroup:
        """Some of the records."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        cut = {name: part[records] for name, part in own.items() if isinstance(part, Tensor)}
        return replace(self, **cut)

    def shown(self, y_hat: Float[Tensor, "R T ny"]) -> Float[Tensor, "R T ny"]:
        """An output clipped to the limits of the sensors, as it is scored."""
        return y_hat if self.limits is None else y_hat.clamp(*self.limits.unbind(1))

    def counted(self, y_hat: Float[Tensor, "R T ny"]) -> RecordGroup:
        """The group with weight 0 where a saturated measurement agrees with the output."""
        # If the measurement is at a limit and the model's output is beyond it, there is no error.
        if self.beyond is None:
            return self
        return replace(self, weight=self.weight * (self.beyond * (y_hat - self.y) <= 0))

    def weigh(
        self,
        errors: Float[Tensor, "R T ny *columns"],
        records: slice = EVERY,
        time: slice = EVERY,
    ) -> Float[Tensor, "R T ny *columns"]:
        """Weighted errors, or weighted rows of their Jacobian."""
        # A spectrum needs all samples. It has T real numbers: the real parts of all lines, and the
        # imaginary parts of the lines between 0 and fs / 2.
        weight = self.weight[records]
        if not self.spectral:
            weight = weight[:, time]
            return errors if self.plain else _columns(weight, errors) * errors
        spectrum = torch.fft.rfft(errors, dim=1)
        spectrum *= _columns(weight, spectrum)
        return torch.cat([spectrum.real, spectrum.imag[:, 1 : (errors.shape[1] + 1) // 2]], dim=1)

    @cached_property
    def plain(self) -> bool:
        """True if every sample has the same weight."""
        return not self.spectral and bool((self.weight == 1).all())

    def unweigh(self, r: Float[Tensor, "R T ny"]) -> Float[Tensor, "R T ny"]:
        """The adjoint of ``weigh``."""
        if not self.spectral:
            return self.weight * r
        T, m = self.u.shape[1], self.weight.shape[1]
        imag = pad(r[:, m:], (0, 0, 1, 2 * m - 1 - T))
        spectrum = self.weight * torch.complex(r[:, :m], imag)
        # irfft counts the lines between 0 and fs / 2 twice.
        spectrum[:, 1 : (T + 1) // 2] /= 2
        return T * torch.fft.irfft(spectrum, T, dim=1)


def group_records(
    records: Sequence[NormalisedRecord], model: Weights, own: slice = EVERY
) -> list[RecordGroup]:
    """Groups of records, as tensors of the model's dtype and device; ``own`` selects records."""
    members: dict[tuple[int, Start, bool], list[NormalisedRecord]] = defaultdict(list)
    estimated: dict[tuple[int, Start, bool], list[int]] = defaultdict(list)
    count = itertools.count()
    numbers = [next(count) if STARTS[each.record.start].fitted else 0 for each in records]
    for each, number in list(zip(records, numbers, strict=True))[own]:
        kind = each.record.samples, each.record.start, each.record.line_weight is not None
        members[kind].append(each)
        estimated[kind].append(number)
    groups = []

    def stacked(arrays: list[NDArray]) -> Tensor:
        return torch.tensor(np.stack(arrays)).to(model.flat)

    for kind, group in members.items():
        _, name, spectral = kind
        start, physical = STARTS[name], [each.record for each in group]
        u, y = stacked([each.u for each in group]), stacked([each.y for each in group])
        own_x0 = [record.x0 for record in physical if record.x0 is not None]
        groups.append(
            RecordGroup(
                u=u,
                y=y,
                x0=start.known(model, u, y, stacked(own_x0) if own_x0 else None),
                estimated=torch.tensor(estimated[kind]) if start.fitted else None,
                scored=stacked([r.scored for r in physical]),
                weight=stacked([_factors(r) for r in physical]),
                start_weight=stacked([r.start_factors for r in physical]) if start.fitted else None,
                spectral=spectral,
                start=start,
                beyond=stacked([r.beyond for r in physical])
                if any(r.limits is not None for r in physical)
                else None,
                limits=stacked([_limits(each) for each in group])
                if any(each.limits is not None for each in group)
                else None,
            )
        )
    return groups


def _limits(each: NormalisedRecord) -> Float[Array, "2 1 ny"]:
    """Limits of each output; infinite if there are none."""
    none = np.outer([-np.inf, np.inf], np.ones(each.y.shape[1]))
    return (none if each.limits is None else each.limits)[:, None]


def _factors(record: Record) -> Float[Array, "m ny"]:
    """Factors on the errors, or on their spectrum by ``rfft``."""
    T, ny = record.y.shape
    if record.line_weight is None:
        return record.factors
    # Parseval: Σ e² = Σ |E|² / T over all T lines; each line between 0 and fs / 2 counts twice.
    twice = np.full((T // 2 + 1, 1), 2.0)
    twice[0] = 1.0
    if T % 2 == 0:
        twice[-1] = 1.0
    return np.broadcast_to(
        np.sqrt(record.weight * record.line_weight * twice / T), (len(twice), ny)
    )


def _columns(weight: Float[Tensor, "R m ny"], like: Tensor) -> Tensor:
    """The weight with as many axes as the tensor that it multiplies."""
    return weight.reshape(*weight.shape, *[1] * (like.ndim - weight.ndim))
