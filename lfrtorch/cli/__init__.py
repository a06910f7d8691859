"""The command line: its configuration by Hydra, the folder of a run, a module for each command."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]

CONF = next(folder for folder in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if folder.is_dir())
"""The settings: inside the package if it is installed, at the top of its repository otherwise."""
