"""The command line: every configuration runs, and user errors are messages without a traceback."""

from __future__ import annotations

import inspect
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import (
    BENCHES,
    CONF,
    PERIOD,
    ROOT,
    SHORTER,
    SIMULATED,
    SWEEP,
    configuration,
    file_overrides,
    launched,
)
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import get_object
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf, open_dict

import lfrtorch
from lfrtorch import InputError
from lfrtorch.cli import claim, command, config, errors, fit, interrupts, run_folder
from lfrtorch.cli.hydra_versions import instantiate
from lfrtorch.datasets import f16, official
from lfrtorch.reporting import plots


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """All figures of a run are empty, which takes no time."""
    empty = plots.png(Figure(figsize=(0.1, 0.1)))
    monkeypatch.setattr(plots, "png", lambda _: empty)


@pytest.fixture
def short(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path_factory: pytest.TempPathFactory,
    shorter: Callable[..., None],
) -> None:
    """The Bouc-Wen system is simulated, official files at hand or not, and for short."""
    nothing = tmp_path_factory.mktemp("nothing")
    monkeypatch.setattr(official, "cache", lambda: nothing)
    monkeypatch.setattr(f16, "_TESTS", (2,))  # of three levels of 74 000 samples
    shorter(period=PERIOD, sweep=SWEEP)


ROUNDING = 1e-12
"""Of outputs of about 5, a thousand units in the last place: sums in another order."""


OWN_DATA = {
    ("boucwen_record", "rms"): [*8 * [50], *4 * [25], *4 * [10]],
    ("emps", "validation"): 0.25,
    ("emps", "drift"): 0.01,
}
"""Settings of the data that are not the loader's own."""


@pytest.mark.parametrize("bench", BENCHES)
def test_every_bench_composes(bench: str):
    cfg = configuration(f"+bench={bench}")
    assert cfg.name == bench
    settings = config.configured(cfg)
    dataset = bench.removesuffix("_record").removesuffix("_known")
    assert cfg.data["_target_"] == f"lfrtorch.datasets.{dataset}.load"
    assert settings.sizes.items() <= dict(cfg).items()
    arguments = inspect.signature(get_object(cfg.data["_target_"])).parameters
    for name, argument in arguments.items():  # a bench is the loader's own default, spelt out
        default = argument.default
        if (bench, name) in OWN_DATA:
            assert cfg.data[name] == OWN_DATA[bench, name]
            continue
        assert cfg.data[name] == (list(default) if isinstance(default, tuple) else default)


ADAM = "init=paper trainer=adam trainer.max_iter=2"


@pytest.mark.parametrize(
    ("bench", "choice"), [*((bench, "trainer.max_iter=2") for bench in BENCHES), ("boucwen", ADAM)]
)
@pytest.mark.numeric
@pytest.mark.usefixtures("short", "coarse")
def test_every_bench_runs_two_iterations(bench: str, choice: str, tmp_path, request):
    cfg = configuration(f"+bench={bench}", *SHORTER.get(bench, "").split(), *choice.split())
    if bench not in SIMULATED:
        cfg.data.root = str(request.getfixturevalue("benchmark_root"))
    cfg.figures = (bench, choice) == ("boucwen", "trainer.max_iter=2")  # of whole periods, once
    try:
        fit.run(cfg, tmp_path)
    except FileNotFoundError as failed:
        if bench not in SIMULATED:
            pytest.skip(str(failed))
        raise
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["fit"]["iterations"] == 2
    for name, score in metrics["scores"].items():
        assert 0 < score["rmse"] < np.inf
        assert score["source"] in ("official", "simulated", "stand-in")
        assert (tmp_path / "figures" / f"{name}.png").is_file() == cfg.figures
    assert (tmp_path / "report.html").is_file() == cfg.figures


def test_notes_on_the_data_are_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(official, "cache", lambda: tmp_path)  # without files
    cfg = configuration("+bench=parwh", "data.levels=[100]")
    data = config.loaded(cfg)
    assert data.tests[0].source == "stand-in"
    assert capsys.readouterr().out == f"note: {data.notes[0]}\n"


@pytest.mark.parametrize("group", ["bla", "data"])
def test_every_option_of_a_group_is_an_argument_of_its_target(group: str):
    for path in (CONF / group).glob("*.yaml"):
        node = OmegaConf.load(path)
        assert isinstance(node, DictConfig)
        target = lfrtorch.estimate_bla if group == "bla" else get_object(node["_target_"])
        assert set(node) - {"_target_"} <= set(inspect.signature(target).parameters)


