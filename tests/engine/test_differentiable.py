"""The layer with the manners of torch: carried state, torch.func, forward mode, torch.compile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from reference import normal, random_cell
from torch import Tensor
from torch.autograd import forward_ad, gradcheck
from torch.func import functional_call, grad, jacfwd, jacrev, jvp, stack_module_state, vmap
from torch.testing import assert_close

from lfrtorch import InputError
from lfrtorch.engine.lfr import LFR

pytestmark = [
    pytest.mark.usefixtures("fast"),
    pytest.mark.numeric,
    # torch's own use of it, in its forward mode
    pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning"),
]


def small(seed: int = 0) -> LFR:
    return LFR(random_cell(2, 2, 3, 2, 1, 2, seed=seed))


def stepped(lfr: LFR, u: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """The cell in a loop, by torch alone."""
    outputs = []
    for k in range(u.shape[1]):
        y, x = lfr.cell(u[:, k], x)
        outputs.append(y)
    return torch.stack(outputs, dim=1), x


def test_the_last_state_and_its_gradients_are_those_of_a_loop():
    lfr, u, x0 = small(), normal(2, 7, 2), normal(2, 3, seed=1).requires_grad_()
    weights = [x0, *lfr.parameters()]
    found, expected = lfr(u, x0, return_state=True), stepped(lfr, u, x0)
    assert_close(found, expected)
    for loss in (
        lambda y, x: x.square().sum(),
        lambda y, x: (y**2).sum() + x.sin().sum(),
    ):
        mine = torch.autograd.grad(loss(*found), weights, retain_graph=True, allow_unused=True)
        wanted = torch.autograd.grad(loss(*expected), weights, retain_graph=True, allow_unused=True)
        for a, b in zip(mine, wanted, strict=True):
            assert_close(torch.zeros_like(a) if b is None else b, a)


def test_parts_with_carried_state_have_the_gradients_of_the_whole():
    lfr, u = small(), normal(2, 30, 2).requires_grad_()
    weights, x, outputs = [u, *lfr.parameters()], None, []
    for part in u.split(11, dim=1):
        y, x = lfr(part, x, return_state=True)
        outputs.append(y)
    assert x is not None
    whole, end = lfr(u, return_state=True)
    assert_close((torch.cat(outputs, dim=1), x), (whole, end), rtol=0, atol=1e-13)
    mine = torch.autograd.grad(torch.cat(outputs, dim=1).square().sum() + x.sum(), weights)
    wanted = torch.autograd.grad(whole.square().sum() + end.sum(), weights)
    assert_close(mine, wanted)


def test_the_state_of_one_record_has_no_axis_of_records():
    lfr, u, x0 = small(), normal(1, 9, 2), normal(1, 3, seed=1)
    (y, x), (whole, end) = lfr(u[0], x0[0], return_state=True), lfr(u, x0, return_state=True)
    assert torch.equal(y, whole[0])
    assert torch.equal(x, end[0])
    with pytest.raises(InputError, match="a period ends where it begins"):
        lfr(u, None, "periodic", return_state=True)


@pytest.mark.parametrize("start", ["zero", "periodic"])
def test_derivatives_of_both_modes_are_those_of_finite_differences(start):
    lfr = small()
    u, x0 = normal(2, 4, 2).requires_grad_(), normal(2, 3, seed=1).requires_grad_()
    step, tolerance = {"zero": (1e-5, 1e-7), "periodic": (1e-4, 1e-5)}[start]

    def of_weights(u: Tensor, *weights: Tensor) -> Tensor:
        named = dict(zip(dict(lfr.named_parameters()), weights, strict=True))
        return functional_call(lfr, named, (u, None, start))

    def check(function: Callable[..., Any], *inputs: Tensor) -> None:
        assert gradcheck(
            function, inputs, eps=step, atol=tolerance, rtol=tolerance,
            check_forward_ad=True,
        )  # fmt: skip

    check(of_weights, u, *(p.detach().clone().requires_grad_() for p in lfr.parameters()))
    if start == "zero":
        check(lambda u, x0: lfr(u, x0, return_state=True), u, x0)


def test_jacobians_by_both_modes_agree():
    lfr, u = small(), normal(1, 6, 2)
    weights = {name: p.detach() for name, p in lfr.named_parameters()}

    def y(weights: dict[str, Tensor]) -> Tensor:
        return functional_call(lfr, weights, (u,))

    backwards, forwards = jacrev(y)(weights), jacfwd(y)(weights)
    for name in weights:
        assert_close(backwards[name], forwards[name], rtol=1e-9, atol=1e-11)
    # Both agree with what backward finds.
    (expected,) = torch.autograd.grad(lfr(u)[0, 3, 1], [lfr.cell.A])
    assert_close(backwards["cell.A"][0, 3, 1], expected)
    change = normal(1, 6, 2, seed=4)
    along = jvp(lfr, (u,), (change,))[1]
    assert_close(along, torch.einsum("abcdef,def->abc", jacrev(lfr)(u), change))
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(u, change)
        assert_close(forward_ad.unpack_dual(lfr(dual)).tangent, along)


def test_vmap_over_signals_is_a_larger_batch():
    lfr, u, x0 = small(), normal(12, 8, 2), normal(4, 3, seed=2)
    together = vmap(lfr)(u.unflatten(0, (4, 3)))
    assert torch.equal(together.flatten(0, 1), lfr(u))
    # One input, several states, none of them with an axis of records.
    y, x = vmap(lambda x0: lfr(u[0], x0, return_state=True))(x0)
    expected = lfr(u[:1].expand(4, -1, -1), x0, return_state=True)
    assert_close((y, x), expected, rtol=0, atol=1e-14)
    each = vmap(grad(lambda u: lfr(u).square().sum()))(u.unflatten(0, (4, 3)))
    (wanted,) = torch.autograd.grad(lfr(u.requires_grad_()).square().sum(), u)
    assert_close(each.flatten(0, 1), wanted)


def test_vmap_over_weights_is_an_ensemble():
    models, u = [small(seed) for seed in range(3)], normal(2, 8, 2)
    weights, buffers = stack_module_state(models)  # pyright: ignore[reportArgumentType]
    base = small()

    def y(weights: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
        return functional_call(base, (weights, buffers), (u,))

    together = vmap(y)(weights, buffers)
    assert_close(together, torch.stack([lfr(u) for lfr in models]))
    gradients = vmap(grad(lambda w, b: y(w, b).square().sum()))(weights, buffers)
    for i, lfr in enumerate(models):
        wanted = torch.autograd.grad(lfr(u).square().sum(), list(lfr.parameters()))
        for name, each in zip(dict(lfr.named_parameters()), wanted, strict=True):
            assert_close(gradients[name][i], each)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning")
def test_compiled_models_have_it_as_it_is():
    lfr, u = small(), normal(2, 8, 2)
    gain = torch.nn.Linear(2, 1, dtype=torch.float64)
    model = torch.nn.Sequential(lfr, torch.nn.Tanh(), gain)
    compiled = torch.compile(model, backend="eager")
    assert torch.equal(compiled(u), model(u))
    mine, wanted = (
        torch.autograd.grad(f(u).square().sum(), list(model.parameters()))
        for f in (compiled, model)
    )
    assert_close(mine, wanted)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused(dtype: torch.dtype):
    lfr, u = small().to(dtype), normal(1, 5, 2).to(dtype)
    with pytest.raises(InputError, match=r"give torch.float64 or torch.float32"):
        lfr(u)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert small()(normal(1, 5, 2)).dtype == torch.float64
