"""The examples run, and show what they say."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import lfrtorch

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


@pytest.mark.numeric
@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")  # of torch.func itself
def test_one_page_comes_to_the_cost_of_the_package_from_the_same_start():
    page = runpy.run_path(str(EXAMPLES / "minimal.py"))
    torch.manual_seed(0)
    records = [page["measured"](125, seed) for seed in range(8)]
    signals = [np.stack([r.u for r in records]), np.stack([r.y for r in records])]
    (u_mean, u_std), (y_mean, y_std) = ((s.mean((0, 1)), s.std((0, 1))) for s in signals)
    u = torch.as_tensor((signals[0] - u_mean) / u_std)
    y = torch.as_tensor((signals[1] - y_mean) / y_std)
    weights = page["embedded"](*page["subspace"](u, y, nx=2), nu=1, nz=1, nw=1, nn=6)
    weights, _ = page["fit"](weights, ["Bu", "Dyu"], u, y, iterations=3)
    weights, linear = page["fit"](weights, ["A", "Bu", "Cy", "Dyu"], u, y, iterations=8)
    start = page["scaled"](weights, u)
    _, errors = page["fit"](start, list(start), u, y, iterations=30)

    static = lfrtorch.Network(1, 1, 6, dtype=torch.float64)
    cell = lfrtorch.LFRCell(1, 1, 2, 1, 1, static, dtype=torch.float64, random=False)
    with torch.no_grad():
        for name, weight in start.items():
            (static if hasattr(static, name) else cell).get_parameter(name).copy_(weight)
    scaler = lfrtorch.Scaler(u_mean, u_std, y_mean, y_std)
    model = lfrtorch.Model(
        lfrtorch.LFR(cell), scaler, records[0].fs, records[0].inputs, records[0].outputs
    )
    trainer = lfrtorch.LevenbergMarquardt(max_iter=30)
    history = lfrtorch.fit(model, records, trainer=trainer).history
    # The start has the output of the best linear approximation, and that is the package's, too.
    bla = lfrtorch.estimate_bla(records, nx=2)
    bla_rmse = np.sqrt(np.mean([lfrtorch.rmse(r, bla.simulate(r)) ** 2 for r in records]))
    assert linear[-1] * y_std[0] == pytest.approx(bla_rmse, rel=1e-2)
    assert errors[0] == pytest.approx(linear[-1], rel=1e-9)
    assert errors[0] * y_std[0] == pytest.approx(history[0].train, rel=1e-9)
    # The costs, 1/144 of the start's, are 0.1 % apart: the package accelerates its steps.
    assert errors[-1] < 0.1 * errors[0]
    assert (errors[-1] * y_std[0]) ** 2 == pytest.approx(history[-1].train ** 2, rel=1e-2)


@pytest.mark.slow
@pytest.mark.numeric
def test_optuna_searches_around_identify(capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("optuna", reason="needs optuna: pip install optuna")
    found = runpy.run_path(str(EXAMPLES / "optuna_search.py"))
    study = found["study"]
    assert len(study.trials) == 10
    assert study.best_value == min(trial.value for trial in study.trials)
    assert study.best_value < 0.011  # the noise is 0.01 rms
    printed = capsys.readouterr().out
    assert printed.startswith(f"{study.best_params}\nBetter than the linear model")


@pytest.mark.slow
@pytest.mark.numeric
def test_ray_fits_many_settings(capfd: pytest.CaptureFixture[str]):
    pytest.importorskip("ray", reason="needs ray: pip install ray")
    subprocess.run([sys.executable, EXAMPLES / "ray_sweep.py"], check=True)
    found = [float(e) for e in re.findall(r"nn=\d seed=\d: ([\d.]+) rms", capfd.readouterr().out)]
    assert len(found) == 6
    assert found == sorted(found)
    assert found[0] < 0.015  # the noise has 0.01


@pytest.mark.slow
@pytest.mark.numeric
def test_an_identified_motor_in_mujoco_is_closer_than_a_perceptron(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("mujoco", reason="pip install mujoco")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(EXAMPLES)
    errors = runpy.run_path(str(EXAMPLES / "mujoco_pendulum.py"))["main"]()
    assert errors["NL-LFR"] < 0.3 * errors["perceptron"]
