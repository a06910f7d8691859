"""Identified actuators of all joints of all robots, for simulators that step in batches.

``NAME.pt`` is written by ``lfrtorch export to=torch``; its inputs are the error of the joint's
position and its velocity, its output is the torque. The simulator has to call ``torques`` at the
model's rate, ``actuators.model.fs``. Nothing here needs lfrtorch.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

DCMotor: Any = object
with suppress(ImportError):
    from isaaclab.actuators import DCMotor  # pyright: ignore[reportMissingImports]


class Actuators:
    """The states of all actuators, and their torques."""

    def __init__(self, path: str, robots: int, joints: int, device: str = "cpu") -> None:
        self.model: Any = torch.jit.load(path, map_location=device)
        self.x = self.model.x_rest.repeat(robots, joints, 1)

    def reset(self, robots: Sequence[int] | slice = slice(None)) -> None:
        """Put the actuators of some robots at rest."""
        self.x[robots] = self.model.x_rest

    @torch.no_grad()
    def torques(self, error: Tensor, velocity: Tensor) -> Tensor:
        """Torques (robots, joints) of the next sample, from position errors and velocities."""
        u = torch.stack([error, velocity], dim=-1).flatten(0, 1)
        x, y = self.model(self.x.flatten(0, 1), u)
        self.x = x.view_as(self.x)
        return y.view_as(error)


class IdentifiedMotor(DCMotor):
    """An actuator of IsaacLab in the place of ActuatorNetMLP and ActuatorNetLSTM.

    ``IdentifiedMotorCfg = ActuatorNetLSTMCfg(class_type=IdentifiedMotor, network_file="motor.pt")``
    """

    def __init__(self, cfg: Any, *args: Any, **kwargs: Any) -> None:
        super().__init__(cfg, *args, **kwargs)
        sizes = self._num_envs, self.num_joints
        self.actuators = Actuators(cfg.network_file, *sizes, self._device)

    def reset(self, env_ids: Sequence[int]) -> None:
        """Put the actuators of some environments at rest."""
        self.actuators.reset(env_ids)

    def compute(self, control_action: Any, joint_pos: Tensor, joint_vel: Tensor) -> Any:
        """Replace wanted positions by torques."""
        self._joint_vel[:] = joint_vel
        error = control_action.joint_positions - joint_pos
        self.computed_effort = self.actuators.torques(error, joint_vel)
        self.applied_effort = self._clip_effort(self.computed_effort)
        control_action.joint_efforts = self.applied_effort
        control_action.joint_positions = control_action.joint_velocities = None
        return control_action
