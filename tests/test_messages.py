"""Claim: what a message or a docstring tells a user to read is in the wheel, too."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.paths import PACKAGE, ROOT

from diffvbd import said

PAGES = {path.name for path in (ROOT / "docs").glob("*.md")}  # setup.py ships these, .ci/wheels.py looks for them
ABSENT = re.compile(r"\b(?:docs|tests|bench|examples)/|\b\w+\.(?:md|rst|ipynb)\b|\bMakefile\b|\bREADME\b")
FILES = sorted(PACKAGE.rglob("*.py"))


def docstrings(tree: ast.AST) -> Iterator[ast.Constant]:
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node) is not None:
            first = node.body[0]
            assert isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
            yield first.value


def messages(tree: ast.AST) -> Iterator[str]:
    """Literal texts that are neither docstrings nor arguments of page()."""
    other = {id(node) for node in docstrings(tree)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "page":
            other |= {id(argument) for argument in node.args}
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in other:
            yield node.value


def pages(tree: ast.AST) -> set[str]:
    """Pages that calls of page() and docstrings name."""
    found = {m for node in docstrings(tree) for m in re.findall(r"\bdocs/([\w/-]*(?:\.md)?)", str(node.value))}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "page":
            (argument,) = node.args
            assert isinstance(argument, ast.Constant), "page() takes a literal, which this test can read"
            found.add(str(argument.value))
    return found


def test_names_of_files_are_found() -> None:
    tree = ast.parse('"""docs/a.md says."""\nwarn("too few (docs/b.md)")\nwarn(f"{x}; " + page("c.md"))')
    assert [text for text in messages(tree) if ABSENT.search(text)] == ["too few (docs/b.md)"]
    assert pages(tree) == {"a.md", "c.md"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_what_is_named_is_in_the_wheel(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert [text for text in messages(tree) if ABSENT.search(text)] == [], "take said.page()"
    assert pages(tree) <= PAGES


def test_a_message_says_where_its_page_is() -> None:
    where = Path(said.page("numerics.md").removeprefix("see "))
    assert where.read_text(encoding="utf-8").startswith("# ")
