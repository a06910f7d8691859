"""The tanks under do-mpc, with the observer of lfrtorch.

do-mpc takes the exported function as the right-hand side of a discrete model, with the disturbances
of the pumps as states that stay; the observer tells it both at every sample.

    python examples/tank_do_mpc.py    # pip install 'lfrtorch[casadi]' do-mpc
"""

import casadi as ca
import do_mpc
import numpy as np
from quadruple_tank import HIGH, LOW, TS, QuadrupleTank, identified

import lfrtorch


def controller(model: lfrtorch.Model, wanted: np.ndarray) -> do_mpc.controller.MPC:
    """Level 1 stays below 17 cm. Who changes ``wanted`` in place changes the target."""
    f = lfrtorch.export.casadi_function(model)
    plant = do_mpc.model.Model("discrete", "SX")
    x = plant.set_variable("_x", "x", (f.size1_in("x"), 1))
    d = plant.set_variable("_x", "d", (2, 1))
    u = plant.set_variable("_u", "u", (2, 1))
    plant.set_variable("_tvp", "target", (2, 1))
    x_next, y = f(x, u + d)
    plant.set_rhs("x", x_next)
    plant.set_rhs("d", d)
    plant.set_expression("y", y)
    plant.setup()
    mpc = do_mpc.controller.MPC(plant)
    mpc.settings.n_horizon, mpc.settings.t_step = 30, TS
    mpc.settings.store_full_solution = False
    mpc.settings.supress_ipopt_output()
    mpc.set_objective(lterm=ca.sumsqr(plant.aux["y"] - plant.tvp["target"]), mterm=ca.DM(0))
    mpc.set_rterm(u=1.0)
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = LOW, HIGH
    mpc.set_nl_cons(
        "ceiling", plant.aux["y"][0], ub=17.0, soft_constraint=True, penalty_term_cons=100
    )
    ahead = mpc.get_tvp_template()

    def targets(_: float) -> object:
        ahead["_tvp", :, "target"] = wanted
        return ahead

    mpc.set_tvp_fun(targets)
    mpc.setup()
    return mpc


def closed_loop(
    model: lfrtorch.Model, noise: lfrtorch.NoiseCovariance, samples: int = 240
) -> np.ndarray:
    """Errors of the levels: 16 and 12 cm from sample 60 on, 0.4 V more on pump 1 from 140 on."""
    plant, observer = QuadrupleTank(seed=4), model.observer(noise=noise, disturbance="input")
    u, wanted, errors = np.array([3.0, 2.8]), np.array([12.0, 12.0]), []
    mpc = controller(model, wanted)
    for _ in range(300):
        plant.step(u)
    for k in range(samples):
        wanted[0] = 16.0 if k >= 60 else 12.0
        observer.correct(plant.measured(), u)
        known = np.append(observer.state, observer.disturbance)
        if k == 0:
            mpc.x0, mpc.u0 = known, u
            mpc.set_initial_guess()
        errors.append(plant.levels[:2] - wanted)
        u = mpc.make_step(known[:, None])[:, 0]
        observer.advance(u)
        plant.step(u + np.array([0.4 if k >= 140 else 0.0, 0.0]))
    return np.array(errors)


def main() -> None:
    """Identify, control, say how well."""
    errors = closed_loop(*identified())
    for name, end in (("before the load", 140), ("with 0.4 V more on pump 1", 240)):
        print(f"offset {name}: {errors[end - 30 : end].mean(axis=0).round(3)} cm")


if __name__ == "__main__":
    main()
