"""The search for sizes finds planted ones, and its rule is right on errors that are known."""

import json
import math
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
import torch
from reference import random_cell

from lfrtorch._support.tables import number
from lfrtorch.distributed import ProcessLostError, Ranks
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.nonlinearity import Polynomial
from lfrtorch.fitting.size_search import (
    LEGEND,
    Candidate,
    SizeRound,
    SizeSearch,
    race,
    search_sizes,
)
from lfrtorch.fitting.starts import initialise
from lfrtorch.fitting.trainer import StoppedError
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import Model
from lfrtorch.paired_blocks import BLOCKS
from lfrtorch.records import Channel, Record, Scaler

OPTIMISER = LevenbergMarquardt(max_iter=10)

pytestmark = pytest.mark.numeric


Planted = tuple[list[Record], list[Record], LinearModel]


@cache
def plant(nz: int, nw: int, noise: float = 0.02, T: int = 300) -> Planted:
    """Training and validation records of a system with 3 neurons, and its linear model."""
    cell = random_cell(nx=2, nz=nz, nw=nw, nn=3, seed=2, radius=0.7)
    with torch.no_grad():
        cell.Dzu.mul_(3.0)
        cell.Dyw.fill_(1.0)
    channel = (Channel("s"),)
    truth = Model(LFR(cell), Scaler(*np.array([[0.0], [1.0], [0.0], [1.0]])), 1.0, channel, channel)
    train, validation = [], []
    for seed, use in ((1, train), (2, validation)):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((T, 1))
        y = truth.simulate(u)
        use.append(Record(u, y + noise * y.std() * rng.standard_normal(y.shape), skip=20))
    return train, validation, estimate_bla(train, nx=2)


def search(planted: Planted, **options: Any) -> SizeSearch:
    train, validation, bla = planted

    def start(sizes: Any, seed: int) -> Model:
        return initialise(bla, train, **sizes, seed=seed)

    given: dict[str, Any] = {"start": start, "train": train, "validation": validation}
    given |= {"nn": (1, 3, 6), "seeds": (0,), "linear": bla, "trainer": OPTIMISER}
    return search_sizes(**given | options)


def polynomial(planted: Planted, sizes: Any, seed: int) -> Model:
    train, _, bla = planted
    static = Polynomial(sizes["nz"], sizes["nw"], sizes["degree"])
    return initialise(bla, train, nz=sizes["nz"], nw=sizes["nw"], static=static, seed=seed)


@pytest.fixture(scope="module")
def single() -> SizeSearch:
    trainer = LevenbergMarquardt(max_iter=30)
    return search(plant(1, 1), nz=(1, 2), nw=(1, 2), finalists=5, seeds=(0, 1), trainer=trainer)


def test_planted_sizes_are_chosen(single: SizeSearch):
    found = single
    assert found.chosen.sizes == {"nz": 1, "nw": 1, "nn": 3}
    # Each size with both seeds, and five of them to the end.
    tried = {(*c.sizes.values(), c.seed) for c in found.candidates}
    assert len(tried) == len(found.candidates) == 24
    rounds = [c.rounds for c in found.candidates]
    assert rounds == sorted(rounds, reverse=True)
    assert rounds.count(rounds[0]) == 5
    assert {c.iterations for c in found.candidates if c.rounds == 1} == {5}
    last = [c.error for c in found.candidates[:5]]
    assert last == sorted(last)
    # What is left at the true sizes is the noise.
    assert found.chosen.error == pytest.approx(0.02, rel=0.1)
    assert found.chosen.ratio < 0.5


def test_a_second_input_of_the_map_is_found():
    trainer = LevenbergMarquardt(max_iter=30)
    found = search(plant(2, 1, noise=0.005), nz=(1, 2), nw=(1, 2), nn=3, trainer=trainer)
    assert found.chosen.sizes == {"nz": 2, "nw": 1, "nn": 3}
    assert len(found.candidates) == 4
    assert found.notes == ("nz 2 is the largest tried; a larger one may do better.",)


@pytest.mark.slow
def test_states_are_searched_with_the_other_sizes():
    planted = train, _, bla = plant(2, 1)
    models = {nx: bla if nx == 2 else estimate_bla(train, nx) for nx in (1, 2, 3)}

    def start(sizes: Any, seed: int) -> Model:
        sizes = dict(sizes)
        return initialise(models[sizes.pop("nx")], train, **sizes, seed=seed)

    options: dict[str, Any] = {"nx": (1, 2, 3), "nz": 2, "nw": 1, "nn": 3, "seeds": (0, 1, 2, 3)}
    trainer = LevenbergMarquardt(max_iter=30)
    found = search(planted, start=start, trainer=trainer, **options)
    assert found.chosen.sizes == {"nx": 2, "nz": 2, "nw": 1, "nn": 3}
    assert {c.sizes["nx"] for c in found.candidates} == {1, 2, 3}


