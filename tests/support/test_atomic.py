"""Files are replaced at once, and left as they were by an error."""

from pathlib import Path

import pytest

from lfrtorch._support.atomic import refuse_existing, whole_file


def test_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "made" / "x.csv"
    for text in ("old", "new"):
        with whole_file(path) as fresh:
            assert fresh.suffix == ".csv"
            fresh.write_text(text)
        assert path.read_text() == text
    assert list(path.parent.iterdir()) == [path]


def test_an_error_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("old")

    def fail() -> None:
        with whole_file(path) as fresh:
            fresh.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_permissions_are_the_usual_ones(tmp_path: Path) -> None:
    usual, path = tmp_path / "usual", tmp_path / "x"
    usual.touch()
    with whole_file(path):
        pass
    assert path.stat().st_mode == usual.stat().st_mode


def test_refuses_to_replace_unasked(tmp_path: Path) -> None:
    refuse_existing(tmp_path / "new", "overwrite=true")
    with pytest.raises(ValueError, match="overwrite=true"):
        refuse_existing(tmp_path, "overwrite=true")
