"""A static map of one's own: a physical law with two parameters in place of the network.

A mass on a spring that hardens: the restoring force is k z + a z³ + b |z| z. The linear part is
the model's own; the law below is the rest. Any torch module from (..., nz) to (..., nw) will do.

    python examples/own_static_map.py
"""

import numpy as np
import torch

import lfrtorch


class HardeningSpring(torch.nn.Module):
    """w = a z³ + b |z| z."""

    def __init__(self) -> None:
        super().__init__()
        self.a = torch.nn.Parameter(torch.zeros(()))
        self.b = torch.nn.Parameter(torch.zeros(()))

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        """Shape: z: (..., 1) -> w: (..., 1)."""
        return self.a * z**3 + self.b * z.abs() * z


def measured(samples: int, seed: int) -> lfrtorch.Record:
    """What stands for a measurement: a mass of 4 g, sampled at 500 Hz, 20 µm rms of noise."""
    rng = np.random.default_rng(seed)
    fs, mass, damping, stiffness, cubic = 500.0, 4e-3, 0.08, 40.0, 4e5
    white = 0.3 * rng.standard_normal(samples)
    force = np.convolve(white, np.ones(8) / np.sqrt(8), mode="same").astype(np.float64)
    x = v = 0.0
    displacement = []
    for f in force:
        displacement.append(x)
        for _ in range(10):  # explicit steps, short enough
            v += (f - damping * v - stiffness * x - cubic * x**3) / mass / fs / 10
            x += v / fs / 10
    noisy = np.array(displacement) + 2e-5 * rng.standard_normal(samples)
    inputs, outputs = (lfrtorch.Channel("force", "N"),), (lfrtorch.Channel("displacement", "m"),)
    return lfrtorch.Record(force, noisy, fs=fs, inputs=inputs, outputs=outputs)


def main() -> None:
    """Fit, and compare with the linear model."""
    train, validation, test = (measured(n, seed) for seed, n in enumerate((2000, 1000, 1000)))
    bla = lfrtorch.estimate_bla(train, nx=2, offset=False)
    model = lfrtorch.initialise(bla, train, nz=1, nw=1, static=HardeningSpring())
    trainer = lfrtorch.LevenbergMarquardt(max_iter=30)
    result = lfrtorch.fit(model, train, validation, trainer=trainer)
    print(f"{result.iterations} iterations, {result.seconds:.0f} s: {result.reason}")
    for name, found in (("linear model", bla), ("with the spring", model)):
        error = 1e6 * lfrtorch.rmse(test, found.simulate(test))
        print(f"{name:16} {error:8.1f} µm rms on the test")
    model.save("runs/spring")
    spring = HardeningSpring()
    lfrtorch.load("runs/spring", static=spring)  # weights are saved, never code
    print(f"a = {spring.a.item():.3g}, b = {spring.b.item():.3g}: the law is cubic")


if __name__ == "__main__":
    main()
