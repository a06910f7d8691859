"""Configurations and command lines of tests."""

from __future__ import annotations

import copy
import sys
from functools import cache
from pathlib import Path

import pytest
from omegaconf import DictConfig

from lfrtorch.cli import command
from lfrtorch.cli.composition import composed

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"
BENCHES = sorted(path.stem for path in (CONF / "bench").glob("*.yaml"))
PERIOD, SWEEP = 1024, 3000
"""Samples of the Bouc-Wen system, where it is simulated."""
SHORTER = {  # fewer samples and iterations, so that two iterations take a second
    "boucwen": f"data.samples={PERIOD} starts=2 bla.max_iter=1",
    "boucwen_record": f"data.samples={PERIOD} data.rms=[50,25] bla.max_iter=1 starts=1",
    "cascaded_tanks": "bla.max_iter=1 starts=1",
    "cascaded_tanks_known": "bla.max_iter=1 starts=1 nn=2",
    "ced": "bla.max_iter=1 starts=1",
    "emps": "data.validation=0.8 bla.max_iter=1 starts=1",
    "emps_known": "data.validation=0.8 bla.max_iter=1 starts=1",
    "f16": "data.train=[multisine_3] data.validation=[multisine_5] nx=6 modes=1"
    " bla.max_iter=1 starts=1 first_part=1 refit=false",
    "fine_steering_mirror": "data.levels=[100] data.validation=5 nx=4 nz=1 nw=1 nn=4 relaxations=1"
    " bla.max_iter=1 first_part=1 refit=false",
    "parwh": "data.source=stand-in data.levels=[325] bla.max_iter=1 starts=1",
    "silverbox": "data.validation=0.8 bla.max_iter=1 starts=1",
    "wh_process_noise": "data.validation=9 bla.max_iter=1 starts=1",
    "wiener_hammerstein": "data.validation=0.9 nx=4 nz=1 nw=1 nn=4 bla.max_iter=1 starts=1",
}
SIMULATED = ("boucwen", "boucwen_record", "parwh")
"""All others are measured."""
GROUPS = ("+bench", "data", "bla", "static", "trainer")


@cache
def usual(*groups: str) -> DictConfig:
    """By Hydra, which takes a tenth of a second; without figures and starts, which take seconds."""
    return composed("config", ["figures=false", "starts=1", *groups])


def configuration(*overrides: str) -> DictConfig:
    """Of a run without figures and of one start, unless more is asked for."""
    groups = [word for word in overrides if word.split("=")[0] in GROUPS]
    cfg = copy.deepcopy(usual(*groups))
    cfg.merge_with_dotlist([word for word in overrides if word not in groups])
    return cfg


def launched(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    """The command line in this process."""
    monkeypatch.setattr(sys, "argv", ["train.py", *words])
    command.start("fit")


def file_overrides(csv: Path) -> list[str]:
    return [
        "data=file",
        f"data.path={csv}",
        "data.inputs=[u]",
        "data.outputs=[y]",
        "data.fs=10",
        "data.start=zero",
    ]
