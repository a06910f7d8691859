"""The tanks under LQG with integral action, by python-control.

The model is linearised about the rest that ``trim`` found, with the integrals of the errors as two
more states; the observer is that of the nonlinear model. At a limit of a pump the integrals are set
to those that ask for the limit, so that they do not wind up.

    python examples/tank_lqg.py    # pip install 'lfrtorch[control]'
"""

import control
import numpy as np
from quadruple_tank import HIGH, LOW, QuadrupleTank, identified

import lfrtorch


def closed_loop(
    model: lfrtorch.Model, noise: lfrtorch.NoiseCovariance, step: float = 2.0, samples: int = 400
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the levels, and inputs: a step of level 1, and 0.4 V more on pump 1 from 150 on."""
    rest = lfrtorch.analysis.trim(model, y=[12.0, 12.0])
    local = lfrtorch.analysis.linearise(model, rest).to_control()
    weights = np.block([
        [local.C.T @ local.C + 1e-6 * np.eye(local.nstates), np.zeros((local.nstates, 2))],
        [np.zeros((2, local.nstates)), 0.02 * np.eye(2)],
    ])  # fmt: skip
    gain, _, _ = control.dlqr(local, weights, np.eye(2), integral_action=local.C)

    plant, observer = QuadrupleTank(seed=4), model.observer(noise=noise, x0=rest.x)
    u, integral, errors, inputs = rest.u, np.zeros(2), [], []
    for _ in range(300):
        plant.step(u)
    for k in range(samples):
        wanted = rest.y + np.array([step if 40 <= k < 250 else 0.0, 0.0])
        y = plant.measured()
        observer.correct(y, u)
        asked = rest.u - gain @ np.append(observer.state - rest.x, integral)
        u = np.clip(asked, LOW, HIGH)
        integral += np.linalg.solve(gain[:, -2:], asked - u) + y - wanted
        observer.advance(u)
        errors.append(plant.levels[:2] - wanted)
        inputs.append(u)
        plant.step(u + np.array([0.4 if k >= 150 else 0.0, 0.0]))
    return np.array(errors), np.array(inputs)


def main() -> None:
    """Identify, control, say how well."""
    errors, _ = closed_loop(*identified())
    for name, end in (("after a step", 150), ("with 0.4 V more on pump 1", 250), ("back", 400)):
        print(f"offset {name}: {errors[end - 30 : end].mean(axis=0).round(3)} cm")


if __name__ == "__main__":
    main()
