"""The linear model from the command line: table, figures, checkpoint, messages."""

from __future__ import annotations

import copy
import json
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from command_line import configuration
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf

import lfrtorch
from lfrtorch.cli import command, errors, fit, linear
from lfrtorch.cli.composition import composed
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record

ROOT = Path(__file__).resolve().parents[2]
T, FS, SKIP = 1200, 50.0, 100
RESONANCE = 0.9 * np.exp(2j * np.pi * 0.1)  # z plane
NOISE = 0.01


def written(path: Path, **columns: np.ndarray) -> Path:
    rows = "\n".join(",".join(f"{v:.12g}" for v in row) for row in np.stack([*columns.values()], 1))
    path.write_text(f"{','.join(columns)}\n{rows}\n")
    return path


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of figures are empty, which takes no time."""
    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)


@pytest.fixture(scope="module")
def csv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two inputs, a constant, and two outputs of one resonance and of a delayed input."""
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, T))
    denominator = np.poly([RESONANCE, RESONANCE.conj()]).real
    x = 5.0 + scipy.signal.lfilter([0.0, 1.0], denominator, a + 0.5 * b)
    phi = scipy.signal.lfilter([0.0, 0.3], [1.0], a - b)
    x, phi = x + NOISE * rng.standard_normal(T), phi + NOISE * rng.standard_normal(T)
    path = tmp_path_factory.mktemp("csv") / "lab.csv"
    return written(path, a=a, b=b, rest=np.ones(T), x=x, phi=phi)


def overrides(csv: Path, inputs: str, outputs: str, *more: str) -> list[str]:
    columns = [f"data.inputs=[{inputs}]", f"data.outputs=[{outputs}]"]
    return [
        "data=file",
        f"data.path={csv}",
        *columns,
        f"data.fs={FS}",
        f"data.skip={SKIP}",
        "data.start=zero",
        *more,
    ]


def run(monkeypatch: pytest.MonkeyPatch, folder: Path, *words: str) -> dict:
    """linear.json of a run."""
    monkeypatch.setattr(sys, "argv", ["bla.py", f"hydra.run.dir='{folder}'", *words])
    command.run("linear", linear.main)  # with data of these tests
    return json.loads((folder / "linear.json").read_text())


@pytest.mark.numeric
def test_one_command_gives_table_figures_and_checkpoint(csv, tmp_path, monkeypatch, capsys):
    # Order 3 finds noise only, and validates worse than 2 by 0.6 %.
    found = run(monkeypatch, tmp_path, *overrides(csv, "a,b", "x", "nx=auto", "nx_max=3"))
    printed = capsys.readouterr()
    assert printed.err == ""
    for name in ("frequency_response", "poles_and_zeros", "order_scan", "test"):
        assert (tmp_path / "figures" / f"{name}.png").is_file()
    assert (tmp_path / "config.yaml").is_file()
    assert found["verdict"]["usable"]
    assert "\nOn test the linear model's error is" in printed.out
    for line in ("  chosen", "BLA: order 2", "note: noise: not told apart", "% of std", "x/a"):
        assert line in printed.out
    assert (found["nx"], found["scan"]["chosen"]) == (2, 2)
    assert found["scan"]["orders"] == [1, 2, 3]
    assert "scripts/bla.py data=file" in found["command"]
    model = lfrtorch.LinearModel.load(tmp_path / "linear")
    assert model.nx == 2
    assert [c.name for c in model.inputs + model.outputs] == ["a", "b", "x"]


