"""All benchmarks: arguments that they refuse, and files that are missing or damaged."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfrtorch import datasets
from lfrtorch.datasets import official

FIRST = {
    "cascaded_tanks": ("Cascaded_Tanks/CascadedTanksFiles/dataBenchmark.mat", "Cascaded_Tanks"),
    "ced": ("CED/DATAUNIF.MAT", "CED"),
    "emps": ("EMPS/DATA_EMPS.mat", "EMPS"),
    "f16": ("F16/F16GVT_Files/BenchmarkData/F16Data_FullMSine_Level1.mat", "F16"),
    "fine_steering_mirror": ("FineSteeringMirror/combined_data.npz", "FineSteeringMirror"),
    "parwh": ("ParWH/ParWHFiles/ParWHData.mat", "ParWH"),
    "silverbox": ("Silverbox/SilverboxFiles/SNLS80mV.mat", "Silverbox"),
    "wh_process_noise": (
        "WienHammer/WienerHammersteinFiles/WH_EstimationExample.mat",
        "not_splitted_benchmarks.WienerHammerstein_Process_Noise",
    ),
    "wiener_hammerstein": (
        "WienerHammerBenchMark/WienerHammerBenchMark.mat",
        "WienerHammerBenchMark",
    ),
}
"""The file that a benchmark reads first, and the function that downloads it."""

REFUSED: dict[str, list[tuple[dict[str, Any], str]]] = {
    "boucwen": [
        ({"samples": 149}, "period of 149 samples .* at least 150"),
        ({"samples": 1024.0}, "whole number"),
        ({"rms": 0.0}, "rms is 0.0; give a positive"),
        ({"rms": np.nan}, "rms is nan"),
        ({"rms": 1e9}, "integration fails under a force of up to .* smaller"),
        ({"rms": []}, "rms is empty; give"),
        ({"rms": [50, -1]}, "rms is -1; give a positive"),
        ({"selection_rms": [50, 0]}, "selection_rms is 0; give"),
        ({"noise_rms": -1e-6}, "noise_rms is -1e-06; give"),
        ({"noise_rms": np.inf}, "noise_rms is inf; give a number of at least 0"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": 3, "validation_seed_offset": -4}, "offset is -4; .* whole number of at least -3"),
        ({"validation_seed_offset": 0}, "none may be the training or simulated test realisation"),
        ({"validation_seed_offset": 1999}, "none may be the training or simulated test"),
    ],
    "cascaded_tanks": [
        ({"validation": -0.1}, "validation is -0.1"),
        ({"validation": 1.0}, "leaves 0 of the 1024"),
        ({"skip": 0}, "skip is 0"),
        ({"first": 0}, "first is 0"),
        ({"validation": 0.25, "first": 769}, "first is 769.*give 768 at most"),
    ],
    "ced": [
        ({"validation": 0}, "validation is 0"),
        ({"validation": 1.0}, "leaves 0 of the 400"),
        ({"download": "no"}, "download is 'no'; give True or False"),
    ],
    "emps": [
        ({"validation": 1.0}, "leaves 0 of the 24841"),
        ({"drift": -0.01}, "drift is -0.01; give a number of at least 0"),
    ],
    "f16": [
        ({"train": []}, "give one or more to train"),
        ({"train": ["multisine_1", "multisine_1"]}, "each once in all"),
        ({"train": ["multisine_2"]}, "train is .'multisine_2'.; give a list of multisine_1"),
        ({"train": "sweep_1"}, "train is sweep_1; give a list of"),
        ({"train": ["sweep_5"], "validation": ["sweep_5"]}, "each once in all"),
        ({"validation": [5]}, "validation is .5.; give a list of"),
    ],
    "fine_steering_mirror": [
        ({"levels": [150]}, "levels is .150.; give one or more of 100, 200, 300"),
        ({"levels": None}, "levels is None"),
        ({"validation": -1}, "validation"),
        ({"mean": 1}, "mean is 1; give True or False"),
    ],
    "parwh": [
        ({"source": "simulated"}, "'simulated'; give one of auto, official, stand-in"),
        ({"seed": -1}, "seed is -1"),
        ({"realisations": 0}, "realisations is 0; give a whole number of at least 1"),
        ({"periods": 0}, "periods is 0"),
        ({"noise_rms": -1e-3}, "noise_rms is -0.001"),
        ({"levels": ()}, r"levels is \(\); give one or more of 100, 325"),
        ({"levels": "100"}, "levels is 100; give one or more"),
        ({"levels": [100, 100]}, "each once"),
    ],
    "silverbox": [
        ({"validation": 0}, "validation is 0"),
        ({"validation": 0.999}, "leaves 65 of the 65062 .* needs 501"),
        ({"warm_up": -1}, "warm_up is -1"),
        ({"warm_up": 60_000}, "needs 60001"),
    ],
    "wh_process_noise": [
        ({"validation": value}, f"validation is {value!r}; give a whole number")
        for value in (0, 1.5, "2", None, True)
    ],
    "wiener_hammerstein": [
        ({"validation": 0}, "validation is 0"),
        ({"validation": 0.95}, "leaves 5000 of the 100000 .* needs 6001"),
        ({"split": "package"}, "split is 'package'; give 'official' or 'site'"),
        ({"skip": -1}, "skip is -1"),
        ({"skip": 80_000}, "validation is 0.2, which leaves 80000"),
    ],
}


@pytest.mark.parametrize(
    ("name", "arguments", "match"),
    [(name, *case) for name, cases in REFUSED.items() for case in cases],
)
def test_refused_arguments(name, arguments, match):
    with pytest.raises(ValueError, match=match):
        getattr(datasets, name).load(**arguments)


@pytest.mark.parametrize("name", FIRST)
def test_a_missing_file_is_one_message(tmp_path, name):
    file, loader = FIRST[name]
    with pytest.raises(FileNotFoundError, match=rf"(?s)no '{file}'.*root=DIR") as told:
        getattr(datasets, name).load(root=tmp_path)
    assert f"nonlinear_benchmarks.{loader}()" in str(told.value)


@pytest.mark.parametrize("name", FIRST)
def test_a_missing_file_is_downloaded_if_that_is_asked_for(tmp_path, monkeypatch, name):
    asked: list[tuple[Path, str, str]] = []
    monkeypatch.setattr(official, "_download", lambda *words: asked.append(words))
    word = {"source": "official"} if name == "parwh" else {"download": True}
    with pytest.raises(FileNotFoundError, match="left no"):
        getattr(datasets, name).load(root=tmp_path, **word)
    assert asked == [(tmp_path, *FIRST[name])]


@pytest.mark.parametrize("name", FIRST)
def test_a_damaged_file_is_named(tmp_path, name):
    path = tmp_path / FIRST[name][0]
    path.parent.mkdir(parents=True)
    path.write_bytes(b"damaged" * 99)
    with pytest.raises(
        ValueError, match=r"no readable .*download (it|them|the file) again"
    ) as told:
        getattr(datasets, name).load(root=tmp_path)
    assert str(told.value).startswith(f"'{path}'")
