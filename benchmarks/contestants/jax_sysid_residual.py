"""jax-sysid as its README: a residual recurrent network, 1000 Adam and 1000 L-BFGS evaluations."""

import jax
import jax.numpy as jnp
import numpy as np
from given import affordable, every_u, keep, order, u, y
from jax_sysid.models import Model
from jax_sysid.utils import standard_scale, unscale

jax.config.update("jax_enable_x64", True)
Ys, ymean, ygain = standard_scale(y)
Us, umean, ugain = standard_scale(u)
nx, ny, nu, nn = order, 1, 1, 5


def sigmoid(x):
    return 1.0 / (1.0 + jnp.exp(-x))


@jax.jit
def state_fcn(x, u, params):
    A, B, C, W1, W2, W3, b1, b2, W4, W5, b3, b4 = params
    return A @ x + B @ u + W3 @ sigmoid(W1 @ x + W2 @ u + b1) + b2


@jax.jit
def output_fcn(x, u, params):
    A, B, C, W1, W2, W3, b1, b2, W4, W5, b3, b4 = params
    return C @ x + W5 @ sigmoid(W4 @ x + b3) + b4


def fitted(evaluations):
    np.random.seed(0)
    rand = np.random.randn
    A, B, C = 0.5 * np.eye(nx), 0.1 * rand(nx, nu), 0.1 * rand(ny, nx)
    W1, W2, W3 = 0.1 * rand(nn, nx), 0.5 * rand(nn, nu), 0.5 * rand(nx, nn)
    W4, W5 = 0.5 * rand(nn, nx), 0.5 * rand(ny, nn)
    b1, b2, b3, b4 = np.zeros(nn), np.zeros(nx), np.zeros(nn), np.zeros(ny)
    model = Model(nx, ny, nu, state_fcn=state_fcn, output_fcn=output_fcn)
    model.init(params=[A, B, C, W1, W2, W3, b1, b2, W4, W5, b3, b4])
    model.loss(rho_x0=1e-4, rho_th=1e-4)
    model.optimization(adam_epochs=evaluations, lbfgs_epochs=evaluations)
    model.fit(Ys, Us)
    return model


model = fitted(affordable(fitted, 1000, first=1))
simulated, _ = model.predict(model.x0, (every_u - umean) * ugain)
keep(unscale(simulated, ymean, ygain))
