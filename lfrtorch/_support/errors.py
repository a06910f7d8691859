"""Errors of this package: those that a caller can mend, and those that end a run."""

from __future__ import annotations


class LfrtorchError(Exception):
    """Error that the package raises with a message for its user; any other error is a bug."""


LONGEST = 160
"""Number of characters of another library's message that are shown."""

_LONGEST_INPUT_ERROR = 1000  # characters of a message, which may hold a value that was given


class InputError(LfrtorchError, ValueError):
    """Unusable argument or file: the message says what was expected and what to do.

    The middle of a long message, which shows the value that was given, is left out.
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
