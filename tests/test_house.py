"""Claim: what tests share stands in tests/helpers alone, every tolerance in one table, with its reason, and named
tuples are changed by one helper."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.paths import PACKAGE, ROOT, TESTS

from diffvbd.testing.tolerances import TOLERANCE

FILES = sorted(TESTS.rglob("*.py"))
KEYWORDS = ("rtol", "atol", "rel", "abs")
LEAST = 0.01  # a bound from here on is a claim about what happens, not about digits


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def numbers(node: ast.AST) -> Iterator[ast.Constant]:
    """Literal floats of an expression, unless they are arguments of a call."""
    if isinstance(node, ast.Constant) and isinstance(node.value, float):
        yield node
    if not isinstance(node, ast.Call):
        for child in ast.iter_child_nodes(node):
            yield from numbers(child)


def literal_tolerances(tree: ast.Module) -> list[int]:
    """Lines where an assertion bounds something from above by a small literal, or a call gets one as a tolerance."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert):
            for compare in (n for n in ast.walk(node.test) if isinstance(n, ast.Compare)):
                sides = [compare.left, *compare.comparators]
                for left, operator, right in zip(sides, compare.ops, sides[1:], strict=False):
                    upper = right if isinstance(operator, (ast.Lt, ast.LtE)) else left
                    if isinstance(operator, (ast.Lt, ast.LtE, ast.Gt, ast.GtE)):
                        found |= {n.lineno for n in numbers(upper) if 0 < n.value < LEAST}
        if isinstance(node, ast.Call):
            given = [k.value for k in node.keywords if k.arg in KEYWORDS]
            found |= {n.lineno for value in given for n in numbers(value) if n.value != 0}
    return sorted(found)


def test_a_literal_tolerance_is_found() -> None:
    source = (
        "assert a <= 1e-12 * b\nassert 2e-3 > c\nassert c > 1e-3\nassert d == approx(1e-3, rel=0.1)\nassert e < f(1e-9)"
    )
    assert literal_tolerances(ast.parse(source)) == [1, 2, 4]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(TESTS).as_posix())
def test_tolerances_stand_in_the_table(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    assert [lines[n - 1].strip() for n in literal_tolerances(tree_of(path))] == []


def test_every_entry_of_the_table_has_a_reason_and_a_use() -> None:
    sources = [p.read_text(encoding="utf-8") for p in [*FILES, *PACKAGE.rglob("*.py"), *(ROOT / "bench").glob("*.py")]]
    used = set(re.findall(r'"(\w+)"', "\n".join(s for s in sources if "TOLERANCE: dict" not in s)))
    for name, (value, reason) in TOLERANCE.items():
        assert value > 0 and len(reason.split()) > 2, name
        assert name in used, name


def test_no_test_imports_another_and_names_are_unique() -> None:
    for path in FILES:
        for node in ast.walk(tree_of(path)):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [n for n in names if n.rpartition(".")[2].startswith("test_")], path
    # pytest imports each by its bare name
    assert not {name: count for name, count in Counter(p.name for p in FILES).items() if count > 1}


def test_helpers_say_what_they_are() -> None:
    helpers = [path for path in FILES if path.parent.name == "helpers"]
    assert len(helpers) >= 10 and all(ast.get_docstring(tree_of(path)) for path in helpers)
    assert all(path.parent.name == "helpers" or path.name.startswith(("test_", "conftest")) for path in FILES)


def test_named_tuples_are_changed_by_the_helper() -> None:
    """torch.compile of torch 2.11 cannot follow `_replace`; CI has a later one."""
    sources = [p for p in PACKAGE.rglob("*.py") if p.parent.name != "tasks"]
    assert [p.name for p in sources if "._replace(" in p.read_text(encoding="utf-8")] == ["tuples.py"]
