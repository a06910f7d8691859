"""Words of the command line that no configuration takes end in one line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lfrtorch import InputError
from lfrtorch.cli.composition import (
    check_words,
    chosen_by_data,
    composed,
    in_full,
    in_groups,
    parsed,
)
from lfrtorch.cli.quotes import quoted

FILE = ["data=file", "data.path=x.csv"]
PATTERN = ["data=file", "data.path='runs/*.mat'"]
INPUTS = ["data.inputs=[0]"]


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("config", [*FILE, "max_iter=5"], "'max_iter'; did you mean trainer.max_iter=5?"),
        ("config", [*FILE, "+max_iter=5"], "'max_iter'; did you mean trainer.max_iter=5?"),
        ("config", ["+start=estimated"], "'start'; did you mean data.start=estimated?"),
        ("config", [*FILE, "++seeds=1"], "'seeds'; did you mean seed=1?"),
        ("config", ["inputs=[u]"], "'inputs'; did you mean data.inputs=[u]?"),
        ("config", [*FILE, "data.input=[u]"], "'data.input'; did you mean data.inputs=[u]?"),
        ("config", ["bench=boucwen"], "a benchmark is added to the settings: +bench=boucwen."),
        ("config", [*FILE, "data.zzzz=1"], "'data.zzzz'; if the function takes it, write +data.zz"),
        ("config", [*FILE, "zzzz=1"], "no setting 'zzzz'; --help lists them all."),
        ("config", ["data.path=x.csv"], "add a file, or +bench=NAME"),
        ("config", [*FILE, "data.inputs=a,b"], "for a list write data.inputs=[a,b], for a run"),
        ("config", [*FILE, "nx=1,2"], "nx=1,2 has several values: for a run of each of them add"),
        ("config", ["static=poly"], "no static=poly; give network, own, polynomial."),
        ("config", ["data=-1"], "no data=-1; give boucwen, "),
        ("config", ["static={a: 1}"], "no static={'a': 1}; give network, "),
        ("config", ["=1"], "'=1' is not understood; write NAME=VALUE"),
        ("config", ["~nx"], "nx cannot be taken away; leave out ~nx."),
        ("config", ["~static"], "static cannot be taken away"),
        ("evaluate", ["nx=${nowhere}"], "Interpolation key 'nowhere' not found"),
        ("config", ["+bench=tanks"], "no bench=tanks; give boucwen, "),
        ("config", ["-m", *FILE, "seed=interval(0,9)", "zzzz=1"], "no setting 'zzzz'"),
        ("config", ["-m", *FILE, "trainer=glob(*)", "data.input=[u]"], "did you mean data.inputs"),
        ("config", ["zzzz"], "'zzzz' is neither a setting, NAME=VALUE, nor a file"),
        ("config", ["two words"], "'two words' is not understood; write NAME=VALUE"),
        ("config", ["data.inputs=[u,"], "write NAME=VALUE, and quotes"),
        ("config", ["hydra/launcher=nowhere"], "Could not find 'hydra/launcher/nowhere'"),
        ("linear", [*FILE, "frf.metod=fast"], "'frf.metod'; did you mean frf.method=fast?"),
        ("simulate", ["path=x.csv"], "'path'; did you mean data.path=x.csv?"),
        ("evaluate", ["checkpiont=x"], "'checkpiont'; did you mean checkpoint=x?"),
        ("export", ["too=c"], "'too'; did you mean to=c?"),
        ("export", ["ouput=x"], "'ouput'; did you mean out=x?"),  # not data.outputs: it reads none
        ("export", ["data.path=x.csv"], "no setting 'data.path'; --help lists them all."),
    ],
)
def test_an_unknown_word_is_refused_in_one_line(command: str, words: list[str], message: str):
    with pytest.raises(InputError) as refused:
        check_words(command, words)
    text = str(refused.value)
    assert message in text
    assert "\n" not in text
    assert "HYDRA_FULL_ERROR" not in text


def test_a_folder_is_no_file(tmp_path: Path):
    for folder in (tmp_path, tmp_path / "a=b.csv"):
        folder.mkdir(exist_ok=True)
        with pytest.raises(InputError, match=re.escape(f"give its files, or checkpoint={folder}")):
            check_words("evaluate", in_full("evaluate", [str(folder)]))


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("config", ["+bench=boucwen", "seed=1", "bla.offset=true"]),
        ("config", [*FILE, "+data.x=1", "+trainer.x=1", "+bla.weight=x", "++trainer.max_iter=5"]),
        ("config", ["+data._target_=my.loader", "+data.path=x", "trainer._target_=my.Trainer"]),
        ("config", [*FILE, "static=own", "static._target_=my.Map", "+static.width=3"]),
        ("config", [*FILE, "ridge={static: 1e-3}", "hydra.run.dir='x y'"]),
        ("config", ["-m", "+bench=boucwen,parwh", "nx=1,2", "seed=range(3)"]),
        ("config", ["-m", *FILE, "trainer=glob(*)", "seed=interval(0,9)"]),
        ("config", ["--cfg", "job"]),
        ("config", []),
        ("linear", [*FILE, "frf.method=fast", "nx=auto"]),
        ("evaluate", ["checkpoint=x", "+bench=boucwen", "starts=3"]),
        ("simulate", ["data=file", "data.path=x.csv", "start=given", "x0=[1,2]"]),
    ],
)
def test_known_words_pass(command: str, words: list[str]):
    check_words(command, words)


def test_words_of_an_earlier_run_are_taken_as_they_are():
    saved = ["+bench=boucwen", "+old_word=3"]
    check_words("config", ["resume=x", "data.seed=2"], [*saved, "resume=x", "data.seed=2"])
    with pytest.raises(InputError, match=r"no setting 'data\.seeed'"):
        check_words("config", ["resume=x", "data.seeed=2"], [*saved, "resume=x", "data.seeed=2"])


@pytest.mark.parametrize(
    ("command", "words", "taken"),
    [
        (
            "config",
            ["start=estimated", *FILE, "max_iter=9"],
            ["data.start", *FILE, "trainer.max_iter"],
        ),
        ("config", ["-m", *FILE, "tolerance=0,1"], ["-m", *FILE, "trainer.tolerance"]),
        ("config", [*FILE, "seed=1", "nx=auto"], [*FILE, "seed", "nx"]),  # not data.seed
        ("config", [*FILE, "zzzz=1", "offset=False"], [*FILE, "zzzz", "bla.offset"]),
        ("linear", ["method=fast"], ["frf.method"]),
        ("simulate", ["path=x.csv", "start=zero"], ["data.path", "start"]),
    ],
)
def test_names_as_messages_have_them_are_taken(command: str, words: list[str], taken: list[str]):
    found = in_groups(command, words)
    for word, given, name in zip(found, words, taken, strict=True):
        assert word == (name if name in (*FILE, "-m") else f"{name}={given.partition('=')[2]}")


WHOLE = [*FILE, "data.inputs=[force]", "data.outputs=[disp]", "data.fs=750", "nx=3"]


@pytest.mark.parametrize(
    ("command", "short", "long"),
    [
        ("config", "x.csv inputs=force outputs=disp fs=750 nx=3", WHOLE),
        ("linear", "inputs=force nx=3 x.csv fs=750 outputs=disp", WHOLE),
        ("config", "path=x.csv data.inputs=force data.outputs=[disp] data.fs=750 nx=3", WHOLE),
        ("config", "data=file x.csv inputs=0 outputs=2,1", [*FILE, *INPUTS, "data.outputs=[2,1]"]),
        ("evaluate", "checkpoint=m x.csv", ["checkpoint=m", *FILE]),
        ("simulate", "checkpoint=m x.csv inputs=0", ["checkpoint=m", FILE[1], *INPUTS]),
        ("preview", "x.csv y.mat.csv", [FILE[0], "data.path=[x.csv,y.mat.csv]"]),
        ("config", "runs/*.mat test=sweep.csv", [*PATTERN, "data.test=sweep.csv"]),
        ("config", "x.csv inputs=null", [*FILE, "data.inputs=null"]),
        ("config", "x.csv reference=r,'s,t'", [*FILE, "data.reference=[r,'s,t']"]),
        ("config", "+bench=boucwen seed=1", ["+bench=boucwen", "seed=1"]),
    ],
)
def test_few_words_are_a_whole_command_line(command: str, short: str, long: list[str]):
    words = [quoted(word) for word in in_full(command, short.split())]
    check_words(command, words)
    assert composed(command, words) == composed(command, long)


AUTO = ["nn=auto", "nw=auto", "nx=auto", "nz=auto"]


@pytest.mark.parametrize(
    ("words", "added"),
    [
        (FILE, AUTO),
        ([*FILE, "nx=3", "seed=1"], ["nn=auto", "nw=auto", "nz=auto"]),
        ([*FILE, "nx=3", "nz=1", "nw=1", "nn=4"], []),
        ([*FILE, "static=polynomial"], ["degree=auto", "nw=auto", "nx=auto", "nz=auto"]),
        ([*FILE, "static=own"], ["nx=auto"]),
        ([*FILE, "ridge=0.1"], AUTO),
        ([*FILE, "structure=wiener", "nx=2"], []),
        ([*FILE, "init_from=runs/a"], []),
        ([*FILE, "update=runs/a"], ["data.validation=0"]),
        ([*FILE, "update=runs/a", "data.validation=0.1"], []),
        (["+bench=boucwen", "update=runs/a"], []),
        ([*FILE, "resume=runs/a"], []),
        (["+bench=boucwen"], []),
        (["-m", *FILE, "nn=5,10"], []),
    ],
)
def test_sizes_of_a_model_of_files_are_chosen_by_the_data(words: list[str], added: list[str]):
    assert chosen_by_data(words) == added


def test_names_of_columns_that_need_quotes_are_a_list_too():
    words = ["x.csv", "inputs=Force (N),acc[0]", "outputs='Weg [mm]'"]
    cfg = composed("config", [quoted(word) for word in in_full("config", words)])
    assert (cfg.data.inputs, cfg.data.outputs) == (["Force (N)", "acc[0]"], ["Weg [mm]"])


def test_a_comma_is_a_list_of_columns_or_of_runs():
    words = ["x.csv", "inputs=a,b", "outputs=y", "nn=5,10"]
    assert in_full("config", words)[2:] == ["data.inputs=[a,b]", "data.outputs=[y]", "nn=5,10"]
    found = in_full("config", ["-m", *words])
    assert found[:3] == ["-m", "data=file", "data.path=x.csv"]
    assert found[3:] == ["data.inputs=a,b", "data.outputs=[y]", "nn=5,10"]
    check_words("config", found)
    assert in_full("config", ["-m", "x.csv", "inputs=[a],[b]"])[-1] == "data.inputs=[a],[b]"


def test_entries_of_a_table_that_is_empty_are_given_by_their_names():
    words = in_full("config", ["x.csv", "fixed.Cy=[[1,null]]", "fixed.A=[[0.5]]"])
    cfg = check_words("config", words)
    assert cfg is not None
    assert cfg.fixed == {"Cy": [[1, None]], "A": [[0.5]]}


def test_paths_that_hydra_would_read_otherwise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    names = ["5", "a,b.csv", "a=1.csv", "{x}.csv", "null", "it's.csv", "Maß 1.csv"]
    for name in names:
        (tmp_path / name).touch()
    path, *other = in_full("simulate", names)
    assert (parsed(path).value(), other) == (names, [])
    for name in names:
        assert composed("preview", in_full("preview", [name])).data.path == name


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["x.cvs"], "'x.cvs' is neither a setting, NAME=VALUE, nor a file; there is 'x.csv' in"),
        (["x.cvs", "fs=750"], "'x.cvs' is neither a setting, NAME=VALUE, nor a file; there is"),
        (["force"], "'force' is neither a setting, NAME=VALUE, nor a file; its folder has 'x.csv'"),
        (["x.csv", "data.path=x.csv"], "data.path is given twice"),
        (["x.csv", "path=x.csv"], "data.path is given twice"),
        (["x.csv", "input=u"], "no setting 'input'; did you mean data.inputs=u?"),
        (["inputs=u,v"], "data.inputs is of no use before data are chosen: add a file, or +bench="),
        (["q" * 300 + ".csv"], "is not a path (File name too long)"),
    ],
)
def test_few_words_that_are_wrong(words, message, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.csv").touch()
    with pytest.raises(InputError, match=re.escape(message)):
        check_words("config", in_full("config", words))
