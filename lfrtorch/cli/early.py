"""Checks of the words, settings and file of a command line, before the slow import of torch."""

from __future__ import annotations

import os
import sys
from dataclasses import fields
from typing import Any

from omegaconf import OmegaConf

from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import expanded
from lfrtorch.cli import run_folder, sweep
from lfrtorch.cli.checks import CHECKS
from lfrtorch.cli.composition import SWEEPS, check_words, chosen_by_data, in_full, of_newest
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.quotes import quoted
from lfrtorch.files.excel import EXTENSIONS, workbook
from lfrtorch.files.formats import open_table
from lfrtorch.files.loggers import READERS
from lfrtorch.files.measurement import Wanted, read_measurement

_SMALL = 2**22
"""Largest number of bytes of a file that is read twice: this takes a tenth of a second."""


def take_words(command: str) -> None:
    """Complete the words of the program, or end it with a message if they are wrong."""
    with user_errors():
        given = [of_newest(word) for word in in_full(command, sys.argv[1:])]
        words, several = given, not SWEEPS.isdisjoint(given)
        if command in ("config", "linear"):
            words = sweep.words_of_runs(given) if several else run_folder.arguments(given)
        if command == "config":
            words = [*words, *chosen_by_data(words)]
        if several:  # errors then come to user_errors, without tracebacks
            os.environ["HYDRA_FULL_ERROR"] = "1"
        if os.environ.get("RANK", "0") != "0":
            words = [*words, *run_folder.SILENT]
        sys.argv[1:] = [quoted(word) for word in words]
        cfg = check_words(command, given, sys.argv[1:])
        if cfg is not None and not several:
            CHECKS[command](cfg)
            if command in ("config", "linear"):
                check_file(cfg.data)


def check_file(data: Any) -> None:
    """Refuse a single file, its columns or its sampling frequency, if the file is read fast."""
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
