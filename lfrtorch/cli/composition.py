"""Words of a command line: complete them, and refuse words that no configuration takes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from copy import deepcopy
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import ChoiceSweep, Glob, Override, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import expanded
from lfrtorch.cli import CONF, declared
from lfrtorch.cli.hydra_versions import COMPOSED
from lfrtorch.cli.quotes import in_quotes, quoted, read
from lfrtorch.files.excel import workbook
from lfrtorch.files.formats import FORMATS, extension, similar

GROUPS = ("bla", "frf", "data", "trainer")
"""Groups whose words are arguments of functions. A name in several groups means the last group."""

declared.register()

SWEEPS = {"-m", "--multirun"}
"""Options that make a run for each of several values."""

_DATE = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d-\d{6}")  # name of the folder of a single run
_SETTING = re.compile(r"[+~]*(?:hydra/)?[\w.]+=")  # beginning of a word NAME=VALUE
# Commands with a group ``data``.
_DATA_CHOSEN = {"config", "linear", "evaluate", "preview"}
_LISTS = {"data.inputs", "data.outputs", "data.reference"}


def in_full(command: str, given: Sequence[str]) -> list[str]:
    """The words in full: ``x.csv inputs=u`` becomes settings of a file and its columns."""
    words = with_names(given)
    names = [word.partition("=")[0].lstrip("+") for word in words]
    at = next((i for i, name in enumerate(names) if name in ("path", "data.path")), None)
    chosen = not {"data", "bench", "resume"}.isdisjoint(names)
    if command in _DATA_CHOSEN and not chosen and at is not None:
        words.insert(at, "data=file")
    several = not SWEEPS.isdisjoint(words)
    return [_listed(word, several=several) for word in in_groups(command, words)]


def of_newest(word: str) -> str:
    """The word; if its value is a folder of runs, where a model is wanted, the newest run in it."""
    name, _, value = word.partition("=")
    if name not in ("checkpoint", "init_from", "update"):
        return word
    folder = expanded(str(parsed(word).value()))
    runs = [run for run in folder.glob("*") if _DATE.fullmatch(run.name) and _has_model(run)]
    if not runs or _has_model(folder):
        return word
    newest = max(runs)
    print(f"note: {name} is {newest}, the newest run in {value}")
    return f"{name}={_plain_or_quoted(name, str(newest))}"


def _has_model(folder: Path) -> bool:
    return any((folder / inside / "model.json").is_file() for inside in ("", "model", "linear"))


def chosen_by_data(words: Sequence[str]) -> list[str]:
    """Words for sizes that were not given, so that the data choose them; none in several runs."""
    if not SWEEPS.isdisjoint(words):
        return []
    pairs = [word.lstrip("+").partition("=") for word in words]
    given = {name: value for name, _, value in pairs}
    names = {name.split(".")[0] for name in given}
    if "update" in names and given.get("data") == "file":  # all but the test are fitted
        return [] if "data.validation" in given else ["data.validation=0"]
    if given.get("data") != "file" or not names.isdisjoint({"bench", "resume", "init_from"}):
        return []
    last = "degree" if given.get("static") == "polynomial" else "nn"
    static = {"nz", "nw", last}
    if given.get("static") == "own" or "structure" in names:
        static = set()
    return [f"{name}=auto" for name in sorted({"nx"} | static) if name not in given]


def with_names(given: Sequence[str]) -> list[str]:
    """The words; words without a name that may be files become values of ``data.path``."""
    other = [
        word
        for word in given
        if not word
        or word[0] == "-"
        or (word[0] == "~" and "/" not in word)
        or (_SETTING.match(word) and not os.path.exists(word))
        or not _may_be_file(word)
    ]
    paths = [_plain_or_quoted("data.path", word) for word in given if word not in other]
    if not paths:
        return other
    if any(word.startswith(("data.path=", "path=")) for word in other):
        raise InputError("data.path is given twice; a path alone is data.path, too.")
    value = paths[0] if len(paths) == 1 else f"[{','.join(paths)}]"
    at = next(i for i, word in enumerate(given) if word not in other)  # options keep their places
    return [*other[:at], f"data.path={value}", *other[at:]]


def _may_be_file(word: str) -> bool:
    """Tell if a word is a file or a pattern of files, or ends like a measurement file."""
    path, _ = workbook(expanded(word))
    if path.is_dir() or ("=" in word and not path.exists()):
        return False
    return path.is_file() or not {"*", "?"}.isdisjoint(word) or extension(path) in FORMATS


def _plain_or_quoted(option: str, path: str) -> str:
    """A path as a value, in quotes if Hydra would read it as something else."""
    word = f"{option}={path}"
    found = read(word)
    return path if found and found.value() == path else in_quotes(path)


def _listed(word: str, *, several: bool) -> str:
    """A word for columns with its names as a list; they are several runs if ``several``."""
    name, _, value = quoted(word).partition("=")
    if name not in _LISTS:
        return word
    given = parsed(word).value()
    if isinstance(given, ChoiceSweep):
        single = given.simple_form and not several
    else:
        single = isinstance(given, str | int | QuotedString)
    return f"{name}=[{value}]" if single else word


def in_groups(command: str, given: Sequence[str]) -> list[str]:
    """The words with their groups: ``start=estimated`` becomes ``data.start=estimated``."""
    cfg = chosen(command, [parsed(word) for word in given if "=" in word])
    names = dict(spelt(_with_data(command, cfg)))
    tables = tuple(f"{name}." for name, node in cfg.items() if node == {})  # take any entry
    return [
        names.get(name, f"++{name}" if name.startswith(tables) else name) + word[len(name) :]
        for word, name in ((word, word.partition("=")[0]) for word in given)
    ]


def check_words(command: str, given: Sequence[str], used: Sequence[str] = ()) -> DictConfig | None:
    """Compose the words; refuse words that Hydra would not take, or that nothing would read.

    Options of Hydra, as --help, compose nothing.
    """
    # ``used`` may begin with words of an earlier run, which took them.
    if {word for word in given if word.startswith("-")} - SWEEPS:
        return None
    words, every = (
        [parsed(word) for word in line if word not in SWEEPS] for line in (given, used or given)
    )
    cfg = chosen(command, every)
    for word in words:
        if word.is_sweep_override() and SWEEPS.isdisjoint(given):
            raise InputError(several_values(word, cfg))
        if not (is_choice(word) or word.is_delete() or taken(word, cfg)):
            raise InputError(unknown(command, word, cfg))
    return _composed(CONF, command, _of_first_run(every))


def chosen(command: str, words: Sequence[Override]) -> DictConfig:
    """The configuration with the words that choose options of groups, and without other words."""
    for word in words:
        name, value = word.key_or_group, word.value()
        if word.is_delete() and "." not in name and name != "data":
            raise InputError(f"{name} cannot be taken away; leave out {word.input_line}.")
        if name == "bench" and not adds(word):
            raise InputError(f"a benchmark is added to the settings: +{word.input_line}.")
        choices = sorted(path.stem for path in (CONF / name).glob("*.yaml"))
        one = not (value is None or isinstance(value, list) or word.is_sweep_override())
        if choices and one and value not in choices:
            raise InputError(f"there is no {name}={value}; give {', '.join(choices)}.")
    return _composed(CONF, command, _of_first_run(filter(is_choice, words)))


def parsed(word: str) -> Override:
    """The word as Hydra reads it."""
    found = read(quoted(word))
    if found and found.key_or_group:
        return found
    if Path(word).is_dir():
        raise InputError(
            f"'{word}' is a folder: give its files, or checkpoint={word} if it has a model."
        )
    if re.fullmatch(r"[\w./-]+", word):
        raise InputError(
            f"'{word}' is neither a setting, NAME=VALUE, nor a file{similar(expanded(word))}."
        )
    raise InputError(
        f"'{word}' is not understood; write NAME=VALUE, and quotes around the word if a space, "
        "a comma or a bracket stands in its value: \"NAME='VALUE'\"."
    )


def several_values(word: Override, cfg: DictConfig) -> str:
    """Message about values that are neither a list nor several runs."""
    name, values = word.get_key_element(), word.get_value_string()
    listed = name.startswith("data.") or isinstance(OmegaConf.select(cfg, name), ListConfig)
    meant = f"for a list write {name}=[{values}], " if listed else ""
    return f"{name}={values} has several values: {meant}for a run of each of them add -m."


def is_choice(word: Override) -> bool:
    """Tell if a word chooses an option of a group, which may be one of Hydra's."""
    return (CONF / word.key_or_group).is_dir() or word.is_hydra_override()


