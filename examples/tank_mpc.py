"""Predictive control without offset: CasADi and IPOPT, with a model of data in place of physics.

Every sample: the observer corrects the states and a disturbance of each pump by the measured
levels; ``trim`` says which input at rest has the wanted levels under that disturbance; IPOPT finds
the next 30 inputs. Pumps and their steps are limited, level 1 stays below 17 cm, and the model
within the region of its data. From sample 140 on, pump 1 has 0.4 V more, which nobody measures.

    python examples/tank_mpc.py [FIGURE.png]    # pip install 'lfrtorch[casadi]'
"""

import sys
import time
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from matplotlib.figure import Figure
from quadruple_tank import HIGH, LOW, TS, QuadrupleTank, identified

import lfrtorch

HORIZON, STEP, CEILING = 30, 0.5, 17.0  # samples; V a sample; cm
WANTED, LOADED = {0: (12.0, 12.0), 60: (16.0, 12.0), 220: (10.0, 15.0)}, 140  # cm from a sample on


class Predictive:
    """Inputs that bring the levels to a target."""

    def __init__(self, model: lfrtorch.Model) -> None:
        f = lfrtorch.export.casadi_function(model)
        reach = lfrtorch.export.casadi_reach(model)
        nx, nu = f.size1_in("x"), f.size1_in("u")
        X, U = ca.SX.sym("X", nx, HORIZON + 1), ca.SX.sym("U", nu, HORIZON)
        slack = ca.SX.sym("slack", 2)
        start, before, d = ca.SX.sym("start", nx), ca.SX.sym("before", nu), ca.SX.sym("d", nu)
        y_s, u_s = ca.SX.sym("y_s", 2), ca.SX.sym("u_s", nu)
        cost, equal, below, steps = 1e3 * ca.sum1(slack), [X[:, 0] - start], [], []
        for k in range(HORIZON):
            v = U[:, k] + d
            x_next, y = f(X[:, k], v)
            step = U[:, k] - (U[:, k - 1] if k else before)
            cost += ca.sumsqr(y - y_s) + 0.05 * ca.sumsqr(U[:, k] - u_s) + ca.sumsqr(step)
            equal.append(X[:, k + 1] - x_next)
            steps.append(step)
            below += [y[0] - CEILING - slack[0], reach(X[:, k], v) - 1.0 - slack[1]]
        problem = {
            "x": ca.veccat(X, U, slack),
            "p": ca.vertcat(start, before, d, y_s, u_s),
            "f": cost,
            "g": ca.vertcat(*equal, *steps, *below),
        }
        quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
        warm = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3}
        self._solver = ca.nlpsol("mpc", "ipopt", problem, quiet | warm)
        states, inputs = nx * (HORIZON + 1), nu * HORIZON
        self._limits = {
            "lbx": np.r_[np.full(states, -np.inf), np.full(inputs, LOW), 0.0, 0.0],
            "ubx": np.r_[np.full(states, np.inf), np.full(inputs, HIGH), np.inf, np.inf],
            "lbg": np.r_[np.zeros(states), np.full(inputs, -STEP), np.full(len(below), -np.inf)],
            "ubg": np.r_[np.zeros(states), np.full(inputs, STEP), np.zeros(len(below))],
        }
        self._first = slice(states, states + nu)
        self._guess: dict[str, Any] = {}

    def __call__(
        self, x: np.ndarray, before: np.ndarray, d: np.ndarray, target: lfrtorch.analysis.Trim
    ) -> np.ndarray:
        """The next input, from the states, the input before, the disturbance and the target."""
        p = np.concatenate([x, before, d, target.y, target.u - d])
        if not self._guess:
            stays = np.tile(x, HORIZON + 1), np.tile(before, HORIZON), np.zeros(2)
            self._guess = {"x0": np.concatenate(stays)}
        found = self._solver(p=p, **self._guess, **self._limits)
        assert self._solver.stats()["success"]
        self._guess = {"x0": found["x"], "lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}
        return np.asarray(found["x"])[self._first, 0]


def closed_loop(
    model: lfrtorch.Model,
    noise: lfrtorch.NoiseCovariance,
    schedule: Mapping[int, tuple[float, float]] = WANTED,
    samples: int = 320,
) -> dict[str, np.ndarray]:
    """Plant, observer and controller."""
    plant, controller = QuadrupleTank(seed=4), Predictive(model)
    observer = model.observer(noise=noise, disturbance="input")
    u, wanted, signals = np.array([3.0, 2.8]), np.zeros(2), []
    for _ in range(300):
        plant.step(u)
    for k in range(samples):
        wanted = np.array(schedule.get(k, wanted))
        began = time.perf_counter()
        observer.correct(plant.measured(), u)
        d = observer.disturbance
        target = lfrtorch.analysis.trim(model, y=wanted, bounds=(LOW + d, HIGH + d))
        u = controller(observer.state, u, d, target)
        observer.advance(u)
        took = time.perf_counter() - began
        signals.append((plant.levels[:2].copy(), wanted, u, d, np.array([took])))
        plant.step(u + np.array([0.4 if k >= LOADED else 0.0, 0.0]))
    names = "levels", "wanted", "u", "disturbance", "seconds"
    return {name: np.array(s) for name, s in zip(names, zip(*signals, strict=True), strict=True)}


def figure(found: dict[str, np.ndarray]) -> Figure:
    """Levels, inputs, and the disturbance as the observer sees it."""
    drawn = Figure(figsize=(8, 6), layout="constrained")
    axes = drawn.subplots(3, sharex=True)
    t = TS / 60 * np.arange(len(found["u"]))
    axes[0].plot(t, found["levels"], label=["level 1", "level 2"])
    axes[0].plot(t, found["wanted"], "k:", drawstyle="steps-post")
    axes[0].axhline(CEILING, color="0.7")
    axes[1].plot(t, found["u"], drawstyle="steps-post", label=["pump 1", "pump 2"])
    axes[2].plot(t, found["disturbance"], label=["on pump 1", "on pump 2"])
    for ax, name in zip(axes, ("level (cm)", "input (V)", "disturbance (V)"), strict=True):
        ax.set_ylabel(name)
        ax.legend(loc="upper left")
    axes[2].set_xlabel("time (min)")
    return drawn


def main() -> None:
    """Identify, control, say how well."""
    found = closed_loop(*identified())
    error, seconds = found["levels"] - found["wanted"], 1e3 * found["seconds"]
    for name, end in (("at 16 and 12 cm", 140), ("with 0.4 V more", 220), ("at 10 and 15 cm", 320)):
        print(f"offset {name}: {error[end - 30 : end].mean(axis=0).round(3)} cm")
    print(f"a sample takes {np.median(seconds):.1f} ms, 95 % {np.percentile(seconds, 95):.1f} ms")
    for path in sys.argv[1:]:
        figure(found).savefig(path, dpi=100)


if __name__ == "__main__":
    main()
