"""Official files: where they are looked for, what is read from them, how they are cut."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pytest
from scipy.io import savemat

from lfrtorch import Record
from lfrtorch.datasets import official

ARCHIVE = "Bench/Files.zip"


def test_cache_folder_of_each_system(monkeypatch):
    monkeypatch.setenv("HOME", "/home/ada")
    monkeypatch.setenv("USERPROFILE", "/home/ada")
    monkeypatch.setenv("LOCALAPPDATA", "C:/Users/ada/AppData/Local")
    for platform, expected in {
        "linux": "/home/ada/.nonlinear_benchmarks",
        "darwin": "/home/ada/Library/Application Support/nonlinear_benchmarks",
        "win32": "C:/Users/ada/AppData/Local/nonlinear_benchmarks",
    }.items():
        monkeypatch.setattr(official.sys, "platform", platform)
        assert official.cache().as_posix() == expected


def test_files_are_found_below_root_or_in_the_cache(tmp_path, monkeypatch):
    path = tmp_path / "Bench" / "x.mat"
    path.parent.mkdir()
    path.touch()
    assert official.find(tmp_path, "Bench/x.mat", "Bench") == path
    assert official.find(str(tmp_path), "Bench/x.mat", "Bench") == path
    monkeypatch.setattr(official, "cache", lambda: tmp_path)
    assert official.find(None, "Bench/x.mat", "Bench") == path


def test_a_missing_file_is_named_with_advice(tmp_path, monkeypatch):
    monkeypatch.setattr(official, "cache", lambda: tmp_path / "cache")
    for root, folder in ((tmp_path, tmp_path), (None, tmp_path / "cache")):
        with pytest.raises(FileNotFoundError, match=r"no 'Bench/x\.mat' in") as refusal:
            official.find(root, "Bench/x.mat", "Loader")
        for part in (f"'{folder}'", "holds 'Bench'", "root=DIR", "nonlinear_benchmarks.Loader"):
            assert part in str(refusal.value)


def test_other_files_do_as_well(tmp_path):
    def find():
        return official.find(tmp_path, "Bench/a/x.mat", "Bench", others=["Bench/x.mat", ARCHIVE])

    (tmp_path / "Bench" / "a").mkdir(parents=True)
    for content in (None, b""):  # an empty archive is a placeholder
        if content is not None:
            (tmp_path / ARCHIVE).write_bytes(content)
        with pytest.raises(FileNotFoundError, match=r"no 'Bench/a/x\.mat'"):
            find()
    (tmp_path / ARCHIVE).write_bytes(b"zip")
    for file in (ARCHIVE, "Bench/x.mat", "Bench/a/x.mat"):  # each before those that were there
        if file != ARCHIVE:
            (tmp_path / file).touch()
        assert find() == tmp_path / file


@pytest.fixture
def package(monkeypatch):
    """A nonlinear_benchmarks that writes a file, and the folders it was asked to write into."""
    asked = []

    def Bench(*, data_file_locations: bool, dir_placement: Path):
        assert data_file_locations
        asked.append(dir_placement)
        (dir_placement / "Bench").mkdir()
        (dir_placement / "Bench" / "x.mat").touch()

    def Broken(**_: Any):
        raise Exception("Download failed after 5 attempts")

    fake = SimpleNamespace(Bench=Bench, Broken=Broken, Empty=lambda **_: None)
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", fake)
    return asked


def test_a_missing_file_is_downloaded_where_it_is_looked_for(tmp_path, monkeypatch, package):
    monkeypatch.setattr(official, "cache", lambda: tmp_path / "cache")
    with pytest.raises(FileNotFoundError):
        official.find(None, "Bench/x.mat", "Bench")
    assert not package
    for root, folder in ((None, tmp_path / "cache"), (tmp_path / "a" / "b", tmp_path / "a" / "b")):
        for _ in range(2):  # the second time it is there
            found = official.find(root, "Bench/x.mat", "Bench", download=True)
            assert found == folder / "Bench" / "x.mat"
        assert package.pop() == folder
        assert not package


def test_a_download_that_fails(tmp_path, package):
    for loader, kind, message in (
        ("Broken", OSError, "Broken.. failed .*after 5 attempts.*remove what it left in '{}'"),
        ("Unknown", OSError, "Unknown.. failed .*AttributeError"),
        ("Empty", FileNotFoundError, "Empty.. left no 'Bench/x.mat' in .*remove that from '{}'"),
    ):
        with pytest.raises(kind, match=message.format(tmp_path / "Bench")):
            official.find(tmp_path, "Bench/x.mat", loader, download=True)


def test_a_loader_in_a_submodule(tmp_path, monkeypatch, package):
    submodule = SimpleNamespace(Bench=sys.modules["nonlinear_benchmarks"].Bench)
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks.more", submodule)
    found = official.find(tmp_path, "Bench/x.mat", "more.Bench", download=True)
    assert found == tmp_path / "Bench" / "x.mat"
    with pytest.raises(OSError, match=r"nonlinear_benchmarks\.more\.Unknown\(\) failed"):
        official.find(tmp_path, "Bench/y.mat", "more.Unknown", download=True)


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", None)  # its import fails
    with pytest.raises(FileNotFoundError, match=r"no 'Bench/x\.mat' in") as refusal:
        official.find(tmp_path / "new", "Bench/x.mat", "Bench", download=True)
    assert "pip install 'lfrtorch[bench]'" in str(refusal.value)
    assert "root=DIR" in str(refusal.value)
    assert not (tmp_path / "new").exists()


def test_arrays_keep_their_axes(tmp_path):
    whole = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    vectors = {"c": np.arange(5.0)[:, None], "d": np.arange(5)[None, :] ** 2}
    savemat(tmp_path / "x.mat", {"a": whole, "b": whole[0], "other": 1.0, **vectors})
    with ZipFile(tmp_path / "x.zip", "w", ZIP_DEFLATED) as archive:
        archive.writestr("folder/other.mat", "")
        archive.write(tmp_path / "x.mat", "folder/x.mat")
    for path in (tmp_path / "x.mat", tmp_path / "x.zip"):
        shapes = {"d": (5,), "b": (3, 4), "c": (5,), "a": (2, 3, 4)}
        found = official.read_arrays(path, shapes, "x.mat")
        assert list(found) == list(shapes)
        for name, vector in vectors.items():
            assert np.array_equal(found[name], vector.ravel())
            assert found[name].dtype == np.float64
        assert np.array_equal(found["a"], whole)
        assert np.array_equal(found["b"], whole[0])
        assert found["a"].dtype == np.float64
        for wrong in ({"a": (4, 3, 2)}, {"a": (2, 12)}):
            (shape,) = wrong.values()
            with pytest.raises(ValueError, match=r"'a' has shape \(2, 3, 4\) .* expected") as told:
                official.read_arrays(path, wrong, "x.mat")
            assert f"expected {shape} and real numbers" in str(told.value)
            assert str(told.value).startswith(f"'{path}'")
            assert str(told.value).endswith("any archive beside it, and download them again.")
    for member in ("y.mat", "folder"):
        with pytest.raises(ValueError, match=f"no readable '{member}'"):
            official.read_arrays(tmp_path / "x.zip", {"a": (2, 3, 4)}, member)


def test_archive_note(tmp_path):
    path, known = tmp_path / "x.zip", "900150983cd24fb0d6963f7d28e17f72"  # RFC 1321, of "abc"
    missing = "no x.zip beside x.mat: its checksum is unknown"
    assert official.archive_note(path, known, "x.mat") == missing
    path.touch()
    assert official.archive_note(path, known, "x.mat") == missing
    path.write_bytes(b"abc")
    assert official.archive_note(path, known, "x.mat") == f"x.zip is the known file (md5 {known})"
    assert official.archive_note(path, "0" * 32, "x.mat") == (
        f"x.zip is not the known file: md5 {known}, expected {'0' * 32}; scores may not compare"
    )


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ({"b": np.zeros((1, 5))}, "no readable 'a'"),
        ({"a": np.zeros((1, 4))}, r"shape \(1, 4\).*expected \(1, 5\) or \(5, 1\)"),
        ({"a": np.zeros((5, 2))}, r"shape \(5, 2\)"),
        ({"a": np.full((1, 5), np.nan)}, "without NaN"),
        ({"a": np.full((5, 1), 1j)}, "type complex128"),
        ({"a": "words"}, "type <U5"),
        (b"", "no readable 'a'"),
        (b"text " * 99, "no readable 'a'"),
    ],
)
def test_refused_signals(tmp_path, content, match):
    refused(tmp_path, content, match, lambda path: official.read_arrays(path, {"a": (5,)}))


def refused(tmp_path, content, match, read):
    path: Path = tmp_path / "x.mat"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        savemat(path, content)
    with pytest.raises(ValueError, match=match) as refusal:
        read(path)
    assert str(refusal.value).startswith(f"'{path}'")
    assert str(refusal.value).endswith(
        "remove 'x.mat' and any archive beside it, and download them again."
    )


def test_fields_of_a_struct_are_read_in_the_order_of_their_names(tmp_path):
    a = np.arange(12, dtype=np.int16).reshape(4, 3)
    savemat(tmp_path / "x.mat", {"s": {"b": a + 0.5, "a": a, "fs": 5.0}, "a": 1.0})
    for fields, expected in ((("a", "b"), (a, a + 0.5)), (("b", "a"), (a + 0.5, a))):
        found = official.read_struct(tmp_path / "x.mat", "s", fields)
        for matrix, known in zip(found, expected, strict=True):
            assert matrix.dtype == np.float64
            assert np.array_equal(matrix, known)
    (column,) = official.read_struct(tmp_path / "x.mat", "s", ["fs"])
    assert column.shape == (1, 1)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ({"t": {"a": np.zeros((4, 3))}}, r"no readable struct 's' with a and b \(KeyError"),
        ({"s": np.zeros((4, 3))}, "no readable struct 's'"),
        ({"s": 1.0}, "no readable struct 's'"),
        ({"s": "words"}, "no readable struct 's'"),
        ({"s": [{"a": 1.0, "b": 1.0}, {"a": 1.0, "b": 1.0}]}, "no readable struct 's'"),
        ({"s": {"a": np.zeros((4, 3))}}, "no readable struct 's' with a and b"),
        ({"s": {"a": np.zeros((4, 3)), "b": np.zeros((3, 4))}}, r"'s\.b' .* expected \(4, 3\)"),
        ({"s": {"a": np.zeros((4, 3, 2)), "b": 1.0}}, r"'s\.a' .*\(4, 3, 2\); expected \(samp"),
        ({"s": {"a": np.zeros((0, 0)), "b": 1.0}}, r"'s\.a' .*\(0, 0\); expected \(samples, rec"),
        ({"s": {"a": np.ones((4, 3)), "b": np.full((4, 3), np.inf)}}, r"'s\.b' .*without NaN"),
        ({"s": {"a": np.full((4, 3), 1j), "b": np.ones((4, 3))}}, r"'s\.a' .*type complex128"),
        (b"", "no readable struct 's'"),
        (b"text " * 99, "no readable struct 's'"),
    ],
)
def test_refused_structs(tmp_path, content, match):
    fields = ["a", "b"]
    refused(tmp_path, content, match, lambda path: official.read_struct(path, "s", fields))


def test_held_out():
    assert official.held_out(1000, 0.2) == 200
    assert official.held_out(65_062, 0.2) == 13_012
    refused: list[Any] = [0, 1, 1.5, 1e-9, -0.1, float("nan"), float("inf"), None, "0.2"]
    for validation in refused:
        with pytest.raises(ValueError, match=r"validation is"):
            official.held_out(1000, validation)
    assert official.held_out(1000, 0.9, least=100) == 900
    with pytest.raises(ValueError, match=r"leaves 100 of the 1000 .* it needs 101"):
        official.held_out(1000, 0.9, least=101)


def test_part():
    whole = Record(np.arange(20.0), -np.arange(20.0), fs=5.0, source="official")
    part = official.part(whole, 8, 12, warm_up=3, name="test")
    assert (part.name, part.start, part.skip, part.fs) == ("test", "zero", 3, 5.0)
    assert part.source == "official"
    assert np.array_equal(part.u[:, 0], np.arange(5.0, 12.0))
    assert np.array_equal(part.y[part.skip :, 0], -np.arange(8.0, 12.0))
    estimated = official.part(whole, 8, 12, warm_up=3, name="test", start="estimated")
    assert (estimated.start, estimated.skip) == ("estimated", 3)
