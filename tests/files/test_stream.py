"""Channels of a model are found in a file, and samples that cannot be used are named."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from lfrtorch.data.records import Channel
from lfrtorch.files.stream import FileStream

FS, T = 750.0, 1000
INPUTS, OUTPUTS = (Channel("u1", "N"), Channel("u2")), (Channel("y", "mm"),)
U = np.random.default_rng(0).normal(size=(T, 2))
Y = np.random.default_rng(1).normal(size=T)
TIMES = np.arange(T) / FS


def csv(path: Path, **columns: np.ndarray) -> Path:
    rows = np.stack([*columns.values()], axis=1)
    lines = [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in rows]
    path.write_text("\n".join([",".join(columns), *lines]) + "\n")
    return path


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return csv(tmp_path / "x.csv", **{"t": TIMES, "y (mm)": Y, "u2": U[:, 1], "u1 (N)": U[:, 0]})


def opened(path: Path, **options) -> FileStream:
    return FileStream(path, INPUTS, OUTPUTS, FS, **options)


def read(path: Path, samples: int = 300, **options) -> list:
    return list(opened(path, **options).blocks(samples))


def refused(message: str, path: Path, **options) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        read(path, **options)


def test_channels_are_found_by_the_names_of_the_model(file: Path):
    blocks = read(file)
    assert [len(block.u) for block in blocks] == [300, 300, 300, 100]
    times, u, y = (np.concatenate(part) for part in zip(*blocks, strict=True))
    assert times.shape == (T, 0)
    assert np.array_equal(u, U)
    assert np.array_equal(y[:, 0], Y)


def test_channels_are_found_where_they_are_said_to_be(file: Path):
    block = read(file, T, inputs=["u1 (N)", 2], outputs=1, time="t")[0]
    assert np.array_equal(block.u, U)
    assert np.array_equal(block.y[:, 0], Y)
    assert np.array_equal(block.times[:, 0], TIMES)


def test_outputs_may_be_missing(tmp_path: Path):
    path = csv(tmp_path / "x.csv", u1=U[:, 0], u2=U[:, 1])
    stream = opened(path)
    assert (stream.y, stream.missing) == ((), ["y"])
    assert next(stream.blocks()).y.shape == (T, 0)
    refused("no column 'y', named in outputs", path, outputs="y")


def test_samples_of_an_output_may_be_missing(tmp_path: Path):
    y = np.where(np.arange(T) == 500, np.nan, Y)
    (block,) = read(csv(tmp_path / "x.csv", u1=U[:, 0], u2=U[:, 1], y=y), T)
    assert np.array_equal(block.y[:, 0], y, equal_nan=True)


def test_columns_that_cannot_be(file: Path, tmp_path: Path):
    listed = "has no column 'u1'; it has 2 column(s): 'force', 'u2'. The model has u1 (N), u2;"
    refused(listed, csv(tmp_path / "a.csv", force=Y, u2=Y))
    refused("inputs is 1 column(s)", file, inputs=["u2"])
    refused("'force', named in inputs", file, inputs=["force", "u2"])
    other = csv(tmp_path / "b.csv", **{"u1 (kN)": Y, "u2": Y})
    refused("column u1 (kN) of", other)
    refused("is in another unit than the model's u1 (N); convert it", other)
    refused("the time column y (mm) has the unit 'mm', which is not a unit of time", file, time="y")
    refused("the time column u2 does not rise", file, inputs=[3, 3], time="u2")


@pytest.mark.parametrize("samples", [7, 300, T])
def test_a_gap_is_named_by_its_line(samples: int, tmp_path: Path):
    u = U.copy()
    u[437, 1] = np.nan
    path = csv(tmp_path / "x.csv", u1=u[:, 0], u2=u[:, 1])
    refused("x.csv', line 439: column 'u2' has no finite number; interp", path, samples=samples)


# --- times ----------------------------------------------------------------------------------


def timed(folder: Path, times: np.ndarray, name: str = "t") -> Path:
    return csv(folder / "x.csv", **{name: times, "u1": U[:, 0], "u2": U[:, 1]})


@pytest.mark.numeric
@pytest.mark.parametrize(
    ("name", "times"),
    [
        ("t", 1e6 + TIMES),
        ("t [ms]", 1e3 * TIMES),
        ("t (us)", 1e6 * TIMES),
        ("t", np.round(TIMES, 3)),  # steps of 1 and 2 ms, where 1.33 is meant
        ("t", TIMES * (1 + 5e-4)),  # another clock
        ("t", TIMES + 0.05 / FS * np.sin(np.arange(T))),
    ],
)
def test_times_that_run_at_the_rate(name: str, times: np.ndarray, tmp_path: Path):
    path = timed(tmp_path, times, name)
    scale = {"t": 1.0, "t [ms]": 1e-3, "t (us)": 1e-6}[name]
    for samples in (300, T - 1, T):  # blocks of one sample, too
        found = np.concatenate([block.times for block in read(path, samples, time="t")])[:, 0]
        assert np.array_equal(found, scale * times)


@pytest.mark.numeric
@pytest.mark.parametrize(("rate", "samples"), [(375.0, 7), (700.0, 300), (1500.0, T)])
def test_times_at_another_rate(rate: float, samples: int, tmp_path: Path):
    message = f"says {rate:g} Hz and the model runs at 750 Hz; resample"
    refused(message, timed(tmp_path, np.arange(T) / rate), samples=samples, time="t")


def test_times_that_cannot_be(tmp_path: Path):
    np.savez(tmp_path / "x.npz", t=np.stack([TIMES, TIMES], axis=1), u1=U[:, 0], u2=U[:, 1])
    refused("time is 't', 2 columns; name one", tmp_path / "x.npz", time="t")
    refused("line 3: the time column t does not rise", timed(tmp_path, -TIMES), time="t")
    missing = np.where(np.arange(T) == 20, np.nan, TIMES)
    refused("line 22: column 't' has no finite number", timed(tmp_path, missing), time="t")


@pytest.mark.numeric
# The gap is before the first sample of a block, before the last one, and inside.
@pytest.mark.parametrize(("lost", "samples"), [(1, 100), (100, 300), (1, 301), (100, 301), (1, T)])
def test_samples_that_are_lost(lost: int, samples: int, tmp_path: Path):
    times = (np.arange(T) + lost * (np.arange(T) >= 300)) / FS
    message = f"x.csv', line 302: {lost} sample(s) are missing before it, as the time column t says"
    refused(message, timed(tmp_path, times), samples=samples, time="t")


@pytest.mark.numeric
@pytest.mark.parametrize("samples", [300, 301, T])
def test_a_sample_that_is_repeated(samples: int, tmp_path: Path):
    path = timed(tmp_path, (np.arange(T) - (np.arange(T) >= 300)) / FS)
    said = "line 302: the time column t has 1 time stamp(s) twice"
    refused(said, path, samples=samples, time="t")


def test_a_rate_behind_the_file_is_refused(tmp_path: Path):
    refused("is simulated at the times that it has", Path(f"{timed(tmp_path, TIMES)}#750Hz"))


def test_a_parquet_file_is_not_read_ahead(tmp_path: Path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    n, groups = 10_000, 40
    schema = pa.schema([(name, pa.float64()) for name in ("u1", "u2")])
    with pq.ParquetWriter(tmp_path / "x.parquet", schema) as file:
        for seed in range(groups):
            u = np.random.default_rng(seed).normal(size=(2, n))
            file.write_table(pa.table({"u1": u[0], "u2": u[1]}))
    before = pa.total_allocated_bytes()
    blocks = opened(tmp_path / "x.parquet").blocks(n)
    held = max(pa.total_allocated_bytes() - before for _ in blocks)
    assert held < groups * 2 * n * 8 / 4  # a quarter of the file


def test_the_rate_that_the_file_says_is_the_models(tmp_path: Path):
    path = tmp_path / "x.mat"
    signals = {"u1": U[:, 0], "u2": U[:, 1]}
    taken = "the column 't' is taken for the time, 750 Hz"
    for found, note in (
        ({}, "nothing says how it is sampled; the model's 750 Hz are taken"),
        ({"Ts": 1 / FS}, "fs is 750 Hz, as 'Ts' in the file says"),
        ({"t": TIMES}, taken),
    ):
        savemat(path, signals | found)
        stream = opened(path, find_time=True)
        assert stream.note == note
        assert bool(stream.times) == ("t" in found)
    savemat(path, signals | {"fs": 400.0})
    refused("as 'fs' in the file says, and the model runs at 750 Hz", path, find_time=True)
    savemat(path, signals | {"t": TIMES[::-1]})
    refused("the column 't' does not rise", path, find_time=True)
    read(path)
