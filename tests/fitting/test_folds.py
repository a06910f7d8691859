"""Stretches that are left out in turn: every sample once, the rest trains."""

from dataclasses import replace

import numpy as np
import pytest

from lfrtorch.data.records import Record, Start
from lfrtorch.fitting.folds import as_folded, folds


def record(samples: int, start: Start = "zero", skip: int = 0, period: int | None = None) -> Record:
    time = np.arange(samples, dtype=float)
    return Record(time, 1000.0 * samples + time, start=start, skip=skip, period=period)


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
def test_every_scored_sample_is_left_out_once_and_trains_in_the_others(kind: str, count: int):
    records = as_folded(some(kind))
    every = sorted(y for r in records for y in r.y[r.skip :, 0])
    found = folds(records, count)
    left_out = [fold.left_out([r.y for r in records])[:, 0] for fold in found]
    assert sorted(np.concatenate(left_out)) == every
    assert max(map(len, left_out)) - min(map(len, left_out)) <= 2
    for fold, own in zip(found, left_out, strict=True):
        trains = [y for r in fold.train for y in r.y[r.scored[:, 0], 0]]
        assert not {*trains} & {*own}
        assert {*every} <= {*trains, *own}


def test_a_masked_sample_stays_so_and_none_is_periodic():
    valid = np.arange(200) % 7 > 0
    whole = replace(record(200, skip=20), start="given", x0=np.ones(1), valid=valid)
    (steady, own) = as_folded([record(60, "periodic", period=20), whole])
    assert (steady.start, steady.period, own.start) == ("estimated", None, "estimated")
    for fold in folds([own], 3):
        (train,) = fold.train
        assert not train.scored[~valid].any()
        assert not train.scored[slice(*fold.windows[0])].any()


def test_folds_that_cannot_be_say_so():
    with pytest.raises(ValueError, match="folds is 1"):
        folds([record(200)], 1)
    with pytest.raises(ValueError, match=r"15 scored samples, of which 2 stretches.*longer rec"):
        folds([record(15)], 2)
