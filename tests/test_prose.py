"""The prose of the package and of the guide: what a machine can tell of it."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

PACKAGE = ROOT / "lfrtorch"

FORBIDDEN = r"(?:Of|With|So much|What|Which|Whether|Who|How)\b"
"""First words of a sentence that leaves its subject out, or hides it."""

SECTION = re.compile(r"(Args|Attributes|Shape|Returns|Raises|References|Example):$")
"""Head of a section of a docstring, after which no sentence is judged."""

LONGEST = 30
"""Most words of a sentence of the guide."""

NUMBERS = 3
"""Most numbers of a paragraph of the guide; tables, code and figures do not count."""

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]


def modules() -> Iterator[tuple[str, ast.Module]]:
    """Modules of the package by their paths."""
    for path in sorted(PACKAGE.rglob("*.py")):
        name = str(path.relative_to(PACKAGE))
        yield name, ast.parse(path.read_text(encoding="utf-8"))


def constants(tree: ast.AST) -> Iterator[tuple[ast.Assign | ast.AnnAssign, ast.Expr]]:
    """Assignments at the top of modules and classes, with the text that follows each."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef):
            for before, after in zip(node.body, node.body[1:], strict=False):
                if isinstance(before, ast.Assign | ast.AnnAssign) and is_text(after):
                    assert isinstance(after, ast.Expr)
                    yield before, after


def is_text(node: ast.AST) -> bool:
    """Tell if a statement is nothing but a string."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Docstrings with the lines that they begin at, those of constants included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield node.body[0].lineno, text
    for _, text in constants(tree):
        yield text.lineno, ast.literal_eval(text.value)


def sentences(text: str) -> list[str]:
    """Sentences of a docstring before its sections."""
    prose: list[str] = []
    for line in text.split("\n"):
        if SECTION.match(line):
            break
        prose.append(line if not line.startswith("    ") else "")
    return re.split(r"(?<=[.!?])\s+|\n\n", "\n".join(prose).strip())


def test_no_sentence_of_a_docstring_hides_its_subject():
    bad = [
        f"{name}:{line}: {sentence}"
        for name, tree in modules()
        for line, text in docstrings(tree)
        for sentence in sentences(text)
        if re.match(FORBIDDEN, sentence.strip())
    ]
    assert bad == []


def test_no_argument_is_described_without_a_subject():
    entry = re.compile(rf"    [\w, ]+: (?:{FORBIDDEN})", re.IGNORECASE)
    bad = [
        f"{name}:{line}: {each.strip()}"
        for name, tree in modules()
        for line, text in docstrings(tree)
        for each in text.split("\n")
        if entry.match(each)
    ]
    assert bad == []


def test_a_constant_has_a_docstring_of_its_own():
    bad = [
        f"{name}:{text.lineno}: {ast.unparse(before)}"
        for name, tree in modules()
        for before, text in constants(tree)
        if isinstance(before, ast.Assign)
        and (len(before.targets) > 1 or isinstance(before.value, ast.Tuple))
        and isinstance(before.targets[0], ast.Tuple)
    ]
    assert bad == []


def paragraphs(page: str) -> Iterator[str]:
    """Paragraphs and items of a page, without code, tables, figures, headings and directives."""
    page = re.sub(r"^(```|~~~).*?^\1", "", page, flags=re.M | re.S)
    for block in re.split(r"\n\s*\n|\n(?=[-*] |\d+\. )", page):
        lines = [
            line for line in block.strip().split("\n") if not line.startswith(("|", "#", "!["))
        ]
        text = re.sub(r"^([-*]|\d+\.) ", "", " ".join(line.strip() for line in lines))
        if text and not block.startswith("    "):
            yield plain(text)


def plain(text: str) -> str:
    """A text as a reader sees it: links and roles by their words, code as one word."""
    text = re.sub(r"\{\w+\}`[^`]*`|``[^`]+``|`[^`]*`", "CODE", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", lambda link: link[1] or "PAGE", text)
    return text.replace("*", "")


def parts(paragraph: str) -> list[str]:
    """Sentences of a paragraph of the guide; abbreviations end none."""
    return re.split(r"(?<=[.!?])[\"')]*\s+(?=[A-Z\[(\"'`$]|CODE)", paragraph)


def test_sentences_of_the_guide_are_short():
    long = [
        f"{page.name}: {len(sentence.split())}: {sentence}"
        for page in PAGES
        for paragraph in paragraphs(page.read_text(encoding="utf-8"))
        for sentence in parts(paragraph)
        if len(sentence.split()) > LONGEST
    ]
    assert long == []


def test_a_paragraph_of_the_guide_has_few_numbers():
    many = [
        f"{page.name}: {paragraph}"
        for page in PAGES
        for paragraph in paragraphs(page.read_text(encoding="utf-8"))
        if len(re.findall(r"(?<![\w.])(?<!e-)\d[\d.,]*", paragraph)) > NUMBERS
    ]
    assert many == []


@pytest.mark.parametrize("page", PAGES[1:], ids=lambda page: page.stem)
def test_a_page_of_the_guide_shows_something_and_leads_on(page: Path):
    text = page.read_text(encoding="utf-8")
    assert re.search(r"^(    \S|```|\||!\[)", text, flags=re.M), "no command, figure or table"
    assert re.search(r"^Next: ", text.rstrip().split("\n\n")[-1]), (
        "no last line with what comes next"
    )
