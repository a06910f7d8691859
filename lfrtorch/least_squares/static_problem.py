"""The error of a static map over samples of its input and output."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor
from torch.nn import Module
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from lfrtorch.engine.static_jacobian import linearise_static
from lfrtorch.least_squares.levenberg_marquardt import DenseJacobian, LeastSquares


class StaticProblem(LeastSquares):
    """Residual and Jacobian of static(z) - w, for ``LevenbergMarquardt``.

    θ is the vector of all parameters of the map. The map holds the θ that was evaluated last.

    Args:
        static: the map.
        z, w: samples of its input and output.
    """

    def __init__(self, static: Module, z: Float[Tensor, "T nz"], w: Float[Tensor, "T nw"]) -> None:
        self.static, self.z, self.w = static, z.unsqueeze(0), w.unsqueeze(0)

    @property
    def theta(self) -> Float[Tensor, " P"]:
        """Parameters as they stand in the module."""
        return parameters_to_vector(self.static.parameters()).detach()

    def write(self, theta: Float[Tensor, " P"]) -> None:
        """Put θ into the module."""
        vector_to_parameters(theta.clone(), self.static.parameters())

    def cost(self, residual: Tensor) -> float:
        """|r|²."""
        return float(residual.square().sum())

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """r at θ."""
        self.write(theta)
        return (self.static(self.z) - self.w).detach().flatten()

    def linearise(self, theta: Float[Tensor, " P"]) -> DenseJacobian:
        """dr/dθ at θ."""
        r = self.residual(theta)
        weights = {name: p.detach() for name, p in self.static.named_parameters()}
        jacobian = linearise_static(self.static, self.z, weights)
        return DenseJacobian(jacobian.by_weight().flatten(0, 2), r)
