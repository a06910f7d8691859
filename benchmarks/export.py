"""A model inside CasADi: the exported function, a callback to torch, and l4casadi.

    python benchmarks/export.py [--l4casadi]

Prints a table: seconds until the function is ready, microseconds of one sample and of its Jacobian
(best of several rounds, called from Python), and milliseconds and iterations of a predictive
controller: ipopt, 20 samples ahead, multiple shooting, an input between limits. The Hessian is
exact with the export alone: the callback has none, and that of l4casadi has numbers that are none.
With --l4casadi that package must be installed; it builds its library in ./_l4c_generated.
"""

from __future__ import annotations

import argparse
import time
import timeit
from collections.abc import Callable
from typing import Any

import casadi
import numpy as np
import torch
from torch import Tensor

import lfrtorch
from lfrtorch.data.records import Channel
from lfrtorch.export import casadi_function

NX, SEED, HORIZON, TARGET = 3, 0, 20, 0.5
"""Sizes of Bouc-Wen: 3 states, z of 2, w of 1, 15 neurons; the controller's problem."""

ROUNDS = 5

Shape = tuple[int, int]


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--l4casadi", action="store_true", help="try that package, too")
    options = parser.parse_args()
    torch.set_num_threads(1)
    model = planted()
    ways: dict[str, Callable[[lfrtorch.Model], Any]] = {
        "lfrtorch.export": casadi_function,
        "callback to torch": by_callback,
    }
    if options.l4casadi:
        ways["l4casadi"] = by_l4casadi
    print("| in CasADi | ready | a sample | its Jacobian | controller | iterations |")
    print("|---" * 6 + "|")
    for name, way in ways.items():
        clock = time.perf_counter()
        function = way(model)
        ready = time.perf_counter() - clock
        sample, jacobian = evaluations(function)
        solved, iterations = controller(function, name == "lfrtorch.export")
        print(
            f"| {name} | {ready:.3g} s | {1e6 * sample:.3g} µs | {1e6 * jacobian:.3g} µs "
            f"| {1e3 * solved:.3g} ms | {iterations} |",
            flush=True,
        )


def planted() -> lfrtorch.Model:
    """A stable model with random weights."""
    torch.manual_seed(SEED)
    static = lfrtorch.Network(2, 1, 15)
    cell = lfrtorch.LFRCell(1, 1, NX, 2, 1, static, random=False).double()
    with torch.no_grad():
        for matrix in (cell.Bu, cell.Bw, cell.Cz, cell.Dzu, cell.Cy):
            matrix.normal_()
        cell.A.copy_(torch.diag(torch.tensor([0.9, 0.8, 0.5])))
        cell.Bw.mul_(0.02)
        cell.Cz.mul_(0.2)
    one, none = np.ones(1), np.zeros(1)
    scaler = lfrtorch.Scaler(none, one, none, one)
    return lfrtorch.Model(lfrtorch.LFR(cell), scaler, 100.0, (Channel("u"),), (Channel("y"),))


