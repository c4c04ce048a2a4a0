"""`python -m bench.report` writes the figures of bench/results/*.json into docs/performance.md.

A file takes part if its results hold a list of rows with name, unit, value, target and note.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "performance.md"
RESULTS = ROOT / "bench" / "results"
BEGIN, END = "<!-- figures: begin, written by python -m bench.report -->", "<!-- figures: end -->"
EMPTY = "No figures yet: run `python -m bench cpu`, then `python -m bench.report`.\n"


def main() -> int:
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), section(RESULTS)), encoding="utf-8")
    print(f"wrote {PAGE.relative_to(ROOT)}")
    return 0


def filled(page: str, text: str) -> str:
    """`page` with `text` between the markers."""
    pattern = re.escape(BEGIN) + ".*?" + re.escape(END)
    if len(re.findall(pattern, page, re.DOTALL)) != 1:
        raise ValueError(f"page: expected one pair of markers {BEGIN} ... {END}")
    return re.sub(pattern, lambda _: f"{BEGIN}\n\n{text}\n{END}", page, flags=re.DOTALL)


def section(results: Path) -> str:
    """A heading, the machine and a table for each file of figures in a folder."""
    parts = []
    for path in sorted(results.glob("*.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        rows = figures(content.get("results") if isinstance(content, dict) else content)
        if rows:
            parts.append(f"### {path.stem}\n\n{_machine(content)}{table(rows)}")
    return "\n".join(parts) or EMPTY


def figures(results: Any) -> list[dict[str, Any]]:
    """The rows: `results` itself, or the first of its values that is a list of rows with name and value."""
    candidates = results.values() if isinstance(results, dict) else [results]
    for rows in candidates:
        if isinstance(rows, list) and rows and all(isinstance(r, dict) and {"name", "value"} <= r.keys() for r in rows):
            return rows
    return []


def table(rows: list[dict[str, Any]]) -> str:
    lines = ["| what | value | unit | target | note |", "| --- | ---: | --- | ---: | --- |"]
    for row in rows:
        cells = [_text(row.get(key)) for key in ("name", "value", "unit", "target", "note")]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _machine(content: Any) -> str:
    known = content.get("environment") if isinstance(content, dict) else None
    if not known:
        return ""
    shown = [str(known["cpu"])] if known.get("cpu") else []
    shown += [f"{known[key]} {key}" for key in ("cores", "threads") if known.get(key)]
    shown += [f"{key} {known[key]}" for key in ("python", "torch", "diffvbd") if known.get(key)]
    return ", ".join(shown) + f"; {known.get('date', 'no date')}.\n\n"


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.3g}" if 1e-3 <= abs(value) < 1e6 or value == 0 else f"{value:.2e}"
    return " ".join(str(value).split()).replace("|", "\\|")


if __name__ == "__main__":
    sys.exit(main())