def test_a_static_map_of_ones_own(csv: Path, tmp_path: Path, capsys):
    words = [*file_overrides(csv), "nx=1", "nz=1", "nw=1", "trainer.max_iter=2", "static=own"]
    cfg = configuration(*words, "static._target_=cli.test_fit.Cubic")
    with open_dict(cfg):
        cfg.static.scale = 0.5
    fit.run(cfg, tmp_path)
    model = lfrtorch.load(tmp_path, static=Cubic(1, 1, 0.5))
    assert isinstance(model.lfr.cell.static, Cubic)
    assert model.lfr.cell.static.scale == 0.5
    assert "nx 1, nz 1, nw 1, a map of one's own" in capsys.readouterr().out
    cfg.init_from, cfg.nx = str(tmp_path), None
    again = tmp_path / "again"
    again.mkdir()
    fit.run(cfg, again)
    assert lfrtorch.load(again, static=Cubic(1, 1, 0.5)).sizes["nx"] == 1


class Cubic(torch.nn.Linear):
    """w = scale W z³ + b."""

    def __init__(self, nz: int, nw: int, scale: float) -> None:
        super().__init__(nz, nw, dtype=torch.float64)
        self.scale = scale

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        return super().forward(self.scale * input**3)


def test_the_words_of_a_run_are_read(tmp_path: Path):
    (tmp_path / ".hydra").mkdir()
    saved = ["trainer=adam", "trainer.max_iter=30", "resume=x", "init=paper"]
    OmegaConf.save(OmegaConf.create(saved), tmp_path / ".hydra" / "overrides.yaml")
    words = run_folder.arguments([f"resume={tmp_path}"])
    assert words[:3] == ["trainer=adam", "trainer.max_iter=30", "init=paper"]


def test_the_paper_cases_are_one_override():
    for nz, nw in ((1, 1), (2, 1), (2, 2)):
        cfg = configuration("+bench=boucwen", f"nz={nz}", f"nw={nw}")
        assert config.configured(cfg).sizes == {"nx": 3, "nz": nz, "nw": nw, "nn": 25}


@pytest.mark.numeric
@pytest.mark.usefixtures("coarse")
def test_run_writes_its_folder_and_the_checkpoint_simulates(csv, tmp_path, monkeypatch, capsys):
    words = [f"hydra.run.dir='{tmp_path}'", *file_overrides(csv), "nx=1", "nz=1", "nw=1", "nn=4"]
    words += ["starts=1", "trainer.max_iter=20"]
    launched(monkeypatch, *words)
    for name in ("metrics.json", "config.yaml", "model/model.json", "figures/test.png"):
        assert (tmp_path / name).is_file()
    assert list(tmp_path.glob("events.out.tfevents.*"))
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 10
    # five of the test, BLA, poles, map, steps, history
    line, command = [text for text in capsys.readouterr().out.splitlines() if "starts=8" in text]
    assert line.startswith("next: ")
    assert command.strip().startswith("python train.py data=file ")
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["command"].startswith("python train.py data=file ")
    score = metrics["scores"]["test"]
    assert score["source"] == "file"
    assert score["rmse"] < 0.5 * score["lti_rmse"]  # the saturation is found: 0.2, and falling

    test = instantiate(configuration(*file_overrides(csv), "nx=1").data).tests[0]
    model = lfrtorch.load(tmp_path)
    assert lfrtorch.rmse(test, model.simulate(test)) == pytest.approx(score["rmse"], abs=ROUNDING)
    assert [c.name for c in model.inputs + model.outputs] == ["u", "y"]


@pytest.mark.numeric
def test_init_from_continues_where_the_run_ended(csv: Path, tmp_path: Path):
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
    arguments = [*file_overrides(csv), "nx=1"]
    fit.run(configuration(*arguments, "trainer.max_iter=5"), first)
    validation = fit.run(
        configuration(*arguments, f"init_from={first}", "trainer.max_iter=0"), second
    )
    before = json.loads((first / "metrics.json").read_text())["validation"]["rmse"]
    assert validation == pytest.approx(before, abs=ROUNDING)


