"""Wiener-Hammerstein benchmark of 2009: measurements of an electronic circuit.

Input u (V), output y (V), 188000 samples at 51.2 kHz in one file. Officially samples 1 to 100000
are for estimation and 100001 to 188000 for the test, whose first 1000 the usual score leaves out.
The site nonlinearbenchmark.org and its package test on samples 105201 to 184000, of which 50 are
not scored, and estimate on 5201 to 105200, which reach into the official test.

References:
    J. Schoukens, J. Suykens, L. Ljung (2009), "Wiener-Hammerstein benchmark", 15th IFAC Symposium
    on System Identification.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch.data.dataset import Dataset
from lfrtorch.datasets import official

__all__ = ["load"]

_FILE = "WienerHammerBenchMark/WienerHammerBenchMark.mat"
_FS = 51200.0  # Hz
_SAMPLES, _ESTIMATION = 188_000, 100_000
_WARM_UP = 1000  # samples, unscored, of the official test: a BLA's transient is 1e-12 V after 300

_SITE = (5200, 105_200), (105_200, 184_000)  # estimation and test of nonlinearbenchmark.org


def load(
    *,
    split: str = "official",
    validation: float = 0.2,
    skip: int | None = None,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """Measurement cut in time into a training, a validation and the test records.

    The tests are ``"test"``, the official one, and ``"site"``. ``split="site"`` trains on the
    site's estimation part, which overlaps ``"test"``, and leaves ``"site"`` alone.

    Validation and ``"test"`` begin amid the measurement. They are simulated from zero state, from
    1000 samples before their scored ones on: validation begins that much earlier, in the training
    part, and the official test score leaves its first 1000 samples out. The start state of
    ``"site"`` is fitted to the 50 samples that are not scored.

    Args:
        split: ``"official"`` or ``"site"``.
        validation: last fraction of the estimation samples, which validates.
        skip: samples at the beginning of the training record that are not fitted. Default: 5000
            for the official split, the end of an earlier response (55 samples), then rest, as the
            input starts at sample 4999; 1000 for the site's, which begins amid the measurement.
        download: download a missing file.
        root: folder that holds ``WienerHammerBenchMark/WienerHammerBenchMark.mat``.

    Shape:
        u, y (V) of training: (80000, 1); of validation: (21000, 1), 20000 of them scored; of the
        tests: (88000, 1), 87000 scored, and (78800, 1), 78750 scored.

    Example:
        >>> data = lfrtorch.datasets.wiener_hammerstein.load(download=True)  # doctest: +SKIP
    """
    if split not in ("official", "site"):
        raise InputError(f"split is {split!r}; give 'official' or 'site'.")
    site = split == "site"
    if skip is None:
        skip = _WARM_UP if site else 5000  # the input starts at 4999
    integer("skip", skip, 0)
    first, last = _SITE[0] if site else (0, _ESTIMATION)
    held_out = official.held_out(last - first, validation, least=_WARM_UP + skip + 1)
    path = official.find(root, _FILE, "WienerHammerBenchMark", download=download)
    shapes = {"uBenchMark": (_SAMPLES,), "yBenchMark": (_SAMPLES,)}
    u, y = official.read_arrays(path, shapes).values()
    whole = official.record(u, y, {"u": "V"}, {"y": "V"}, fs=_FS)
    trained = last - held_out
    of_site = replace(whole[slice(*_SITE[1])], start="estimated", skip=50, name="site")
    of_paper = official.part(whole, _ESTIMATION + _WARM_UP, _SAMPLES, warm_up=_WARM_UP, name="test")
    return Dataset(
        name="wiener_hammerstein",
        train=[official.part(whole, first + skip, trained, warm_up=skip, name="train")],
        validation=[official.part(whole, trained, last, warm_up=_WARM_UP, name="validation")],
        tests=[of_site] if site else [of_paper, of_site],
        published=official.published("wiener_hammerstein"),
        leaderboard=[of_site],
    )
