"""Trajectory of a model and its derivatives."""