def test_polynomial_is_chosen_and_continued(csv, tmp_path, capsys):
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
    arguments = [*file_overrides(csv), "nx=1", "nz=1", "trainer.max_iter=2"]
    fit.run(configuration(*arguments, "static=polynomial", "degree=2"), first)
    cfg = configuration(*arguments, f"init_from={first}")
    fit.run(cfg, second)
    assert OmegaConf.load(second / "config.yaml").used.degree == 2
    sizes = json.loads((second / "metrics.json").read_text())["sizes"]
    assert sizes == {"nx": 1, "nz": 1, "nw": 1, "degree": 2}
    assert "nx 1, nz 1, nw 1, polynomial of degree 2" in capsys.readouterr().out


@pytest.mark.usefixtures("short")
def test_init_from_says_which_sizes_it_takes(csv, tmp_path, capsys):
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
    arguments = [*file_overrides(csv), "nx=1", "trainer.max_iter=1"]
    fit.run(configuration(*arguments, "nz=1", "nn=4"), first)
    cfg = configuration(*arguments, "nn=auto", f"init_from={first}")
    fit.run(cfg, second)
    saved = OmegaConf.load(second / "config.yaml")
    assert (saved.used.nz, saved.used.nn, saved.nn) == (1, 4, "auto")
    assert "nz is 1, that of the model in" in capsys.readouterr().out
    with pytest.raises(InputError, match="a linear model: give the folder of a run") as told:
        fit.run(configuration(*arguments, f"init_from={first / 'linear'}"), second)
    assert "lfrtorch.LinearModel" not in str(told.value)
    with pytest.raises(ValueError, match="and the model at 10"):
        fit.run(configuration("+bench=boucwen", f"init_from={first}"), second)


@pytest.mark.numeric
def test_a_resting_test_part_gives_a_score_that_is_null(tmp_path: Path):
    rng = np.random.default_rng(0)
    u = np.concatenate([rng.standard_normal(400), np.zeros(200)])
    y = np.convolve(u, [0.5, 0.3, 0.1])[: len(u)]
    y[-200:] = 0.0
    np.savez(tmp_path / "rest.npz", u=u, y=y)
    overrides = ["data=file", f"data.path={tmp_path / 'rest.npz'}", "data.inputs=[u]"]
    overrides += ["data.outputs=[y]", "data.fs=1", "data.test=0.1", "nx=1", "trainer.max_iter=1"]
    overrides.append("data.start=zero")
    fit.run(configuration(*overrides), tmp_path)
    score = json.loads((tmp_path / "metrics.json").read_text())["scores"]["test"]
    assert score["nrmse"] is None
    assert score["rmse"] >= 0


@pytest.mark.usefixtures("undrawn")
def test_a_run_without_test_and_validation_records(tmp_path: Path, capsys):
    u = np.random.default_rng(0).standard_normal(300)
    y = np.convolve(u, [0.0, 0.5, 0.3])[: len(u)]
    np.savez(tmp_path / "all.npz", u=u, y=y)
    overrides = ["data=file", f"data.path={tmp_path / 'all.npz'}", "data.inputs=[u]"]
    overrides += ["data.outputs=[y]", "data.fs=1", "nx=1", "trainer.max_iter=1"]
    overrides += ["data.test=0", "data.validation=0", "figures=true", "data.start=zero"]
    fit.run(configuration(*overrides), tmp_path)
    assert "nothing is scored" in capsys.readouterr().out
    assert json.loads((tmp_path / "metrics.json").read_text())["scores"] == {}
    assert (tmp_path / "figures" / "convergence.png").is_file()


def judged_when_interrupted(folder: Path) -> None:
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["fit"]["reason"] == "interrupted"
    assert metrics["fit"]["iterations"] >= 3
    assert metrics["scores"]["test"]["rmse"] < metrics["scores"]["test"]["lti_rmse"]
    assert lfrtorch.load(folder).sizes["nx"] == 1


@pytest.mark.numeric
def test_the_interrupt_key_keeps_the_best_model_and_its_scores(
    csv: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
):
    words = [*file_overrides(csv), "nx=1", "nz=1", "nw=1", "nn=4", "starts=1"]
    words.append("trainer._target_=cli.test_fit.Interrupted")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    with pytest.raises(SystemExit) as end:
        launched(monkeypatch, f"hydra.run.dir='{tmp_path}'", *words, "figures=false")
    assert end.value.code == 128 + signal.SIGINT
    assert f"to go on: python train.py resume={tmp_path}" in capsys.readouterr().err
    judged_when_interrupted(tmp_path)


