"""The one residual over records of different lengths, starts and windows."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from reference import measure, normal, random_cell, random_model
from torch import Tensor
from torch.testing import assert_close

from lfrtorch.data.metrics import rmse
from lfrtorch.data.records import Channel, Record, Start
from lfrtorch.least_squares.jacobian import Jacobian
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.output_rows import OutputRows
from lfrtorch.least_squares.problem import Problem
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


@pytest.fixture
def model() -> Model:
    return random_model(random_cell(2, 2, 2, 2, 1, 3))


def some_records(model: Model) -> list[Record]:
    """Groups: (30, zero) twice with other windows, (30, periodic), (20, zero)."""
    noise = np.random.default_rng(0)
    records = []
    groups: list[tuple[int, Start, int]] = [
        (30, "zero", 0), (30, "periodic", 4), (30, "zero", 7), (20, "zero", 1)
    ]  # fmt: skip
    for T, start, skip in groups:
        exact = measure(model, T, seed=len(records), start=start, skip=skip)
        y = exact.y + noise.normal(size=exact.y.shape)
        records.append(Record(exact.u, y, exact.fs, start, skip, name=f"{start} {T} {skip}"))
    return records


def all_kinds(model: Model, *, given: bool = True) -> list[Record]:
    """Every start, window and weight in one problem."""
    zero, periodic, third, fourth = some_records(model)
    lines = np.linspace(0.5, 2.0, 2 * 16).reshape(16, 2) * (np.arange(16) != 3)[:, None]
    records = [
        replace(zero, weight=[0.5, 3.0]),
        periodic,
        replace(periodic, skip=0, line_weight=lines, weight=2.0),
        replace(third, start="estimated"),
        replace(fourth, start="estimated", weight=4.0),
        replace(zero, start="estimated", skip=3),
        with_gaps(replace(fourth, start="estimated")),
    ]
    return [*records, replace(fourth, start="given", x0=[0.3, -0.2])] if given else records


def test_residual_is_the_error_of_all_scored_samples(model: Model):
    records = some_records(model)
    problem = Problem.of(model, records)
    r = problem.residual(problem.theta)
    expected = [((model.simulate(x) - x.y) / model.scaler.y_scale)[x.skip :] for x in records]
    assert r.shape == (2 * (30 + 30 + 30 + 20),)
    assert problem.size == 2 * (30 + 26 + 23 + 19)
    # The order of the records is the problem's own, and samples that do not count are zero.
    mine, theirs = np.sort(r[r != 0].numpy()), np.sort(np.concatenate(expected).ravel())
    np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-9)
    for record in records:
        problem = Problem.of(model, record)
        score = problem.rmse(problem.theta)
        assert score == pytest.approx(rmse(record, model.simulate(record)), rel=1e-9)


def with_gaps(record: Record) -> Record:
    """The same without some samples of each output, which are far off."""
    valid = np.random.default_rng(1).random(record.y.shape) < 0.8
    return replace(record, y=np.where(valid, record.y, 1e6), valid=valid)


def test_samples_that_are_not_valid_have_no_error(model: Model):
    zero, _, third, _ = some_records(model)
    records = [with_gaps(zero), with_gaps(replace(third, start="estimated"))]
    problem = Problem.of(model, records)
    kept = [r.valid[r.skip :] for r in records if r.valid is not None]
    assert problem.size == sum(int(valid.sum()) for valid in kept)
    r = problem.residual(problem.theta)
    (group, _) = problem.errors.groups
    expected = ((model.simulate(zero) - zero.y) / model.scaler.y_scale)[kept[0]]
    assert np.count_nonzero(r[: group.y.numel()]) == len(expected)
    mine = r[: group.y.numel()]
    np.testing.assert_allclose(np.sort(mine[mine != 0].numpy()), np.sort(expected))
    alone = Problem.of(model, records[0])
    score = rmse(records[0], model.simulate(records[0]))
    assert alone.rmse(alone.theta) == pytest.approx(score, rel=1e-9)


RIDGES = pytest.mark.parametrize("ridge", [0.0, 0.5, {"static": 0.1, "A": 0.3, "x0": 2.0}])


@RIDGES
def test_gradient_and_jacobian_agree(model: Model, ridge):
    problem = Problem.of(model, all_kinds(model), ridge=ridge)
    theta = problem.theta + 0.1
    point, gradient = problem.gradient(theta)
    r, J = point.residual, problem.jacobian(theta)
    assert_close(r, problem.residual(theta), rtol=0, atol=1e-9)
    assert_close(gradient, 2 * J.mT @ r / problem.size, rtol=1e-8, atol=1e-8)


@RIDGES
def test_jacobian_is_the_slope_of_the_residual(model: Model, ridge):
    problem = Problem.of(model, all_kinds(model), ridge=ridge)
    theta = problem.theta
    assert len(theta) == model.parameter_count + 4 * 2
    step = 1e-4 * torch.randn(len(theta), generator=torch.Generator().manual_seed(0)).double()
    expected = (problem.residual(theta + step) - problem.residual(theta - step)) / 2
    # Truncation |step|³ = 1e-11, and the periodic start is known to 1e-10.
    assert_close(problem.jacobian(theta) @ step, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("ridge", "given", "precise", "kept"),
    [
        (0.0, True, True, True),
        (0.0, False, False, False),
        (0.5, False, True, False),
        (0.5, True, False, True),
        ({"static": 0.1, "A": 0.3, "x0": 2.0}, False, False, True),
        ({"static": 0.1, "A": 0.3, "x0": 2.0}, True, True, False),
    ],
)
def test_system_and_products_are_those_of_the_whole_jacobian(
    model: Model, ridge, given: bool, precise: bool, kept: bool, monkeypatch
):
    """In blocks of five samples, kept or not, by QR or by normal equations, gauge left out.

    That is exact in periodic steady state, which is known to 1e-10.
    """
    monkeypatch.setattr("lfrtorch.engine.sensitivity.BLOCK", 5)
    monkeypatch.setattr("lfrtorch.least_squares.jacobian.CACHED_BYTES", 1 << 20 if kept else 0)
    problem = Problem.of(model, all_kinds(model, given=given), ridge=ridge)
    theta = problem.theta + 0.1
    r, J = problem.residual(theta), problem.jacobian(theta)
    jacobian = problem.linearise(theta)
    system, gradient = jacobian.system(1e-15 if precise else 1e-2, 1e-12)
    scale = float(torch.linalg.svdvals(J)[0]) ** 2
    assert system.scale == pytest.approx(scale, rel=1e-9)
    assert_close(gradient, J.mT @ r, rtol=0, atol=1e-10 * scale)
    damping = 1e-3 * scale
    expected = -torch.linalg.solve(J.mT @ J + damping * torch.eye(len(theta)), J.mT @ r)
    assert_close(system.solve(gradient, damping), expected, rtol=0, atol=1e-7)
    assert_close(jacobian.tangent(theta), J @ theta, rtol=0, atol=1e-8)
    assert_close(jacobian.adjoint(r), J.mT @ r, rtol=0, atol=1e-8)


def test_weights_multiply_the_squared_errors(model: Model):
    (record,) = some_records(model)[:1]
    plain = Problem.of(model, record)
    theta = plain.theta + 0.1
    squares = plain.residual(theta).reshape(-1, 2).square().sum(0)
    weighted = Problem.of(model, replace(record, weight=[0.5, 3.0]))
    expected = float(0.5 * squares[0] + 3.0 * squares[1])
    assert weighted.cost(weighted.residual(theta)) == pytest.approx(expected, rel=1e-9)
    assert weighted.rmse(theta) == pytest.approx(plain.rmse(theta), rel=1e-12)


def test_beyond_a_limit_there_is_no_error(model: Model):
    """Samples at the limit of a sensor count on its inner side alone."""
    exact = measure(model, 60)
    high = float(np.quantile(exact.y, 0.7))
    record = replace(exact, y=np.minimum(exact.y, high), limits=(None, high))
    problem = Problem.of(model, record)
    theta = problem.theta
    assert problem.cost(problem.residual(theta)) < 1e-20
    assert problem.rmse(theta) < 1e-9
    assert np.allclose(model.simulate(record), record.y)
    other = theta + 0.05
    errors = problem.residual(other).reshape(60, 2)
    problem.write(other)
    y_hat = model.simulate(record.u)
    beyond = (record.y >= high) & (y_hat > high)
    assert beyond.any()
    assert ((record.y >= high) & ~beyond).any()
    shown = rmse(record, model.simulate(record))
    assert problem.rmse(other) == pytest.approx(shown, rel=1e-12)
    judge = Problem.judge(model, record)
    assert judge.rmse(judge.theta) == pytest.approx(shown, rel=1e-12)
    error = (model.simulate(record) - record.y) / model.scaler.y_scale
    assert judge.cost(judge.residual(judge.theta)) == pytest.approx(np.sum(error**2), rel=1e-12)
    problem.write(other)
    expected = np.where(beyond, 0.0, y_hat - record.y) / model.scaler.y_scale
    assert_close(errors, torch.as_tensor(expected))
    step = 1e-6 * torch.linspace(-1.0, 1.0, len(theta)).to(theta)
    slope = problem.residual(other + step) - problem.residual(other - step)
    assert_close(2.0 * problem.jacobian(other) @ step, slope, atol=1e-10, rtol=1e-4)


@pytest.mark.parametrize("T", [30, 31])
def test_unit_line_weights_are_plain_least_squares(model: Model, T: int):
    noise = np.random.default_rng(1).normal(size=(T, 2))
    record = measure(model, T, start="periodic")
    record = replace(record, y=record.y + noise)
    lines = replace(record, line_weight=np.ones(T // 2 + 1))
    plain, weighted = Problem.of(model, record), Problem.of(model, lines)
    theta = plain.theta + 0.1
    cost = plain.cost(plain.residual(theta))
    assert weighted.cost(weighted.residual(theta)) == pytest.approx(cost, rel=1e-9)


@pytest.mark.parametrize("T", [30, 31])
def test_line_weights_weigh_the_spectrum_of_the_error(model: Model, T: int):
    record = measure(model, T, start="periodic")
    t = 2 * np.pi * np.arange(T)[:, None] / T
    y = record.y + model.scaler.y_scale * (np.cos(3 * t) + 2.0 * np.sin(5 * t))
    weight = np.zeros(T // 2 + 1)
    weight[[3, 5, 6]] = 4.0, 0.25, 9.0
    problem = Problem.of(model, replace(record, y=y, line_weight=weight))
    # Σ cos² = Σ sin² = T / 2 over whole periods, in each of two outputs.
    expected = 2 * (4.0 * 1.0 + 0.25 * 4.0) * T / 2
    assert problem.cost(problem.residual(problem.theta)) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("T", [29, 30])
@pytest.mark.parametrize("by_line", [True, False])
def test_adjoint_of_the_weights_is_that_of_their_product(model: Model, T: int, by_line: bool):
    """<W e, r> = <e, W' r>, where each line but 0 and fs / 2 stands for two."""
    rng, record = np.random.default_rng(0), measure(model, T, start="periodic")
    F = T // 2 + 1
    weights = {"line_weight": rng.uniform(0.5, 2.0, (F, 2))} if by_line else {"weight": [0.5, 3.0]}
    problem = Problem.of(model, [replace(record, **weights)] * 2)
    (group,) = problem.errors.groups
    e, r = normal(2, T, 2), normal(2, T, 2, seed=1)
    weighed, unweighed = group.weigh(e), group.unweigh(r)
    assert weighed.shape == unweighed.shape == e.shape
    # Sums of some hundred products of size 1.
    assert_close((weighed * r).sum(), (e * unweighed).sum(), rtol=0, atol=1e-11)


