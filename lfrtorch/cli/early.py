"""What is wrong with the words of a fit, said before torch is imported, which takes seconds."""

from __future__ import annotations

import os
import sys
from dataclasses import fields
from typing import Any

from omegaconf import DictConfig, OmegaConf

from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import expanded
from lfrtorch._support.settings import check_settings
from lfrtorch.cli.composition import (
    check_words,
    chosen_by_data,
    composed,
    first_run,
    in_full,
    parsed,
)
from lfrtorch.cli.errors import user_errors
from lfrtorch.files.excel import EXTENSIONS, workbook
from lfrtorch.files.formats import open_table
from lfrtorch.files.loggers import READERS
from lfrtorch.files.measurement import Wanted, read_measurement
from lfrtorch.fitting.plain_settings import PlainSettings
from lfrtorch.least_squares.options import AdamOptions, LevenbergMarquardtOptions

_SMALL = 2**22
"""Bytes of a file up to which it is read twice: a tenth of a second."""

_SIZES = {"nx", "nz", "nw", "nn", "degree"}


def check(command: str) -> None:
    """End the program with a message if its words, numbers, file or columns cannot be."""
    given = sys.argv[1:]
    if any(word.startswith("-") or word.startswith("resume=") for word in given):
        return  # several runs, options of Hydra, or the words of another run
    with user_errors(os.environ.get("RANK", "0")):
        words = in_full(command, given)
        whole = [*words, *chosen_by_data(words)] if command == "config" else words
        check_words(command, words, whole)
        cfg = composed(command, [first_run(parsed(word)) for word in whole])
        if command == "config":
            check_numbers(cfg)
        check_file(cfg.get("data"))


def check_numbers(cfg: DictConfig) -> None:
    """Refuse plain settings beyond their limits."""
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    own = {one.name: plain[one.name] for one in fields(PlainSettings)}
    brought = cfg.init_from is not None or cfg.known._target_ is not None
    check_settings(PlainSettings(**own), without=_SIZES if brought else ())
    trainer = plain["trainer"]
    of_adam = str(trainer.get("_target_")).endswith("Adam")
    kind: Any = AdamOptions if of_adam else LevenbergMarquardtOptions
    names = {one.name for one in fields(kind)}
    options = {k: v for k, v in trainer.items() if k in names and not isinstance(v, dict)}
    try:
        check_settings(kind(**options))
    except InputError as error:
        raise InputError(f"trainer: {error}") from None


def check_file(data: Any) -> None:
    """Refuse a single file, its columns or its sampling frequency, if it is read without delay."""
    if data is None or data.get("_target_") != "lfrtorch.load_records":
        return
    path = data.path
    if not isinstance(path, str) or {"*", "?"} & set(path):
        return
    file = expanded(path)
    if workbook(file)[0].suffix.lower() in (*EXTENSIONS, *READERS):
        return  # these are read whole
    given: Any = OmegaConf.to_container(data)
    try:
        table = open_table(file)
        for side in ("inputs", "outputs"):
            if given[side] is not None:
                table.find(given[side], side)
        if file.stat().st_size < _SMALL:
            given["units"] = given["units"] or {}
            read_measurement(table, Wanted(**{one.name: given[one.name] for one in fields(Wanted)}))
    except (InputError, OSError) as error:
        raise InputError(f"data: {error}") from None
