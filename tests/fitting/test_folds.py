"""Stretches that are left out in turn: every sample once, the rest trains."""

from dataclasses import replace

import numpy as np
import pytest

from lfrtorch.fitting.folds import folds
from lfrtorch.records import Record, Start


def record(samples: int, start: Start = "zero", skip: int = 0, period: int | None = None) -> Record:
    time = np.arange(samples, dtype=float)
    return Record(time, 1000.0 * samples + time, start=start, skip=skip, period=period)


def scored(records: list[Record]) -> list[float]:
    return [y for each in records for y in each.y[each.skip :, 0]]


def some(kind: str) -> list[Record]:
    steady: Start = "periodic"
    return {
        "one": [record(200, skip=20)],
        "amid": [record(200, "estimated")],
        "several": [record(100), record(70, "estimated", skip=5), record(130, skip=9)],
        "periods": [record(200, steady, period=20), record(40, steady, period=40)],
        "realisations": [record(50 + i, steady, period=50 + i) for i in range(4)],
    }[kind]


@pytest.mark.parametrize("kind", ["one", "amid", "several", "periods", "realisations"])
@pytest.mark.parametrize("count", [2, 4])
def test_every_sample_is_left_out_once_and_trains_in_the_others(kind: str, count: int):
    records = some(kind)
    found = folds(records, count)
    assert len(found) == count
    every = sorted(scored(records))
    assert sorted(y for fold in found for y in scored(fold.left_out)) == every
    for fold in found:
        assert sorted(scored(fold.train) + scored(fold.left_out)) == every
    sizes = [len(scored(fold.left_out)) for fold in found]
    assert max(sizes) - min(sizes) <= (60 if records[0].start == "periodic" else 2)


def test_what_was_left_out_is_simulated_from_the_start_of_its_record():
    whole = replace(record(200, skip=20), start="given", x0=np.ones(1))
    for fold in folds(whole, 3):
        (left_out,) = fold.left_out
        assert np.array_equal(left_out.u, whole.u[: left_out.samples])
        assert left_out.start == "given"
        for part in fold.train:
            assert part.start == ("given" if part.u[0] == 0 else "estimated")
    steady = folds(record(60, "periodic", period=20), 3)[1]
    assert [(r.samples, r.start, r.period) for r in steady.train] == 2 * [(20, "periodic", 20)]


def test_folds_that_cannot_be_say_so():
    with pytest.raises(ValueError, match="folds is 1"):
        folds(record(200), 1)
    weighted = replace(record(60, "periodic", period=20), line_weight=np.ones(31))
    with pytest.raises(ValueError, match="has line_weight"):
        folds(weighted, 3)
    for records in (record(200, "periodic", period=200), record(15)):
        with pytest.raises(ValueError, match="folds is 2, and one of these stretches"):
            folds(records, 2)
