"""`python -m bench report`: what pages in the repository show of bench/results. The site's build makes the other
tables.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench import paper, tradeoff
from bench.common import RESULTS, ROOT, commit, is_ancestor

BEGIN, END = "<!-- figures: begin, written by python -m bench report -->", "<!-- figures: end -->"
RESULTS_PAGE = ROOT / "docs" / "results.md"  # between its markers


def main() -> int:
    """Fills the pages, if every result says what it was measured on."""
    if wrong := refused(RESULTS):
        print("\n".join([*wrong, "nothing written: measure these again on a clean commit"]), file=sys.stderr)
        return 1
    page = RESULTS_PAGE.read_text(encoding="utf-8")
    RESULTS_PAGE.write_text(filled(page, paper.beside(RESULTS)), encoding="utf-8")
    for path in sorted(RESULTS.glob("tradeoff*.json")):
        results = json.loads(path.read_text(encoding="utf-8"))["results"]
        tradeoff.draw(results, ROOT / "docs" / "images" / f"results_{path.stem}.png")
    print(f"wrote {RESULTS_PAGE.relative_to(ROOT)}")
    return 0


def filled(page: str, text: str) -> str:
    """`page` with `text` between the markers."""
    pattern = re.escape(BEGIN) + ".*?" + re.escape(END)
    if len(re.findall(pattern, page, re.DOTALL)) != 1:
        raise ValueError(f"page: expected one pair of markers {BEGIN} ... {END}")
    return re.sub(pattern, lambda _: f"{BEGIN}\n\n{text}\n{END}", page, flags=re.DOTALL)


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