def test_start_state_is_fitted_with_the_parameters(model: Model):
    """A record cut from the middle of another, and the first of its samples thrown away."""
    whole = measure(model, 200)
    later = replace(whole[50:], start="estimated")
    problem = Problem.of(model, [whole, later])
    states = model.signals(whole).x[0]
    assert_close(problem.theta[-2:], states[50], rtol=0, atol=1e-7)
    assert problem.rmse(problem.theta) < 1e-8
    solved = Problem.judge(model, [whole, later])
    assert len(solved.theta) == model.parameter_count
    assert solved.rmse(solved.theta) < 1e-8
    given = Problem.of(model, replace(whole[50:], start="given", x0=states[50].numpy()))
    assert given.rmse(given.theta) < 1e-9


def test_ridge_by_group_is_of_its_parameters_only(model: Model):
    problem = Problem.of(model, some_records(model), ridge={"A": 0.25, "static.bz": 4.0})
    theta = problem.theta
    longer = problem.residual(theta + 1.0)[-len(theta) :]
    names = [name for name, p in model.lfr.cell.named_parameters() for _ in range(p.numel())]
    expected = [{"A": 0.5, "static.bz": 2.0}.get(name, 0.0) for name in names]
    assert_close(longer, torch.tensor(expected, dtype=longer.dtype), rtol=1e-12, atol=0)


