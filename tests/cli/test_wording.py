"""Notes are printed in the words of a command."""

import pytest

from lfrtorch.cli.errors import as_words


@pytest.mark.parametrize(
    ("note", "words"),
    [
        (
            "try feedthrough=False and refine='prediction'",
            "feedthrough=false and refine=prediction",
        ),
        ("use integrators=[1,0] and start='estimated';", "integrators=[1,0] and start=estimated;"),
        ("leave them out, by Record(valid=...) or an empty cell", "out, by an empty cell"),
        ("output 'y' is 'a=b' for x='one two'", "output 'y' is 'a=b' for x='one two'"),
    ],
)
def test_settings_are_words(note: str, words: str):
    assert words in as_words(note)
