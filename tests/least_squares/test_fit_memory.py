"""Sizes that take more memory to fit than a machine has."""

import numpy as np
import pytest
import torch
from reference import random_cell, random_model

from lfrtorch.data.records import Record
from lfrtorch.engine.cell import LFRCell
from lfrtorch.least_squares.fit_memory import check_fit_memory
from lfrtorch.least_squares.problem import Problem
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial


def planned(nz: int, nn: int) -> LFRCell:
    with torch.device("meta"):
        return LFRCell(1, 1, 2, nz, 1, Network(nz, 1, nn), random=False)


@pytest.mark.parametrize(("nz", "nn"), [(1, 10_000_000), (3000, 3), (1000, 100_000)])
def test_sizes_beyond_any_machine(nz: int, nn: int):
    with pytest.raises(ValueError, match=rf"nx=2, nz={nz} and nw=1 takes .*; give smaller sizes"):
        check_fit_memory(planned(nz, nn))


def test_start_states_count_as_parameters():
    check_fit_memory(planned(2, 20))
    with pytest.raises(ValueError, match="a fit of 100000099 parameters"):
        check_fit_memory(planned(2, 20), states=100_000_000)


def test_rows_of_spectra_are_held():
    check_fit_memory(planned(2, 20), rows=100_000)
    with pytest.raises(ValueError, match=r"to 100000000000 samples with line_weight takes .*TB"):
        check_fit_memory(planned(2, 20), rows=100_000_000_000)


def test_a_polynomial_of_too_many_terms():
    with pytest.raises(ValueError, match="a polynomial with nz=60, nw=1 and degree=30 takes"):
        Polynomial(60, 1, 30)


def test_a_system_of_all_start_states_is_checked_after_one_without(monkeypatch: pytest.MonkeyPatch):
    """A search eliminates the start states of many records, and a covariance has them all."""
    model, rng = random_model(random_cell(nx=2)), np.random.default_rng(0)
    records = [
        Record(rng.normal(size=(9, 1)), rng.normal(size=(9, 1)), fs=model.fs, start="estimated")
        for _ in range(50)
    ]
    checked: list[int] = []
    monkeypatch.setattr(
        "lfrtorch.least_squares.problem.check_fit_memory",
        lambda cell, states, rows: checked.append(states),
    )
    problem = Problem.of(model, records)
    for eliminate in (True, True, False, False):
        problem.linearise(problem.theta, eliminate=eliminate)
    assert checked == [0, 100]


@pytest.mark.parametrize(("states", "rows"), [(0, 0), (7, 0), (7, 100)])
def test_bytes_are_those_of_the_matrices_of_a_step(states: int, rows: int, monkeypatch):
    """Four of P x P, three of P x gauge directions, the largest group of these, and rows x P."""
    asked: list[int] = []
    monkeypatch.setattr(
        "lfrtorch.least_squares.fit_memory.check_memory", lambda count, *_: asked.append(count)
    )
    cell = planned(3, 20)
    cell.Bu.requires_grad_(False)
    check_fit_memory(cell, states, rows)
    P = sum(p.numel() for p in cell.parameters()) - 2 + states
    numbers = 4 * P**2 + 3 * P * (2**2 + 3**2 + 1**2) + (3**2) ** 2 + rows * P
    assert asked == [4 * numbers]
