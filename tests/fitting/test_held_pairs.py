"""Settings that hold entries go together: a fit keeps what each of them holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch import InputError, LevenbergMarquardt, Record, Settings, identify
from lfrtorch.engine.held import integrating_states
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

FREE = float("nan")
SEARCH = LevenbergMarquardt(max_iter=6)


def saturating(integrates: bool = False, smooth: int = 1) -> Record:
    """A first-order lag with a saturated input, noise on its state and, if asked, an integrator."""
    random = np.random.default_rng(0)
    u, noise = random.standard_normal((2, 400))
    u = np.convolve(u, np.hanning(smooth + 2), "same")
    x, s, y = np.zeros(2), 0.0, np.zeros(400)
    for k in range(400):
        y[k] = s if integrates else x[0] + 0.5 * x[1]
        w = np.tanh(1.5 * u[k])
        s += x[0]
        x = np.array([0.8 * x[0] + 0.3 * w + 0.02 * noise[k], 0.5 * x[1] + 0.4 * x[0]])
    return Record(u, y, name="record", start="estimated" if integrates else "zero")


def kept(model: Model) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    cell = model.lfr.cell
    return {name: (mask, cell.get_parameter(name)[mask]) for name, mask in cell.held.items()}


def identified(record: Record, **options: Any) -> lfrtorch.Run:
    base: dict[str, Any] = {"nx": 2, "nz": 1, "nw": 1, "nn": 3, "starts": 1, "trainer": SEARCH}
    settings = Settings(**base | options)
    return identify(lfrtorch.Dataset("lag", [record[:300]], [record[300:]], []), settings)


def check_zeros(model: Model, *names: str) -> None:
    for name in names:
        mask = model.lfr.cell.held[name]
        assert mask.any()
        assert not model.lfr.cell.get_parameter(name)[mask].any(), name


@pytest.mark.parametrize(
    ("structure", "guarantee"),
    [
        ("hammerstein", None),
        ("hammerstein", "contracting"),
        ("wiener_hammerstein", "stable"),
        ("wiener_hammerstein", "contracting"),
    ],
)
def test_a_structure_with_given_entries(structure: str, guarantee: Any, tmp_path: Path):
    nx = 2 if structure == "hammerstein" else 4
    row = [[0.7] + [FREE] * (nx - 1)]
    run = identified(
        saturating(), structure=structure, fixed={"Cy": row},
        trainer=LevenbergMarquardt(max_iter=4, guarantee=guarantee),
    )  # fmt: skip
    model = run.model
    check_zeros(model, *({"Cz"} if structure == "hammerstein" else {"A", "Bu", "Bw", "Cz"}))
    Cy = model.scaler.y_scale[0] * model.lfr.cell.Cy[0, 0].item()
    assert Cy == pytest.approx(0.7, rel=1e-12)
    errors = [one.train for one in run.fit.history]
    assert errors[-1] < errors[0]
    if guarantee is not None:
        assert np.abs(np.linalg.eigvals(model.lfr.cell.A.detach())).max() < 1.0
    again = lfrtorch.load(model.save(tmp_path / "model"))
    assert again.net_parameter_count == model.net_parameter_count < model.parameter_count
    assert {n: m.tolist() for n, m in again.lfr.cell.held.items()} == {
        n: m.tolist() for n, m in model.lfr.cell.held.items()
    }


def test_integrators_with_given_entries():
    linear = {"integrators": 1}
    fixed = {"A": [[0.8, FREE], [FREE, FREE]]}
    run = identified(saturating(integrates=True), fixed=fixed, linear=linear)
    cell = run.model.lfr.cell
    assert integrating_states(cell).tolist() == [False, True]
    assert cell.A[0, 0].item() == 0.8
    assert run.fit.history[-1].train < run.fit.history[0].train


ENTRIES = {"fixed": {"A": [[0.8, FREE], [FREE, FREE]], "Bu": [[FREE], [0.0]]}}


@pytest.mark.parametrize(
    ("options", "names", "trainer"),
    [
        ({"structure": "hammerstein"}, {"Cz"}, SEARCH),
        ({"structure": "wiener_hammerstein"}, {"A", "Bu", "Bw", "Cz"}, SEARCH),
        ({"z_feedthrough": False}, {"Dzu"}, SEARCH),
        (ENTRIES, {"A", "Bu"}, SEARCH),
        (ENTRIES, {"A", "Bu"}, lfrtorch.Adam(max_iter=20)),
    ],
)
def test_innovations_keep_what_the_system_holds(options: Any, names: set[str], trainer: Any):
    """A, Bu and Bw of a predictor change with K, and those of its system do not."""
    run = identified(saturating(), noise="innovation", **options, trainer=trainer)
    model, errors = run.model, [one.train for one in run.fit.history]
    assert model.K is not None
    assert model.K.any()
    assert {*model.lfr.cell.held} == names
    assert min(errors) < errors[0]
    if "fixed" in options:
        assert model.lfr.cell.A[0, 0].item() == 0.8
        assert model.lfr.cell.Bu[1, 0].item() == 0.0
    else:
        check_zeros(model, *names)


def test_innovations_behind_an_integrator():
    """The search begins at the simulation, with no innovations."""
    run = identified(saturating(integrates=True), noise="innovation", linear={"integrators": 1})
    model = run.model
    assert integrating_states(model.lfr.cell).tolist() == [False, True]
    assert model.K is not None
    assert model.K.any()
    assert run.fit.history[-1].train < 0.5 * run.fit.history[0].train
    ahead = run.evaluation.predictions[1][0]
    assert np.std(ahead.error) < np.std(ahead.linear_error)


@pytest.mark.parametrize("structure", ["wiener", "hammerstein", "wiener_hammerstein", "parallel"])
def test_a_mean_keeps_a_structure(structure: str):
    """Its w does not come back to its z: a first-order change of w leaves z as it is."""
    sizes = {"nz": 2, "nw": 2, "nn": 4} if structure == "parallel" else {}
    run = identified(saturating(), structure=structure, starts=3, average=3, refit=True, **sizes)
    models = run.fit.members or [run.model]
    mean = lfrtorch.mean_model([*models, models[0]])
    refitted = lfrtorch.fit(mean, saturating(), trainer=SEARCH, monitors=[]).model
    A, _, Bw, Cz = (m for m in refitted.lfr.cell.matrices()[:4])
    markov = [Cz @ np.linalg.matrix_power(A, k) @ Bw for k in range(4)]
    assert max(np.abs(part).max() for part in markov) < 1e-12 or structure == "hammerstein"
    if structure == "hammerstein":
        assert not Cz.any()
    if structure == "parallel":
        Wz = refitted.lfr.cell.get_parameter("static.Wz")
        assert ((Wz != 0).sum(dim=1) <= 1).all()


def test_what_is_held_at_two_values_is_refused():
    with pytest.raises(InputError, match=r"Bw\[0, 0\] is held at 0 by .* and at 0.5 by"):
        identified(saturating(), structure="wiener", fixed={"Bw": [[0.5], [FREE]]})


# --- settings that were apart because of how each was made --------------------------------------


def test_driven_states_stand_behind_a_static_map():
    """Of blocks in series they belong to the second one: z does not see them."""
    run = identified(saturating(), structure="wiener_hammerstein", relaxations=1)
    cell = run.model.lfr.cell
    assert cell.nx == 2 + 2 + 1
    assert cell.A[4, 4] > 0
    check_zeros(run.model, "A", "Bu", "Bw", "Cz")
    assert cell.held["Cz"][0].tolist() == [False, False, True, True, True]
    assert run.fit.history[-1].train < run.fit.history[0].train


class Cubic(torch.nn.Module):
    """w = z + a z³, all of one kind."""

    def __init__(self, nz: int, nw: int) -> None:
        super().__init__()
        self.a = torch.nn.Parameter(0.1 * torch.ones(nw, dtype=torch.float64))
        self.W = torch.nn.Parameter(torch.ones(nw, nz, dtype=torch.float64))

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        w = z @ self.W.mT
        return w + self.a * w**3


@pytest.mark.parametrize("static", ["polynomial", Cubic], ids=["polynomial", "own"])
def test_branches_in_parallel_have_maps_of_any_kind(static: Any):
    """Each w is a function of the z of the same number alone."""
    run = identified(saturating(), structure="parallel", static=static, nz=2, nw=2)
    assert run.fit.history[-1].train < run.fit.history[0].train
    w = run.model.lfr.cell.map
    z = torch.randn(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for own, other in ((0, 1), (1, 0)):
        moved = z.index_add(1, torch.tensor([other]), torch.ones_like(z[:, :1]))
        change = (w(moved) - w(z)).detach().abs()
        assert not change[:, own].any()
        assert change[:, other].min() > 0.0


def test_one_map_of_all_z_is_no_parallel_branches():
    bla = lfrtorch.estimate_bla(saturating(), nx=2)
    options: dict[str, Any] = {"nz": 2, "nw": 2, "structure": "parallel"}
    with pytest.raises(InputError, match="each w of the map depends on all z; give a network"):
        lfrtorch.initialise(bla, saturating(), static=lfrtorch.Polynomial(2, 2, 3), **options)


@pytest.mark.parametrize("structure", ["hammerstein", "parallel"])
@pytest.mark.usefixtures("short_paths")
def test_sizes_of_a_structure_are_searched(structure: str):
    sizes = {"nz": "auto", "nw": "auto"} if structure == "hammerstein" else {"nz": 2, "nw": 2}
    run = identified(saturating(), structure=structure, nn="auto", **sizes, starts=2)
    assert run.choice is not None
    assert len(run.choice.candidates) > 1
    check_zeros(run.model, "Cz")


@pytest.mark.usefixtures("short_paths")
def test_sizes_are_searched_with_given_entries():
    run = identified(saturating(), fixed={"Cy": [[0.7, FREE]]}, nn="auto", starts=2)
    Cy = run.model.scaler.y_scale[0] * run.model.lfr.cell.Cy[0].detach() * run.fit.averaged
    assert Cy[0].item() == pytest.approx(0.7, rel=1e-9)


@pytest.mark.parametrize(
    ("given", "sizes"),
    [
        ({"nx": "auto", "fixed": {"Cy": [[0.7, FREE]]}}, {"nx": 2}),
        ({"nw": "auto", "nx": 1, "fixed": {"Bw": [[FREE, 0.0]]}}, {"nw": 2}),
        (
            {"nx": "auto", "structure": "wiener_hammerstein", "relaxations": 1,
             "fixed": {"Cy": [[0.7, *[FREE] * 4]]}},
            {"nx": 2},
        ),
    ],
)  # fmt: skip
def test_sizes_that_are_auto_follow_from_given_matrices(given: Any, sizes: dict[str, int]):
    settings = Settings(**{"nx": 2, "nz": 1, "nw": 1, "nn": 3} | given)
    assert {name: getattr(settings, name) for name in sizes} == sizes
    assert not settings.searched


class Cube(torch.nn.Module):
    """A map of one's own: w = W z³."""

    def __init__(self, nz: int, nw: int) -> None:
        super().__init__()
        self.W = torch.nn.Parameter(torch.zeros(nw, nz, dtype=torch.float64))

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        return z.pow(3) @ self.W.mT


