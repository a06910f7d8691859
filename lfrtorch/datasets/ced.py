"""Coupled electric drives (CED): measurements of two motors that drive a pulley by a flexible belt.

The input u (V) drives both motors, the output z (ticks/s) is the speed of the pulley: 500 samples
at 50 Hz in each of two measurements. u12, z12 is louder: its input is u11 + 0.5 V. The first 400
samples of each are for estimation and the last 100 for the test. The score leaves out the first 10
samples of the test, to which a model may fit its start state (4 in older versions of the package
nonlinear_benchmarks, and in scores that were published with them).

The pulse counter does not see the sign of the speed: z is its absolute value, an even function. The
pulley hangs on a spring, which gives a lightly damped mode.

The archive is FULLTEXT01.zip, or CoupledElectricDrivesDataSetAndReferenceModels.zip in older
versions of nonlinear_benchmarks. Its PRBS measurements, DATAPRBS.MAT, are not in the benchmark.

References:
    T. Wigren, M. Schoukens (2017), "Coupled electric drives data set and reference models",
    Technical report 2017-024, Uppsala University.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official

__all__ = ["load"]

_FILE = "CED/DATAUNIF.MAT"
_ARCHIVES = ("CED/FULLTEXT01.zip", "CED/CoupledElectricDrivesDataSetAndReferenceModels.zip")
_FS = 50.0  # Hz
_SAMPLES, _ESTIMATION = 500, 400
_WINDOW = 10  # samples, unscored, of the tests
_SITE = "_site"  # ending of the name of a test that is cut as on the site
_LEVELS = {"low": ("u11", "z11"), "high": ("u12", "z12")}


def load(
    *, validation: float = 0.2, download: bool = False, root: str | Path | None = None
) -> Dataset:
    """Records of both measurements, each cut in time into training, validation and test.

    The tests score the same samples twice. ``"low_site"`` and ``"high_site"`` are what the site
    nonlinearbenchmark.org gives: the start state is fitted to the 10 outputs that are not scored.
    Validation and the tests ``"low"`` and ``"high"`` are simulated from the beginning of their
    measurement: all samples before the scored ones are warm-up. The measurements may not begin at
    rest. So all records have an estimated start: training fits it with the parameters, validation
    and these tests fit it to the warm-up. Hundreds of samples with known inputs determine the state
    better than 10 outputs, which hide the sign of the speed.

    Args:
        validation: last fraction of the estimation samples of each measurement, which validates.
        download: download a missing file.
        root: folder that holds ``CED/DATAUNIF.MAT``, or ``CED/FULLTEXT01.zip`` with the file in it.

    Shape:
        u (V), z (ticks/s) of training: (320, 1); of validation: (400, 1), 80 of them scored; of the
        tests ``"low"`` and ``"high"``: (500, 1), and of the site's: (100, 1), 90 scored.

    Example:
        >>> data = lfrtorch.datasets.ced.load(download=True)  # doctest: +SKIP
    """
    trained = _ESTIMATION - official.held_out(_ESTIMATION, validation)
    path = official.find(root, _FILE, "CED", others=_ARCHIVES, download=download)
    shapes = {signal: (_SAMPLES, 1) for signals in _LEVELS.values() for signal in signals}
    arrays = official.read_arrays(path, shapes, Path(_FILE).name)

    whole = {
        level: official.record(arrays[u], arrays[z], {"u": "V"}, {"z": "ticks/s"}, fs=_FS)
        for level, (u, z) in _LEVELS.items()
    }

    def parts(first: int, last: int, prefix: str = "", *, warm_up: int) -> list[Record]:
        return [
            official.part(
                record, first, last, warm_up=warm_up, name=prefix + level, start="estimated"
            )
            for level, record in whole.items()
        ]

    scored = _ESTIMATION + _WINDOW
    site = [replace(r, name=r.name + _SITE) for r in parts(scored, _SAMPLES, warm_up=_WINDOW)]
    return Dataset(
        name="ced",
        train=parts(0, trained, "train_", warm_up=0),
        validation=parts(trained, _ESTIMATION, "validation_", warm_up=trained),
        tests=[*parts(scored, _SAMPLES, warm_up=scored), *site],
        published=official.published("ced"),
        leaderboard=site,
    )
