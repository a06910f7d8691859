"""A model that is made of blocks stays so: in a fit, in a file, and in what it computes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, random_cell, random_model

import lfrtorch
from lfrtorch.data.records import Record
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.held import (
    IN_SERIES,
    held_parameters,
    integrators,
    measured_states,
    no_feedthrough,
    past_outputs,
    structure,
)
from lfrtorch.engine.weights import Held
from lfrtorch.maps.direct_sum import DirectSum
from lfrtorch.maps.known_map import KnownEquations, KnownModel
from lfrtorch.maps.network import Network
from lfrtorch.maps.operations import Formula
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

KINDS = ("wiener", "hammerstein", "wiener_hammerstein", "parallel")


def begun(kind: str, record: Record, *, nx: int = 2, seed: int = 0, **sizes: Any) -> Model:
    bla = lfrtorch.estimate_bla(record, nx=nx)
    branches = 2 if kind == "parallel" else 1
    sizes = {"nz": branches, "nw": branches, "nn": 6} | sizes
    return lfrtorch.initialise(bla, record, **sizes, structure=kind, seed=seed)


def truth(kind: str) -> Model:
    """A system of that structure, strongly nonlinear; blocks in series have a state per branch."""
    branches = 2 if kind == "parallel" else 1
    nx = 2 * branches
    cell = random_cell(1, 1, nx, branches, branches, 4, radius=0.8, feedback=1.0, seed=3)
    cell.hold(structure(cell, kind))
    assert isinstance(cell.static, Network)
    with torch.no_grad():
        cell.Dyw.fill_(1.0 if kind == "wiener" else 0.0)
        cell.static.Ww.mul_(2.0)
        cell.static.Wz.mul_(2.0)
        cell.Bw.mul_(2.0)
    return random_model(cell)


@pytest.fixture(scope="module")
def record() -> Record:
    return measure(random_model(random_cell(nx=2, radius=0.8, feedback=0.4)), 200)


@pytest.mark.parametrize("kind", KINDS)
def test_a_fit_and_a_file_keep_the_blocks(kind: str, record: Record, tmp_path: Path):
    model = begun(kind, record)
    linear = lfrtorch.estimate_bla(record, nx=2)
    np.testing.assert_allclose(model.simulate(record), linear.simulate(record), atol=1e-8)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=25)
    fitted = lfrtorch.fit(model, record, record, trainer=trainer).model
    cell = fitted.lfr.cell
    error = np.std(fitted.simulate(record) - record.y)
    assert error < 0.98 * np.std(linear.simulate(record) - record.y)
    assert cell.held.keys() == structure(cell, kind).keys()
    for name, zeros in cell.held.items():
        assert not cell.get_parameter(name)[zeros].any(), name
    again = lfrtorch.load(fitted.save(tmp_path / "model"))
    assert all(again.lfr.cell.held[name].equal(mask) for name, mask in cell.held.items())
    assert again.parameter_count == fitted.parameter_count
    assert again.parameter_count < sum(p.numel() for p in again.lfr.parameters())


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_planted_systems_are_recovered(kind: str):
    """From noise-free steady states, to a fiftieth of the linear model's error on other data.

    Validation picks one of 16 starts if the blocks are in series: the linear model does not say
    which of its poles are before the static map and which after it.
    """
    system = truth(kind)
    train, judge, test = (
        measure(system, T, seed=seed, start="periodic")
        for seed, T in enumerate([1024, 1024, 400], start=1)
    )
    nx, starts = system.lfr.cell.nx, 16 if kind in IN_SERIES else 3
    linear = lfrtorch.estimate_bla(train, nx=nx)
    models = [begun(kind, train, nx=nx, seed=seed, nn=4) for seed in range(starts)]
    trainer = lfrtorch.LevenbergMarquardt(max_iter=100)
    fitted = lfrtorch.fit(models, train, judge, trainer=trainer).model
    left = np.std(fitted.simulate(test) - test.y) / np.std(linear.simulate(test) - test.y)
    assert left < 0.02, left


def test_what_a_structure_has_no_place_for_is_refused(record: Record):
    with pytest.raises(lfrtorch.InputError, match="a w for each z"):
        begun("parallel", record, nz=2, nw=1)
    with pytest.raises(lfrtorch.InputError, match="use one of free, wiener"):
        begun("volterra", record)


# --- which entries ------------------------------------------------------------------------------

F, H = False, True
"""An entry that is free, and one that is held."""


def held_entries(cell: LFRCell, *given: Held) -> dict[str, Any]:
    """Masks by name after all is held, and nothing but what is held at 0 has changed."""
    before = {name: p.detach().clone() for name, p in cell.named_parameters()}
    for each in given:
        cell.hold(each)
    for name, p in cell.named_parameters():
        mask = cell.held.get(name, torch.zeros(p.shape, dtype=torch.bool))
        assert torch.equal(p.detach(), before[name].masked_fill(mask, 0.0)), name
    return {name: mask.tolist() for name, mask in cell.held.items()}


IN_TWO = {
    1: {
        "A": [[F, H, H], [H, F, F], [H, F, F]],
        "Bu": [[F, F], [H, H], [H, H]],
        "Bw": [[H, H], [F, F], [F, F]],
        "Cz": [[F, H, H], [F, H, H]],
    },
    2: {
        "A": [[F, F, H], [F, F, H], [H, H, F]],
        "Bu": [[F, F], [F, F], [H, H]],
        "Bw": [[H, H], [H, H], [F, F]],
        "Cz": [[F, F, H], [F, F, H]],
    },
}
"""Two states or one behind the static map, by how many are before it."""


@pytest.mark.parametrize(
    ("kind", "before", "entries"),
    [
        ("free", None, {}),
        ("wiener", None, {"Bw": [[H, H]] * 3}),
        ("hammerstein", None, {"Cz": [[H, H, H]] * 2}),
        ("wiener_hammerstein", None, IN_TWO[1]),
        ("wiener_hammerstein", 2, IN_TWO[2]),
        (
            "parallel",
            None,
            IN_TWO[1]
            | {
                "static.Wz": [[F, H]] * 3 + [[H, F]] * 2,
                "static.Ww": [[F, F, F, H, H], [H, H, H, F, F]],
            },
        ),
    ],
)
def test_each_structure_holds_these_entries(kind: str, before: int | None, entries: Any):
    cell = random_cell(2, 1, 3, 2, 2, 5)
    assert held_entries(cell, structure(cell, kind, before=before)) == entries


@pytest.mark.parametrize(
    ("z", "y", "names"),
    [(True, True, ()), (False, True, ("Dzu",)), (False, False, ("Dzu", "Dyu")),
     (True, False, ("Dyu", "Dyw"))],
)  # fmt: skip
def test_without_feedthrough_one_path_of_the_input_is_closed(z: bool, y: bool, names: Any):
    cell = random_cell(2, 1, 3, 2, 2, 5)
    shapes = {name: torch.ones_like(cell.get_parameter(name)).bool().tolist() for name in names}
    assert held_entries(cell, no_feedthrough(cell, z=z, y=y)) == shapes


@pytest.mark.parametrize(
    ("z", "y", "entries"),
    [
        (False, True, {"Dzu": [[F], [F], [H], [H]]}),
        (True, False, {"Dyu": [[H]], "Dyw": [[F, F, F, H]]}),
    ],
)
def test_known_equations_keep_what_they_say_of_the_input(z: bool, y: bool, entries: Any):
    cell = beside_known_equations()
    assert held_entries(cell, no_feedthrough(cell, z=z, y=y)) == entries


def beside_known_equations() -> LFRCell:
    """A tank of three z and w, and a network of two z and one w."""
    f = Formula.traced(lambda h, u, a: [0.9 * h + a * u], 3)
    h = Formula.traced(lambda h, u, a: [h, a * h], 3)
    known = KnownModel(KnownEquations(f, h, ("h",), ("a",), ("",), 1, "discrete", 1, False), 1.0)
    static = DirectSum([known, Network(2, 1, 3)], [(known.nz, known.nw), (2, 1)]).double()
    assert (known.nz, known.nw) == (2, 3)
    return LFRCell(1, 1, 2, 4, 4, static, dtype=torch.float64)


def test_a_predictor_sees_no_output_at_once():
    cell = random_cell(3, 2, 2, 1, 1)
    assert held_entries(cell, past_outputs(cell)) == {
        "Dzu": [[F, H, H]], "Dyu": [[F, H, H]] * 2,
    }  # fmt: skip


def test_outputs_that_are_the_states_are_held_so():
    cell = random_cell(1, 2, 2, 1, 1)
    cell.hold(measured_states(cell))
    assert {name: mask.all().item() for name, mask in cell.held.items()} == dict.fromkeys(
        ["Cy", "Dyu", "Dyw"], True
    )
    assert torch.equal(cell.Cy.detach(), torch.eye(2, dtype=torch.float64))
    assert not cell.Dyu.any()
    assert not cell.Dyw.any()


def test_integrators_are_held_in_their_columns():
    cell = random_cell(1, 1, 3, 1, 1)
    assert integrators(cell) == {}
    with torch.no_grad():
        cell.A[:, 1], cell.Cz[:, 1] = torch.tensor([0.0, 1.0, 0.0]), 0.0
    A = cell.A.detach().clone()
    cell.hold(integrators(cell))
    columns = [F, H, F]
    assert cell.held["A"].tolist() == [columns] * 3
    assert cell.held["Cz"].tolist() == [columns]
    assert cell.Cz[0, 1].item() == 0.0
    assert torch.equal(cell.A.detach(), A)


def test_held_entries_are_those_of_the_free_parameters_in_their_order():
    cell = random_cell(1, 1, 2, 1, 1, 2)
    zero = torch.tensor(0.0)
    cell.hold({"A": (torch.eye(2).bool(), zero), "Cy": (torch.tensor([[True, False]]), zero)})
    free = [(n, p.numel()) for n, p in cell.named_parameters() if n != "A"]
    cell.A.requires_grad_(False)
    first = sum(count for n, count in free[: [n for n, _ in free].index("Cy")])
    assert held_parameters(cell).nonzero().flatten().tolist() == [first]
    cell.A.requires_grad_()
    assert held_parameters(cell).nonzero().flatten().tolist() == [0, 3, 4 + first]