class Cubes(lfrtorch.StaticMap):
    """The same in equations, of which machine code is made: a search fits many."""

    def __init__(self, nz: int, nw: int) -> None:
        super().__init__(nz=nz, nw=nw)
        self.W = torch.nn.Parameter(torch.zeros(nw, nz, dtype=torch.float64))

    def equations(self, z: Any, phi: Any) -> list[Any]:
        rows = [phi[i * self.nz : (i + 1) * self.nz] for i in range(self.nw)]
        return [sum(a * b**3 for a, b in zip(row, z, strict=True)) for row in rows]


@pytest.mark.usefixtures("short_paths")
def test_sizes_of_a_map_of_ones_own_are_searched():
    run = identified(saturating(), static=Cubes, nz="auto", nw="auto", ridge=0.1)
    assert run.choice is not None
    assert {*run.choice.chosen.sizes} == {"nx", "nz", "nw"}


def test_predictions_are_fitted_in_windows():
    run = identified(saturating(), noise="innovation", horizon=50)
    assert run.model.K is not None
    assert run.fit.history[-1].train < run.fit.history[0].train


def test_the_starts_of_a_mean_begin_on_a_part():
    run = identified(saturating(), first_part=0.5, first_iterations=3, starts=3, average=3)
    assert sorted(start.number for start in run.fit.starts) == [0, 1, 2]
    assert run.settings.seeds == (0, 1000, 2000)