def test_rounds_cost_about_the_same_and_halve_the_models():
    assert race(1000, 6, 75) == [(48, 13), (24, 25), (6, 75)]  # 624, 288 and 300 iterations
    assert race(30, 6, 75) == [(30, 13), (24, 25), (6, 75)]
    assert race(8, 6, 75) == [(8, 25), (6, 75)]
    assert race(5, 6, 75) == [(5, 75)]
    assert race(48, 6, 2) == [(48, 1), (6, 2)]
    assert race(48, 6, 0) == [(48, 0)]


def test_more_starts_of_few_sizes_and_a_part_of_many():
    few = search(plant(1, 1), nz=1, nw=1, nn=(1, 3), seeds=(0, 1000), finalists=1)
    assert sorted((c.sizes["nn"], c.seed) for c in few.candidates) == [
        (1, 0), (1, 1000), (3, 0), (3, 1000),
    ]  # fmt: skip
    nn = range(1, 12)
    trainer = LevenbergMarquardt(max_iter=1)
    part = search(plant(1, 1), nz=1, nw=1, nn=nn, seeds=(0, 1000), finalists=1, trainer=trainer)
    assert len({c.sizes["nn"] for c in part.candidates}) == len(part.candidates) == 8
    again = search(plant(1, 1), nz=1, nw=1, nn=nn, seeds=(0, 1000), finalists=1, trainer=trainer)
    assert [c.sizes for c in again.candidates] == [c.sizes for c in part.candidates]


def test_rounds_are_told():
    told: list[SizeRound] = []
    found = search(plant(1, 1), nz=1, nw=1, finalists=1, watch=told.append)
    assert [(r.number, r.count, r.models, r.iterations) for r in told] == [
        (1, 2, 3, 4), (2, 2, 1, 10),
    ]  # fmt: skip
    assert told[-1].best.error == found.candidates[0].error <= told[0].best.error
    assert str(told[0]).startswith("sizes, round 1 of 2: 3 models to iteration 4, ")


def test_numbers_are_those_of_the_models(single: SizeSearch):
    found = single
    train, (record,), bla = plant(1, 1)
    linear = (record.y - bla.simulate(record))[record.skip :] / record.y.std()
    assert found.counts.sum() == record.samples - record.skip
    for candidate in found.candidates:
        model = initialise(bla, train, **candidate.sizes, seed=candidate.seed)
        assert candidate.parameters == model.parameter_count
        assert candidate.parameters_net == model.net_parameter_count
        mean = candidate.squares.sum() / found.counts.sum()
        assert candidate.error == pytest.approx(math.sqrt(mean), rel=1e-12)
        ratio = candidate.error / np.sqrt(np.mean(linear**2))
        assert candidate.ratio == pytest.approx(ratio, rel=1e-12)
        assert 0 < candidate.error_std < 0.2 * candidate.error
        assert f"validation {number(candidate.error)} ± " in str(candidate)


def test_table_marks_the_chosen_and_rises_in_parameters(single: SizeSearch):
    found = single
    lines = found.table().splitlines()
    assert lines[0].split()[:6] == ["nz", "nw", "nn", "iterations", "parameters", "net"]
    rows = [line.split() for line in lines[2 : -len(LEGEND.splitlines())]]
    net = [int(row[5]) for row in rows]
    assert net == sorted(net)
    assert len(net) == 5  # those of the last round
    assert [row[:3] for row in rows if row[-1] == "chosen"] == [["1", "1", "3"]]
    assert found.notes == ()
    entries = found.entries()
    assert json.loads(json.dumps(entries)) == entries
    assert [e["nn"] for e in entries if e["chosen"]] == [3]
    assert {e["seed"] for e in entries} <= {0, 1}
    assert min(e["standard_errors_above"] for e in entries) == 0.0


def test_degree_takes_the_place_of_neurons():
    planted = plant(1, 1)
    options: dict[str, Any] = {"nz": 1, "nw": 1, "degree": (1, 3)}
    found = search(planted, start=partial(polynomial, planted), linear=None, **options)
    assert {c.sizes["degree"] for c in found.candidates} == {1, 3}
    assert found.chosen.sizes == {"nz": 1, "nw": 1, "degree": 3}
    assert math.isnan(found.chosen.ratio)  # no linear model to compare with
    assert "linear" not in str(found.chosen)
    assert found.table().splitlines()[0].split()[2] == "degree"


# --- the rule ---------------------------------------------------------------------------------


def tried(net: int, mean: float, error: float) -> Candidate:
    """A model whose squared errors in the blocks have this mean and standard error."""
    ramp = np.linspace(-1.0, 1.0, BLOCKS)
    squares = mean + error * math.sqrt(BLOCKS) * ramp / ramp.std(ddof=1)
    return Candidate({"nn": net}, 0, 1, 1, net, net, 0.0, math.sqrt(mean), 0.0, math.nan, squares)


