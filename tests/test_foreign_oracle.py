"""The numerical core beside freq-statespace, in JAX: the same numbers from the same θ.

``make oracle`` makes its environment and runs these tests; ``peer_freq_statespace.py`` runs there.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from reference import measure, move, normal, random_cell, random_model
from torch import Tensor
from torch.func import functional_call, jacfwd, jacrev

from lfrtorch import LevenbergMarquardt, Model, Record, Scaler
from lfrtorch._support.types import Array
from lfrtorch.least_squares.problem import Problem

TESTS = Path(__file__).resolve().parent
PYTHON = Path(os.environ.get("LFRTORCH_ORACLE", TESTS.parent / ".oracle" / "bin" / "python"))
"""The Python that has freq-statespace."""

pytestmark = [
    pytest.mark.numeric,
    pytest.mark.slow,
    pytest.mark.skipif(not PYTHON.is_file(), reason="no freq-statespace: make oracle installs it"),
]

DAMPINGS = [1e2, 1.0, 1e-1]
"""λ of the steps. Eigenvalues of JᵀJ are 0 to 1e4, so steps have rounding errors of 1e-12 / λ."""

FIRST_DAMPING = 1.0
"""λ of the first step of a fit of freq-statespace."""

TRUNCATION = 1e-12


class Core(NamedTuple):
    """r and J at the θ of a model, and the system and the gradient Jᵀr in two ways."""

    r: Tensor
    J: Tensor
    systems: list[tuple[Any, Tensor]]


def core(model: Model, records: list[Record]) -> Core:
    """By normal equations, as for damping of 1e-2, and by orthogonal transformations."""
    problem = Problem.of(model, records)
    theta = problem.theta
    systems = [problem.linearise(theta).system(damping, TRUNCATION) for damping in (1e-2, 0.0)]
    return Core(problem.residual(theta), problem.jacobian(theta), systems)


def core_step(model: Model, records: list[Record], damping: float) -> Tensor:
    """The first step of the search, with this λ."""
    problem = Problem.of(model, records)
    theta = problem.theta
    relative = damping / problem.linearise(theta).system(0.0, TRUNCATION)[0].scale
    search = LevenbergMarquardt(damping=relative, least_damping=relative, acceleration=False)
    return search.step(problem, search.init(problem, theta)).theta - theta


# --- both sides -----------------------------------------------------------------------------


class Both(NamedTuple):
    """A model, its records, and what freq-statespace computes of them."""

    model: Model
    records: list[Record]
    theirs: Mapping[str, Array]


def planted(T: int, start: Any, **sizes: Any) -> tuple[Model, list[Record]]:
    """A model some way off, and two noisy records of the true one."""
    truth, records = random_model(random_cell(**sizes, radius=0.7, feedback=0.2)), []
    for seed in (0, 1):
        exact = measure(truth, T, seed=seed, start=start)
        noise = 0.1 * normal(*exact.y.shape, seed=seed + 2).numpy()
        records.append(replace(exact, y=exact.y + noise))
    model = replace(truth, scaler=Scaler.of(records))
    move(model, 0.05)
    return model, records


def given(model: Model, records: list[Record]) -> dict[str, Any]:
    """What the other side starts from; one whole period before the record leaves nothing of x0."""
    weights = {name: p.detach().numpy() for name, p in model.lfr.cell.named_parameters()}
    periodic, T = records[0].start == "periodic", records[0].samples
    signals = {name: np.stack([getattr(r, name) for r in records], axis=-1) for name in ("u", "y")}
    options = {"names": [*weights], "dampings": DAMPINGS, "offset": T if periodic else 0}
    return {**options, "fs": model.fs, **vars(model.scaler), **signals, **weights}


@cache
def both(start: str, number: int) -> Both:
    T, sizes = MODELS[number]
    model, records = planted(T, start, **sizes)
    with TemporaryDirectory() as folder:
        before, after = Path(folder, "given.npz"), Path(folder, "found.npz")
        np.savez(before, **given(model, records))
        done = subprocess.run(
            [PYTHON, TESTS / "peer_freq_statespace.py", before, after],
            env={**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": ""},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return Both(model, records, dict(np.load(after)))


MODELS = [
    (500, {"nu": 1, "ny": 1, "nx": 2, "nz": 1, "nw": 1, "nn": 8}),
    (300, {"nu": 2, "ny": 2, "nx": 3, "nz": 2, "nw": 2, "nn": 5}),
]
steady = pytest.mark.parametrize("case", [("periodic", 0), ("periodic", 1)], ids=str)
all_cases = pytest.mark.parametrize(
    "case", [("zero", 0), ("periodic", 0), ("zero", 1), ("periodic", 1)], ids=str
)


def agree(mine: Any, theirs: Array):
    """The columns differ by less than 1e-9 of their largest entries."""
    mine = np.asarray(mine)
    assert mine.shape == theirs.shape
    apart = np.abs(mine - theirs).max(axis=0) / np.abs(theirs).max(axis=0)
    assert apart.max() < 1e-9


@all_cases
def test_simulations(case: tuple[str, int]):
    model, records, theirs = both(*case)
    agree(np.stack([model.simulate(record) for record in records], axis=-1), theirs["y"])


@all_cases
def test_residual_and_jacobian(case: tuple[str, int]):
    model, records, theirs = both(*case)
    r, J, _ = core(model, records)
    agree(r, theirs["r"])
    agree(J, theirs["J"])
    agree(J.mT @ J, theirs["J"].T @ theirs["J"])


@all_cases
@pytest.mark.parametrize("derivative", [jacfwd, jacrev])
@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
def test_derivatives_of_the_module(case: tuple[str, int], derivative: Any):
    model, records, theirs = both(*case)
    u = torch.as_tensor(np.stack([model.scaler.normalise_u(record.u) for record in records]))

    def simulated(weights: dict[str, Tensor]) -> Tensor:
        return functional_call(model.lfr, weights, (u, None, records[0].start)).flatten()

    by_name = derivative(simulated)({name: p.detach() for name, p in model.lfr.named_parameters()})
    agree(torch.cat([part.flatten(1) for part in by_name.values()], dim=1), theirs["J"])


@all_cases
def test_gradient_and_damped_steps(case: tuple[str, int]):
    model, records, theirs = both(*case)
    for system, gradient in core(model, records).systems:
        agree(gradient, theirs["gradient"])
        for damping, step in zip(DAMPINGS, theirs["steps"], strict=True):
            agree(system.solve(gradient, damping), step)


@steady
def test_first_step_of_a_fit(case: tuple[str, int]):
    """Its cost is Σ |E|² over the lines of rfft, by their number and that of records."""
    model, records, theirs = both(*case)
    T = records[0].samples
    # T Σ e² is the sum over all T lines, in which those between 0 and fs / 2 count twice.
    once = np.full(T // 2 + 1, 0.5)
    once[[0, -1]] = 1.0
    damping = FIRST_DAMPING * len(once) * len(records) / T
    records = [replace(record, line_weight=once) for record in records]
    agree(core_step(model, records, damping), theirs["first_step"])