def lag(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
    return (p.a * x.h + 0.4 * u[0],)


@pytest.mark.parametrize(
    "options",
    [
        {"noise": "innovation"},
        {"init": "paper"},
        {"z_feedthrough": False},
        {"static": Cube, "nn": 0},
    ],
    ids=str,
)
def test_what_stands_beside_known_equations(options: dict[str, Any]):
    known = lfrtorch.Known(lag, states=["h"], parameters={"a": 0.6}, method="discrete")
    run = identified(saturating(), **{"known": known, "nx": 1, "nn": 3} | options)
    model, cell = run.model, run.model.lfr.cell
    assert run.fit.history[-1].train < run.fit.history[0].train
    assert cell.Cz[0, 0].item() == cell.Bw[0, 0].item() == 1.0
    if "noise" in options:
        assert model.K is not None
        assert model.K.any()
    if "z_feedthrough" in options:
        assert not cell.Dzu[2:].any()
        assert cell.Dzu[1, 0].item() == 1.0


@pytest.mark.parametrize(
    ("driven", "acts_on"),
    [
        ({"relaxations": 2}, ["h"]),
        ({"relaxations": 2}, ["y"]),
        ({"relaxations": 2}, ["h", "y"]),
        ({"modes": 1}, ["h", "y"]),
    ],
    ids=str,
)
def test_states_that_w_alone_drives_beside_known_equations(
    driven: dict[str, int], acts_on: list[str]
):
    """They begin at rest and reach only what the learned part may act on."""
    known = lfrtorch.Known(
        lag, states=["h"], parameters={"a": 0.6}, method="discrete", acts_on=acts_on
    )
    run = identified(saturating(smooth=12), known=known, nx=1, nn=3, **driven)
    assert run.fit.history[-1].train < run.fit.history[0].train
    cell = run.model.lfr.cell
    assert cell.nx == 1 + 1 + 2
    assert cell.Cz[0].tolist() == [1.0, 0.0, 0.0, 0.0]  # the equations see their state
    assert not cell.Bw[2:, 0].any()  # and drive no other
    assert not cell.Cz[1].any()
    assert cell.Bw[2:, 1:].any()
    assert bool(cell.Cy[:, 2:].any()) == ("y" in acts_on)
    assert bool(cell.A[0, 2:].any()) == ("h" in acts_on)
    if "relaxations" in driven:
        assert cell.Cz[2:, 2:].any()


def test_driven_states_need_a_learned_map():
    known = lfrtorch.Known(lag, states=["h"], parameters={"a": 0.6}, method="discrete")
    with pytest.raises(InputError, match="has a w to drive their states; give nn=6"):
        Settings(known=known, nn=0, relaxations=1)


def test_a_frozen_matrix_stays_so_in_predictions_and_means():
    bla = lfrtorch.estimate_bla(saturating(), nx=2, refine="prediction")
    models = [lfrtorch.initialise(bla, saturating(), nz=1, nw=1, nn=3, seed=k) for k in range(2)]
    for model in models:
        model.lfr.cell.Dzu.requires_grad_(False)
    before = [model.lfr.cell.Dzu.detach().clone() for model in models]
    mean = lfrtorch.mean_model(models)
    assert not mean.lfr.cell.Dzu.requires_grad
    assert mean.lfr.cell.Cz.requires_grad
    fitted = lfrtorch.fit(
        models[0], saturating(), noise="innovation", trainer=SEARCH, monitors=[]
    ).model
    assert torch.equal(fitted.lfr.cell.Dzu, before[0])
    assert not fitted.lfr.cell.Dzu.requires_grad


@pytest.mark.parametrize(
    "options",
    [
        {"structure": "wiener"},
        {"fixed": {"Bu": [[0.7], [FREE]]}},
        {"linear": {"integrators": 1}},
    ],
    ids=str,
)
def test_a_mean_of_predictors_keeps_nothing_of_their_systems(options: dict[str, Any]):
    """Its A has K of one model times Cy of another: what each system holds is lost."""
    given: dict[str, Any] = {"nx": 2, "nz": 1, "nw": 1, "nn": 3, "noise": "innovation", **options}
    with pytest.raises(InputError, match="a mean of predictors breaks"):
        Settings(**given, average=2)
    assert Settings(**given).average == 1
    simulated: dict[str, Any] = {**given, "noise": "output", "average": 2}
    assert Settings(**simulated).averages


@pytest.mark.usefixtures("short_paths")
def test_sizes_are_searched_with_innovations_and_a_structure():
    run = identified(saturating(), structure="wiener", nn="auto", noise="innovation", starts=2)
    assert run.fit.averaged == 1
    check_zeros(run.model, "Bw")


def test_predictors_of_held_systems_are_not_averaged():
    bla = lfrtorch.estimate_bla(saturating(), nx=2, refine="prediction")
    models = [
        lfrtorch.initialise(bla, saturating(), nz=1, nw=1, nn=3, seed=k, structure="hammerstein")
        for k in range(2)
    ]
    for model in models:  # an entry of the state equation
        model.lfr.cell.hold({"Bu": (torch.tensor([[True], [False]]), model.lfr.cell.Bu.detach())})
    with pytest.raises(InputError, match="a mean of predictors breaks"):
        lfrtorch.fit(models, saturating(), noise="innovation", average=2, monitors=[])
