"""The errors of this package: what a caller can mend, or what ended a run."""

from __future__ import annotations


class LfrtorchError(Exception):
    """An error that the package raises with a message for its user; any other is a bug."""


class InputError(LfrtorchError, ValueError):
    """What was given cannot be used: the message says what was expected and what to do."""


LONGEST = 160
"""Characters of another library's message that are shown."""


def brief(error: BaseException | str, longest: int = LONGEST) -> str:
    """The message of another library on one line, cut off if it is longer.

    Example:
        >>> from lfrtorch._support.errors import brief
        >>> brief("no such\\n    key")
        'no such key'
    """
    text = " ".join(str(error)[: 4 * longest].split())
    return text if len(text) <= longest else f"{text[:longest]}..."