@pytest.mark.slow
def test_the_interrupt_key_reaches_the_program(csv: Path, tmp_path: Path):
    """Of Adam, which has no end of its own."""
    words = [*file_overrides(csv), "nx=1", "trainer=adam", "trainer.max_iter=1000000"]
    words += ["trainer.learning_rate=0.01", "threads=1", "figures=false"]
    with subprocess.Popen(
        [sys.executable, str(ROOT / "train.py"), f"hydra.run.dir='{tmp_path}'", *words],
        stdout=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        # A shell's background job, which a test run may be, hands down an ignored SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.lstrip().startswith("50/"):
                break
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
        assert process.wait(timeout=60) == 128 + signal.SIGINT
    assert "interrupted" in rest
    judged_when_interrupted(tmp_path)


class Terminated(lfrtorch.LevenbergMarquardt):
    """Levenberg-Marquardt whose process is asked to end in its third iteration."""

    def step(self, problem: Any, state: Any) -> Any:
        if state.iteration == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return super().step(problem, state)


@pytest.mark.numeric
def test_sigterm_ends_the_fit_after_an_iteration_and_all_is_written(csv: Path, tmp_path: Path):
    usual = signal.getsignal(signal.SIGTERM)
    cfg = configuration(*file_overrides(csv), "nx=1", "trainer._target_=cli.test_fit.Terminated")
    with pytest.raises(interrupts.TerminatedError, match="the best model so far is in"):
        fit.run(cfg, tmp_path)
    assert signal.getsignal(signal.SIGTERM) == usual
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["fit"]["reason"] == "interrupted"
    assert metrics["fit"]["iterations"] == 3
    assert metrics["scores"]["test"]["rmse"] < metrics["scores"]["test"]["lti_rmse"]


@pytest.mark.usefixtures("short_paths", "untraced")
def test_a_run_of_few_words_is_saved_in_full_and_goes_on(
    csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = ["nx=1", "nn=2", "starts=1", "start=zero", "figures=false", "max_iter=1", "fs=10"]
    launched(monkeypatch, str(csv), *words, f"hydra.run.dir={tmp_path}")
    assert "note: inputs=u, outputs=y, by the names of the columns" in capsys.readouterr().out
    assert run_folder.words_of(tmp_path)[:2] == ["data=file", f"data.path={csv}"]
    launched(monkeypatch, f"resume={tmp_path}", "max_iter=2")
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["fit"]["iterations"] == 2


@pytest.mark.numeric
def test_a_run_that_was_terminated_goes_on_to_the_same_end(csv: Path, tmp_path: Path):
    settings = [*file_overrides(csv), "nx=1", "starts=2", "trainer.max_iter=8", "threads=1"]
    cut, whole = tmp_path / "cut", tmp_path / "whole"
    for folder in (cut, whole):
        folder.mkdir()
    fit.run(configuration(*settings), whole)
    with pytest.raises(interrupts.TerminatedError, match=f"python train.py resume={cut}"):
        fit.run(configuration(*settings, "trainer._target_=cli.test_fit.Terminated"), cut)
    assert json.loads((cut / "metrics.json").read_text())["fit"]["reason"] == "interrupted"
    fit.run(configuration(*settings, f"resume={cut}"), cut)
    ends = [json.loads((folder / "metrics.json").read_text()) for folder in (cut, whole)]
    assert ends[0]["scores"] == ends[1]["scores"]
    assert ends[0]["ranking"] == ends[1]["ranking"]
    weights = [(f / "model" / "weights.safetensors").read_bytes() for f in (cut, whole)]
    assert weights[0] == weights[1]


@pytest.mark.numeric
@pytest.mark.usefixtures("short_paths")
def test_a_run_of_searched_sizes_goes_on(csv: Path, tmp_path: Path):
    settings = [*file_overrides(csv), "nx=1", "nz=auto", "nw=1", "nn=2", "trainer.max_iter=4"]
    cut = tmp_path / "cut"
    cut.mkdir()
    fit.run(configuration(*settings, "seed=5"), cut)
    ends = [json.loads((cut / "metrics.json").read_text())]
    fit.run(configuration(*settings, "seed=5", "trainer.max_iter=6", f"resume={cut}"), cut)
    ends.append(json.loads((cut / "metrics.json").read_text()))
    assert [end["fit"]["iterations"] for end in ends] == [4, 6]
    assert ends[0]["sizes_search"] == ends[1]["sizes_search"]


@pytest.mark.numeric
def test_a_run_of_before_there_were_structures_goes_on_and_is_scored(csv, tmp_path, monkeypatch):
    folder, out = tmp_path / "run", tmp_path / "scores.json"
    folder.mkdir()
    settings = [*file_overrides(csv), "nx=1", "trainer.max_iter=3"]
    fit.run(configuration(*settings), folder)
    saved: Any = OmegaConf.load(folder / "config.yaml")
    assert saved.pop("structure") == "free"
    OmegaConf.save(saved, folder / "config.yaml")
    fit.run(configuration(*settings, "trainer.max_iter=5", f"resume={folder}"), folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["fit"]["iterations"] == 5
    OmegaConf.save(saved, folder / "config.yaml")
    monkeypatch.setattr(
        sys, "argv", ["evaluate.py", f"checkpoint={folder}", f"out={out}", *file_overrides(csv)]
    )
    command.start("evaluate")
    scores = json.loads(out.read_text())["scores"]
    assert scores["test"]["rmse"] == pytest.approx(metrics["scores"]["test"]["rmse"], rel=1e-9)


@pytest.mark.numeric
@pytest.mark.usefixtures("undrawn")
def test_the_mean_of_starts_is_a_model_of_the_run(csv: Path, tmp_path: Path):
    settings = [*file_overrides(csv), "nx=1", "starts=3", "average=3", "trainer.max_iter=3"]
    judged = fit.run(configuration(*settings, "data.validation=0", "figures=true"), tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["averaged"], metrics["sizes"]["nx"]) == (3, 3)
    assert judged == metrics["ranking"][0]["train"]
    model = lfrtorch.load(tmp_path)
    assert model.sizes == metrics["sizes"]
    page = (tmp_path / "report.html").read_text()
    assert "mean of the best 3" in page
    assert "mean of 3 models with nx 1, nz 2, nw 1, 15 neurons" in page
    assert (
        "Used: nx 1, nz 2, nw 1, nn 15, ridge 0.0, starts 3, average 3, seed 0, max_iter 3." in page
    )


def test_the_mean_is_of_other_maps_too(csv: Path, tmp_path: Path):
    settings = [*file_overrides(csv), "nx=1", "starts=2", "average=2", "trainer.max_iter=1"]
    settings += ["static=polynomial", "figures=false", "data.validation=0"]
    fit.run(configuration(*settings), tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text())["averaged"] == 2
    assert lfrtorch.load(tmp_path).sizes == {"nx": 2, "nz": 4, "nw": 2, "degree": 3}


def test_a_new_run_forgets_the_one_that_it_replaces(csv: Path, tmp_path: Path):
    settings = [*file_overrides(csv), "nx=1", "trainer.max_iter=2", "threads=100000"]
    for seed in (0, 1):
        fit.run(configuration(*settings, f"seed={seed}"), tmp_path)
    assert torch.get_num_threads() == os.cpu_count()
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["fit"]["iterations"] == 2


def test_resume_takes_the_settings_of_the_run(tmp_path: Path):
    saved = tmp_path / "it's a run"
    (saved / ".hydra").mkdir(parents=True)
    text = "- +bench=boucwen\n- trainer.max_iter=60\n- resume=before\n"
    (saved / ".hydra" / "overrides.yaml").write_text(text)
    given = [f"resume={saved}", "trainer.max_iter=90"]
    found = run_folder.arguments(given)
    assert found[:-1] == ["+bench=boucwen", "trainer.max_iter=60", *given]
    parser = OverridesParser.create()
    assert parser.parse_override(found[-1]).value() == str(saved)


def test_resume_needs_a_run(tmp_path: Path):
    with pytest.raises(ValueError, match="not the folder of a run"):
        run_folder.arguments([f"resume={tmp_path}"])
    for name in ("first", "tank/second"):
        (tmp_path / name / ".hydra").mkdir(parents=True)
        (tmp_path / name / ".hydra" / "overrides.yaml").touch()
    with pytest.raises(ValueError, match=r"one of the runs in it: .*first, .*second") as refused:
        run_folder.arguments([f"resume={tmp_path}"])
    assert "hydra" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- trainer._target_=os.system\n", "names code: trainer._target_=os.system; add that word"),
        ("- '+x={_target_: os.system}'\n", "names code"),
        ("- hydra.searchpath=[/tmp]\n", "names code"),
        ("- [1\n", "is damaged"),
        ("nx: 2\n", "is no list of words"),
        ("- 5\n", "is no list of words"),
        ("- &a [x]\n- *a\n", "it has aliases"),
        ("- !!python/object/apply:os.system [ls]\n", "is damaged"),
    ],
)
def test_resume_runs_no_code_of_the_folder(tmp_path: Path, text: str, message: str):
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "overrides.yaml").write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)):
        run_folder.arguments([f"resume={tmp_path}"])


