"""The fit of a static map to samples: its slope, and maps that are found again."""

import pytest
import torch
from reference import normal
from torch.func import jacrev

from lfrtorch.engine.nonlinearity import Network, Polynomial
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.static_problem import StaticProblem

pytestmark = pytest.mark.numeric


@pytest.mark.parametrize(
    "static",
    [Network(2, 3, 4, dtype=torch.float64), Polynomial(2, 3, 2, dtype=torch.float64)],
)
def test_slope(static: torch.nn.Module):
    problem = StaticProblem(static, normal(7, 2), normal(7, 3, seed=1))
    theta = problem.theta
    J = problem.linearise(theta)
    names, weights = zip(*static.named_parameters(), strict=True)

    def residual(theta: torch.Tensor) -> torch.Tensor:
        parts = theta.split([w.numel() for w in weights])
        own = {n: p.view(w.shape) for n, p, w in zip(names, parts, weights, strict=True)}
        w = torch.func.functional_call(static, own, (problem.z,))
        return (w - problem.w).flatten()

    torch.testing.assert_close(J.jacobian, jacrev(residual)(theta), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(J.residual, residual(theta), rtol=0, atol=1e-14)


def test_polynomial_is_found_again():
    true, static = (Polynomial(2, 2, 3, dtype=torch.float64) for _ in range(2))
    true.reset_parameters(torch.Generator().manual_seed(0))
    static.reset_parameters(torch.Generator().manual_seed(1))
    z = normal(200, 2)
    problem = StaticProblem(static, z, true(z).detach())
    search = LevenbergMarquardt(max_iter=20)
    state = search.init(problem, problem.theta)
    while not state.reason:
        state = search.step(problem, state)
    problem.write(state.theta)
    torch.testing.assert_close(static.C, true.C, rtol=0, atol=1e-8)
