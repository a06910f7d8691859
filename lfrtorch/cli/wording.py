"""Notes of the package in the words of the command line."""

from __future__ import annotations

import re


def as_words(note: str) -> str:
    """Return a note with its settings as words of a command: feedthrough=false, start=zero."""
    note = note.replace("by Record(valid=...) or ", "by ").replace(", or Record(valid=...)", "")
    note = re.sub(r"\b(\w+)='(\w+)'", r"\1=\2", note)
    return re.sub(r"\b(\w+)=(True|False)\b", lambda m: f"{m[1]}={m[2].lower()}", note)
