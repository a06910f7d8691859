"""The LFR as a layer of something larger, trained by any torch optimiser.

A system is watched by a sensor with a law of its own: y = h(LFR(u)). The sensor is a small network
behind the LFR; gradients of both flow through one call of ``backward``, for the LFR by its adjoint
recurrence in machine code.

    python examples/in_a_larger_model.py
"""

import numpy as np
import torch

import lfrtorch


class Watched(torch.nn.Module):
    """y = v + h(v) with v = LFR(u), normalised units."""

    def __init__(self, lfr: lfrtorch.LFR) -> None:
        super().__init__()
        self.lfr = lfr
        last = torch.nn.Linear(8, 1)
        torch.nn.init.zeros_(last.weight)
        self.sensor = torch.nn.Sequential(torch.nn.Linear(1, 8), torch.nn.Tanh(), last).double()

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        """Shape: u: (R, T, nu) -> y: (R, T, ny)."""
        v = self.lfr(u)
        return v + self.sensor(v)


def measured(samples: int, seed: int) -> lfrtorch.Record:
    """A second-order system with a saturating feedback, and a sensor that saturates, too."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(samples)
    x, y = np.zeros(2), []
    for u_k in u:
        y.append(np.arctan(1.5 * x[0]) + 0.002 * rng.standard_normal())
        x = np.array([0.9 * x[0] + 0.3 * x[1], -0.3 * x[0] + 0.8 * x[1] + 0.5 * u_k])
        x[1] -= 0.2 * np.tanh(2.0 * x[1])
    return lfrtorch.Record(u, np.array(y))


STEPS = 3000


def main() -> None:
    """Train the whole, and compare with the linear model."""
    train, test = measured(2000, seed=0), measured(1000, seed=1)
    bla = lfrtorch.estimate_bla(train, nx=2)
    start = lfrtorch.initialise(bla, train, nz=1, nw=1, nn=8)
    scaler, whole = start.scaler, Watched(start.lfr)

    def signals(record: lfrtorch.Record) -> tuple[torch.Tensor, torch.Tensor]:
        u, y = scaler.normalise_u(record.u), scaler.normalise_y(record.y)
        return torch.as_tensor(u).unsqueeze(0), torch.as_tensor(y).unsqueeze(0)

    u, y = signals(train)
    # A line search ends early here on some processors, where a trial diverges; small steps do not.
    optimiser = torch.optim.Adam(whole.parameters(), lr=0.03)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        optimiser.zero_grad()
        torch.nn.functional.mse_loss(whole(u), y).backward()
        optimiser.step()
        schedule.step()
    with torch.no_grad():
        y_hat = scaler.restore_y(whole(signals(test)[0])[0].numpy())
    for name, found in (("linear model", bla.simulate(test)), ("LFR and sensor", y_hat)):
        print(f"{name:15} {lfrtorch.rmse(test, found):.4f} rms on the test, of which noise 0.0020")


if __name__ == "__main__":
    main()
