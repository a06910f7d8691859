"""The configuration has the settings and the defaults of Python."""

from __future__ import annotations

from dataclasses import fields

import pytest
from command_line import configuration

from lfrtorch import Adam, LevenbergMarquardt, Settings
from lfrtorch.cli.config import configured


@pytest.mark.parametrize(
    ("name", "trainer"), [("levenberg_marquardt", LevenbergMarquardt), ("adam", Adam)]
)
def test_defaults_are_those_of_the_declarations(name: str, trainer: type):
    found = configured(configuration(f"trainer={name}", "data=file", "nx=2", "starts=auto"))
    usual = Settings(nx=2, trainer=trainer())
    for one in fields(Settings):
        if one.name != "linear":
            assert getattr(found, one.name) == getattr(usual, one.name), one.name


def test_every_setting_is_a_word_of_the_configuration():
    words = {*map(str, configuration("data=file", "nx=2"))}
    assert {one.name for one in fields(Settings)} - words == {"linear"}  # bla=...