def test_ridge_of_an_unknown_group(model: Model):
    with pytest.raises(ValueError, match=r"ridge has a group 'B',.*parameters are A, Bu, .*bw"):
        Problem.of(model, some_records(model), ridge={"B": 1.0})
    with pytest.raises(ValueError, match=r"ridge of 'A' is -1; give"):
        Problem.of(model, some_records(model), ridge={"A": -1})
    for ridge in (-1.0, float("nan")):
        with pytest.raises(ValueError, match=r"ridge is .*; give a number of at least 0"):
            Problem.of(model, some_records(model), ridge=ridge)


def test_penalty_is_no_part_of_the_score(model: Model):
    records = some_records(model)
    plain, ridged = Problem.of(model, records), Problem.of(model, records, ridge=4.0)
    theta = plain.theta + 0.1
    r, longer = plain.residual(theta), ridged.residual(theta)
    assert_close(longer[: len(r)], r, rtol=0, atol=1e-9)
    assert_close(longer[len(r) :], torch.full_like(theta, 2.0 * 0.1), rtol=1e-12, atol=0)
    assert ridged.rmse(theta) == pytest.approx(plain.rmse(theta), rel=1e-9)


def test_a_search_that_goes_on_keeps_the_start_of_its_ridge(model: Model):
    records = some_records(model)
    first = Problem.of(model, records, ridge=4.0)
    theta = first.theta + 0.1
    first.write(first.theta * (1.0 + 1e-9))  # another machine rounds in other ways
    second = Problem.of(model, records, ridge=4.0)
    second.load_state_dict(first.state_dict())
    penalty = slice(-len(theta), None)
    assert torch.equal(second.residual(theta)[penalty], first.residual(theta)[penalty])


