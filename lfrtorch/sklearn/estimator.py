"""A nonlinear LFR model as an estimator of scikit-learn, for its pipelines and searches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from lfrtorch._support.errors import InputError
from lfrtorch._support.frames import columns_of, is_frame
from lfrtorch._support.optional import imported
from lfrtorch._support.types import Array
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record, Start
from lfrtorch.files.split import cut
from lfrtorch.fitting.observer import Observer
from lfrtorch.fitting.settings import Settings
from lfrtorch.job import identify
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt

base = imported("sklearn.base", "sklearn")
validation = imported("sklearn.utils.validation", "sklearn")


class NLLFR(base.MultiOutputMixin, base.RegressorMixin, base.BaseEstimator):
    """A nonlinear LFR model: rows of X are samples of the inputs, in the order of time.

    Samples are not independent: a split must keep records whole, or in one piece. ``groups`` of
    ``fit`` names the record of each row, and ``GroupKFold`` or ``LeaveOneGroupOut`` splits by it.
    ``fit`` has no test records; the part held out by ``validation`` chooses the iterate.
    ``predict`` simulates its rows as one record from x = 0, and ``score`` is R² of that simulation.

    Args:
        nx, nz, nw, nn, starts, ridge, seed: as in :class:`lfrtorch.Settings`.
        max_iter: iterations of Levenberg-Marquardt.
        fs: sampling frequency in Hz; it only sets the unit of time of the model.
        start: start of a record of ``fit``, ``"zero"`` or ``"estimated"``; a prediction begins at
            x = 0, since there are no outputs.
        skip: samples at the beginning of every record of ``fit`` that are not scored.
        validation: last part of each record, which chooses the iterate; 0 for none.

    Attributes:
        model_: the :class:`lfrtorch.Model`.
        run_: the :class:`lfrtorch.Run`.
        n_iter_: iterations of the fit.

    Shape:
        X: (T, nu), y: (T,) or (T, ny), groups: (T,).

    References:
        Buitinck et al., "API design for machine learning software: experiences from the
        scikit-learn project", ECML PKDD workshop, 2013.

    Example:
        >>> from lfrtorch.sklearn import NLLFR
        >>> estimator = NLLFR(nx=1, nz=1, nn=4, max_iter=10).fit(record.u, record.y)
        >>> bool(estimator.score(record.u, record.y) > 0.9)
        True
    """

    def __init__(
        self,
        nx: int | str = "auto",
        *,
        nz: int | str = 1,
        nw: int | str = 1,
        nn: int | str = 10,
        starts: int = 1,
        ridge: float | str = 0.0,
        seed: int = 0,
        max_iter: int = 100,
        fs: float = 1.0,
        start: str = "zero",
        skip: int = 0,
        validation: float = 0.2,
    ) -> None:
        self.nx, self.nz, self.nw, self.nn = nx, nz, nw, nn
        self.starts, self.ridge, self.seed, self.max_iter = starts, ridge, seed, max_iter
        self.fs, self.start, self.skip, self.validation = fs, start, skip, validation

    def fit(self, X: Any, y: Any, groups: ArrayLike | None = None) -> NLLFR:
        """Identify a model; consecutive rows of a group are a record."""
        X, y = (columns_of(s, range(s.shape[1])) if is_frame(s) else s for s in (X, y))
        u, target = validation.validate_data(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64, ensure_min_samples=2
        )
        self._flat = target.ndim == 1
        target, start = target.reshape(len(u), -1), cast(Start, self.start)
        records = [
            Record(u[rows], target[rows], fs=self.fs, start=start, name=str(name), skip=self.skip)
            for name, rows in _stretches(groups, len(u))
        ]
        settings = Settings(
            **{name: getattr(self, name) for name in ("nx", "nz", "nw", "nn", "starts", "seed")},
            ridge=self.ridge,  # pyright: ignore[reportArgumentType]
            trainer=LevenbergMarquardt(max_iter=self.max_iter),
        )
        self.run_ = identify(self._by_use(records), settings, observer=Observer())
        self.model_, self.n_iter_ = self.run_.model, self.run_.fit.iterations
        return self

    def _by_use(self, records: Sequence[Record]) -> Dataset:
        """Divide the records: the last part of each is for validation."""
        if not 0.0 <= self.validation < 1.0:
            raise InputError(f"validation is {self.validation}; give a part from 0 to below 1.")
        parts = [cut(record, self.validation, 0.0) for record in records]
        chosen = [part["validation"] for part in parts if "validation" in part]
        return Dataset("arrays", [part["train"] for part in parts], chosen, [])

    def predict(self, X: Any) -> Array:
        """Simulated output, (T,) or (T, ny), from x = 0."""
        validation.check_is_fitted(self)
        X = columns_of(X, range(X.shape[1])) if is_frame(X) else X
        u = validation.validate_data(self, X, reset=False, dtype=np.float64)
        y = self.model_.simulate(u)
        return y[:, 0] if self._flat else y


def _stretches(groups: ArrayLike | None, samples: int) -> list[tuple[object, slice]]:
    """Name and rows of each record."""
    if groups is None:
        return [("record", slice(0, samples))]
    labels = np.asarray(groups)
    if labels.shape != (samples,):
        raise InputError(
            f"groups has the shape {labels.shape}; give the record of each of the {samples} rows."
        )
    edges = np.flatnonzero(np.append(True, labels[1:] != labels[:-1]))
    ends = [*edges[1:].tolist(), samples]
    return [(labels[a], slice(int(a), b)) for a, b in zip(edges, ends, strict=True)]
