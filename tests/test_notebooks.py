"""Claim: the tutorials are stored without outputs, small and portable, all are in the navigation and assert what their
text says, and the first of them finds it."""

import importlib.util
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from helpers.paths import ROOT

from diffvbd.testing import tolerance

FOLDER = ROOT / "docs" / "tutorials"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LONGEST_CELL = 25  # lines
LARGEST = 40_000  # bytes

notebooks = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def source(cell: dict[str, Any]) -> str:
    return "".join(cell["source"])


def faults(notebook: dict[str, Any]) -> list[str]:
    """What a notebook must not have, in words."""
    found = []
    metadata = notebook["metadata"]
    if metadata.get("kernelspec", {}).get("name") != "python3":
        found.append("kernel: expected python3")
    if extra := set(metadata) - {"kernelspec", "language_info"} | set(metadata.get("language_info", {})) - {"name"}:
        found.append(f"metadata of a machine or an editor: {sorted(extra)}")
    for cell in notebook["cells"]:
        start = source(cell)[:40]
        if set(cell["metadata"]) - {"tags"}:
            found.append(f"metadata of a cell: {start}")
        if cell["cell_type"] != "code":
            continue
        if cell["outputs"] or cell["execution_count"] is not None:
            found.append(f"stored outputs or an execution count: {start}")
        if source(cell).count("\n") >= LONGEST_CELL:
            found.append(f"more than {LONGEST_CELL} lines: {start}")
    return found


def test_faults_are_found() -> None:
    cell = {
        "cell_type": "code",
        "metadata": {"scrolled": True},
        "execution_count": 3,
        "outputs": [],
        "source": "1\n" * 25,
    }
    bad = {"metadata": {"language_info": {"name": "python", "version": "3.11"}}, "cells": [cell]}
    assert len(faults(bad)) == 5


@notebooks
def test_nothing_is_stored_but_text_and_code(path: Path) -> None:
    assert faults(read(path)) == [], "clear all outputs before you commit"
    assert path.stat().st_size <= LARGEST


@notebooks
def test_text_is_asserted_and_no_fallback_is_silent(path: Path) -> None:
    code = [source(cell) for cell in read(path)["cells"] if cell["cell_type"] == "code"]
    assert sum("\nassert " in f"\n{text}" or "\n    assert " in text for text in code) >= 2
    for text in code:
        for handler in text.split("except ")[1:]:
            assert "print(" in re.split(r"\n(?=\S)", handler)[0], f"silent fallback: {handler}"


@notebooks
def test_links_lead_somewhere(path: Path) -> None:
    text = "\n".join(source(cell) for cell in read(path)["cells"] if cell["cell_type"] == "markdown")
    for target in re.findall(r"\]\(([^)\s#]+)[^)]*\)", text):
        assert re.match(r"[a-z]+:", target) or (FOLDER / target).exists(), f"{path.name} links to {target}"


def test_all_are_in_the_navigation() -> None:
    page = (FOLDER / "index.md").read_text(encoding="utf-8")
    toctree = re.findall(r"^```\{toctree\}.*?^```$", page, re.MULTILINE | re.DOTALL)[0]
    assert NOTEBOOKS and set(re.findall(r"^([\w-]+)$", toctree, re.MULTILINE)) == {path.stem for path in NOTEBOOKS}
    assert all(f"]({path.name})" in page for path in NOTEBOOKS)


def test_the_site_links_to_their_files() -> None:
    """By the first cell of each and by the page that lists them; code stays as it is."""
    spec = importlib.util.spec_from_file_location("conf", ROOT / "docs" / "conf.py")
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(conf := importlib.util.module_from_spec(spec))
    for path in NOTEBOOKS:
        shown = [path.read_text(encoding="utf-8")]
        conf.adapt(None, f"tutorials/{path.stem}", shown)
        first, *others = json.loads(shown[0])["cells"]
        assert f"{{download}}`Download this notebook <{path.name}>`" in source(first).splitlines()
        assert others == read(path)["cells"][1:]
    page = [(FOLDER / "index.md").read_text(encoding="utf-8")]
    conf.adapt(None, "tutorials/index", page)
    assert all(f"({{download}}`notebook <{path.name}>`)" in page[0] for path in NOTEBOOKS)


@pytest.mark.slow
def test_the_quickstart_finds_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        import ipykernel  # noqa: F401
        import nbclient
        import nbformat
    except ModuleNotFoundError as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(f"needs {error.name}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # the kernel imports the package of this checkout
    notebook = nbformat.read(FOLDER / "quickstart.ipynb", as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    ).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    printed = "".join(output.text for output in outputs if output.output_type == "stream")
    found = re.search(r"evaluations: (\S+) Pa, true (\S+) Pa", printed)
    assert found, printed
    assert float(found[1]) == pytest.approx(float(found[2]), rel=tolerance("identified_by_example"))
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 3