def test_jacobian_is_that_of_its_argument_whatever_the_module_holds(model: Model):
    records = some_records(model)
    theta = Problem.of(model, records).theta
    expected = Problem.of(model, records).jacobian(theta)
    problem, other = Problem.of(model, records), Problem.of(model, records)
    problem.residual(theta)
    other.residual(theta + 0.1)
    assert_close(problem.jacobian(theta), expected, rtol=0, atol=1e-8)


def test_frozen_parameters_are_no_part_of_theta(model: Model):
    model.lfr.cell.A.requires_grad_(False)
    before = model.lfr.cell.A.clone()
    problem = Problem.of(model, some_records(model))
    assert len(problem.theta) == model.parameter_count - 4
    problem.residual(problem.theta + 0.1)
    assert torch.equal(model.lfr.cell.A, before)
    assert problem.jacobian(problem.theta).shape[1] == model.parameter_count - 4


def test_divergence_is_a_residual_that_is_not_finite(model: Model):
    problem = Problem.of(model, measure(model, 2000))
    theta = problem.theta
    assert not torch.isfinite(problem.residual(theta + 3.0)).all()
    assert torch.isfinite(problem.residual(theta)).all()


@pytest.mark.parametrize(
    ("nu", "ny", "fs", "message"),
    [(1, 2, 100.0, "input"), (2, 1, 100.0, "output"), (2, 2, 50.0, "50")],
)
def test_records_that_are_not_the_model_s(model: Model, nu: int, ny: int, fs: float, message: str):
    record = Record(np.ones((20, nu)), np.ones((20, ny)), fs, name="lab")
    with pytest.raises(ValueError, match=f"(?s)lab.*{message}"):
        Problem.of(model, record)
    started = replace(some_records(model)[0], start="given", x0=[1.0])
    with pytest.raises(ValueError, match=r"x0 of 1 entries, but the model has 2 states"):
        Problem.of(model, started)


