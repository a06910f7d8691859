"""Notebooks run, commands are understood, links lead somewhere, all exported names have a page."""

import re
import shlex
from pathlib import Path

import matplotlib
import pytest
from matplotlib import pyplot

import lfrtorch
from lfrtorch.cli import command
from lfrtorch.cli.composition import composed, first_run, in_full, parsed
from lfrtorch.cli.quotes import quoted

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]

COMMAND = re.compile(
    r"^    lfrtorch (preview|fit|linear|simulate|evaluate|export) (.+?)(?: +#.*)?$", re.MULTILINE
)
COMMANDS = sorted(
    {
        found
        for page in PAGES
        for found in COMMAND.findall(page.read_text("utf-8").replace("\\\n", " "))
    }
)

FEW = ["nx=1", "nz=1", "nw=1", "nn=2", "starts=1", "max_iter=2", "figures=false"]
"""Words after which a fit takes a second."""

CELL = re.compile(r"^```{code-cell}.*?$(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.slow
@pytest.mark.numeric
@pytest.mark.parametrize(
    "notebook", sorted((DOCS / "notebooks").glob("*.md")), ids=lambda p: p.stem
)
def test_notebook_fits_better_than_the_linear_model(notebook: Path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    cells = "".join(CELL.findall(notebook.read_text(encoding="utf-8")))
    exec(re.sub(r"^%.*$", "", cells, flags=re.MULTILINE), {})
    pyplot.close("all")
    linear, nonlinear = re.findall(
        r"(?:linear(?: model)?|NL-LFR): ([\d.]+) .m rms", capsys.readouterr().out
    )
    assert float(nonlinear) < float(linear) / 3


def test_reference_has_all_that_is_exported():
    text = (DOCS / "api" / "lfrtorch.md").read_text(encoding="utf-8")
    tables = re.findall(r"^\.\. autosummary::$(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    described = set(re.findall(r"^   (\w+)$", "".join(tables), re.MULTILINE))
    pages = {page.stem for page in (DOCS / "api").glob("*.md")}
    assert set(lfrtorch.__all__) <= described | pages


@pytest.mark.parametrize(("name", "words"), COMMANDS, ids=[" ".join(each) for each in COMMANDS])
def test_command_of_the_guide_has_settings_that_exist(name: str, words: str):
    command = "config" if name == "fit" else name
    given = in_full(command, [word for word in shlex.split(words) if word != "--help"])
    overrides = [word for word in given if word != "-m"]
    if "-m" in given:
        read = [parsed(word) for word in overrides]
        overrides = [first_run(word) for word in read if not word.is_hydra_override()]
    composed(command, [quoted(word) for word in overrides])


@pytest.mark.numeric
@pytest.mark.parametrize(
    ("page", "more"),
    [
        pytest.param(DOCS / "guide" / "tutorial.md", FEW, id="tutorial, few iterations"),
        pytest.param(DOCS / "guide" / "tutorial.md", [], id="tutorial", marks=pytest.mark.slow),
        pytest.param(ROOT / "README.md", [], id="README", marks=pytest.mark.slow),
    ],
)
def test_commands_run_in_an_empty_folder(
    page: Path, more: list[str], tmp_path, monkeypatch, capsys
):
    """One after another, as a reader types them; the file of the tutorial is there."""
    monkeypatch.chdir(tmp_path)
    tutorial = (DOCS / "guide" / "tutorial.md").read_text(encoding="utf-8")
    exec("".join(re.findall(r"^```python$(.*?)^```$", tutorial, re.MULTILINE | re.DOTALL)), {})
    text = page.read_text(encoding="utf-8")
    lines = re.findall(r"(?:^    |`)lfrtorch ((?:[a-z]+) [^`\n]+)", text, re.MULTILINE)
    assert {line.split()[0] for line in lines} >= {"preview", "fit", "export"}
    whole = next(line for line in lines if line.startswith("fit ")).removeprefix("fit ")
    for line in lines:
        typed = line.replace("...", whole).replace("/DATE", "")
        words = [*shlex.split(typed), *(more if typed.startswith("fit") else [])]
        monkeypatch.setattr("sys.argv", ["lfrtorch", *words])
        command.main()
        assert capsys.readouterr().err == "", line
    written = {path.name for path in tmp_path.rglob("*")}
    assert written >= {"metrics.json", "config.yaml", "model.c", "model.h"}
    assert ("report.html" in written) == (more == [])
    assert ("predicted.csv" in written) == (page.stem == "tutorial")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_pages_lead_to_files(page: Path):
    links = r"(?:\]\((?!http|#)|^```{include} )([^)#\s]+)"
    for target in re.findall(links, page.read_text(encoding="utf-8"), re.MULTILINE):
        assert (page.parent / target).exists(), target
