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


def test_an_error_of_the_system_names_the_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file' cannot be written to: "):
        fill(tmp_path / "file" / "x.csv", "")
    with pytest.raises(OSError, match="' cannot be written to: No space left"):
        fill(tmp_path / "x.csv", OSError(28, "No space left on device"))
    with pytest.raises(FileNotFoundError, match=r"No such file or directory: '/nowhere/x\.csv'"):
        fill(
            tmp_path / "x.csv", FileNotFoundError(2, "No such file or directory", "/nowhere/x.csv")
        )
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def fill(path: Path, text: str | OSError) -> None:
    with whole_file(path) as fresh:
        if isinstance(text, OSError):
            raise text
        fresh.write_text(text)


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