def step(model: lfrtorch.Model, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """(x, u) -> (x_next, y); the model's units are physical, as its scaling is the identity."""
    y, x_next = model.lfr.cell(u, x)
    return x_next, y


class Torch(casadi.Callback):
    """A function of torch that CasADi calls.

    Args:
        function: of x and u.
        shapes: of the arguments, and of what comes out.
        derivative: makes the same of its Jacobian, by the name that CasADi gives it.
    """

    def __init__(
        self,
        function: Callable[[Tensor, Tensor], tuple[Tensor, ...]],
        shapes: tuple[list[Shape], list[Shape]],
        derivative: Callable[[str], Torch] | None = None,
        name: str = "step",
    ) -> None:
        casadi.Callback.__init__(self)
        self.function, self.shapes, self.derivative = function, shapes, derivative
        self.kept: Torch | None = None  # CasADi keeps no reference
        self.construct(name, {})

    def get_n_in(self) -> int:
        """Number of arguments."""
        return len(self.shapes[0])

    def get_n_out(self) -> int:
        """Number of results."""
        return len(self.shapes[1])

    def get_sparsity_in(self, i: int) -> Any:
        """Shape of an argument."""
        return casadi.Sparsity.dense(*self.shapes[0][i])

    def get_sparsity_out(self, i: int) -> Any:
        """Shape of a result."""
        return casadi.Sparsity.dense(*self.shapes[1][i])

    def eval(self, arguments: Any) -> Any:
        """The numbers."""
        x, u = (torch.tensor(np.array(argument)[:, 0]) for argument in arguments[:2])
        return [found.detach().numpy() for found in self.function(x, u)]

    def has_jacobian(self) -> bool:
        """Whether there is one."""
        return self.derivative is not None

    def get_jacobian(self, name: str, inames: Any, onames: Any, opts: Any) -> Any:
        """The callback for it."""
        assert self.derivative is not None
        self.kept = self.derivative(name)
        return self.kept


def by_callback(model: lfrtorch.Model) -> Any:
    """The model called sample by sample, with derivatives by autograd."""

    def jacobian(x: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        by_out = torch.autograd.functional.jacobian(lambda x, u: step(model, x, u), (x, u))
        return tuple(one for by_in in by_out for one in by_in)

    x, u = (NX, 1), (1, 1)
    blocks = [(NX, NX), (NX, 1), (1, NX), (1, 1)]
    return Torch(
        lambda x, u: step(model, x, u),
        ([x, u], [x, u]),
        lambda name: Torch(jacobian, ([x, u, x, u], blocks), name=name),
    )


def by_l4casadi(model: lfrtorch.Model) -> Any:
    """The package's function, compiled."""
    import l4casadi  # pyright: ignore[reportMissingImports]

    class Step(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.cell = model.lfr.cell.float()

        def forward(self, signals: Tensor) -> Tensor:
            return torch.cat(step(model, signals[:NX, 0], signals[NX:, 0])).unsqueeze(-1)

    function = l4casadi.L4CasADi(Step(), name="lfr")
    x, u = casadi.MX.sym("x", NX), casadi.MX.sym("u")
    out = function(casadi.vertcat(x, u))
    return casadi.Function("step", [x, u], [out[:NX], out[NX:]])


def evaluations(function: Any) -> tuple[float, float]:
    """Seconds of a sample and of its Jacobian."""
    x, u = casadi.DM([0.1, 0.2, 0.3]), casadi.DM(0.5)
    jacobian, out = function.jacobian(), function(x, u)

    def best(call: Callable[[], Any], number: int = 200) -> float:
        return min(timeit.repeat(call, number=number, repeat=ROUNDS)) / number

    return best(lambda: function(x, u)), best(lambda: jacobian(x, u, *out))


def controller(function: Any, exact: bool) -> tuple[float, int]:
    """Seconds and iterations of one solution."""
    problem = casadi.Opti()
    x, u = problem.variable(NX, HORIZON + 1), problem.variable(HORIZON)
    problem.subject_to(x[:, 0] == 0)
    cost = 0
    for k in range(HORIZON):
        x_next, y = function(x[:, k], u[k])
        problem.subject_to(x[:, k + 1] == x_next)
        cost += (y - TARGET) ** 2 + 1e-3 * u[k] ** 2
    problem.minimize(cost)
    problem.subject_to(problem.bounded(-1.0, u, 1.0))
    hessian = "exact" if exact else "limited-memory"
    quiet = {"print_level": 0, "sb": "yes", "hessian_approximation": hessian, "tol": 1e-6}
    problem.solver("ipopt", {"print_time": False}, quiet)
    problem.solve()  # the first one allocates
    clock = time.perf_counter()
    problem.solve()
    return time.perf_counter() - clock, problem.stats()["iter_count"]


if __name__ == "__main__":
    main()
