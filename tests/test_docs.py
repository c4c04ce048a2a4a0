"""Documentation is true: its examples run, its quotes stand in the sources, its links lead somewhere."""

import importlib.util
import inspect
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.marks import quick_and_slow
from helpers.paths import ROOT

import diffvbd as dv
from diffvbd.testing import tolerance

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NOTEBOOKS = sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))
FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
pages = pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())


def fences(page: Path) -> list[tuple[str, str]]:
    """Info string and content of each fenced block."""
    return [(info.strip(), text) for info, text in FENCE.findall(page.read_text(encoding="utf-8"))]


def slug(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


# What a page computes may take a minute: those that everyone reads first are quick.
LENGTHY = ("performance", "attachments", "damping")
LONG = [page for page in PAGES if page.parent.name == "guides" or page.stem in LENGTHY]
QUICK = [page for page in PAGES if page not in LONG]


@pytest.mark.parametrize("page", quick_and_slow(QUICK, PAGES), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_examples_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "__docs__"}
    for info, text in fences(page):
        needs = re.fullmatch(r"python needs=(\w+)", info)  # an extra that `make` does not install
        if info == "python" or (needs and importlib.util.find_spec(needs[1])):
            exec(compile(text, str(page), "exec"), names)
    if page.name == "README.md":
        check_gradient(names)
    if page.name == "identify-a-material.md":
        assert names["log_mu"].exp().item() == pytest.approx(1.5e5, rel=tolerance("identified_by_example"))


def check_gradient(names: dict[str, Any]) -> None:
    """The gradient of the first example is that of differences, and of the sign that it says."""

    def height(mu: torch.Tensor) -> torch.Tensor:
        options = {"steps": 20, "mu": mu, "lam": 2e5, "solver": dv.VBD(0.01, 40)}
        return dv.rollout(names["model"], names["x"], names["v"], **options).x[-1, :, 1].mean()

    mu = names["mu"].detach()
    assert torch.equal(height(mu), names["height"])
    step = 1e-3 * mu
    difference = (height(mu + step) - height(mu - step)) / (2 * step)
    assert mu.grad is None and names["mu"].grad > 0
    assert names["mu"].grad.item() == pytest.approx(difference.item(), rel=tolerance("finite_difference"))


def prose(page: Path) -> str:
    """A page, or the Markdown cells of a notebook, without programs."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        text = "\n\n".join("".join(c["source"]) for c in json.loads(text)["cells"] if c["cell_type"] == "markdown")
    return FENCE.sub("", text)


def broken_links(page: Path) -> list[str]:
    """Targets of links, pictures and cards that are not there, or have no such heading."""
    text, broken = prose(page), []
    targets = re.findall(r"\]\(([^)\s]+)(?:\s[^)]*)?\)", text)
    for name in re.findall(r"^:link: (\S+)$", text, re.MULTILINE):  # a card names a page without its ending
        targets.append(f"{name}.ipynb" if (page.parent / f"{name}.ipynb").exists() else f"{name}.md")
    for target in targets:
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        if re.match(r"[a-z]+:", target):
            continue
        headings = re.findall(r"^#+ (.*)$", prose(file), re.MULTILINE) if file.exists() and anchor else []
        if not file.exists() or anchor and anchor not in map(slug, headings):
            broken.append(target)
    return broken


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    assert broken_links(page) == []


def test_every_public_name_is_in_the_reference() -> None:
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "reference").glob("*.md"))
    modules = set(re.findall(r"automodule:: (\S+)", pages))
    for name in dv.__all__:
        value = getattr(dv, name)
        if inspect.ismodule(value):
            listed = rf"automodule:: diffvbd\.{name}\b|module:: diffvbd\.{name}\b"
        else:
            listed = rf"auto(class|function):: diffvbd\.{name}$"
        assert re.search(listed, pages, re.MULTILINE), f"docs/reference does not list dv.{name}"
        if inspect.ismodule(value) and value.__name__ not in modules and f"diffvbd.{name}" not in modules:
            for member in value.__all__:
                assert re.search(rf"auto(class|function):: {member}$", pages, re.MULTILINE), f"dv.{name}.{member}"


def test_workflows_and_ci_call_targets_that_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    callers = [*(ROOT / ".github" / "workflows").glob("*.yml"), ROOT / ".ci" / "run"]
    called = [name for path in callers for name in re.findall(r"\bmake ([a-z-]+)", path.read_text(encoding="utf-8"))]
    assert {"docs", "lint", "test-all"} <= set(called) <= targets


# --- tutorials --------------------------------------------------------------------------------------------------------


FOLDER = ROOT / "docs" / "tutorials"


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