def test_integrator_in_steady_state_ends_the_search_with_a_reason():
    """x+ = x + u with a zero-mean input closes from any start: I - Φ is singular."""
    cell = random_cell(1, 1, 1, 0, 0)
    with torch.no_grad():
        cell.A.fill_(1.0)
        cell.Bu.fill_(1.0)
    model = random_model(cell)
    u = np.tile([1.0, -1.0], 10) * model.scaler.u_scale + model.scaler.u_offset
    record = Record(u, np.ones(20), model.fs, "periodic")
    problem = Problem.of(model, record)
    optimiser = LevenbergMarquardt()
    state = optimiser.step(problem, optimiser.init(problem, problem.theta))
    assert state.reason == "the Jacobian vanishes or is not finite"


def test_one_record_twice_has_two_start_states(model: Model):
    record = replace(some_records(model)[0], start="estimated")
    problem = Problem.of(model, [record, record])
    theta = problem.theta + 0.1
    point, gradient = problem.gradient(theta)
    r, J = point.residual, problem.jacobian(theta)
    assert_close(gradient, 2 * J.mT @ r / problem.size, rtol=1e-8, atol=1e-8)
    assert (J[:, -4:] != 0).any(dim=0).all()


def test_theta_changed_in_place_is_another_theta(model: Model):
    problem = Problem.of(model, some_records(model))
    theta = problem.theta
    before = problem.residual(theta)
    theta += 0.1
    assert not torch.allclose(problem.residual(theta), before)


def test_weights_of_the_module_are_not_those_of_theta(model: Model):
    problem = Problem.of(model, some_records(model))
    theta = problem.theta
    problem.residual(theta)
    kept = theta.clone()
    with torch.no_grad():
        model.lfr.cell.A.mul_(2.0)
    assert torch.equal(theta, kept)
    problem.write(theta.float())
    assert model.lfr.cell.A.dtype == torch.float64


def test_an_output_without_weight_is_scored_all_the_same(model: Model):
    record = measure(model, 30)
    off = replace(record, y=record.y + model.scaler.y_scale, weight=[0.0, 1.0])
    problem = Problem.of(model, off)
    expected = np.sqrt(np.mean(model.scaler.y_scale**2))
    assert problem.rmse(problem.theta) == pytest.approx(expected, rel=1e-9)


def test_nothing_to_fit(model: Model):
    model.lfr.requires_grad_(False)
    with pytest.raises(ValueError, match="all parameters of the model are frozen"):
        Problem.of(model, some_records(model))
    start = replace(some_records(model)[0], start="estimated")
    assert len(Problem.of(model, start).theta) == 2
    assert len(Problem.judge(model, start).theta) == 0


def cached_rows(jacobian: Jacobian, group: int = 0) -> Tensor | None:
    """The rows that the Jacobian of a group of records holds."""
    part = jacobian.parts[group]
    assert isinstance(part, OutputRows)
    return None if part._cached is None else part._cached[0]


@pytest.mark.parametrize("spare", [0, -1])
def test_rows_of_all_groups_share_the_room_for_them(model: Model, spare: int, monkeypatch):
    """Two of three groups fit exactly; a byte less, and the last does not."""
    records = some_records(model)
    problem = Problem.of(model, records)
    columns = len(problem.linearise(problem.theta)._reduced.kept) + 1
    room = 8 * 2 * (2 * 30 + 20) * columns + spare  # of two outputs
    monkeypatch.setattr("lfrtorch.least_squares.jacobian.CACHED_BYTES", room)
    jacobian = problem.linearise(problem.theta)
    jacobian.system(1e-2, 1e-12)
    kept = [cached_rows(jacobian, group) is not None for group in range(3)]
    assert kept == [True, False, spare == 0]
    d = torch.ones_like(problem.theta)
    assert_close(jacobian.tangent(d), jacobian.whole() @ d, rtol=0, atol=1e-8)


