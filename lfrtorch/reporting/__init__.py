"""Scores, figures, advice and the report of a run."""

from lfrtorch.reporting.console import Console
from lfrtorch.reporting.run_files import write

__all__ = ["Console", "write"]
