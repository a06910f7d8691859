"""A pendulum in MuJoCo, driven by a motor that was identified from a log of 20 s.

The true motor has a current loop of 15 ms, saturates, and has dry friction with memory, the
bristles of Dahl's model. Its log has position errors, joint velocities and torques with noise of
1 %. An NL-LFR is identified and exported to TorchScript, and a multilayer perceptron of as many
parameters is trained on the same log, on a history of errors and velocities, as legged_gym's
actuator nets are. Then MuJoCo steps the pendulum in closed loop with each of the three motors.

    python examples/mujoco_pendulum.py    # pip install mujoco
"""

import numpy as np
import torch
from robot_actuator import Actuators

import lfrtorch

FS, SECONDS, NOISE = 500, 20, 0.01
HISTORY = 0, 2, 4  # samples back

PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body>
    <joint name="hinge" type="hinge" axis="0 1 0" damping="0.01" armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.4"/>
  </body></worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


class TrueMotor:
    """The motor on the test bench."""

    def __init__(self) -> None:
        self.current = self.bristles = 0.0

    def torque(self, error: float, velocity: float) -> float:
        """Torque of a sample; the states go on to the next one."""
        found = 2.5 * np.tanh(self.current / 2.5) - 0.4 * self.bristles - 0.03 * velocity
        for _ in range(10):
            self.current += (6.0 * error - self.current) / (0.015 * FS * 10)
            self.bristles += 10.0 * (velocity - abs(velocity) * self.bristles) / (FS * 10)
        return float(found)


class Identified:
    """The exported model."""

    def __init__(self, path: str) -> None:
        self.actuators = Actuators(path, robots=1, joints=1)

    def torque(self, error: float, velocity: float) -> float:
        """Torque of a sample."""
        u = (torch.tensor([[value]], dtype=torch.float32) for value in (error, velocity))
        return float(self.actuators.torques(*u))


class Perceptron:
    """A network of the history of errors and velocities."""

    def __init__(self, net: torch.nn.Module) -> None:
        self.net, self.past = net, np.zeros((max(HISTORY) + 1, 2))

    def torque(self, error: float, velocity: float) -> float:
        """Torque of a sample."""
        self.past = np.vstack([[error, velocity], self.past[:-1]])
        with torch.no_grad():
            return float(self.net(torch.tensor(self.past[[*HISTORY]].ravel(), dtype=torch.float32)))


def closed_loop(motor: TrueMotor | Identified | Perceptron, wanted: np.ndarray) -> np.ndarray:
    """Errors of the position, velocities, torques and angles, (T, 4)."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(PENDULUM)
    data = mujoco.MjData(model)
    rows = []
    for target in wanted:
        angle, velocity = data.qpos[0], data.qvel[0]
        torque = motor.torque(target - angle, velocity)
        rows.append([target - angle, velocity, torque, angle])
        data.ctrl[0] = torque
        mujoco.mj_step(model, data)
    return np.array(rows)


def targets(seed: int) -> np.ndarray:
    """Wanted angles: random steps, and slow random motion."""
    rng = np.random.default_rng(seed)
    steps = np.repeat(rng.uniform(-1.0, 1.0, SECONDS * 2), FS // 2)
    t = np.arange(len(steps)) / FS
    waves = (
        np.sin(2 * np.pi * f * t + p)
        for f, p in zip(rng.uniform(0.2, 3.0, 5), rng.uniform(0, 6, 5), strict=True)
    )
    return 0.6 * steps + 0.2 * sum(waves)


def trained(log: np.ndarray, torque: np.ndarray, size: int) -> torch.nn.Module:
    """A perceptron of about ``size`` parameters, by Adam and, at the end, L-BFGS."""
    torch.manual_seed(0)
    rows = np.hstack([np.roll(log, back, axis=0) for back in HISTORY])[max(HISTORY) :]
    x = torch.tensor(rows, dtype=torch.float32)
    y = torch.tensor(torque[max(HISTORY) :, None], dtype=torch.float32)
    hidden = max(2, round((size - 1) / (x.shape[1] + 2)))
    scale = torch.nn.Linear(x.shape[1], x.shape[1])
    with torch.no_grad():
        scale.weight.copy_(torch.diag(1.0 / x.std(0)))
        scale.bias.copy_(-x.mean(0) / x.std(0))
    scale.requires_grad_(False)
    net = torch.nn.Sequential(
        scale, torch.nn.Linear(x.shape[1], hidden), torch.nn.Tanh(), torch.nn.Linear(hidden, 1)
    )
    free = [p for p in net.parameters() if p.requires_grad]
    adam = torch.optim.Adam(free, lr=1e-2)
    for _ in range(1000):
        adam.zero_grad()
        torch.nn.functional.mse_loss(net(x), y).backward()
        adam.step()
    search = torch.optim.LBFGS(free, max_iter=500, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        search.zero_grad()
        found = torch.nn.functional.mse_loss(net(x), y)
        found.backward()
        return found

    search.step(loss)
    return net


def main() -> dict[str, float]:
    """Log, identify, export, and compare; returns rms errors of the angle in degrees."""
    log = closed_loop(TrueMotor(), targets(0))
    inputs, rng = log[:, :2], np.random.default_rng(1)
    torque = log[:, 2] + NOISE * log[:, 2].std() * rng.standard_normal(len(log))
    record = lfrtorch.Record(
        inputs, torque, fs=FS, start="zero",
        inputs=(lfrtorch.Channel("error", "rad"), lfrtorch.Channel("velocity", "rad/s")),
        outputs=(lfrtorch.Channel("torque", "N m"),),
    )  # fmt: skip
    settings = lfrtorch.Settings(nx=2, nz=3, nw=2, nn=10, starts=8)
    run = lfrtorch.identify(record, settings)
    print(run.verdict)
    lfrtorch.export.write(run.model, "torch", "motor", name="motor", overwrite=True)
    size = run.model.parameter_count
    net = trained(inputs, torque, size)

    wanted = targets(2)
    truth = closed_loop(TrueMotor(), wanted)[:, 3]
    errors = {}
    for name, motor in (("NL-LFR", Identified("motor/motor.pt")), ("perceptron", Perceptron(net))):
        angle = closed_loop(motor, wanted)[:, 3]
        errors[name] = float(np.degrees(np.sqrt(np.mean((angle - truth) ** 2))))
        print(f"{name}, {size} parameters: {errors[name]:.3f} degrees rms beside the true motor")
    return errors


if __name__ == "__main__":
    main()
