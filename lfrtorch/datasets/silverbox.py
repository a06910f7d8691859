"""Silverbox benchmark: measurements of an electronic Duffing oscillator, split as the field does.

Input V1 (V), output V2 (V), 131072 samples at 610.35 Hz in one file: an "arrow", Gaussian noise of
growing amplitude (samples 101 to 40575), then ten realisations of an odd random-phase multisine
(samples 40651 to 127400). Three quarters of the multisines are for estimation; the tests are the
last quarter, the arrow, and the first 32000 samples of the arrow, where it does not exceed the
amplitudes of the multisines.

The input has an offset of 6.2 mV and the output one of 0.8 mV. They stay in the records: models
have operating points and biases of their own.

References:
    T. Wigren, J. Schoukens (2013), "Three free data sets for development and benchmarking in
    nonlinear system identification", European Control Conference.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lfrtorch._support.checks import integer
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.datasets import official

__all__ = ["load"]

_FILE = "Silverbox/SilverboxFiles/SNLS80mV.mat"
_FS = 1e7 / 2**14  # Hz
_SAMPLES = 131_072
_ESTIMATION = (40_650, 105_712)  # samples of the multisines, three quarters
_SKIP = 50  # samples, unscored, of the tests
_TESTS = {  # first sample, and the one after the last
    "multisine": (105_712, 127_400),
    "arrow": (100, 40_575),
    "arrow_no_extrapolation": (100, 32_100),  # samples within the amplitudes of the multisines
}


def load(
    *,
    validation: float = 0.2,
    warm_up: int = 500,
    download: bool = False,
    root: str | Path | None = None,
) -> Dataset:
    """Measurement cut in time into a training, a validation and three test records.

    All records are simulated from zero state. The arrow begins at rest. The others begin amid the
    measurement, and the effect of a zero state on the output (40 to 80 mV) fades by a factor of 6
    every 50 samples only. After the 50 samples that the tests leave out it would still add 0.14 mV
    to the rms error of the multisine test. So that test and validation begin ``warm_up`` samples
    earlier, with the inputs measured there, and training leaves as many samples out.

    Args:
        validation: last fraction of the estimation samples, which validates.
        warm_up: samples that are simulated and not scored.
        download: download a missing file.
        root: folder that holds ``Silverbox/SilverboxFiles/SNLS80mV.mat``.

    Shape:
        u, y (V) of training: (52050, 1), its first 500 not scored; of validation: (13512, 1),
        13012 scored; of the tests ``"multisine"``: (22188, 1), 21638 scored, ``"arrow"``:
        (40475, 1), 40425 scored, ``"arrow_no_extrapolation"``: (32000, 1), 31950 scored.

    Example:
        >>> data = lfrtorch.datasets.silverbox.load(download=True)  # doctest: +SKIP
    """
    integer("warm_up", warm_up, 0)
    begin, end = _ESTIMATION
    trained = end - official.held_out(end - begin, validation, least=warm_up + 1)
    path = official.find(root, _FILE, "Silverbox", download=download)
    u, y = official.read_arrays(path, {"V1": (_SAMPLES,), "V2": (_SAMPLES,)}).values()
    whole = official.record(u, y, {"V1": "V"}, {"V2": "V"}, fs=_FS)

    def part(name: str, first: int, last: int, unscored: int) -> Record:
        return official.part(whole, first, last, warm_up=unscored, name=name)

    def test(name: str, warm_up: int) -> Record:
        first, last = _TESTS[name]
        return part(name, first + _SKIP, last, warm_up + _SKIP)

    return Dataset(
        name="silverbox",
        train=[part("train", begin + warm_up, trained, warm_up)],
        validation=[part("validation", trained, end, warm_up)],
        tests=[test(name, warm_up if name == "multisine" else 0) for name in _TESTS],
        published=official.published("silverbox"),
        leaderboard=[replace(test(name, 0), start="estimated") for name in _TESTS],
    )
