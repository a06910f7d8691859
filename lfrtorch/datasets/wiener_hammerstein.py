"""Wiener-Hammerstein benchmark of 2009: measurements of an electronic circuit, official split.

Input u (V), output y (V), 188000 samples at 51.2 kHz in one file. Officially samples 1 to 100000
are for estimation and 100001 to 188000 for the test, whose first 1000 the usual score leaves out.
(The package nonlinear_benchmarks tests on samples 105201 to 184000 alone, 78800 of 88000, and
estimates on 5201 to 105200, which reach into the official test.)

References:
    J. Schoukens, J. Suykens, L. Ljung (2009), "Wiener-Hammerstein benchmark", 15th IFAC Symposium
    on System Identification.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lfrtorch._support.checks import integer
from lfrtorch.dataset import Dataset, Published
from lfrtorch.datasets import official
from lfrtorch.records import Channel, Record

__all__ = ["load"]

_FILE = "WienerHammerBenchMark/WienerHammerBenchMark.mat"
_FS = 51200.0  # Hz
_SAMPLES, _ESTIMATION = 188_000, 100_000
_AT_REST = 5000  # samples at the beginning of the file; the input starts at 4999
_WARM_UP = 1000  # samples, unscored, of the official test: a BLA's transient is 1e-12 V after 300

_PACKAGE = (105_200, 184_000)  # its test, the first 50 samples unscored

_COMPARED = "as compared in Beintema, Schoukens and Tóth (2023)"
_PUBLISHED = (
    Published("BLA", {"test": 44e-3}, "the best of several, which reach up to 56 mV"),
    Published("PNLSS", {"test": 0.4e-3}, _COMPARED),
    Published("NL-LFR (2020)", {"test": 0.294e-3}, _COMPARED),
    Published("QBLA", {"test": 0.28e-3}, _COMPARED),
    Published("SUBNET", {"test": 0.241e-3}, "Beintema, Schoukens and Tóth (2023)"),
)


def load(
    *,
    validation: float = 0.2,
    skip: int = _AT_REST,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """The measurement, cut in time into a training, a validation and the official test record.

    Validation and test begin amid the measurement. They are simulated from zero state, 1000 samples
    ahead of what they score: validation begins that much earlier, in the training part, and the
    official test score leaves its first 1000 samples out.

    Args:
        validation: fraction of the estimation samples, the last of them, that validate.
        skip: samples at the beginning of the training record that are not fitted: the end of an
            earlier response (55 samples), then rest. The input starts at sample 4999.
        download: whether a missing file is downloaded, by the package nonlinear_benchmarks.
        root: folder that holds ``WienerHammerBenchMark/WienerHammerBenchMark.mat``; by default the
            cache folder of the package nonlinear_benchmarks.

    Shape:
        u, y (V) of training: (80000, 1); of validation: (21000, 1), 20000 of them scored; of the
        test: (88000, 1), 87000 scored.

    Raises:
        ValueError: an argument out of range, or a file that cannot be used.
        FileNotFoundError: no such file below ``root``.
        OSError: the download fails.

    Example:
        >>> data = lfrtorch.datasets.wiener_hammerstein.load(download=True)  # doctest: +SKIP
        >>> lfrtorch.datasets.wiener_hammerstein.load(root="elsewhere")
        Traceback (most recent call last):
        FileNotFoundError: there is no '...' in 'elsewhere'. Give the folder that holds ...
    """
    integer("skip", skip, 0)
    held_out = official.held_out(_ESTIMATION, validation, least=_WARM_UP + skip + 1)
    path = official.find(root, _FILE, "WienerHammerBenchMark", download=download)
    u, y = official.read_mat(path, ["uBenchMark", "yBenchMark"], _SAMPLES)
    whole = Record(
        u,
        y,
        fs=_FS,
        source="official",
        inputs=(Channel("u", "V"),),
        outputs=(Channel("y", "V"),),
    )
    trained = _ESTIMATION - held_out
    return Dataset(
        name="wiener_hammerstein",
        train=[official.part(whole, skip, trained, warm_up=skip, name="train")],
        validation=[
            official.part(whole, trained, _ESTIMATION, warm_up=_WARM_UP, name="validation")
        ],
        tests=[
            official.part(whole, _ESTIMATION + _WARM_UP, _SAMPLES, warm_up=_WARM_UP, name="test")
        ],
        published=_PUBLISHED,
        leaderboard=[replace(whole[slice(*_PACKAGE)], start="estimated", skip=50, name="test")],
    )