@pytest.mark.numeric
@pytest.mark.usefixtures("undrawn")
def test_numbers_are_those_of_the_system(csv: Path, tmp_path: Path, monkeypatch):
    found = run(monkeypatch, tmp_path, *overrides(csv, "a,b", "x,phi", "nx=3"))
    assert [(s["use"], s["record"]) for s in found["scores"]] == [
        ("train", "train"), ("validation", "validation"), ("test", "test"),
    ]  # fmt: skip
    dataset = lfrtorch.load_records(
        csv, inputs=["a", "b"], outputs=["x", "phi"], fs=FS, skip=SKIP, start="zero"
    )
    model = lfrtorch.LinearModel.load(tmp_path / "linear")
    for score, record in zip(
        found["scores"], (*dataset.train, *dataset.validation, *dataset.tests), strict=True
    ):
        y, y_hat = (signal[record.skip :] for signal in (record.y, model.simulate(record)))
        for i, output in enumerate(score["outputs"]):
            error = y[:, i] - y_hat[:, i]
            assert output["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-9)
            assert output["nrmse"] == pytest.approx(output["rmse"] / np.std(y[:, i]), rel=1e-9)
            assert output["rmse"] == pytest.approx(NOISE, rel=0.25)
    pole = max(found["poles"], key=lambda p: p["imag"])
    s = np.log(RESONANCE) * FS
    assert pole["frequency"] == pytest.approx(abs(s) / (2 * np.pi), rel=1e-2)
    assert pole["damping"] == pytest.approx(-s.real / abs(s), rel=2e-2)
    assert pole["radius"] == pytest.approx(0.9, rel=1e-2)
    offsets = {o["channel"]: o["offset"] for o in found["offsets"]}
    assert set(offsets) == {"a", "b", "x", "phi"}
    gain = model.frf([0.0])[0].real  # at the operating point
    x = offsets["x"] - gain[0] @ [offsets["a"], offsets["b"]]
    assert x == pytest.approx(5.0, abs=0.01)
    assert {r["channel"] for r in found["response_std"]} == {"x/a", "x/b", "phi/a", "phi/b"}
    assert all(0 < r["std"] < 0.1 for r in found["response_std"])
    assert found["frf"]["method"] == "local_polynomial"
    assert found["scan"] is None


@pytest.mark.numeric
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("refine", ["prediction", "frequency"])
def test_refinements_and_zeros_by_channel(refine: str, csv: Path, tmp_path: Path, monkeypatch):
    words = overrides(csv, "a,b", "x", "nx=2", f"bla.refine={refine}", "bla.max_iter=20")
    found = run(monkeypatch, tmp_path, *words)
    assert found["fit"]["criterion"] == refine
    assert set(found["zeros"]) == {"x/a", "x/b"}
    # The operating point of a response is the means, which a finite record has not settled to.
    limit = {"prediction": 1.1, "frequency": 2.0}[refine]
    assert found["scores"][-1]["outputs"][0]["rmse"] < limit * NOISE
    assert (lfrtorch.LinearModel.load(tmp_path / "linear").K is not None) == (
        refine == "prediction"
    )


def odd_multisine() -> Dataset:
    """Two periods of a random odd multisine through a cubic system, and one of another."""

    def record(seed: int) -> Record:
        u = np.tile(lfrtorch.multisine(512, grid="random_odd", seed=seed).u[0], (4, 1))
        x = scipy.signal.lfilter([0.0, 1.0], [1.0, -0.6], u[:, 0])
        y = x + 0.01 * x**3 + 1e-4 * np.random.default_rng(seed).standard_normal(len(x))
        return Record(u[1024:], y[1024:], start="periodic", period=512, name="odd")

    return Dataset("odd", [record(0)], [record(1)], [record(2)])


@pytest.mark.numeric
@pytest.mark.usefixtures("undrawn")
def test_fast_method_draws_the_distortion(tmp_path: Path, monkeypatch, capsys):
    words = ["+data={_target_: cli.test_linear.odd_multisine}", "nx=1", "bla.refine=frequency"]
    found = run(monkeypatch, tmp_path, *words, "frf.method=fast")
    assert found["frf"] == {"method": "fast", "experiments": 1, "periods": 2, "lines": 96}
    assert (tmp_path / "figures" / "distortion.png").is_file()
    assert found["poles"][0]["radius"] == pytest.approx(0.6, abs=0.01)
    capsys.readouterr()


def two_inputs_at_once() -> Dataset:
    """One periodic experiment, which cannot tell two inputs apart at one line."""
    u = np.random.default_rng(0).standard_normal((256, 2))
    y = np.roll(u, 1, axis=0) @ [[1.0], [0.5]]
    records = [Record(u, y, start="periodic", name="once")]
    return Dataset("once", records, [], records)


@pytest.mark.numeric
@pytest.mark.usefixtures("undrawn")
def test_without_a_response_the_model_is_found_all_the_same(tmp_path: Path, monkeypatch, capsys):
    words = ["+data={_target_: cli.test_linear.two_inputs_at_once}", "nx=1"]
    found = run(monkeypatch, tmp_path, *words)
    assert found["frf"] is None
    assert "note: no measured frequency response: 1 record(s) cannot" in capsys.readouterr().out
    assert any(n.startswith("no measured frequency response") for n in found["notes"])
    assert found["scores"][0]["outputs"][0]["nrmse"] < 1e-6
    assert (tmp_path / "figures" / "frequency_response.png").is_file()


@pytest.mark.parametrize(
    ("inputs", "more", "message"),
    [
        ("force", ["nx=2"], "has no column 'force'"),
        ("a", [], "nx, the number of states, is not set"),
    ],
)
def test_user_errors_are_one_message(
    inputs: str, more: list[str], message: str, csv: Path, tmp_path: Path, monkeypatch, capsys
):
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, tmp_path, *overrides(csv, inputs, "x", *more))
    printed = capsys.readouterr()
    assert stop.value.code == 1
    assert message in printed.err
    assert "Traceback" not in printed.err + printed.out
    assert not (tmp_path / "linear.json").exists()