def first_run(word: Override) -> str:
    """The word as it is in the first of several runs."""
    if not word.is_sweep_override():
        return str(word.input_line)
    return f"{word.get_key_element()}={next(word.sweep_string_iterator())}"


def _of_first_run(words: Iterable[Override]) -> tuple[str, ...]:
    """The words without globs and intervals: only the sweeper knows their values."""
    known = (w for w in words if not (isinstance(w.value(), Glob) or w.is_interval_sweep()))
    return tuple(map(first_run, known))


def composed(command: str, words: Sequence[str] = ()) -> DictConfig:
    """The configuration; if Hydra cannot make one, an error with the first line of its reason."""
    return deepcopy(_composed(CONF, command, tuple(words)))


@lru_cache(maxsize=8)  # a command line is composed twice, in 0.1 s each
def _composed(folder: Path, command: str, words: tuple[str, ...]) -> DictConfig:
    try:
        within = GlobalHydra.instance().is_initialized()  # at the end of a command of Hydra
        with nullcontext() if within else initialize_config_dir(**COMPOSED, config_dir=str(folder)):
            cfg = compose(command, list(words))
            OmegaConf.to_container(cfg, resolve=True)  # raises if a name is not defined
            return cfg
    except (HydraException, OmegaConfBaseException) as failed:
        raise InputError(str(failed).splitlines()[0]) from None


