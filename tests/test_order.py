"""The scan over orders finds the one that was planted, and says what it rests on."""

import numpy as np
import pytest
import reference
from reference import System, random_system

from lfrtorch.bla import estimate_bla
from lfrtorch.frf import estimate_frf
from lfrtorch.order import MARGIN, scan_orders
from lfrtorch.records import Record


def record_of(system: System, seed: int, noise: float = 0.1, T: int = 600) -> Record:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(T, 1))
    y = reference.periodic_response(system, u)
    return Record(u, y + noise * y.std() * rng.normal(size=y.shape), 10.0, "periodic")


@pytest.mark.parametrize("validated", [True, False])
def test_planted_order_is_chosen(validated: bool):
    system = random_system(3, seed=4)
    scan = scan_orders(
        record_of(system, 0), range(1, 7), validation=record_of(system, 1) if validated else ()
    )
    assert scan.orders == (1, 2, 3, 4, 5, 6)
    assert scan.validated is validated
    assert scan.chosen == 3
    assert scan.best is scan.models[2]
    # What is left at the true order is the noise, a tenth of the output.
    assert scan.scores[2] == pytest.approx(0.1, rel=0.1)
    assert scan.scores[0] > 2 * scan.scores[2]


def test_score_on_validation_is_the_relative_simulation_error():
    system = random_system(2)
    judge = record_of(system, 1)
    scan = scan_orders(record_of(system, 0), [2], validation=judge)
    error = (judge.y - scan.best.simulate(judge)) / judge.y.std()
    assert scan.scores[0] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)


def test_lowest_order_within_the_margin_of_the_best_is_chosen():
    scan = scan_orders(record_of(random_system(2), 0), range(1, 6))
    best = min(scan.scores)
    within = [
        nx for nx, s in zip(scan.orders, scan.scores, strict=True) if s <= (1 + MARGIN) * best
    ]
    assert scan.chosen == min(within)


def test_response_can_be_scanned():
    records = [record_of(random_system(3, seed=4), seed) for seed in range(4)]
    assert scan_orders(estimate_frf(records), range(1, 6)).chosen == 3


def test_orders_that_the_data_do_not_reach_for_are_left_out():
    u = np.random.default_rng(0).normal(size=60)
    scan = scan_orders(Record(u, np.roll(u, 1)), range(1, 20))
    assert scan.orders == tuple(range(1, len(scan.orders) + 1))
    assert len(scan.orders) < 19
    with pytest.raises(ValueError, match="needs one of"):
        estimate_bla(Record(u, np.roll(u, 1)), len(scan.orders) + 1)


def test_table_has_a_line_an_order_and_marks_the_chosen():
    scan = scan_orders(record_of(random_system(2), 0), (3, 1, 2))
    head, *lines = scan.table().splitlines()
    assert head.split()[:3] == ["nx", "fitted", "MDL"]
    assert [line.split()[0] for line in lines] == ["1", "2", "3"]
    assert [line.split()[0] for line in lines if line.endswith("chosen")] == [str(scan.chosen)]


def test_orders_must_be_given():
    record = record_of(random_system(1), 0)
    with pytest.raises(ValueError, match="orders is empty"):
        scan_orders(record, [])
    with pytest.raises(ValueError, match="orders is 0; give a whole number of at least 1"):
        scan_orders(record, [0, 1])
    frf = estimate_frf(record)
    with pytest.raises(ValueError, match="hold a FRF where a record is expected"):
        scan_orders(record, [1], validation=frf)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="constant in all records"):
        scan_orders(Record(np.ones(100), np.ones(100)), [1, 2])
