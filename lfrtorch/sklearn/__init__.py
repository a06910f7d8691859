"""Estimator of scikit-learn for identification."""

from lfrtorch.sklearn.estimator import NLLFR

__all__ = ["NLLFR"]
