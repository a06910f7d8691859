"""The errors of this package: what a caller can mend, or what ended a run."""

from __future__ import annotations


class LfrtorchError(Exception):
    """An error that the package raises with a message for its user; any other is a bug."""


class InputError(LfrtorchError, ValueError):
    """What was given cannot be used: the message says what was expected and what to do."""
