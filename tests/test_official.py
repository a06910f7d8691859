"""Official files: where they are looked for, what is read from them, how they are cut."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from lfrtorch import Record
from lfrtorch.datasets import official


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
        message = str(refusal.value)
        for part in (
            f"'{folder}'",
            "holds 'Bench'",
            "data.root=DIR",
            "nonlinear_benchmarks.Loader",
        ):
            assert part in message


def test_signals_are_read_in_the_order_of_their_names(tmp_path):
    a, b = np.arange(5.0), np.arange(5) ** 2
    savemat(tmp_path / "x.mat", {"a": a[:, None], "b": b[None, :], "other": 1.0})
    for names, expected in ((["a", "b"], (a, b)), (["b", "a"], (b, a))):
        for signal, known in zip(
            official.read_mat(tmp_path / "x.mat", names, 5), expected, strict=True
        ):
            assert signal.dtype == np.float64
            assert np.array_equal(signal, known)


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
    path: Path = tmp_path / "x.mat"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        savemat(path, content)
    with pytest.raises(ValueError, match=match) as refusal:
        official.read_mat(path, ["a"], 5, "ask Ada.")
    assert str(refusal.value).startswith(f"'{path}'")
    assert str(refusal.value).endswith("ask Ada.")


def test_held_out():
    assert official.held_out(1000, 0.2) == 200
    assert official.held_out(65_062, 0.2) == 13_012
    refused: list[Any] = [0, 1, 1.5, 1e-9, -0.1, float("nan"), float("inf"), None, "0.2"]
    for validation in refused:
        with pytest.raises(ValueError, match=r"data\.validation is"):
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
