"""The cell over time as a module: gradients, carried state, batches, the linear case."""

import numpy as np
import pytest
import reference
import torch
from reference import normal, random_cell
from torch import Tensor
from torch.autograd import gradcheck
from torch.nn.utils import parameters_to_vector
from torch.nn.utils.parametrizations import weight_norm
from torch.testing import assert_close

from lfrtorch._support.errors import InputError, LfrtorchError
from lfrtorch.data.records import Start
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.sensitivity import Linearisation, output_jacobian

pytestmark = [
    pytest.mark.numeric,
    # torch's own use of it, in its forward mode
    pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning"),
]

STARTS: tuple[Start, ...] = ("zero", "periodic")


def small() -> LFR:
    return LFR(random_cell(2, 2, 2, 2, 1, 2))


# --- gradients ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    # step h and tolerance: truncation h² against cancellation eps / h, or 1e-10 / h where the
    # start state is known to the periodic tolerance
    ("start", "step", "tolerance"),
    [("zero", 1e-5, 1e-8), ("periodic", 1e-4, 1e-5)],
)
def test_gradients_are_those_of_finite_differences(start: Start, step: float, tolerance: float):
    lfr = small()
    u = normal(2, 4, 2).requires_grad_()

    def y(u: Tensor, *_: Tensor) -> Tensor:
        return lfr(u, start=start)

    assert gradcheck(y, (u, *lfr.parameters()), eps=step, atol=tolerance, rtol=tolerance)
    if start == "zero":
        x0 = normal(2, 2, seed=1).requires_grad_()
        assert gradcheck(lfr, (u, x0), eps=step, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("nw", [0, 2])
def test_gradient_is_the_jacobian_times_the_residual(nw: int, start: Start):
    lfr = LFR(random_cell(2, 2, 3, nw, nw, 4))
    u, r = normal(2, 50, 2), normal(2, 50, 2, seed=1)
    gradients = torch.autograd.grad(lfr(u, start=start), list(lfr.parameters()), r)
    periodic = start == "periodic"
    linearisation = Linearisation(lfr.cell, u, lfr.trajectory(u, start=start), periodic=periodic)
    J = output_jacobian(linearisation)[..., : linearisation.parameters]
    expected = J.flatten(0, 2).mT @ r.flatten()
    assert_close(parameters_to_vector(gradients), expected, rtol=1e-9, atol=1e-9)


def test_gradient_by_the_input_is_that_of_the_plain_loop():
    lfr = small()
    u, r, zero = normal(1, 20, 2).requires_grad_(), normal(20, 2, seed=1), normal(2) * 0
    (gradient,) = torch.autograd.grad(lfr(u), u, r.unsqueeze(0))
    y = reference.nl_lfr(lfr.cell, reference.weights(lfr.cell), u[0], zero).y
    (expected,) = torch.autograd.grad(y, u, r)
    assert_close(gradient, expected, rtol=1e-12, atol=1e-13)


@pytest.mark.usefixtures("fast")
def test_second_derivatives_are_refused():
    lfr = small()
    loss = lfr(normal(1, 5, 2)).square().sum()
    (gradient,) = torch.autograd.grad(loss, lfr.cell.A, create_graph=True)
    with pytest.raises(LfrtorchError, match="first derivatives only; for second ones step its cel"):
        gradient.sum().backward()
    hessian = torch.func.hessian(lambda u: lfr(u).square().sum())
    with pytest.raises(LfrtorchError, match="first derivatives only"):
        hessian(normal(1, 5, 2))


@pytest.mark.parametrize("start", STARTS)
def test_any_optimiser_trains_it_within_a_larger_model(start: Start):
    """A learned input filter before the model and a gain behind it."""
    lfr, u = LFR(random_cell(1, 1, 2, 1, 1, 3, radius=0.5)), normal(2, 60, 1)
    torch.manual_seed(0)
    before, behind = torch.nn.Linear(1, 1).double(), torch.nn.Linear(1, 1).double()
    target = reference_output(u)
    parameters = [*before.parameters(), *lfr.parameters(), *behind.parameters()]

    def loss() -> Tensor:
        return (behind(lfr(before(u), start=start)) - target).square().mean()

    first = float(loss().detach())
    # Steps of bounded length: a line search may try an unstable model, whose loss is NaN.
    optimiser = torch.optim.Adam(parameters, lr=0.05)
    for _ in range(60):
        optimiser.zero_grad()
        loss().backward()
        optimiser.step()
    assert float(loss().detach()) < 0.1 * first
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in parameters)


