"""Scores, figures, advice and the report of a run."""
