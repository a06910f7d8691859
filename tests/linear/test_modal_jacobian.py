"""Derivatives by modes are those of the general path."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference import POLES, random_system, special_poles

from lfrtorch import Record, estimate_bla
from lfrtorch.linear.modal_jacobian import ModalJacobian, Modes, with_best_inputs
from lfrtorch.linear.pole_limits import PoleLimits
from lfrtorch.linear.resolvent import frequency_response
from lfrtorch.linear.response_fit import ResponseFit, ResponseJacobian, ResponseProblem
from lfrtorch.linear.spectral_data import SpectralData

pytestmark = pytest.mark.numeric

NX, NU, NY = 5, 2, 3


def some_data(columns: int = 2, *, weighted: bool = False) -> SpectralData:
    rng = np.random.default_rng(2)
    z = np.exp(1j * np.linspace(1.0, 2.0, 40))
    U, Y = (
        rng.normal(size=(40, n, columns)) + 1j * rng.normal(size=(40, n, columns)) for n in (NU, NY)
    )
    return SpectralData(z, U, Y, rng.uniform(0.5, 2.0, size=Y.shape) if weighted else None)


def problems(*, weighted: bool) -> tuple[ResponseProblem, ResponseProblem, torch.Tensor]:
    """The same problem by modes and in general, and θ with poles far from all lines."""
    data, free = some_data(weighted=weighted), np.ones((NY, NU), dtype=bool)
    free[1, 0] = False
    limits = PoleLimits(data.z)
    pair = [
        ResponseProblem(data, NX, free_feedthrough=free, by_modes=modal, limits=limits)
        for modal in (True, False)
    ]
    A, B, C, D = random_system(NX, NU, NY, seed=3)
    D[1, 0] = 0.0
    theta = torch.as_tensor(np.concatenate([m.ravel() for m in (A, B, C, D)]))
    return pair[0], pair[1], theta


@pytest.mark.parametrize("weighted", [True, False])
def test_residual_slope_and_system_are_those_of_the_general_path(weighted: bool):
    modal, general, theta = problems(weighted=weighted)
    r = modal.residual(theta)
    assert r[-NX:].abs().max() > 0  # some poles are beyond their limits
    np.testing.assert_allclose(r, general.residual(theta), rtol=1e-9, atol=1e-9)
    ours, theirs = modal.linearise(theta), general.linearise(theta)
    assert isinstance(ours, ModalJacobian)
    assert isinstance(theirs, ResponseJacobian)
    (system, gradient), (expected, same) = (j.system(1.0, 1e-12) for j in (ours, theirs))
    size = float(same.abs().max())
    np.testing.assert_allclose(gradient, same, rtol=0, atol=1e-9 * size)
    np.testing.assert_allclose(ours.adjoint(r), same, rtol=0, atol=1e-9 * size)
    d = torch.as_tensor(np.random.default_rng(4).normal(size=len(theta)))
    tangent = theirs.tangent(d)
    atol = 1e-9 * float(tangent.abs().max())
    np.testing.assert_allclose(ours.tangent(d), tangent, rtol=0, atol=atol)
    assert system.scale == pytest.approx(expected.scale, rel=1e-9)
    assert system.rank == expected.rank == NX * (NU + NY) + NU * NY - 1
    step = expected.solve(same, 1e-3 * expected.scale)
    atol = 1e-7 * float(step.abs().max())
    np.testing.assert_allclose(system.solve(gradient, 1e-3 * system.scale), step, rtol=0, atol=atol)


def test_slope_with_poles_beyond_their_limits_is_a_central_difference():
    problem, _, theta = problems(weighted=True)
    jacobian, h = problem.linearise(theta), 1e-6
    for seed in range(3):
        d = torch.as_tensor(np.random.default_rng(seed).normal(size=len(theta)))
        d[-NU * NY + NU] = 0.0  # the entry of D that is fixed
        difference = (problem.residual(theta + h * d) - problem.residual(theta - h * d)) / (2 * h)
        atol = 1e-6 * float(difference.abs().max())
        np.testing.assert_allclose(jacobian.tangent(d), difference, rtol=0, atol=atol)


@pytest.mark.parametrize("weighted", [True, False])
def test_best_inputs_are_those_of_the_general_path(weighted: bool, monkeypatch: pytest.MonkeyPatch):
    fit = ResponseFit(some_data(weighted=weighted), known=False)
    A, _, C, _ = random_system(NX, NU, NY, seed=3)
    cost, (_, B, _, D) = fit.with_input_matrices(A, C)
    monkeypatch.setattr("lfrtorch.linear.response_fit.MANY", 1)
    same, (_, B_by_modes, _, D_by_modes) = fit.with_input_matrices(A, C)
    assert same == pytest.approx(cost, rel=1e-10)
    np.testing.assert_allclose(B_by_modes, B, rtol=0, atol=1e-8 * np.abs(B).max())
    np.testing.assert_allclose(D_by_modes, D, rtol=0, atol=1e-8 * np.abs(D).max())


def test_defective_matrix_has_no_modes_and_is_fitted_all_the_same():
    A = np.diag([0.5, 0.5, 0.5]) + np.diag([1.0, 1.0], 1)
    B, C, D = np.ones((3, NU)), np.ones((NY, 3)), np.zeros((NY, NU))
    data = some_data()
    assert Modes.of(A, B, C, D) is None
    assert with_best_inputs(A, C, data, D == 0) is None
    G = frequency_response(A, B, C, D, data.z)
    problem = ResponseProblem(SpectralData(data.z, data.U, G @ data.U), 3, by_modes=True)
    theta = torch.as_tensor(np.concatenate([m.ravel() for m in (A, B, C, D)]))
    assert float(problem.residual(theta).abs().max()) < 1e-9
    assert isinstance(problem.linearise(theta), ResponseJacobian)


def test_one_input_and_output_are_fitted_by_modes_as_well(monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(5)
    system = random_system(4, 1, 1, seed=6)
    u = rng.normal(size=(300, 1))
    y = reference.dlsim(system, np.tile(u, (4, 1)))[-300:]
    record = Record(u, y + 0.01 * y.std() * rng.normal(size=y.shape), start="periodic")
    expected = estimate_bla(record, 4)
    monkeypatch.setattr("lfrtorch.linear.response_fit.MANY", 1)
    found = estimate_bla(record, 4)
    assert found.fit is not None
    assert expected.fit is not None
    assert found.fit.rmse == pytest.approx(expected.fit.rmse, rel=1e-4)


@given(
    kind=st.sampled_from(POLES),
    sizes=st.tuples(st.integers(1, 4), st.integers(1, 2), st.integers(1, 2)),
    hidden=st.sampled_from(["", "input", "output", "both"]),
    seed=st.integers(0, 1000),
)
@example(kind="repeated", sizes=(2, 1, 1), hidden="", seed=0)  # divided by 0
@example(kind="near", sizes=(4, 2, 2), hidden="", seed=3)  # JᵀJ was wrong by 1e7
@example(kind="defective", sizes=(3, 1, 1), hidden="", seed=0)  # warned of an overflow
@example(kind="slow", sizes=(4, 1, 2), hidden="output", seed=0)  # was NaN
@example(kind="slow", sizes=(2, 1, 1), hidden="both", seed=1)  # variances were negative
@settings(max_examples=40)
def test_modes_are_used_where_they_are_the_general_path(
    kind: str, sizes: tuple[int, int, int], hidden: str, seed: int
):
    """Poles of all kinds, and states that no input moves or no output shows."""
    (nx, nu, ny), rng = sizes, np.random.default_rng(seed)
    A = special_poles(kind, nx, rng)
    B, C, D = (rng.normal(size=shape) for shape in ((nx, nu), (ny, nx), (ny, nu)))
    if hidden in ("input", "both"):
        B[0] = 0.0
    if hidden in ("output", "both"):
        C[:, 0] = 0.0
    theta = torch.as_tensor(np.concatenate([m.ravel() for m in (A, B, C, D)]))
    z = np.exp(1j * np.linspace(1.0, 2.0, 20))
    U, Y = (rng.normal(size=(20, n, 2)) + 1j * rng.normal(size=(20, n, 2)) for n in (nu, ny))
    modal, general = (
        ResponseProblem(SpectralData(z, U, Y), nx, by_modes=by_modes) for by_modes in (True, False)
    )
    d = torch.as_tensor(rng.normal(size=len(theta)))
    ours, theirs = modal.linearise(theta), general.linearise(theta)
    expected = theirs.tangent(d)
    size = float(expected.norm())
    np.testing.assert_allclose(ours.tangent(d), expected, rtol=0, atol=1e-6 * size)
    (system, gradient), (same, _) = (j.system(1.0, 1e-12) for j in (ours, theirs))
    assert system.scale == pytest.approx(same.scale, rel=1e-3)
    step, expected = (each.solve(gradient, 1e-2 * same.scale) for each in (system, same))
    # JᵀJ has four digits of the largest left, and a hundredth of that is its damping.
    assert float((step - expected).norm()) <= 1e-2 * float(expected.norm())
    assert (np.diag(modal.covariance(theta, known=False)) >= 0.0).all()