@cache
def usual() -> DictConfig:
    return composed("linear", ["data=file"])


@pytest.mark.parametrize(
    ("inputs", "more", "message"),
    [
        ("a", ["nx=automatic"], "nx is 'automatic'; give a whole number"),
        ("a", ["nx=auto", "nx_max=0"], "nx_max is 0; give a whole number"),
        ("a", ["nx=auto", "bla.speed=3"], "speed"),
        ("a", ["nx=2", "bla.refine=magic"], "refine is 'magic'"),
        ("a", ["nx=2", "frf.method=magic"], "method is 'magic'"),
        (
            "a",
            ["nx=2", "frf.method=fast"],
            "no period; give period=N, or use method='local_",
        ),
        ("rest", ["nx=2"], "signal 'rest' is constant"),
        ("rest", ["nx=auto"], "signal 'rest' is constant"),
    ],
)
def test_settings_that_cannot_be_are_one_message(
    inputs: str, more: list[str], message: str, csv: Path, tmp_path: Path, capsys
):
    cfg = copy.deepcopy(usual())
    OmegaConf.set_struct(cfg, False)  # as + does on the command line
    cfg.merge_with_dotlist(overrides(csv, inputs, "x", *more)[1:])
    with pytest.raises(SystemExit) as stop, errors.user_errors():
        linear.identify(cfg, tmp_path)
    assert stop.value.code == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "linear.json").exists()


@pytest.mark.numeric
def test_train_takes_the_order_of_a_scan(csv: Path, tmp_path: Path, capsys):
    words = overrides(csv, "a,b", "x", "nx=auto", "nx_max=3", "nn=2", "trainer.max_iter=1")
    cfg = configuration(*words)
    fit.run(cfg, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text())["sizes"]["nx"] == 2
    assert "nx: 2\n" in (tmp_path / "config.yaml").read_text()
    printed = capsys.readouterr().out
    assert "  chosen" in printed
    assert "BLA: order 2, simulation error" in printed


def test_a_dead_time_is_found_and_kept(tmp_path: Path, monkeypatch, undrawn, capsys):
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(600), np.zeros(600)
    for k in range(599):
        y[k + 1] = 0.8 * y[k] + (u[k - 4] if k >= 4 else 0.0)
    path = written(tmp_path / "late.csv", u=u, y=y + 0.02 * rng.standard_normal(600))
    words = overrides(path, "u", "y", "nx=1", "delay=auto")
    found = run(monkeypatch, tmp_path / "run", *words)
    (time,) = found["dead_times"]
    assert abs(time["samples"] - 4) < max(3 * time["std"], 0.05)
    assert "dead time of u: " in capsys.readouterr().out
    assert lfrtorch.LinearModel.load(tmp_path / "run" / "linear").delay in ((4,), (5,))
