"""The errors of this package: what a caller can mend, or what ended a run."""

from __future__ import annotations


class LfrtorchError(Exception):
    """An error that the package raises with a message for its user; any other is a bug."""


LONGEST = 160
"""Characters of another library's message that are shown."""

_LONGEST_INPUT_ERROR = 1000  # characters of a message, which may hold a value that was given


class InputError(LfrtorchError, ValueError):
    """What was given cannot be used: the message says what was expected and what to do.

    The middle of a long one, which holds what was given, is left out.
    """

    def __init__(self, message: str) -> None:
        if len(message) > _LONGEST_INPUT_ERROR:
            half = _LONGEST_INPUT_ERROR // 2 - len(" ... ")
            message = " ... ".join(" ".join(p.split()) for p in (message[:half], message[-half:]))
        super().__init__(message)


def brief(error: BaseException | str, longest: int = LONGEST) -> str:
    """Return the message of another library on one line, cut off if it is longer."""
    said = str(error) or (type(error).__name__ if isinstance(error, BaseException) else "")
    text = " ".join(said[: 4 * longest].split())
    return text if len(text) <= longest else f"{text[:longest]}..."
