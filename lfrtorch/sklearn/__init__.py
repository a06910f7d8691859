"""Identification as an estimator of scikit-learn."""

from lfrtorch.sklearn.estimator import NLLFR

__all__ = ["NLLFR"]