@pytest.mark.parametrize(
    ("mean", "error", "chosen"),
    [
        (1.08, 0.09, 5),  # within one standard error of the difference
        (1.08, 0.07, 10),
        (1.12, 0.50, 10),  # likewise, and 5.8 % above in rms error
        (1.015, 0.001, 5),  # 15 standard errors, and 0.7 % of the rms error
        (1.025, 0.001, 10),  # 25 and 1.2 %
    ],
)
def test_the_fewest_parameters_that_do_as_well_are_chosen(mean: float, error: float, chosen: int):
    models = tried(10, 1.0, 0.0), tried(25, 1.0001, 0.0), tried(5, mean, error)
    assert SizeSearch(models, np.ones(BLOCKS, int)).chosen.sizes == {"nn": chosen}
    # 20 is within one standard error of the best; 10 is not, and is better than 20.
    models = tried(30, 1.0, 0.0), tried(20, 1.08, 0.1), tried(10, 1.06, 0.01)
    assert SizeSearch(models, np.ones(BLOCKS, int)).chosen.sizes == {"nn": 10}


def test_finalists_are_compared_where_they_were_not_fitted():
    planted = plant(1, 1, T=150)
    found = search(planted, nz=1, nw=1, finalists=2, folds=3)
    assert len(found.candidates) == 2  # of the last round alone
    assert len(found.counts) == len(found.chosen.squares) == 3 * BLOCKS
    assert found.counts.sum() == 2 * 130
    for candidate in found.candidates:
        assert candidate.iterations > OPTIMISER.limit
        # Which one is better hangs on where ten iterations from a single start end.
        assert 0.0 < candidate.ratio < 1.0
    with pytest.raises(ValueError, match="folds is 1"):
        search(planted, nz=1, nw=1, folds=1)


# --- what goes wrong --------------------------------------------------------------------------


def test_a_candidate_that_diverges_is_listed_and_loses():
    train, _, bla = plant(1, 1)

    def start(sizes: Any, seed: int) -> Model:
        model = initialise(bla, train, **sizes, seed=seed)
        if sizes["nn"] == 2:  # at once, on the records that are fitted
            with torch.no_grad():
                model.lfr.cell.A.copy_(10.0 * torch.eye(2))
        return model

    options: Any = {"start": start, "nz": 1, "nw": 1}
    found = search(plant(1, 1), nn=(2, 3), **options)
    assert [math.isinf(c.error) for c in found.candidates] == [False, True]
    assert found.chosen.sizes["nn"] == 3
    assert str(found.candidates[1]) == "nz 1, nw 1, nn 2: diverges"
    with pytest.raises(ValueError, match="all models that were tried diverge on the validation"):
        search(plant(1, 1), nn=2, **options)


def test_a_model_that_explodes_on_validation_diverges():
    train, (record,), bla = planted = plant(1, 1)

    def start(sizes: Any, seed: int) -> Model:
        model = polynomial(planted, sizes, seed)
        if sizes["degree"] == 3:
            with torch.no_grad():
                model.lfr.cell.get_parameter("static.C")[:, 3] = 0.01
        return model

    louder = Record(1e3 * record.u, 1e3 * record.y, skip=20)
    options: Any = {"nz": 1, "nw": 1, "degree": (2, 3)}
    options |= {"start": start, "trainer": LevenbergMarquardt(max_iter=0)}
    found = search((train, [louder], bla), **options)
    assert {c.sizes["degree"]: math.isinf(c.error) for c in found.candidates} == {3: True, 2: False}
    marks = {line.split()[2]: line.split()[-1] for line in found.table().splitlines()[2:4]}
    assert marks == {"2": "chosen", "3": "diverges"}
    assert found.chosen.sizes["degree"] == 2


def test_ctrl_c_and_lost_processes_end_the_search():
    class CtrlC(LevenbergMarquardt):
        def step(self, problem: Any, state: Any) -> Any:
            raise KeyboardInterrupt

    class Losing(LevenbergMarquardt):
        def step(self, problem: Any, state: Any) -> Any:
            raise ProcessLostError("for good")

    with pytest.raises(StoppedError):
        search(plant(1, 1), trainer=CtrlC())
    with pytest.raises(ProcessLostError, match="for good"):
        search(plant(1, 1), trainer=Losing())
    with pytest.raises(StoppedError):
        search(plant(1, 1), stop=lambda: True)


def test_the_first_process_decides():
    class Other(Ranks):
        """What the first process sends is that all errors are alike."""

        def first(self, part: torch.Tensor) -> torch.Tensor:
            return torch.ones_like(part) if part.numel() == BLOCKS else part

    found = search(plant(2, 1), nz=(1, 2), nw=1, nn=3, ranks=Other())
    assert [e["standard_errors_above"] for e in found.entries()] == [0.0, 0.0]
    assert found.chosen.sizes == {"nz": 1, "nw": 1, "nn": 3}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"validation": []}, "no validation records, on which sizes are chosen"),
        ({"nz": [0, 1]}, "nz is 0; give a whole number of at least 1"),
        ({"nn": []}, "nn is empty"),
        ({"nw": "many"}, "nw is 'many'"),
        ({"seeds": ()}, "seeds is empty"),
        ({"finalists": 0}, "finalists is 0"),
    ],
)
def test_bad_calls_are_refused(options: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        search(plant(1, 1), **options)
