"""Programs of torch: the model's numbers in float32, for batches, without lfrtorch."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from exported import MODELS, inputs
from reference import random_cell, random_model

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.export import torch_modules, write
from lfrtorch.export.equations import equations
from lfrtorch.export.torch_program import _own
from lfrtorch.model.model import Model

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
pytest.importorskip("torch._higher_order_ops.scan", reason="torch.export has no scan before 2.6")

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SINGLE = 1e-5  # of the output's rms


class Law(torch.nn.Module):
    """A law of one's own, of torch's layers."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(2, 2)

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.softsign(self.layer(z)) * z.abs().amax(-1, keepdim=True)


class Branches(torch.nn.Linear):
    def forward(self, input: torch.Tensor) -> torch.Tensor:
        return super().forward(input) if input.sum() > 0 else -input


OWN = random_model(random_cell(2, 2, 3, 2, 2, static=Law(), feedback=0.05))


def check(y: Any, model: Model, u: Array, x0: Array) -> None:
    """An output is that of the model to 1e-5 of its rms."""
    expected = model.simulate(u, start="given", x0=x0)
    error = np.sqrt(np.mean((y.double().numpy() - expected) ** 2, axis=0))
    assert (error <= SINGLE * expected.std(axis=0)).all()


FAST = "tanh", "own"  # tracing takes seconds


@pytest.mark.numeric
@pytest.mark.parametrize(
    "name",
    [*FAST, *(pytest.param(n, marks=pytest.mark.slow) for n in MODELS if n not in FAST)],
)
def test_programs_are_the_model(name: str):
    model = OWN if name == "own" else MODELS[name]
    script, sample, sequence = torch_modules(model, name)
    nx = model.lfr.cell.nx
    u, x0 = inputs(model, 400), np.stack([np.zeros(nx), np.ones(nx)])
    batch = torch.tensor(np.stack([u, u]), dtype=torch.float32), torch.tensor(x0).float()
    for run in (script.simulate, sequence.module()):
        _, y = run(batch[1], batch[0])
        for i in range(2):
            check(y[i], model, u, x0[i])
    x, found = batch[1], []
    for k in range(400):
        x, y = (script, sample.module())[k % 2](x, batch[0][:, k])
        found.append(y[1])
    check(torch.stack(found), model, u, x0[1])
    np.testing.assert_allclose(
        script.x_rest.numpy(), equations(model, "m", _own).x_rest, rtol=1e-6, atol=1e-6
    )
    assert script.fs == model.fs


@pytest.mark.numeric
def test_files_need_torch_alone(tmp_path: Path):
    model = MODELS["tanh"]
    paths = write(model, "torch", tmp_path, name="motor")
    assert [path.name for path in paths] == ["motor.pt", "motor.pt2", "motor_simulate.pt2"]
    u = inputs(model, 50)
    np.save(tmp_path / "u.npy", u)
    code = """
import sys
sys.modules["lfrtorch"] = None  # any import of it is an error
import json, numpy as np, torch
u = torch.tensor(np.load("u.npy"), dtype=torch.float32).expand(7, -1, -1)
about = {"channels.json": ""}
script = torch.jit.load("motor.pt", _extra_files=about)
assert json.loads(about["channels.json"])["name"] == "motor"
sequence = torch.export.load("motor_simulate.pt2").module()
x0 = torch.zeros(7, 4)
y = script.simulate(x0, u)[1]
assert torch.allclose(sequence(x0, u)[1], y, rtol=1e-4, atol=1e-4)
np.save("y.npy", y[6].numpy())
"""
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    check(torch.tensor(np.load(tmp_path / "y.npy")), model, u, np.zeros(4))


def test_a_map_that_branches_is_refused():
    model = random_model(random_cell(1, 1, 1, 1, 1, static=Branches(1, 1)))
    with pytest.raises(InputError, match=r"(?s)static map Branches cannot be traced by torch"):
        torch_modules(model)


@pytest.mark.numeric
def test_actuators_of_a_robot_simulator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    robot_actuator = import_module("robot_actuator")

    model = random_model(random_cell(2, 1, 2, 1, 1, 3))
    (path, *_) = write(model, "torch", tmp_path)

    class DCMotor:
        """What IsaacLab's class has, as far as it is used."""

        def __init__(self, cfg: Any, *args: Any, **kwargs: Any) -> None:
            self._num_envs, self.num_joints, self._device = 3, 2, "cpu"
            self._joint_vel = torch.zeros(3, 2)

        def _clip_effort(self, effort: torch.Tensor) -> torch.Tensor:
            return effort.clamp(-1e3, 1e3)

    body = dict(vars(robot_actuator.IdentifiedMotor))
    body = {name: body[name] for name in ("reset", "compute")}

    def begin(self: Any, cfg: Any) -> None:
        DCMotor.__init__(self, cfg)
        self.actuators = robot_actuator.Actuators(cfg.network_file, 3, 2, self._device)

    motor: Any = type("Motor", (DCMotor,), {**body, "__init__": begin})(
        SimpleNamespace(network_file=str(path))
    )
    u = np.stack([inputs(model, 60) + i for i in range(6)])  # of each joint
    torques = []
    for k in range(60):
        wanted, velocity = torch.tensor(u[:, k], dtype=torch.float32).T.reshape(2, 3, 2)
        action = SimpleNamespace(joint_positions=wanted, joint_velocities=None, joint_efforts=None)
        motor.compute(action, torch.zeros(3, 2), velocity)
        torques.append(action.joint_efforts.flatten())
    rest = motor.actuators.model.x_rest.double().numpy()
    for joint in range(6):
        check(torch.stack(torques)[:, joint : joint + 1], model, u[joint], rest)
    motor.reset([1])
    moved = (motor.actuators.x != motor.actuators.model.x_rest).any(-1)
    assert moved.tolist() == [[True, True], [False, False], [True, True]]
