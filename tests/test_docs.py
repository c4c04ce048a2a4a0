"""Documentation is true: its examples run, its quotes stand in the sources, its links lead somewhere."""

import importlib.util
import inspect
import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.paths import ROOT

import diffvbd as dv
from diffvbd.testing import tolerance

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NOTEBOOKS = sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))
FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# How a docstring states the shape of an array: "shape [...]", a bracket of sizes, or by reference to another function.
SHAPE = re.compile(r"shape|\[[^\]]*\b(V|T|F|P|N|B|3)\b[^\]]*\]|[Aa]s in ")
ARRAYS = {"points", "tets", "body", "triangles", "surface", "offsets", "frames", "low", "high", "pinned", "density"}

pages = pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())


def fences(page: Path) -> list[tuple[str, str]]:
    """Info string and content of each fenced block."""
    return [(info.strip(), text) for info, text in FENCE.findall(page.read_text(encoding="utf-8"))]


def slug(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pages
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
        options = {"steps": 20, "mu": mu, "lam": 2e5, "time_step": 0.01, "sweeps": 40}
        return dv.rollout(names["model"], names["x"], names["v"], **options).x[-1, :, 1].mean()

    mu = names["mu"].detach()
    assert torch.equal(height(mu), names["height"])
    step = 1e-3 * mu
    difference = (height(mu + step) - height(mu - step)) / (2 * step)
    assert mu.grad is None and names["mu"].grad > 0
    assert names["mu"].grad.item() == pytest.approx(difference.item(), rel=tolerance("finite_difference"))


@pages
def test_quotes_stand_in_the_sources(page: Path) -> None:
    for info, text in fences(page):
        source = re.search(r"from=(\S+)", info)
        if source is None:
            continue
        content = (ROOT / source[1]).read_text(encoding="utf-8")
        at = 0
        for piece in text.split("\n...\n"):
            found = content.find(piece.strip("\n"), at)
            assert found >= 0, f"{page.name} quotes what {source[1]} does not say:\n{piece}"
            at = found


def prose(page: Path) -> str:
    """A page, or the Markdown cells of a notebook, without programs."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        text = "\n\n".join("".join(c["source"]) for c in json.loads(text)["cells"] if c["cell_type"] == "markdown")
    return FENCE.sub("", text)


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_line_is_lost(page: Path) -> None:
    """Where a paragraph is wrapped before a per cent or a plus, MyST takes the line for a comment or a list."""
    assert re.findall(r"^ *(?:%|\+ ).*$", prose(page), re.MULTILINE) == []


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


def test_broken_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# Other page\n\n```bash\n# a comment\n```\n")
    good = ["other.md", "other.md#other-page", "#here", "https://example.org/none"]
    bad = ["none.md", "other.md#none", "other.md#a-comment", "#none", "none.webp"]
    page = tmp_path / "page.md"
    page.write_text("# Here\n\n" + "\n".join(f"[text]({target})" for target in [*good, *bad]) + "\n:link: nowhere\n")
    assert broken_links(page) == [*bad, "nowhere.md"]


@pytest.mark.parametrize(
    ("prefix", "module", "name"),
    [
        ("dv", dv, n)
        for n in dv.__all__
        if n
        not in (
            "acceleration",
            "coarse",
            "colliders",
            "contact",
            "distributed",
            "integrators",
            "mesh",
            "solvers",
            "viz",
        )
    ]
    + [("dv.coarse", dv.coarse, n) for n in dv.coarse.__all__]
    + [("dv.colliders", dv.colliders, n) for n in dv.colliders.__all__]
    + [("dv.contact", dv.contact, n) for n in dv.contact.__all__]
    + [("dv.distributed", dv.distributed, n) for n in dv.distributed.__all__]
    + [("dv.mesh", dv.mesh, n) for n in dv.mesh.__all__]
    + [("dv.solvers", dv.solvers, n) for n in dv.solvers.__all__]
    + [("dv.viz", dv.viz, n) for n in ("Viewer", "live", "render")],
)
def test_public_names_are_documented(prefix: str, module: Any, name: str) -> None:
    value = getattr(module, name)
    doc = inspect.getdoc(value)
    assert doc, f"{prefix}.{name} has no docstring"
    overview = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    assert re.search(rf"\b{re.escape(prefix)}\.{name}\b", overview), f"docs/api.md does not mention {prefix}.{name}"
    parameters = inspect.signature(value).parameters
    takes_arrays = any("Tensor" in str(p.annotation) or key in ARRAYS for key, p in parameters.items())
    assert not takes_arrays or SHAPE.search(doc), f"{prefix}.{name} takes arrays; its docstring states no shape"


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


@pytest.mark.parametrize("kind", [dv.Model, dv.TetMesh], ids=lambda kind: kind.__name__)
def test_public_methods_are_documented(kind: type) -> None:
    own = {name: value for name, value in vars(kind).items() if not name.startswith("_")}
    obvious = {"num_vertices", "num_tets", "num_colors"}
    bare = [
        name
        for name, value in own.items()
        if name not in obvious and (callable(value) or isinstance(value, (property, classmethod))) and not value.__doc__
    ]
    assert not bare, f"{kind.__name__}: no docstring on {bare}"


def test_report_writes_figures_between_its_markers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))  # bench is a folder of the repository and no part of the package
    report, cpu = importlib.import_module("bench.report"), importlib.import_module("bench.cpu")
    assert report.section(tmp_path) == report.EMPTY
    monkeypatch.setattr(cpu, "markdown", lambda results: f"| forward | {results['forward']} |\n")
    (tmp_path / "cpu.json").write_text(json.dumps({"environment": {"cpu": "some"}, "results": {"forward": 8.25}}))
    (tmp_path / "other.json").write_text("{}")
    text = report.section(tmp_path)
    assert text.startswith("some, ") and "| forward | 8.25 |" in text
    once = report.filled(report.PAGE.read_text(encoding="utf-8"), text)
    assert text in once and report.filled(once, text) == once


def test_results_pages_show_the_results_that_are_there_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    report = importlib.import_module("bench.report")
    pages = {path.stem: path.read_text(encoding="utf-8") for path in report.RESULTS_PAGES.glob("*.md")}
    index = pages.pop("index")
    found = {stem: (name, content) for name, stem, content in report.harvest(report.RESULTS)}
    shown = [(name, stem) for name, text in pages.items() for stem in re.findall(r"^## (\S+), on ", text, re.MULTILINE)]
    assert found and len(shown) == len(set(shown))
    expected = {(name, stem) for stem, (name, _) in found.items()}
    assert set(shown) == expected, "not made of bench/results: run `python -m bench report`"
    assert set(pages) == {name for name, _ in expected}
    for stem, (name, content) in found.items():
        date = content["environment"]["date"]
        assert date in pages[name] and date in index, f"{stem}.json is newer: run `python -m bench report`"


def test_the_operators_of_a_backend_are_listed() -> None:
    text = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^\| for \| operators \|\n(.*?)\n\n", text, re.MULTILINE | re.DOTALL)
    listed: set[str] = set()
    for cell in re.split(r"[|;]", table):
        names = set(re.findall(r"`([a-z_]+)`", cell)) - {"_backward"}
        listed |= names | ({f"{name}_backward" for name in names} if "each with its `_backward`" in cell else set())
    schema = ROOT / "csrc" / "bind" / "schema.cpp"
    if not schema.exists():
        pytest.skip("the C++ sources are not here")
    text = schema.read_text(encoding="utf-8")
    defined = set(re.findall(r'"([a-z_]+)\(Tensor', text)) | set(re.findall(r'define\(m, "([a-z_]+)"', text))
    assert len(defined) > 20 and listed == defined - {"build_plan"}


def test_workflows_and_ci_call_targets_that_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    callers = [*(ROOT / ".github" / "workflows").glob("*.yml"), ROOT / ".ci" / "run"]
    called = [name for path in callers for name in re.findall(r"\bmake ([a-z-]+)", path.read_text(encoding="utf-8"))]
    assert {"docs", "lint", "test-all"} <= set(called) <= targets
