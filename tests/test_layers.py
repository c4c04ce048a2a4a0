"""Claim: each part of the package knows only those below it, and nothing imports in a circle: by file or by folder,
lazy and type-only imports included. The order is that of docs and of `csrc`; a new part takes its place in it."""

import ast
import re
from pathlib import Path

import pytest
from helpers.paths import CSRC, PACKAGE, needs_csrc

# Lowest first. A file beside the folders is a part of one file; "" is the package's own __init__.
PYTHON = (
    "_version", "_common", "distributed", "energies", "laws", "mesh", "reference", "ops", "embedding", "couplings",
    "_contact", "model", "adjoint",
    "step", "rollout", "inspect", "contact", "results", "colliders", "robots", "solvers", "losses", "viz", "testing",
    "", "envs", "tasks", "cli", "__main__",
)  # fmt: skip
CPP = ("core", "energies", "sweep", "contact", "subspace", "cpu", "cuda", "bind")


def name_of(path: Path) -> str:
    """'mesh.io' for diffvbd/mesh/io.py, '' for the package itself."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").removesuffix(".")


FILES = {name_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def imports_of(name: str) -> set[str]:
    """Files of the package that a file imports, wherever in it the import stands."""
    path, found = FILES[name], set()
    package = ["diffvbd", *path.relative_to(PACKAGE).parent.parts]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{base}.{alias.name}" for alias in node.names}
    names = set()
    for full in found:
        parts = full.split(".")
        if parts[0] == "diffvbd":
            while ".".join(parts[1:]) not in FILES:
                parts.pop()
            names.add(".".join(parts[1:]))
    return names - {name}


def circle(arrows: set[tuple[str, str]]) -> set[str]:
    """Everything that lies on a circle, or between two."""
    while True:
        sources, targets = {a for a, _ in arrows}, {b for _, b in arrows}
        inner = {(a, b) for a, b in arrows if a in targets and b in sources}
        if inner == arrows:
            return sources
        arrows = inner


ARROWS = {(name, other) for name in FILES for other in imports_of(name)}


def test_parts_of_the_package_import_only_what_lies_below() -> None:
    assert {name.split(".")[0] for name in FILES} == set(PYTHON) and len(ARROWS) > 200
    floor = {name: PYTHON.index(name.split(".")[0]) for name in FILES}
    assert not {(a, b) for a, b in ARROWS if floor[b] > floor[a]}


def test_no_files_import_each_other_in_a_circle() -> None:
    assert not circle(ARROWS)
    assert circle({("a", "b"), ("b", "c"), ("c", "b")}) == {"b", "c"}


@pytest.mark.parametrize("part", ["mesh", "reference"])
def test_parts_that_stand_alone(part: str) -> None:
    """The reference checks the rest and shares nothing with it; meshes are of use without torch."""
    assert {b.split(".")[0] for a, b in ARROWS if a.split(".")[0] == part} == {part}


def test_only_ops_names_the_compiled_operators() -> None:
    named = {n for n, path in FILES.items() if re.search(r"\btorch\.ops\b|\btorch\.library\b", path.read_text())}
    assert named and {n.split(".")[0] for n in named} == {"ops"}


@needs_csrc
def test_headers_and_sources_include_only_what_lies_below() -> None:
    paths = {p.relative_to(CSRC).as_posix(): p for p in CSRC.rglob("*") if p.suffix in (".h", ".cpp", ".cu", ".cuh")}
    arrows = set()
    for path, file in paths.items():
        for name in re.findall(r'^\s*#\s*include\s*[<"]([^>"]+)[>"]', file.read_text(), re.MULTILINE):
            target = (file.parent / name).resolve()
            if CSRC.resolve() in target.parents:
                arrows.add((path, target.relative_to(CSRC.resolve()).as_posix()))
            outside = path.startswith(("bind/", "cpu/"))  # all else is compiled without torch
            assert outside or not re.match(r"torch|ATen|c10|Python\.h", name), f"{path} includes {name}"
    assert len(arrows) > 100 and not circle(arrows)
    for path, target in arrows:
        upper, lower = path.split("/")[0], target.split("/")[0]
        assert CPP.index(lower) <= CPP.index(upper), f"{path} includes {target}"
        assert {upper, lower} != {"cpu", "cuda"}, f"{path} includes {target}"