def reference_output(u: Tensor) -> Tensor:
    return LFR(random_cell(1, 1, 2, 1, 1, 3, radius=0.5, seed=3))(u).detach()


def test_backward_takes_the_weights_of_its_forward_pass():
    """``functional_call`` has put the module's own weights back by then."""
    lfr, u = small(), normal(1, 10, 2)
    other = {name: (p.detach() * 0.9).requires_grad_() for name, p in lfr.named_parameters()}
    y = torch.func.functional_call(lfr, other, (u,))
    gradients = torch.autograd.grad(y.sum(), list(other.values()))
    with torch.no_grad():
        for name, p in lfr.named_parameters():
            p.copy_(other[name])
    expected = torch.autograd.grad(lfr(u).sum(), list(lfr.parameters()))
    for mine, wanted in zip(gradients, expected, strict=True):
        assert_close(mine, wanted, rtol=1e-12, atol=1e-13)


def test_no_graph_without_gradients():
    lfr, u = small(), normal(1, 5, 2)
    with torch.no_grad():
        y = lfr(u)
    assert not y.requires_grad
    assert torch.equal(y, lfr(u).detach())


# --- simulation -----------------------------------------------------------------------------


def test_linear_case_is_dlsim():
    lfr = LFR(random_cell(2, 2, 4, 2, 2, 3))
    cell = lfr.cell
    assert cell.static is not None
    with torch.no_grad():
        for p in cell.static.parameters():
            p.zero_()
    A, B, C, D = (m.detach().numpy() for m in (cell.A, cell.Bu, cell.Cy, cell.Dyu))
    u = normal(1, 500, 2)
    expected = reference.dlsim((A, B, C, D), u[0].numpy())
    np.testing.assert_allclose(lfr(u).detach().numpy()[0], expected, rtol=0, atol=1e-10)


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("cut", [1, 20, 39])
def test_two_halves_with_carried_state_are_the_whole(cut: int):
    lfr, u = small(), normal(2, 40, 2)
    whole = lfr.trajectory(u)
    first = lfr.trajectory(u[:, :cut])
    second = lfr.trajectory(u[:, cut:], first.x[:, -1])
    assert torch.equal(torch.cat([first.x[:, :-1], second.x], dim=1), whole.x)
    # Batched products may sum in another order for another number of samples.
    assert_close(torch.cat([first.y, second.y], dim=1), whole.y, rtol=0, atol=1e-14)


@pytest.mark.parametrize("start", STARTS)
def test_batch_of_three_is_three_single_runs(start: Start):
    lfr, u = small(), normal(3, 30, 2)
    together = lfr(u, start=start)
    for r in range(3):
        alone = lfr(u[r : r + 1], start=start)
        # One record more lets the periodic search of all go on: within its tolerance.
        assert_close(together[r], alone[0], rtol=0, atol=1e-14 if start == "zero" else 1e-9)


def test_start_state_is_zero_where_left_out():
    lfr, u = small(), normal(2, 10, 2)
    assert torch.equal(lfr(u), lfr(u, u.new_zeros(2, 2)))


def test_guess_of_the_periodic_start_takes_no_gradient():
    lfr, u = small(), normal(2, 10, 2)
    guess = normal(2, 2, seed=1).requires_grad_()
    y = lfr(u, guess, "periodic")
    assert_close(y, lfr(u, start="periodic"), rtol=0, atol=1e-9)
    (gradient,) = torch.autograd.grad(y.sum(), guess, allow_unused=True)
    assert gradient is None


def test_starts_that_it_does_not_have():
    lfr, u = small(), normal(1, 10, 2)
    with pytest.raises(ValueError, match="start is 'peridoic'"):
        lfr(u, None, "peridoic")
    with pytest.raises(ValueError, match="start='estimated' needs measured outputs"):
        lfr(u, None, "estimated")


# --- the door -------------------------------------------------------------------------------


def test_one_record_needs_no_axis_of_records():
    lfr, u, x0 = small(), normal(1, 20, 2), normal(1, 2, seed=1)
    assert torch.equal(lfr(u[0]), lfr(u)[0])
    assert torch.equal(lfr(u[0], x0[0]), lfr(u, x0)[0])


