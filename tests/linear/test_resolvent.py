"""The response against its formula, its slopes against autograd, poles of any multiplicity."""

import numpy as np
import pytest
import reference
import scipy.linalg
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import MATRICES, POLES, System, random_system, special_matrix, special_poles
from torch import Tensor

from lfrtorch._support.types import Complex
from lfrtorch.linear.resolvent import (
    frequency_response,
    gain_jacobian,
    response_jacobian,
    solve_driven,
    solve_left,
    solve_resolvent,
)

pytestmark = pytest.mark.numeric

OMEGA = np.linspace(0.0, np.pi, 9)
Z = np.exp(1j * OMEGA)

SIZES = pytest.mark.parametrize(
    ("nx", "nu", "ny"), [(1, 1, 1), (1, 3, 2), (4, 1, 1), (4, 2, 3), (5, 3, 1)]
)


def some_input(nu: int, m: int) -> Complex:
    """Spectra (F, nu, m) that are neither real nor the unit matrix."""
    generator = np.random.default_rng(3)
    shape = (len(Z), nu, m)
    return generator.normal(size=shape) + 1j * generator.normal(size=shape)


# --- the response ---------------------------------------------------------------------------


@SIZES
def test_response_is_its_formula(nx: int, nu: int, ny: int):
    system = random_system(nx, nu, ny)
    G = frequency_response(*system, Z)
    expected = reference.frf(system, OMEGA)
    assert G.shape == (len(Z), ny, nu)
    # eps times the gain of the slowest pole, squared: 1e-14 of the largest.
    np.testing.assert_allclose(G, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def jordan(pole: float, nx: int) -> tuple[System, Complex]:
    """One Jordan block in rotated coordinates, and its response by Σ Nᵏ / (z - pole)ᵏ⁺¹."""
    generator = np.random.default_rng(nx)
    N = np.eye(nx, k=1)
    Q = scipy.linalg.qr(generator.normal(size=(nx, nx)))[0]
    B, C, D = (generator.normal(size=shape) for shape in ((nx, 2), (2, nx), (2, 2)))
    G = D + sum(
        C @ np.linalg.matrix_power(N, k) @ B / (Z[:, None, None] - pole) ** (k + 1)
        for k in range(nx)
    )
    A = np.asarray(Q @ (pole * np.eye(nx) + N) @ Q.T)
    return (A, np.asarray(Q @ B), C @ Q.T, D), np.asarray(G, dtype=np.complex128)


@pytest.mark.parametrize(("pole", "nx"), [(0.7, 2), (0.7, 4), (0.0, 2), (0.0, 6), (0.0, 12)])
def test_repeated_pole(pole: float, nx: int):
    """As accurate as a solution for every z, although poles move by eps^(1/nx)."""
    system, expected = jordan(pole, nx)
    G = frequency_response(*system, Z)
    # eps times the condition of zI - A: at 0.7 it is 2 / 0.3^4 = 250 and more, at 0 it is nx².
    atol = 1e-12 if pole else 1e-13
    np.testing.assert_allclose(G, expected, rtol=0, atol=atol * np.abs(expected).max())


# --- its slope ------------------------------------------------------------------------------


def by_autograd(system: System, U: Complex) -> Complex:
    """Slope (F, ny, m, P) of G U with A, B, C, D in a row, by reverse mode through a solution."""
    shapes = [matrix.shape for matrix in system]
    theta = torch.as_tensor(np.concatenate([matrix.ravel() for matrix in system]))
    z, spectra = torch.as_tensor(Z), torch.as_tensor(U)

    def response(theta: Tensor) -> Tensor:
        parts = theta.split([rows * columns for rows, columns in shapes])
        A, B, C, D = (p.reshape(s).to(z.dtype) for p, s in zip(parts, shapes, strict=True))
        M = z[:, None, None] * torch.eye(len(A)) - A
        return torch.view_as_real(
            (C @ torch.linalg.solve(M, B.expand(len(z), -1, -1)) + D) @ spectra
        )

    J = torch.autograd.functional.jacobian(response, theta).numpy()
    return J[:, :, :, 0] + 1j * J[:, :, :, 1]


def slopes(system: System, U: Complex) -> Complex:
    A, B, C, _ = system
    return response_jacobian(solve_driven(A, B, Z, U), solve_left(A, C, Z), U)


@SIZES
@pytest.mark.parametrize("m", [1, 4])
def test_slopes_are_those_of_autograd(nx: int, nu: int, ny: int, m: int):
    system, U = random_system(nx, nu, ny), some_input(nu, m)
    J = slopes(system, U)
    expected = by_autograd(system, U)
    assert J.shape == (len(Z), ny, m, (nx + ny) * (nx + nu))
    # eps times the gain of the slowest pole, cubed: 1e-13 of the largest.
    np.testing.assert_allclose(J, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_slopes_at_a_defective_pole_are_those_of_autograd():
    """Where there are no eigenvectors to take."""
    system, U = jordan(0.0, 4)[0], some_input(2, 1)
    expected = by_autograd(system, U)
    atol = 1e-12 * np.abs(expected).max()
    np.testing.assert_allclose(slopes(system, U), expected, rtol=0, atol=atol)


def test_chosen_columns_are_those_of_all():
    system, U = random_system(3, 2, 3), some_input(2, 2)
    A, B, C, _ = system
    S, L = solve_driven(A, B, Z, U), solve_left(A, C, Z)
    every = response_jacobian(S, L, U)
    columns = np.array([29, 0, 8, 9, 14, 15, 23, 24])  # both ends of A, B, C and D
    assert np.array_equal(response_jacobian(S, L, U, columns), every[..., columns])
    assert response_jacobian(S, L, U, columns[:0]).shape == (len(Z), 3, 2, 0)


@SIZES
def test_slopes_of_the_gain_are_those_under_unit_inputs(nx: int, nu: int, ny: int):
    system = random_system(nx, nu, ny)
    A, B, C, _ = system
    one = np.tile(np.eye(nu, dtype=complex), (len(Z), 1, 1))
    found, expected = gain_jacobian(A, B, C, Z), slopes(system, one)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@given(
    poles=st.sampled_from(POLES),
    kind=st.sampled_from(MATRICES),
    sizes=st.tuples(st.integers(1, 5), st.integers(1, 3), st.integers(1, 3)),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40)
def test_response_of_any_poles_is_its_formula(
    poles: str, kind: str, sizes: tuple[int, int, int], seed: int
):
    (nx, nu, ny), rng = sizes, np.random.default_rng(seed)
    A, B = special_poles(poles, nx, rng), special_matrix(kind, nx, nu, rng)
    C, D = special_matrix(kind, ny, nx, rng), special_matrix(kind, ny, nu, rng)
    X, L = solve_resolvent(A, B, Z), solve_left(A, C, Z)
    for k, z in enumerate(Z):
        inverse = np.linalg.inv(z * np.eye(nx) - A)
        # eps of A, which the inverse multiplies on either side.
        limit = 1e-12 * (1.0 + np.linalg.norm(A)) * np.linalg.norm(inverse) ** 2
        assert np.abs(X[k] - inverse @ B).max() <= limit * np.linalg.norm(B)
        assert np.abs(L[k] - C @ inverse).max() <= limit * np.linalg.norm(C)
    G = frequency_response(A, B, C, D, Z)
    limit = 1e-13 * (np.abs(C).max() * np.abs(X).max() * nx + np.abs(D).max())
    assert np.abs(G - (C @ X + D)).max() <= limit
