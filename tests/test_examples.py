"""The examples run, and show what they say."""

import re
import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.mark.slow
@pytest.mark.numeric
@pytest.mark.parametrize(
    ("name", "ratio"),
    # The larger model ends 21 to 31 times better, by the processor's rounding.
    [("own_static_map", 50), ("in_a_larger_model", 10), ("own_data", 3)],
)
def test_is_many_times_better_than_the_linear_model(
    name: str,
    ratio: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):  # the files of the first run are there in the second
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    printed = capsys.readouterr().out
    errors = [float(e) for e in re.findall(r"([\d.]+) .*rms on the test", printed)]
    assert len(errors) == 4
    assert errors[0] > ratio * errors[1]
