"""Fit many settings on many cores or machines: a task of Ray for each `lfrtorch.identify`.

python examples/ray_sweep.py
"""

import numpy as np
import ray
import torch

import lfrtorch


def measured(samples: int, seed: int) -> lfrtorch.Record:
    """Stand in for a measurement: a filter whose input saturates, with noise."""
    rng = np.random.default_rng(seed)
    u, y = rng.standard_normal(samples), np.zeros(samples)
    for k in range(1, samples):
        y[k] = 0.7 * y[k - 1] + np.tanh(2 * u[k - 1])
    return lfrtorch.Record(u, y + 0.01 * rng.standard_normal(samples), skip=20)


@ray.remote(num_cpus=1)
def identified(data: lfrtorch.Dataset, nn: int, seed: int) -> tuple[float, int, int]:
    """Fit one model on one thread; its validation error and what made it."""
    torch.set_num_threads(1)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=20)
    settings = lfrtorch.Settings(nx=1, nz=1, nn=nn, seed=seed, trainer=trainer)
    run = lfrtorch.identify(data, settings)
    return run.metrics["validation"]["rmse"], nn, seed


if __name__ == "__main__":
    train, validation, test = (measured(600, seed) for seed in range(3))
    data = ray.put(lfrtorch.Dataset("saturation", [train], [validation], [test]))
    tasks = [identified.remote(data, nn, seed) for nn in (2, 4, 8) for seed in range(2)]
    for error, nn, seed in sorted(ray.get(tasks)):
        print(f"nn={nn} seed={seed}: {error:.4f} rms on validation")
    ray.shutdown()  # ray.init(address="auto") before the first task joins a cluster
