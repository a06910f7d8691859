"""The estimator of scikit-learn: its own checks, records as groups, searches."""

from __future__ import annotations

import warnings

import numpy as np
import pandas as pd
import pytest

sklearn = pytest.importorskip("sklearn", reason="lfrtorch[sklearn] is not installed")

from sklearn.base import clone  # noqa: E402
from sklearn.model_selection import GridSearchCV, LeaveOneGroupOut, cross_val_score  # noqa: E402
from sklearn.pipeline import make_pipeline  # noqa: E402
from sklearn.preprocessing import StandardScaler  # noqa: E402
from sklearn.utils.estimator_checks import check_estimator  # noqa: E402

from lfrtorch import InputError  # noqa: E402
from lfrtorch._support.types import Array  # noqa: E402
from lfrtorch.sklearn import NLLFR  # noqa: E402

pytestmark = pytest.mark.numeric

TOO_FEW = "samples; order nx=1"
"""What the checks' 8 to 45 rows of up to 10 inputs end in: they tell no dynamics."""


def saturation(samples: int, seed: int = 0) -> tuple[Array, Array]:
    u = np.random.default_rng(seed).standard_normal(samples)
    y = np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + np.tanh(u[k])
    return u[:, None], y


def several() -> tuple[Array, Array, Array]:
    parts = [saturation(300, seed) for seed in range(3)]
    u, y = (np.concatenate(signals) for signals in zip(*parts, strict=True))
    return u, y, np.repeat([0, 1, 2], 300)


@pytest.mark.slow
def test_what_checks_of_scikit_learn_it_passes():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = check_estimator(NLLFR(nx=1, nn=2, max_iter=3), on_fail=None)
    failed = {each["check_name"]: str(each["exception"]) for each in found
              if each["status"] == "failed"}  # fmt: skip
    assert len(found) - len(failed) > 25
    assert {name for name, why in failed.items() if TOO_FEW not in why} == set()


def test_it_simulates_and_scores():
    u, y = saturation(600)
    estimator = NLLFR(nx=1, nn=4, max_iter=15).fit(u, y)
    assert estimator.score(*saturation(300, 1)) > 0.99
    assert estimator.predict(u).shape == y.shape
    assert 0 < estimator.n_iter_ <= 15
    again = clone(estimator)
    assert again.get_params() == estimator.get_params()
    assert not hasattr(again, "model_")
    both = NLLFR(nx=1, nn=2, max_iter=3).fit(u, np.column_stack([y, 2 * y]))
    assert both.predict(u).shape == (600, 2)
    frame = pd.DataFrame({"force": u[:, 0]})
    named = NLLFR(nx=1, nn=4, max_iter=15).fit(frame, pd.Series(y))
    np.testing.assert_allclose(named.predict(frame), estimator.predict(u))


def test_groups_are_records():
    u, y, groups = several()
    estimator = NLLFR(nx=1, nn=4, max_iter=5).fit(u, y, groups)
    train = estimator.run_.dataset.train
    assert [(record.name, record.samples) for record in train] == [
        ("0", 240),
        ("1", 240),
        ("2", 240),
    ]
    with pytest.raises(InputError, match=r"groups has the shape \(5,\); give the record of each"):
        estimator.fit(u, y, [1, 1, 1, 2, 2])
    with pytest.raises(InputError, match="validation is 2; give a part"):
        NLLFR(nx=1, validation=2).fit(u, y)


def test_searches_leave_out_whole_records():
    u, y, groups = several()
    with sklearn.config_context(enable_metadata_routing=True):
        estimator = NLLFR(nx=1, max_iter=5).set_fit_request(groups=True)
        search = GridSearchCV(estimator, {"nn": [1, 4]}, cv=LeaveOneGroupOut())
        search.fit(u, y, groups=groups)
    assert search.best_score_ > 0.98
    assert len(search.best_estimator_.run_.dataset.train) == 3
    pipeline = make_pipeline(StandardScaler(), NLLFR(nx=1, nn=4, max_iter=5))
    scores = cross_val_score(pipeline, u, y, groups=groups, cv=LeaveOneGroupOut())
    assert scores.min() > 0.95  # two records of each fit count as one