def adds(word: Override) -> bool:
    """Tell if a word is +NAME or ++NAME."""
    return word.is_add() or word.is_force_add()


def taken(word: Override, cfg: DictConfig) -> bool:
    """Tell if a setting is used: it exists, or it is an added argument."""
    group, _, name = word.key_or_group.rpartition(".")
    top = group.split(".")[0]
    if adds(word) and group and (top in cfg or (CONF / top).is_dir()):
        return True
    node = OmegaConf.select(cfg, group) if group else cfg
    if not isinstance(node, DictConfig):
        return isinstance(node, ListConfig)
    return name in node.keys()  # noqa: SIM118, ``in node`` is False for a mandatory value


def unknown(command: str, word: Override, cfg: DictConfig) -> str:
    """Proposal in place of a setting that does not exist."""
    key = word.key_or_group
    _, value = str(word.input_line).split("=", 1)
    if command in _DATA_CHOSEN and cfg.get("data") is None and key.startswith("data."):
        return f"{key} is of no use before data are chosen: add a file, or +bench=NAME."
    names = dict(spelt(_with_data(command, cfg)))
    close = get_close_matches(key, names, n=1, cutoff=0.75)
    if close:
        meant = f"did you mean {names[close[0]]}={value}?"
    elif "." in key and "_target_" in (cfg.get(key.split(".")[0]) or {}):
        meant = f"if the function takes it, write +{key}={value}."
    else:
        meant = "--help lists them all."
    return f"there is no setting '{key}'; {meant}"


def _with_data(command: str, cfg: DictConfig) -> DictConfig:
    """The configuration, with the settings of files if no data are chosen."""
    if command not in _DATA_CHOSEN or cfg.get("data") is not None:
        return cfg
    return DictConfig({**cfg, "data": OmegaConf.load(CONF / "data" / "file.yaml")})


def spelt(cfg: DictConfig) -> Iterator[tuple[str, str]]:
    """Names that a user may write, and the setting that each name means."""
    # A name in several groups means the last of ``GROUPS``; a setting outside the groups comes
    # before all of them.
    groups = [name for name, node in cfg.items() if isinstance(node, DictConfig)]
    for group in sorted(map(str, groups), key=lambda name: (name in GROUPS, name)):
        for name in cfg[group]:
            yield f"{group}.{name}", f"{group}.{name}"
            yield str(name), f"{group}.{name}"
    for name in cfg:
        yield str(name), str(name)
