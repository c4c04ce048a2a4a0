"""`python -m bench report`: every result of bench/results as a page in docs/results, logs of inverse problems as
docs/tasks.md, and figures into docs/performance.md, docs/guides/choose-settings.md and docs/gallery.md."""

from __future__ import annotations

import importlib
import inspect
import json
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bench import paper, plots, tasks, tradeoff
from bench.common import RESULTS, commit, is_ancestor, markdown_table, place

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "performance.md"
RESULTS_PAGES = ROOT / "docs" / "results"
CHOOSING_PAGE = ROOT / "docs" / "guides" / "choose-settings.md"
GALLERY_PAGE = ROOT / "docs" / "gallery.md"
TASKS_PAGE = ROOT / "docs" / "tasks.md"
BENCHMARKS = ("cpu", "gpu", "kernels")  # whose figures docs/performance.md shows, in this order
ORDER = ("exactness", "ablation", "cost", "fd", "generality")  # the paper's come first, the others by name
BEGIN, END = "<!-- figures: begin, written by python -m bench report -->", "<!-- figures: end -->"
EMPTY = "No figures yet: run `python -m bench cpu` or `python -m bench gpu`, then `python -m bench report`.\n"

INTRODUCTION = """\
# Results

Every measurement of `bench/`, a page for each benchmark. `python -m bench report` writes these pages from the JSON
files in `bench/results`; no figure here was typed by hand.

    python -m bench NAME                 # measure one again
    python -m bench all                  # all of them
    python -m bench NAME --device cuda   # on a GPU
    python -m bench NAME --quick --out X # try a script out in seconds

Where the paper states a figure for the same quantity, it is shown beside ours. Its scenes, meshes and machines differ,
as the text of each table says.

Results are as old as their date and commit in this table say, and each page repeats them. The code has changed since:
`git rev-list --count COMMIT..HEAD` counts by how many commits. Measure again what you rely on.
"""


def main(out: Path | None = None) -> int:
    """Fills the pages, if every result says what it was measured on; with a folder, makes pages there of the results
    in it, whatever they were measured on, and leaves docs alone."""
    if out is not None:
        write_pages(results_pages(out, out / "images"), out / "results")
        print(f"wrote {out / 'results'}")
        return 0
    if wrong := refused(RESULTS):
        print("\n".join([*wrong, "nothing written: measure these again on a clean commit"]), file=sys.stderr)
        return 1
    write_pages(results_pages(RESULTS, ROOT / "docs" / "images"), RESULTS_PAGES)
    TASKS_PAGE.write_text(tasks.page(RESULTS / "tasks", tasks.IMAGES, ROOT / "docs"), encoding="utf-8")
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), section(RESULTS)), encoding="utf-8")
    CHOOSING_PAGE.write_text(filled(CHOOSING_PAGE.read_text(encoding="utf-8"), fronts(RESULTS)), encoding="utf-8")
    cards = tasks.gallery(RESULTS / "tasks")
    GALLERY_PAGE.write_text(filled(GALLERY_PAGE.read_text(encoding="utf-8"), cards), encoding="utf-8")
    for page in (RESULTS_PAGES, TASKS_PAGE, PAGE, CHOOSING_PAGE, GALLERY_PAGE):
        print(f"wrote {page.relative_to(ROOT)}")
    return 0


# --- provenance -------------------------------------------------------------------------------------------------------


def refused(results: Path, is_ancestor: Callable[[str], bool] = is_ancestor) -> list[str]:
    """A line for each result that cannot be measured again: its file, its commit, and what is wrong with that."""
    lines = []
    paths = {path.relative_to(results).as_posix(): path for path in results.glob("**/*.json")}
    for name, path in sorted(paths.items()):
        for group, origin in origins(json.loads(path.read_text(encoding="utf-8"))).items():
            if reason := why_refused(origin, is_ancestor):
                lines.append(f"{name}{group}: commit {commit(origin)}: {reason}")
    return lines