@pytest.mark.parametrize(
    ("u", "message"),
    [
        (torch.zeros(8, 200, 8).double(), r"u has the shape \(8, 200, 8\); give \(8, 200, 2\)"),
        (torch.zeros(200).double(), r"u has the shape \(200,\); give \(R, T, 2\)"),
        (torch.zeros(0, 5, 2).double(), "at least one record of one sample"),
        (torch.zeros(3, 0, 2).double(), "at least one record of one sample"),
        (torch.zeros(3, 5, 2), "convert u or the model, so that both are alike"),
        (torch.zeros(3, 5, 2).bfloat16(), "u is torch.bfloat16"),
        (np.zeros((3, 5, 2)), "u is of type ndarray; give a torch tensor"),
    ],
)
def test_an_input_that_is_not_the_models_is_refused(u: Tensor, message: str):
    with pytest.raises(ValueError, match=message):
        small()(u)


@pytest.mark.parametrize("shape", [(3, 1), (1, 2), (2,), (3, 5)])
def test_start_states_are_not_broadcast(shape: tuple[int, ...]):
    with pytest.raises(ValueError, match=r"x0 has the shape .*; give \(3, 2\): records and states"):
        small()(normal(3, 5, 2), torch.zeros(shape).double())


def test_a_model_of_a_dtype_without_kernels_is_refused():
    lfr = small().bfloat16()
    with pytest.raises(ValueError, match=r"dtype is torch\.bfloat16; give torch\.float64"):
        lfr(torch.zeros(1, 5, 2).bfloat16())


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("inside", [False, True], ids=["backward behind it", "backward in it"])
def test_autocast_leaves_the_layer_in_the_dtype_of_its_weights(inside: bool):
    lfr = LFR(random_cell(2, 2, 2, 2, 1, 2, dtype=torch.float32))
    u = normal(2, 20, 2).bfloat16().requires_grad_()
    expected = lfr(u.float())
    wanted = torch.autograd.grad(expected.square().sum(), [u, *lfr.parameters()])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y, x = lfr(u, return_state=True)
        step, ahead = lfr.cell(u[:, 0], u.new_zeros(2, 2))
        if inside:
            y.square().sum().backward()
    if not inside:
        y.square().sum().backward()
    assert_close(y, expected, rtol=0, atol=0)
    assert_close(step, expected[:, 0])
    assert y.dtype == x.dtype == step.dtype == ahead.dtype == torch.float32
    assert_close([u.grad, *(p.grad for p in lfr.parameters())], list(wanted))


def test_autocast_lets_a_larger_model_train():
    lfr = LFR(random_cell(2, 2, 2, 2, 1, 2, dtype=torch.float32))
    model = torch.nn.Sequential(torch.nn.Linear(3, 2), lfr, torch.nn.Linear(2, 1))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = model(torch.ones(2, 10, 3))
        y.square().mean().backward()
    assert y.dtype == torch.bfloat16
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


@pytest.mark.parametrize("alone", [True, False])
def test_exports_of_torch_are_refused_with_those_of_the_package(alone: bool):
    u, lfr = torch.zeros(1, 5, 2, dtype=torch.float64), small()
    model = lfr if alone else torch.nn.Sequential(lfr)
    with pytest.raises(InputError, match=r"lfrtorch\.export\.write\(model, 'onnx', FOLDER\)"):
        torch.export.export(model, (u,))


@pytest.mark.filterwarnings("ignore:There is a performance drop")  # torch's, of weight_norm
def test_a_parametrised_weight_is_refused_and_a_map_of_torchs_layers_may_have_one():
    lfr = small()
    assert lfr.cell.static is not None
    weight_norm(lfr.cell.static, "Wz")
    with pytest.raises(InputError, match=r"static\.Wz is not a parameter any more"):
        lfr(torch.zeros(1, 5, 2, dtype=torch.float64))
    inner = weight_norm(torch.nn.Linear(2, 1, dtype=torch.float64))
    own = LFR(LFRCell(2, 2, 2, 2, 1, torch.nn.Sequential(inner), dtype=torch.float64))
    own(normal(1, 5, 2)).square().sum().backward()
    assert all(p.grad is not None for p in inner.parameters())


def test_a_weight_that_was_put_in_with_another_shape_is_refused():
    lfr = small()
    lfr.cell.Bu = torch.nn.Parameter(normal(2, 1))
    with pytest.raises(ValueError, match=r"Bu has the shape \(2, 1\); with nu=2, .* be \(2, 2\)"):
        lfr(normal(1, 5, 2))
