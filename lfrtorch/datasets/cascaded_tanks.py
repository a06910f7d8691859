"""Cascaded tanks benchmark: water levels with overflow, official split.

Input u (V), of the pump that fills the upper tank; output y (V), the level of the lower one, which
the upper one drains into. An estimation and a test record of 1024 samples each, 4 s apart. The
outflow goes as the root of the level. At large inputs the upper tank overflows, partly into the
lower one, and the sensor of the lower one ends at 10 V, which is in the records as measured.

The records do not begin at rest, and their start states are unknown; the benchmark says that they
are the same. Older versions of the package nonlinear_benchmarks left 5 samples of the test
unscored, version 1.0 leaves 50, and published figures may have either.

References:
    M. Schoukens, P. Mattson, T. Wigren, J.P. Noël (2016), "Cascaded tanks benchmark combining soft
    and hard nonlinearities", Workshop on Nonlinear System Identification Benchmarks.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from lfrtorch.checks import integer
from lfrtorch.datasets import Dataset, Published, official
from lfrtorch.records import Channel, Record

__all__ = ["load"]

_FILE = "Cascaded_Tanks/CascadedTanksFiles/dataBenchmark.mat"
_FS = 0.25  # Hz
_SAMPLES = 1024  # of each record
_WINDOW = 50  # samples that the package leaves unscored

_CT_SUBNET = "Beintema, Schoukens and Tóth (2023), continuous-time SUBNET"
_PUBLISHED = (
    Published("CT-SUBNET, best", {"test": 0.217}, _CT_SUBNET),
    Published("CT-SUBNET, median", {"test": 0.30}, _CT_SUBNET),
    Published("flexible NLSS", {"test": 0.343}, "Svensson and Schön (2017)"),
    Published("pNARX", {"test": 0.413}, f"as compared in {_CT_SUBNET}"),
    Published("BLA", {"test": 0.757}, f"as compared in {_CT_SUBNET}"),
)


def load(
    *,
    validation: float = 0.25,
    skip: int = _WINDOW,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """The estimation record, cut in time for training and validation, and the test record.

    Training estimates its start state with the parameters. The validation record is the whole
    estimation record, of which the last part is scored: the samples before, which it skips, give
    its start state. The start state of the test is fitted to its first ``skip`` samples.

    Args:
        validation: fraction of the estimation samples, the last of them, that validate.
        skip: samples at the beginning of the test that are not scored.
        download: whether a missing file is downloaded, by the package nonlinear_benchmarks.
        root: folder that holds ``Cascaded_Tanks/CascadedTanksFiles/dataBenchmark.mat``; by default
            the cache folder of the package nonlinear_benchmarks.

    Shape:
        u, y (V) of training: (768, 1); of validation: (1024, 1), 256 of them scored; of the test
        ``"test"``: (1024, 1), 974 scored.

    Raises:
        ValueError: an argument out of range, or a file that cannot be used.
        FileNotFoundError: no such file below ``root``.
        OSError: the download fails.
    """
    integer("data.skip", skip, 1)
    trained = _SAMPLES - official.held_out(_SAMPLES, validation)
    path = official.find(root, _FILE, "Cascaded_Tanks", download=download)
    signals = official.read_mat(path, ["uEst", "yEst", "uVal", "yVal"], _SAMPLES)

    def record(name: str, which: int, **settings: Any) -> Record:
        u, y = signals[2 * which : 2 * which + 2]
        channels: dict[str, Any] = {"inputs": (Channel("u", "V"),), "outputs": (Channel("y", "V"),)}
        return Record(
            u, y, fs=_FS, start="estimated", name=name, source="official", **channels, **settings
        )

    return Dataset(
        name="cascaded_tanks",
        train=[replace(record("train", 0)[:trained], start="estimated")],
        validation=[record("validation", 0, skip=trained)],
        tests=[record("test", 1, skip=skip)],
        leaderboard=[record("test", 1, skip=_WINDOW)],
        published=_PUBLISHED,
    )