def test_two_jacobians_keep_their_own_rows_and_a_third_takes_over_the_room(model: Model):
    problem = Problem.of(model, some_records(model))
    first_theta, second_theta = problem.theta, problem.theta + 0.1
    first, second = problem.linearise(first_theta), problem.linearise(second_theta)
    for jacobian in (first, second):
        jacobian.system(1e-2, 1e-12)
    d = torch.ones_like(first_theta)
    assert_close(first.tangent(d), first.whole() @ d, rtol=0, atol=1e-8)
    assert_close(second.tangent(d), second.whole() @ d, rtol=0, atol=1e-8)
    rows = cached_rows(second)
    assert rows is not None
    where = rows.untyped_storage().data_ptr()
    del second, jacobian, rows
    third = problem.linearise(second_theta)
    third.system(1e-2, 1e-12)
    rows = cached_rows(third)
    assert rows is not None
    assert rows.untyped_storage().data_ptr() == where


def test_a_jacobian_asks_for_room_once(model: Model, monkeypatch):
    problem = Problem.of(model, some_records(model))
    jacobian = problem.linearise(problem.theta)
    jacobian.system(1e-2, 1e-12)
    monkeypatch.setattr("lfrtorch.least_squares.output_rows.Memory.take", None)
    jacobian.system(1e-15, 1e-12)


# --- entries that stay as they are ------------------------------------------------------------

RIDGE_AND_ROOM = pytest.mark.parametrize(("ridge", "kept"), [(0.0, True), (0.5, False)])


def holding_some(model: Model) -> tuple[Model, torch.Tensor]:
    """The model with every third of its entries held, the first one too, and their mask."""
    found = deepcopy(model)
    held = torch.arange(model.parameter_count) % 3 == 0
    named = list(found.lfr.cell.named_parameters())
    masks = held.split([p.numel() for _, p in named])
    for (name, p), mask in zip(named, masks, strict=True):
        found.lfr.cell.hold({name: (mask.view_as(p), p.detach())})
    return found, held


@pytest.mark.parametrize(
    ("ridge", "kept", "precise"),
    [(0.0, True, True), (0.5, False, True), (0.5, True, False), (0.0, False, False)],
)
def test_fixed_entries_have_columns_of_zeros(
    model: Model, ridge: float, kept: bool, precise: bool, monkeypatch
):
    """The other columns are the plain Jacobian's, whichever way a product or a system takes."""
    monkeypatch.setattr("lfrtorch.least_squares.jacobian.CACHED_BYTES", 1 << 20 if kept else 0)
    records = all_kinds(model, given=False)
    theta = Problem.of(model, records).theta + 0.1
    plain = Problem.of(model, records, ridge=ridge).jacobian(theta)
    holding, own = holding_some(model)
    problem = Problem.of(holding, records, ridge=ridge)
    held = torch.cat([own, torch.zeros(4 * 2, dtype=torch.bool)])  # start states follow
    r, J = problem.residual(theta), problem.jacobian(theta)
    assert torch.equal(J[:, held], torch.zeros_like(J[:, held]))
    # The same recurrence from a periodic start known to 1e-10.
    assert_close(J[:, ~held], plain[:, ~held], rtol=0, atol=1e-9 * float(plain.abs().max()))

    zeros = torch.zeros(int(held.sum()), dtype=torch.float64)
    _, slope = problem.gradient(theta)
    assert torch.equal(slope[held], zeros)
    assert_close(slope, 2 * J.mT @ r / problem.size, rtol=1e-8, atol=1e-8)

    jacobian = problem.linearise(theta)
    system, gradient = jacobian.system(1e-15 if precise else 1e-2, 1e-12)
    assert torch.equal(gradient[held], zeros)
    assert torch.equal(jacobian.adjoint(r)[held], zeros)
    # As for the whole Jacobian above: the scale of J times 1e-10.
    assert_close(jacobian.tangent(theta), J @ theta, rtol=0, atol=1e-8)
    assert_close(jacobian.adjoint(r), J.mT @ r, rtol=0, atol=1e-8)
    damping = 1e-3 * system.scale
    expected = -torch.linalg.solve(J.mT @ J + damping * torch.eye(len(theta)), J.mT @ r)
    step = system.solve(gradient, damping)
    assert torch.equal(step[held], zeros)
    # The condition is 1e3 by the damping, the steady state known to 1e-10.
    assert_close(step, expected, rtol=0, atol=1e-7 * float(expected.abs().max()))


