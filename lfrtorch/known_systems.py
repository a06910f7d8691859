"""Known models of benchmarks, as ``known._target_=`` names them."""

from __future__ import annotations

import torch
from torch import Tensor

from lfrtorch.known import Known, Parameter, State

_EMPTY = 1e-3
"""Least level whose outflow has a slope, V: that of a root is infinite at 0."""

_SPILLS = 1.0
"""Outflow by overflow, 1/s times the level above the edge: fast beside samples of 4 s."""


def cascaded_tanks() -> Known:
    """Two tanks in a cascade, the upper one filled by a pump; levels in V.

    Both drain by a power of their level (a half after Bernoulli; hoses and a level that the sensor
    sees from elsewhere make it another). What flows over the edge of the upper tank goes partly
    into the lower one, and that ends at its own edge. The pump lifts nothing below some voltage.

    References:
        Schoukens, Mattson, Wigren and Noël, "Cascaded tanks benchmark combining soft and hard
        nonlinearities", Workshop on Nonlinear System Identification Benchmarks, 2016.
    """

    def drain(level: Tensor, p_gain: Tensor, power: Tensor) -> Tensor:
        return p_gain * torch.exp(power * torch.log(level.clamp(min=_EMPTY)))

    def rates(x, u, p):
        first = drain(x.h1, p.out1, p.power1)
        second = drain(x.h2 + p.below2, p.out2, p.power2)
        over = _SPILLS * torch.relu(x.h1 - p.edge1)
        lost = p.spills2 * torch.relu(x.h2 - p.edge2)
        upper = p.pump * u[0] + p.lift - first - over
        return upper, first - second + p.caught * over - lost

    return Known(
        rates,
        states=["h1", "h2"],
        outputs=lambda x, u, p: (x.h2,),
        substeps=4,
        parameters={
            "pump": Parameter(0.08, low=0.0, unit="1/s"),
            "lift": Parameter(-0.1, scale=0.05, unit="V/s"),
            "out1": Parameter(0.08, low=0.0),
            "power1": Parameter(0.5, low=0.1, high=1.5),
            "out2": Parameter(0.05, low=0.0),
            "below2": Parameter(-2.0, low=-10.0, scale=2.0, unit="V"),
            "power2": Parameter(0.5, low=0.1, high=1.5),
            "edge1": Parameter(10.0, low=1.0, scale=2.0, unit="V"),
            "caught": Parameter(0.4, low=0.0, high=2.0),
            "edge2": Parameter(10.0, low=9.5, high=10.5, unit="V"),
            "spills2": Parameter(0.2, low=0.0, high=1.0, unit="1/s"),
        },
    )


_STICKS = 5e-4
"""Speed below which dry friction is no longer whole, m/s."""


def emps() -> Known:
    """The drive of a linear axis: a force moves a mass against viscous and dry friction.

    Per unit of mass, as a position alone does not tell it. The friction is another to each side,
    which the offset and the slope with the speed describe.

    References:
        Janot, Gautier and Brunot, "Data set and reference models of EMPS", Workshop on Nonlinear
        System Identification Benchmarks, 2019.
    """

    def rates(x, u, p):
        friction = p.viscous * x.speed + p.dry * torch.tanh(x.speed / _STICKS)
        return x.speed, p.gain * u[0] - friction - p.offset

    return Known(
        rates,
        states=[State("position", unit="m"), State("speed", unit="m/s")],
        sees=["speed"],
        acts_on=["speed"],
        parameters={
            "gain": Parameter(0.35, low=0.0, unit="m/s² per V"),
            "viscous": Parameter(2.0, low=0.0, unit="1/s"),
            "dry": Parameter(0.2, low=0.0, unit="m/s²"),
            "offset": Parameter(0.0, scale=0.03, unit="m/s²"),
        },
    )
