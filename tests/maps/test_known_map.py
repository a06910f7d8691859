"""A known model in machine code against its equations in torch, alone and in an LFR."""

import pytest
import reference
import torch
from torch.testing import assert_close

from lfrtorch.engine import simulation
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.sensitivity import Linearisation, output_jacobian
from lfrtorch.maps.direct_sum import DirectSum
from lfrtorch.maps.known_map import KnownEquations, KnownModel
from lfrtorch.maps.linearised import CompiledMap, TorchMap, linearise_map
from lfrtorch.maps.network import Network
from lfrtorch.maps.operations import Formula
from lfrtorch.maps.polynomial import Polynomial

pytestmark = pytest.mark.numeric

METHODS = ["rk4", "euler", "discrete", "rk4 centred", "euler centred"]


def rates(h1, h2, u, a, b, k):
    def root(v):
        return torch.sqrt(v.clamp(min=1e-3))

    over = torch.relu(h1 - 1.5)
    return -a * root(h1) + k * u - over, a * root(h1) - b * root(h2) + 0.3 * over


def next_state(*v):
    return [x + 0.1 * change for x, change in zip(v, rates(*v), strict=False)]


def known_map(method: str) -> KnownModel:
    f = Formula.traced(next_state if method == "discrete" else rates, 6)
    h = Formula.traced(lambda h1, h2, u, a, b, k: [h2 + 0.1 * a * u], 6)
    substeps = 1 if method == "discrete" else 3
    names = ("h1", "h2"), ("a", "b", "k"), ("", "", "1/s")
    how, centred = method.split(maxsplit=1)[0], method.endswith("centred")
    equations = KnownEquations(f, h, *names, 1, how, substeps, centred)
    found = KnownModel(equations, 0.2, dtype=torch.float64)
    with torch.no_grad():
        found.p_scale.copy_(torch.tensor([0.3, 0.2, 0.4]))
        found.of_z.copy_(torch.tensor([[0.1, 2.0], [0.2, 1.5], [1.0, 0.7]]))
        found.of_w.copy_(torch.tensor([[0.1, 2.0], [0.2, 1.5], [0.5, 1.3]]))
    return found


def cells(method: str) -> list[LFRCell]:
    """The known model alone, with a network and with a polynomial beside it, and a state more."""
    generator = torch.Generator().manual_seed(0)
    found = []
    for learned in (None, Network(2, 1, 4), Polynomial(2, 1, 2)):
        static, size = known_map(method), 3
        if learned is not None:
            static, size = DirectSum([static, learned.double()], [(3, 3), (2, 1)]), 5
        cell = LFRCell(
            1, 1, 3, size, size - (learned is not None), static, dtype=torch.float64, random=False
        )
        with torch.no_grad():
            cell.Cz[:2, :2], cell.Dzu[2], cell.Bw[:2, :2], cell.Dyw[0, 2] = (
                torch.eye(2), 1.0, torch.eye(2), 1.0
            )  # fmt: skip
            cell.A[2, 2], cell.Bu[2, 0] = 0.5, 0.3
            for entries in (cell.Cz[3:], cell.Dzu[3:], cell.Bw[:, 3:], cell.Dyw[:, 3:]):
                entries.uniform_(-0.1, 0.1, generator=generator)
        found.append(cell)
    return found


def signals(cell: LFRCell):
    generator = torch.Generator().manual_seed(1)
    u = torch.rand(2, 40, 1, dtype=torch.float64, generator=generator)
    return u, torch.rand(2, cell.nx, dtype=torch.float64, generator=generator)


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("method", METHODS)
def test_machine_code_simulates_the_equations(method: str):
    for cell in cells(method):
        u, x0 = signals(cell)
        assert cell.weights().layout.compiled
        found = simulation.simulate(cell, u, x0)
        for r in range(len(u)):
            expected = reference.nl_lfr(cell, reference.weights(cell), u[r], x0[r])
            for part, own in zip(found, expected, strict=True):
                assert_close(part[r], own, rtol=1e-10, atol=1e-12)


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("method", METHODS)
def test_derivatives_are_those_of_torch_func(method: str):
    for cell in cells(method):
        u, x0 = signals(cell)
        trajectory = simulation.simulate(cell, u, x0)
        W = cell.weights()
        found = linearise_map(W.map, trajectory.z, W.phi, W.map.code)
        assert isinstance(found, CompiledMap)
        expected = TorchMap(W.map, trajectory.z, W.phi)
        assert_close(found.J, expected.J)
        assert_close(found.by_weight(), expected.by_weight())
        d_w, d_phi = torch.rand_like(trajectory.w), torch.rand_like(W.phi)
        assert_close(found.tangent(d_phi), expected.tangent(d_phi))
        assert_close(found.adjoint(d_w), expected.adjoint(d_w))