def test_resume_with_a_class_of_ones_own(tmp_path: Path):
    word = "static._target_=mine.Map"
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "overrides.yaml").write_text(f"- {word}\n")
    assert word in run_folder.arguments([f"resume={tmp_path}", word])


@pytest.mark.numeric
def test_a_run_goes_on_with_the_starts_that_were_cheap_for_its_iterations(
    csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    words = [str(csv), "inputs=u", "outputs=y", "fs=10", "nx=1", "nz=1", "nw=1", "nn=2"]
    words += ["figures=false", "start=zero"]
    launched(monkeypatch, f"hydra.run.dir='{tmp_path}'", *words, "trainer.max_iter=2")
    monkeypatch.setattr("lfrtorch.fitting.multistart._MINUTE", 0.0)  # as of many more iterations
    launched(monkeypatch, f"resume={tmp_path}", "trainer.max_iter=3")
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["starts"] == 8
    assert metrics["fit"]["iterations"] == 3


@pytest.mark.parametrize("text", ["nx: [", "- 1", "nz: 2", ""])
def test_damaged_settings_of_a_run_that_goes_on(tmp_path: Path, text: str):
    (tmp_path / "config.yaml").write_text(text)
    cfg = configuration("nx=auto", "starts=auto", f"resume={tmp_path}")
    with pytest.raises(ValueError, match=r"config\.yaml'"):
        run_folder.chosen_before(cfg, tmp_path)


def refused(monkeypatch, capsys, *words: str) -> str:
    """What the command line says as it ends."""
    with pytest.raises(SystemExit) as end:
        launched(monkeypatch, "+bench=silverbox", "data.root=/nowhere", *words)
    assert end.value.code == 1
    return capsys.readouterr().err


def test_a_folder_with_a_run_is_replaced_only_where_asked(tmp_path, monkeypatch, capsys):
    (tmp_path / "config.yaml").touch()
    word = f"++hydra.run.dir={tmp_path.parent}/../{tmp_path.parent.name}/{tmp_path.name}"
    assert "overwrite=true to replace it" in refused(monkeypatch, capsys, word)
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
    assert "overwrite" not in refused(monkeypatch, capsys, word, "overwrite=true")


def test_a_folder_where_a_run_is_at_work_is_refused(tmp_path, monkeypatch, capsys):
    fcntl = pytest.importorskip("fcntl", reason="this system has no such locks")
    handle = os.open(tmp_path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        said = refused(monkeypatch, capsys, f"hydra.run.dir={tmp_path}")
    finally:
        os.close(handle)
    assert "where another run is at work; give another folder" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("below", ["", "/below"])
def test_a_folder_that_is_a_file_is_one_message(tmp_path, below: str, monkeypatch, capsys):
    (tmp_path / "file").touch()
    said = refused(monkeypatch, capsys, f"hydra.run.dir={tmp_path}/file{below}")
    assert "which cannot be written to" in said
    assert len(said.splitlines()) < 4


def test_what_a_killed_run_left_unfinished_goes(tmp_path: Path):
    for name in (".lfrtorch-a.yaml", "model/.lfrtorch-b.safetensors", "mine/.lfrtorch-c"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / ".lfrtorch-model").mkdir()
    (tmp_path / "config.yaml").touch()
    claim.claim(tmp_path, configuration(f"resume={tmp_path}"))
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert left == ["config.yaml", "mine", "mine/.lfrtorch-c", "model"]


def test_figures_are_true_or_false(csv: Path, tmp_path: Path):
    with pytest.raises(InputError, match="figures is 'maybe'; give True or False"):
        fit.run(configuration(*file_overrides(csv), "nx=1", "figures=maybe"), tmp_path)


@pytest.mark.numeric
@pytest.mark.usefixtures("short_paths")
def test_sizes_are_chosen(csv: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    arguments = ["nx=auto", "nx_max=1", "nz=auto", "nw=1", "nn=3", "trainer.max_iter=20"]
    cfg = configuration(*file_overrides(csv), *arguments)
    fit.run(cfg, tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    (chosen,) = (t for t in metrics["sizes_search"] if t["chosen"])
    saved = OmegaConf.load(tmp_path / "config.yaml")
    assert (saved.nx, saved.nz, saved.nn, saved.ridge) == ("auto", "auto", 3, 0.0)
    for used in (saved.used, metrics["used"]):
        assert (used["nx"], used["nz"], used["nn"]) == (chosen["nx"], chosen["nz"], 3)
        assert used["ridge"] == chosen["ridge"] > 0.0
    assert chosen["ratio"] < 0.5
    printed = capsys.readouterr().out
    assert "sizes: nx 1, nz 1, nw 1, nn 3: " in printed
    assert printed.count("  chosen\n") == 2  # the order, and these


@pytest.mark.numeric
@pytest.mark.usefixtures("short_paths")
def test_the_configuration_of_a_run_of_chosen_sizes_makes_it_again(csv: Path, tmp_path: Path):
    sizes = ["nx=1", "nz=1", "nw=1", "nn=auto"]
    cfg = configuration(*file_overrides(csv), *sizes, "trainer.max_iter=2")
    found = []
    for name in ("first", "again"):
        folder = tmp_path / name
        fit.run(cfg, folder)
        found.append(json.loads((folder / "metrics.json").read_text()))
        cfg = OmegaConf.load(folder / "config.yaml")
        assert isinstance(cfg, DictConfig)
    first, again = found
    assert first["scores"] == again["scores"]
    assert first["ranking"] == again["ranking"]
    assert first["used"] == again["used"]
    assert first["used"]["average"] > 1


@pytest.mark.numeric
@pytest.mark.usefixtures("short_paths")
def test_degree_is_chosen_with_adam(csv: Path, tmp_path: Path):
    arguments = [*file_overrides(csv), "nx=1", "nz=1", "nw=1", "static=polynomial", "degree=auto"]
    cfg = configuration(*arguments, "trainer=adam", "trainer.max_iter=4")
    fit.run(cfg, tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["sizes"]["degree"] == OmegaConf.load(tmp_path / "config.yaml").used.degree
    assert {t["degree"] for t in metrics["sizes_search"]} >= {3}


class Interrupted(lfrtorch.LevenbergMarquardt):
    """Levenberg-Marquardt with Ctrl-C in its third iteration."""

    def step(self, problem: Any, state: Any) -> Any:
        if state.iteration == 2:
            signal.raise_signal(signal.SIGINT)
        return super().step(problem, state)


class AtOnce(lfrtorch.LevenbergMarquardt):
    """Levenberg-Marquardt that Ctrl-C ends amid its third iteration, as a second one does."""

    def step(self, problem: Any, state: Any) -> Any:
        if state.iteration == 2:
            raise KeyboardInterrupt
        return super().step(problem, state)


@pytest.mark.parametrize(
    ("trainer", "code", "message"),
    [
        (AtOnce, 130, "stopped while sizes were chosen: nothing to keep"),
        (Terminated, 143, "stopped while sizes were chosen: nothing to keep"),
    ],
)
def test_a_choice_of_sizes_that_is_ended_says_so(
    trainer: type,
    code: int,
    message: str,
    csv: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setattr("lfrtorch.fitting.choice.LevenbergMarquardt", trainer)
    words = [*file_overrides(csv), "nx=1", "nn=auto"]
    with pytest.raises(SystemExit) as stop:
        launched(monkeypatch, f"hydra.run.dir='{tmp_path}'", *words)
    assert stop.value.code == code
    assert capsys.readouterr().err == f"{message}\n"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([], "no data chosen"),
        (["+bench=nonsense"], "nonsense"),
        (["+bench=boucwen", "+max_iter=5"], "did you mean trainer.max_iter=5?\n"),
        (["+bench=boucwen", "nz=0"], "nz is 0"),
        (["+bench=boucwen", "trainer.speed=3"], "speed"),
        (["+bench=boucwen", "data.root=/nowhere"], "no Bouc-Wen test files in '/nowhere'"),
        (["+bench=boucwen", "timeout=-1"], "timeout is -1"),
    ],
)
@pytest.mark.usefixtures("untraced")
def test_user_errors_are_one_message(
    overrides: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    with pytest.raises(SystemExit) as stop:
        launched(monkeypatch, f"hydra.run.dir='{tmp_path}'", *overrides)
    printed = capsys.readouterr()
    assert stop.value.code == 1
    assert message in printed.err
    assert "Traceback" not in printed.err + printed.out
    assert not (tmp_path / ".hydra").exists()  # no folder is left behind


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["nz=many"], "nz is 'many'; give a whole number of at least 1, or auto"),
        (["degree=auto"], "degree is auto, but this static map has no degree; give nn='auto'"),
        (["nn=auto", "static=polynomial"], "nn is auto, but this static map has no nn"),
        (["init=magic"], "init is 'magic'; give 'auto', 'zero_output', 'random_states' or 'paper'"),
        (["activation=softsign"], "activation is 'softsign'"),
        (["trainer.damping=-1"], "damping is -1"),
        (["bla.refine=output"], "refine is 'output'"),
        (["+bench=boucwen", "data.samples=ten"], "a period of ten samples"),
        (["+bench=boucwen", "data.seed=x"], "data: seed is 'x'"),
        (["+bench=silverbox", "data.root=/nowhere"], "there is no 'Silverbox/"),
        (["+bench=parwh", "data.levels=[200]"], "data: levels is [200]; give one or more of 100"),
        (["+bench=parwh", "data.root=/nowhere"], "there is no 'ParWH/ParWHFiles/ParWHData.mat'"),
        (["init_from=/nowhere"], "there is no '/nowhere'; give the folder of a run"),
        (["ridge=-1"], "ridge is -1"),
        (["ridge=abc"], "ridge is 'abc'"),
        (["ridge={B: 1.0}"], "ridge has a group 'B'"),
        (["threads=0"], "threads is 0"),
        (["dtype=float16"], "dtype is float16; give float64 or float32"),
        (["device=abacus"], "device is abacus, which torch cannot use here"),
        (["seed=a"], "seed is 'a'"),
        (["data=boucwen"], "+bench=boucwen"),
        (["data=file", "data.path=/nowhere.csv", "nx=1"], "there is no file '/nowhere.csv'"),
        (["nx=null"], "nx, the number of states, is not set"),
    ],
)
def test_settings_that_cannot_be_are_one_message(
    overrides: list[str],
    message: str,
    csv: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    """The short file is read if no other data are given."""
    given = any(word.startswith(("+bench=", "data=")) for word in overrides)
    cfg = configuration(*([] if given else [*file_overrides(csv), "nx=1"]), *overrides)
    with pytest.raises(SystemExit) as stop, errors.user_errors():
        fit.run(cfg, tmp_path)
    assert stop.value.code == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "metrics.json").exists()


KNOWN = """
import lfrtorch


def model():
    return lfrtorch.Known(
        lambda x, u, p: (p.gain * u[0] - p.rate * x.level,),
        states=["level"],
        parameters={"gain": 1.0, "rate": lfrtorch.Parameter(0.5, low=0.0, unit="1/s")},
    )
"""


@pytest.mark.numeric
def test_a_known_model_stands_in_the_working_directory(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, undrawn: None
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place != str(tmp_path)])
    (tmp_path / "level_of_a_tank.py").write_text(KNOWN)
    u, level, rows = np.random.default_rng(0).standard_normal(300), 0.0, ["u,y"]
    for value in u:
        rows.append(f"{value},{level}")
        level += (2.0 * value - 0.8 * level) * (1 - np.exp(-0.08)) / 0.8
    (tmp_path / "x.csv").write_text("\n".join(rows))
    words = "data=file data.path=x.csv data.inputs=[u] data.outputs=[y] data.fs=10 data.start=zero"
    words += " starts=1 figures=false"
    known = "known._target_=level_of_a_tank.model", "hydra.run.dir=run"
    launched(monkeypatch, *words.split(), *known)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    found = metrics["known"]["values"]
    assert found["gain"]["value"] == pytest.approx(2.0, rel=1e-2)
    assert found["rate"]["value"] == pytest.approx(0.8, rel=1e-2)
    assert found["rate"]["unit"] == "1/s"
    launched(monkeypatch, *words.split(), known[0], "nn=2", "hydra.run.dir=again", "overwrite=true")
    sizes = json.loads((tmp_path / "again" / "metrics.json").read_text())["sizes"]
    assert sizes == {"nx": 0, "nz": 2, "nw": 1, "nn": 2}


@pytest.mark.numeric
def test_entries_are_given_on_the_command_line():
    cfg = configuration("nx=2", "data=file")
    cfg.fixed = {"Cy": [[1.0, None]]}
    fixed = config.configured(cfg).fixed["Cy"]
    np.testing.assert_array_equal(fixed, [[1.0, np.nan]])
