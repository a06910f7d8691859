"""Settings that validate best: Optuna proposes, `lfrtorch.identify` tries.

python examples/optuna_search.py
"""

import numpy as np
import optuna

import lfrtorch


def measured(samples: int, seed: int) -> lfrtorch.Record:
    """Stand in for a measurement: a filter whose input saturates, with noise."""
    rng = np.random.default_rng(seed)
    u, y = rng.standard_normal(samples), np.zeros(samples)
    for k in range(1, samples):
        y[k] = 0.7 * y[k - 1] + np.tanh(2 * u[k - 1])
    return lfrtorch.Record(u, y + 0.01 * rng.standard_normal(samples), skip=20)


train, validation, test = (measured(600, seed) for seed in range(3))
data = lfrtorch.Dataset("saturation", [train], [validation], [test])


def identified(nn: int, ridge: float) -> lfrtorch.Run:
    """Fit one model."""
    trainer = lfrtorch.LevenbergMarquardt(max_iter=20)
    settings = lfrtorch.Settings(nx=1, nz=1, nn=nn, ridge=ridge, trainer=trainer)
    return lfrtorch.identify(data, settings)


def error(trial: optuna.Trial) -> float:
    """Return the validation error of what a trial proposes."""
    ridge = trial.suggest_float("ridge", 1e-8, 1e-2, log=True)
    return identified(trial.suggest_int("nn", 1, 8), ridge).metrics["validation"]["rmse"]


study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0))
study.optimize(error, n_trials=10)
print(study.best_params, identified(**study.best_params), sep="\n")
