"""The numbers of freq-statespace at a θ; runs in its environment, from and to a .npz file.

.oracle/bin/python peer_freq_statespace.py IN.npz OUT.npz: u (T, nu, R), y (T, ny, R), fs, offset
(samples of the period that are simulated before it, from x = 0), dampings, u_offset, u_scale,
y_offset, y_scale, names (of the weights, in the order of θ) and the weights by these names.
"""

import sys

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import freq_statespace as fss  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import lineax as lx  # noqa: E402
import numpy as np  # noqa: E402
import optimistix as optx  # noqa: E402

given = np.load(sys.argv[1])
u, y, offset = given["u"], given["y"], int(given["offset"])
theta = {name: jnp.asarray(given[name]) for name in given["names"]}
nn, nz = theta["static.Wz"].shape
norm = fss.Normalizer(*(given[name] for name in ("u_offset", "u_scale", "y_offset", "y_scale")))


def model_at(theta):
    """The model with these weights."""
    network = fss.static.NeuralNetwork(nz, len(theta["static.bw"]), 1, nn, jax.nn.tanh)
    network = eqx.tree_at(
        lambda found: [part for layer in found.model.layers for part in (layer.weight, layer.bias)],
        network,
        [theta[f"static.{name}"] for name in ("Wz", "bz", "Ww", "bw")],
    )
    linear = (theta[name] for name in ("A", "Bu", "Cy", "Dyu", "Bw", "Cz", "Dyw", "Dzu"))
    return fss.ModelNonlinearLFR(*linear, network, ts=1 / float(given["fs"]), norm=norm)


def weights_of(model):
    """The weights of a model in the order of θ."""
    hidden, out = model.func_static.model.layers
    found = {
        "A": model.A, "Bu": model.B_u, "Bw": model.B_w, "Cz": model.C_z, "Dzu": model.D_zu,
        "Cy": model.C_y, "Dyu": model.D_yu, "Dyw": model.D_yw, "static.Wz": hidden.weight,
        "static.bz": hidden.bias, "static.Ww": out.weight, "static.bw": out.bias,
    }  # fmt: skip
    return jnp.concatenate([found[name].ravel() for name in theta])


def residual(theta):
    """The normalised errors in the order record, sample, output."""
    v = (u - norm.u_mean[:, None]) / norm.u_std[:, None]
    v = jnp.concatenate([v[len(v) - offset :], v])
    x0 = jnp.zeros((len(theta["A"]), u.shape[2]))
    y_hat = model_at(theta)._simulate(v, x0)[0][offset:]
    errors = y_hat - (y - norm.y_mean[:, None]) / norm.y_std[:, None]
    return errors.transpose(2, 0, 1).ravel()


r, pull_back = jax.vjp(residual, theta)
(gradient,) = pull_back(r)
columns = jax.jit(jax.jacfwd(residual))(theta)
J = jnp.concatenate([columns[name].reshape(len(r), -1) for name in theta], axis=1)
descent = optx.DampedNewtonDescent()
linearised = optx.FunctionInfo.ResidualJac(r, lx.MatrixLinearOperator(J))
at_theta = descent.query(None, linearised, None)
out = {
    "y": model_at(theta).simulate(u, offset=offset)[0],
    "r": r,
    "J": J,
    "gradient": jnp.concatenate([gradient[name].ravel() for name in theta]),
    "steps": [descent.step(jnp.asarray(1 / damping), at_theta)[0] for damping in given["dampings"]],
}
if offset:  # its own fit goes from θ to θ + δ, and accepts it: two iterations
    data = fss.create_data_object(u[..., None], y[..., None], float(given["fs"]))
    solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
    options = {"solver": solver, "max_iter": 2, "print_every": -1, "offset": offset}
    fitted = fss.nonlin.optimize(model_at(theta), data, freq_weighting=False, **options)
    out["first_step"] = weights_of(fitted) - weights_of(model_at(theta))
np.savez(sys.argv[2], **out)