def test_jacobian_of_the_outputs_is_that_of_the_recurrence():
    for cell in cells("rk4"):
        u, x0 = signals(cell)
        along = Linearisation(cell, u, simulation.simulate(cell, u, x0))
        found = output_jacobian(along)[0]
        theta = reference.weights(cell)

        def y(theta, x0, cell=cell, u=u):
            return reference.nl_lfr(cell, theta, u[0], x0).y

        by_theta, by_x0 = torch.func.jacrev(y, argnums=(0, 1))(theta, x0[0])
        expected = torch.cat([*(by_theta[name].flatten(2) for name in theta), by_x0], dim=-1)
        assert_close(found, expected, rtol=1e-8, atol=1e-10)


def test_equations_survive_a_description():
    equations = known_map("rk4").physics
    assert KnownEquations.of(equations.described()) == equations
    with pytest.raises(ValueError, match="do not fit"):
        KnownEquations.of(equations.described() | {"method": "bdf"})
    with pytest.raises(ValueError, match="do not fit"):
        KnownEquations.of(replace_states(equations))


def replace_states(equations: KnownEquations):
    return equations._replace(states=("h1",)).described()


def test_a_centred_hold_is_that_of_the_middle_of_samples():
    # A held sine's first harmonic, against the response to the sine itself: no delay is left.
    f, h = Formula.traced(lambda x, u: [u - x], 2), Formula.traced(lambda x, u: [x], 2)
    t = 0.2 * torch.arange(400, dtype=torch.float64)
    u, errors = torch.sin(t)[None, :, None], []
    steady = 0.5 * (torch.sin(t) - torch.cos(t))
    for centred in (False, True):
        equations = KnownEquations(f, h, ("x",), (), (), 1, "rk4", 1, centred)
        cell = LFRCell(
            1, 1, 1, 2, 2, KnownModel(equations, 0.2, dtype=torch.float64), random=False
        ).double()
        with torch.no_grad():
            cell.Cz[0], cell.Dzu[1], cell.Bw[0, 0], cell.Dyw[0, 1] = 1.0, 1.0, 1.0, 1.0
        y = simulation.simulate(cell, u, torch.zeros(1, 1, dtype=torch.float64)).y[0, :, 0]
        errors.append(float((y - steady)[200:].abs().max()))
    assert errors[0] > 0.05
    assert errors[1] < 0.003


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("method", METHODS)
def test_float32_runs_in_the_same_machine_code(method: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(simulation, "newton_states", None)  # what torch would do
    monkeypatch.setattr(TorchMap, "__init__", None)
    for cell in cells(method):
        u, x0 = signals(cell)
        exact = simulation.simulate(cell, u, x0)
        J, *_ = output_jacobian(Linearisation(cell, u, exact))
        rounded = cell.to(torch.float32)
        u, x0 = u.float(), x0.float()
        found = simulation.simulate(rounded, u, x0)
        assert found.y.dtype == torch.float32
        assert_close(found.y.double(), exact.y, rtol=1e-4, atol=1e-4)
        again = simulation.simulate_near(rounded, u, x0, found)
        assert_close(again.y, found.y)
        own, *_ = output_jacobian(Linearisation(rounded, u, found))
        assert_close(own.double(), J, rtol=1e-3, atol=1e-3 * float(J.abs().max()))
