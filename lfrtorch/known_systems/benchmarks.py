"""Known models of benchmarks, as ``known._target_=`` names them."""

from __future__ import annotations

import torch
from torch import Tensor

from lfrtorch.model.known import Known, Parameter, State

_EMPTY = 1e-3
"""Lowest level at which the outflow has a slope, V: the slope of a root is infinite at 0."""

_SPILLS = 1.0
"""Rate of the overflow per level above the edge, 1/s: fast compared with samples of 4 s."""


def cascaded_tanks() -> Known:
    """Cascaded tanks, the upper one filled by a pump; levels in V.

    Both drain by a power of their level: 1/2 after Bernoulli, changed by hoses and by the sensor's
    offset. Part of the upper tank's overflow goes into the lower tank, which overflows at its own
    edge. The pump delivers nothing below some voltage.

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
"""Speed below which dry friction is smoothed, m/s."""


def emps(*, free: bool = False) -> Known:
    """Drive of a linear axis: a force moves a mass against viscous and dry friction.

    Parameters are per unit of mass, since the position does not determine the mass. An offset
    describes that friction differs between the two directions.

    Args:
        free: the learned part sees the position, too, and acts on the output, so that the model
            need not integrate. By default it sees the speed alone, and acts on it.

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
        outputs=lambda x, u, p: (x.position,),
        sees=["position", "speed"] if free else ["speed"],
        acts_on=["speed", "y"] if free else ["speed"],
        parameters={
            "gain": Parameter(0.35, low=0.0, unit="m/s² per V"),
            "viscous": Parameter(2.0, low=0.0, unit="1/s"),
            "dry": Parameter(0.2, low=0.0, unit="m/s²"),
            "offset": Parameter(0.0, scale=0.03, unit="m/s²"),
        },
    )


_GRAVITY = 9.81
"""Gravitational acceleration, m/s²."""

_SAMPLE = 0.01
"""Sampling time of the flights, s."""

_THOUSAND = 1e-3
"""Unit of motor speeds in the equations, rad/s."""

_HOVERING = 7.0
"""Sum of the four motor speeds in hover, 1000 rad/s."""


def nanodrone() -> Known:
    """Rigid body with four propellers: position, velocity, roll, pitch and yaw, body rates.

    The thrust along the body's vertical axis and the torques are sums of squares of the motor
    speeds. Air damps speeds and rates, and its flow across the propellers turns the body. The
    measured velocity comes from an estimator, so the position changes by a multiple of it. Rates
    ahead are uncertain, so the predicted rates are smaller than those that turn the body. A step
    over one sample uses the rates, and with them the attitude, at the middle of the sample.

    References:
        Mahony, Kumar and Corke, "Multirotor aerial vehicles: modeling, estimation, and control of
        quadrotor", IEEE Robotics and Automation Magazine 19(3), 2012.
    """

    def sample(x, u, p):
        motors = [_THOUSAND * speed for speed in u]
        first, second, third, fourth = (motor * motor for motor in motors)
        whole = first + second + third + fourth
        linear = motors[0] + motors[1] + motors[2] + motors[3] - _HOVERING
        sr, cr = torch.sin(x.roll), torch.cos(x.roll)
        sp, cp = torch.sin(x.pitch), torch.cos(x.pitch)
        sy, cy = torch.sin(x.yaw), torch.cos(x.yaw)
        # Axes of the body in the room: ahead, to the left and up.
        axes = (
            (cy * cp, sy * cp, -sp),
            (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr),
            (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr),
        )
        velocity = (x.vx, x.vy, x.vz)
        ahead, aside, rising = (
            sum(a * v for a, v in zip(axis, velocity, strict=True)) for axis in axes
        )
        forces = (
            p.push_x + p.tilt_x * whole - p.drag * ahead,
            p.push_y + p.tilt_y * whole - p.drag * aside,
            p.thrust * whole + p.linear * linear - p.drag_z * rising,
        )
        torques = (
            p.roll_gain * (third + fourth - first - second) + p.flow_x * aside
            - p.damp_x * x.p + p.bias_x + p.gyro_x * x.q * x.r,
            p.pitch_gain * (second + third - first - fourth) + p.flow_y * ahead
            - p.damp_y * x.q + p.bias_y + p.gyro_y * x.p * x.r,
            p.yaw_gain * (second + fourth - first - third)
            - p.damp_z * x.r + p.bias_z + p.gyro_z * x.p * x.q,
        )  # fmt: skip
        old = (x.p, x.q, x.r)
        rates = [rate + _SAMPLE * torque for rate, torque in zip(old, torques, strict=True)]
        roll, pitch, yaw = (0.5 * (a + b) for a, b in zip(old, rates, strict=True))
        roll = p.turn_x * roll + p.turn_roll * (third + fourth - first - second)
        pitch = p.turn_y * pitch + p.turn_pitch * (second + third - first - fourth)
        yaw = p.turn_z * yaw
        turning = (sr * pitch + cr * yaw) / cp
        angles = (
            x.roll + _SAMPLE * (roll + sp * turning),
            x.pitch + _SAMPLE * (cr * pitch - sr * yaw),
            x.yaw + _SAMPLE * turning,
        )
        weight = (0.0, 0.0, _GRAVITY)
        pull = [
            sum(f * axis[i] for f, axis in zip(forces, axes, strict=True)) - weight[i]
            for i in range(3)
        ]
        speeds = [v + _SAMPLE * a for v, a in zip(velocity, pull, strict=True)]
        moves = [v + p.lead * a for v, a in zip(speeds, pull, strict=True)]
        gains, places = (p.scale, p.scale, p.scale_z), (x.x, x.y, x.z)
        places = [s + _SAMPLE * gain * v for s, gain, v in zip(places, gains, moves, strict=True)]
        return (*places, *speeds, *angles, *rates)

    free = {
        "push_x": 0.1, "push_y": 0.1, "tilt_x": 0.02, "tilt_y": 0.02, "linear": 0.3, "lead": 0.02,
        "flow_x": 3.0, "flow_y": 3.0, "bias_x": 1.0, "bias_y": 1.0, "bias_z": 1.0, "gyro_x": 0.3,
        "gyro_y": 0.3, "gyro_z": 0.3, "turn_roll": 0.1, "turn_pitch": 0.1,
    }  # fmt: skip
    begun = {
        "scale": 1.0, "scale_z": 1.0, "thrust": 0.8, "drag": 0.5, "drag_z": 0.5, "roll_gain": 25.0,
        "pitch_gain": 20.0, "yaw_gain": 4.0, "damp_x": 3.0, "damp_y": 3.0, "damp_z": 6.0,
        "turn_x": 1.0, "turn_y": 1.0, "turn_z": 1.0,
    }  # fmt: skip
    units = {
        "m": ("x", "y", "z"), "m/s": ("vx", "vy", "vz"), "rad": ("roll", "pitch", "yaw"),
        "rad/s": ("p", "q", "r"),
    }  # fmt: skip
    return Known(
        sample,
        method="discrete",
        states=[State(name, unit=unit) for unit, names in units.items() for name in names],
        sees=["vx", "vy", "vz", "roll", "pitch", "p", "q", "r", "u"],
        acts_on=["vx", "vy", "vz", "p", "q", "r"],
        parameters={name: Parameter(0.0, scale=scale) for name, scale in free.items()}
        | {name: Parameter(value) for name, value in begun.items()},
    )
