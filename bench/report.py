"""`python -m bench.report` writes the figures of bench/results into docs/performance.md."""

from __future__ import annotations

import importlib
import json
import re
import sys
from pathlib import Path
from typing import Any

from bench.common import RESULTS

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "performance.md"
BENCHMARKS = ("cpu", "gpu")  # whose figures the page shows, in this order
BEGIN, END = "<!-- figures: begin, written by python -m bench.report -->", "<!-- figures: end -->"
EMPTY = "No figures yet: run `python -m bench cpu` or `python -m bench gpu`, then `python -m bench.report`.\n"


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
    """Machine and tables of each benchmark that has results in a folder, as the benchmark itself writes them."""
    parts = []
    for name in BENCHMARKS:
        path = results / f"{name}.json"
        if path.exists():
            content = json.loads(path.read_text(encoding="utf-8"))
            tables = importlib.import_module(f"bench.{name}").markdown(content["results"])
            parts.append(machine(content["environment"]) + "\n\n" + tables)
    return "\n".join(parts) or EMPTY


def machine(environment: dict[str, Any]) -> str:
    """One line on where and with what a benchmark ran."""
    known = {key: value for key, value in environment.items() if value is not None}
    where = f"{known.get('cpu', 'unknown processor')}, {known.get('cores', '?')} cores"
    if known.get("device", "cpu") != "cpu":
        where = f"{known['device']}, driver {known.get('driver', 'unknown')}"
    versions = ", ".join(f"{key} {known[key]}" for key in ("python", "torch", "cuda", "diffvbd") if key in known)
    return f"{where}; {versions}; {known.get('date', 'no date')}."


if __name__ == "__main__":
    sys.exit(main())