def origins(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What a file says of its commit: one for all, and one for each group that was measured by itself (`--only`)."""
    groups = content.get("results")
    groups = groups if isinstance(groups, dict) else {}
    own = {f", {name}": group for name, group in groups.items() if isinstance(group, dict) and "commit" in group}
    return {"": content.get("environment", {}), **own}


def why_refused(environment: dict[str, Any], is_ancestor: Callable[[str], bool]) -> str:
    """What is wrong with the commit of a result, or an empty string. A machine without history (`dirty` is None) is
    believed; it was told its commit by DIFFVBD_COMMIT."""
    known = environment.get("commit")
    if not known:
        return "expected the commit that was measured, got none"
    if environment.get("dirty"):
        return "expected a clean commit, got one with changes that were not committed"
    if not is_ancestor(known):
        return "expected an ancestor of HEAD in the history of this repository"
    return ""


# --- docs/performance.md ----------------------------------------------------------------------------------------------


def filled(page: str, text: str) -> str:
    """`page` with `text` between the markers."""
    pattern = re.escape(BEGIN) + ".*?" + re.escape(END)
    if len(re.findall(pattern, page, re.DOTALL)) != 1:
        raise ValueError(f"page: expected one pair of markers {BEGIN} ... {END}")
    return re.sub(pattern, lambda _: f"{BEGIN}\n\n{text}\n{END}", page, flags=re.DOTALL)


def section(results: Path) -> str:
    """Machine and tables of each benchmark that has results in a folder, as the benchmark itself writes them."""
    parts = []
    for name in BENCHMARKS:
        path = results / f"{name}.json"
        if path.exists():
            content = json.loads(path.read_text(encoding="utf-8"))
            tables = importlib.import_module(f"bench.{name}").markdown(content["results"])
            e = content["environment"]
            parts.append(f"{machine(e)} Commit {commit(e)}.\n\n{tables}")
    return "\n".join(parts) or EMPTY


def fronts(results: Path) -> str:
    """Machine and table of the fastest way to an error in each scene, on each device that was measured."""
    parts = []
    for path in sorted(results.glob("tradeoff*.json"), key=lambda path: len(path.stem)):
        content = json.loads(path.read_text(encoding="utf-8"))
        parts.append(machine(content["environment"]) + "\n\n" + tradeoff.summary(content["results"]))
    return "\n".join(parts) or EMPTY


def machine(environment: dict[str, Any]) -> str:
    """One line on where and with what a benchmark ran."""
    known = {key: value for key, value in environment.items() if value is not None}
    where = f"{place(environment)}, {known.get('cores', '?')} cores"
    if known.get("device", "cpu") != "cpu":
        where = f"{known['device']}, driver {known.get('driver', 'unknown')}"
    versions = ", ".join(f"{key} {known[key]}" for key in ("python", "torch", "cuda", "diffvbd") if key in known)
    return f"{where}; {versions}; {known.get('date', 'no date')}."


# --- docs/results -----------------------------------------------------------------------------------------------------


def results_pages(results: Path, images: Path) -> dict[str, str]:
    """The pages of all results in a folder by their names: an index, and one for each benchmark. Their plots are
    written to `images`, a folder beside that of the pages."""
    found = harvest(results)
    header = ("benchmark", "on", "torch", "date", "commit", "run")
    rows = []
    for name, stem, content in found:
        e = content["environment"]
        run = "quick" if content.get("quick") else "full"
        rows.append((f"[{stem}]({name}.md)", place(e), e.get("torch"), e.get("date"), commit(e), run))
    parts = [INTRODUCTION, markdown_table(header, rows), paper.beside(results)] if rows else [INTRODUCTION, EMPTY]
    pages = {"index": parts}
    for name, stem, content in found:
        if name not in pages:
            module = importlib.import_module(f"bench.{name}")
            pages[name] = [f"# {name}\n\n{inspect.cleandoc(module.__doc__ or '')}\n"]
        pages[name] += result(name, stem, content, images)
    return {name: "\n".join(part for part in parts if part).rstrip() + "\n" for name, parts in pages.items()}


def result(name: str, stem: str, content: dict[str, Any], images: Path) -> list[str]:
    """Machine, plot and tables of one file of results."""
    e = content["environment"]
    parts = [f"## {stem}, on {place(e)}\n\n{machine(e)} Commit {commit(e)}.\n"]
    if name in BENCHMARKS:
        return [*parts, "Its tables stand in [performance](../performance.md#figures).\n"]
    try:
        if plots.draw(name, content["results"], images / f"results_{stem}.png"):
            parts.append(f"![{plots.CAPTIONS[name]}](../{images.name}/results_{stem}.png)\n")
        tables = importlib.import_module(f"bench.{name}").markdown(content["results"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"{stem}.json: expected results of the present bench.{name}, got older ones; run it "
                         "again") from error  # fmt: skip
    # the page has two levels of its own above those of a benchmark, which begin at the second
    return [*parts, re.sub(r"^#", "##", tables, flags=re.MULTILINE)]


def write_pages(pages: Mapping[str, str], folder: Path) -> None:
    """Writes the pages and removes those of results that are gone."""
    folder.mkdir(parents=True, exist_ok=True)
    for page in folder.glob("*.md"):
        if page.stem not in pages:
            page.unlink()
    for name, text in pages.items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")


def harvest(results: Path) -> list[tuple[str, str, dict[str, Any]]]:
    """(benchmark, file without its ending, content) of each result, the paper's first, the CPU's before a GPU's."""
    found = []
    for path in sorted(results.glob("*.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        name = content.get("name")
        if name and "results" in content and (Path(__file__).parent / f"{name}.py").exists():
            found.append((name, path.stem, content))
    return sorted(found, key=lambda entry: (ORDER.index(entry[0]) if entry[0] in ORDER else len(ORDER), *entry[:2]))