@RIDGE_AND_ROOM
def test_search_leaves_fixed_entries_and_brings_the_rest_home(
    model: Model, ridge: float, kept: bool, monkeypatch
):
    """With geodesic acceleration, whose right side is a product with J by itself."""
    monkeypatch.setattr("lfrtorch.least_squares.jacobian.CACHED_BYTES", 1 << 20 if kept else 0)
    records = [measure(model, 60, seed=i) for i in range(2)]
    theta = Problem.of(model, records).theta
    holding, held = holding_some(model)
    problem = Problem.of(holding, records, ridge=1e-8 * ridge)
    away = 0.02 * torch.randn(len(theta), generator=torch.Generator().manual_seed(0)).double()
    away[held] = 0.0
    optimiser = LevenbergMarquardt(max_iter=100)
    state = optimiser.init(problem, theta + away)
    while not state.reason:
        state = optimiser.step(problem, state)
    assert torch.equal(state.theta[held], theta[held])
    # Noise-free, and θ_start of the ridge is the planted θ: the search ends at rounding.
    assert problem.rmse(state.theta) < 1e-8


@pytest.mark.parametrize("ridge", [0.0, 2.0])
def test_minibatches_are_the_whole_in_parts(model: Model, ridge: float):
    kinds = all_kinds(model)
    records = [replace(kinds[i % len(kinds)], weight=1.0 + i % 3) for i in range(80)]
    problem = Problem.of(model, records, ridge=ridge)
    theta = problem.theta + 1e-2 * normal(len(problem.theta), seed=5)
    _, whole = problem.gradient(theta)
    parts = problem.minibatches(0)
    assert len(parts) == 3  # of 32 records at most
    assert sum(part.size for part in parts) == problem.size
    total = torch.stack([part.size / problem.size * part.gradient(theta)[1] for part in parts])
    assert_close(total.sum(0), whole)
    assert_close(problem.gradient(theta)[1], whole)  # the parts have weights of their own


def test_the_error_of_several_units_is_a_relative_one(model: Model):
    """So that the history of a fit, which advice is taken from, does not follow one output."""
    record, scaler, errors = measure(model, 50), model.scaler, []
    record = replace(record, y=record.y + np.random.default_rng(0).normal(size=record.y.shape))
    for factor in (1.0, 1e6):
        by = np.append(factor, np.ones(len(model.outputs) - 1))
        units = replace(scaler, y_offset=scaler.y_offset * by, y_scale=scaler.y_scale * by)
        for unit in ("mm", "Pa"):
            outputs = (Channel("y1", unit), *model.outputs[1:])
            own = replace(model, scaler=units, outputs=outputs)
            problem = Problem.of(own, replace(record, y=record.y * by, outputs=outputs))
            errors.append(problem.rmse(problem.theta))
    of_one, of_several, of_one_scaled, of_several_scaled = errors
    assert of_several_scaled == pytest.approx(of_several)
    assert of_one_scaled > 1e4 * of_one


def test_minibatches_share_records_of_unlike_lengths(model: Model):
    """Also if no two are as long, and in the same numbers, give or take one."""
    for lengths in ([5 + i for i in range(70)], [20] * 64 + [30 + i for i in range(30)]):
        records = [measure(model, samples, seed=i) for i, samples in enumerate(lengths)]
        problem = Problem.of(model, records)
        parts = problem.minibatches(0)
        counts = [sum(len(group.u) for group in part.errors.groups) for part in parts]
        assert sum(counts) == len(records)
        assert max(counts) - min(counts) <= 1
        whole = problem.gradient(problem.theta + 0.01)[1]
        of_parts = [part.size * part.gradient(problem.theta + 0.01)[1] for part in parts]
        torch.testing.assert_close(torch.stack(of_parts).sum(0) / problem.size, whole)


def test_minibatches_are_drawn_anew_and_again_the_same(model: Model):
    problem = Problem.of(model, some_records(model) * 20)
    first, again, other = (
        problem.minibatches(epoch)[0].residual(problem.theta) for epoch in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


def test_few_records_are_not_divided(model: Model):
    problem = Problem.of(model, some_records(model))
    assert problem.minibatches(0) == [problem]
