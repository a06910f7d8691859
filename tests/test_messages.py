"""The first line of what users are told is short."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from lfrtorch._support.tables import WIDEST, in_lines

PACKAGE = Path(__file__).resolve().parents[1] / "lfrtorch"

FILLED = "______"
"""Stands for what a message is filled with: a number, a name."""

FIELD = re.compile(r"\{\w[\w.\[\]]*(:[^{}]*)?\}")
"""What is filled in a sentence of a table."""


def text(node: ast.AST) -> str:
    """The longest that an expression may say."""
    match node:
        case ast.Constant(value=str(value)):
            return FIELD.sub(FILLED, value)
        case ast.JoinedStr(values=values):
            return "".join(map(text, values))
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return text(left) + text(right)
        case ast.IfExp(body=body, orelse=orelse):
            return max(text(body), text(orelse), key=len)
    return FILLED


def said(tree: ast.AST) -> Iterator[str]:
    """All texts of a module but the docstrings, and what becomes part of one."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            continue
        if getattr(getattr(node, "func", None), "id", "") == "setting":
            continue
        if isinstance(node, ast.JoinedStr | ast.BinOp) or (
            isinstance(node, ast.Constant) and isinstance(node.value, str)
        ):
            yield text(node)
        else:
            yield from said(node)


def test_messages_are_short():
    long = [
        f"{path.name}: {each}"
        for path in PACKAGE.rglob("*.py")
        for each in said(ast.parse(path.read_text(encoding="utf-8")))
        if len(each.split("\n")[0]) > WIDEST
    ]
    assert long == []


@pytest.mark.parametrize("length", [20, WIDEST, 500])
def test_a_message_that_names_many_things_has_more_lines(length: int):
    message = "note: " + ", ".join("abc" for _ in range(length // 5))
    first, *more = in_lines(message).split("\n")
    assert len(first) <= WIDEST
    assert bool(more) is (len(message) > WIDEST)
    assert " ".join([first, *(line.strip() for line in more)]) == message
    assert in_lines(f"a\n{message}") == f"a\n{message}"  # a table
