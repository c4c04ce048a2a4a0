"""Claim: `bench contact_motion` runs by groups, keeps what it watched, and knows free fall and free sliding."""

import json
from pathlib import Path

import pytest

from bench import contact_motion, report
from bench.__main__ import main
from bench.contact_motion_scenes import SURFACES, slide, slide_gradient


def test_two_groups_run_by_themselves_and_report_shows_them(tmp_path: Path) -> None:
    for name in ("fall", "spin"):
        assert main(["contact_motion", "--quick", "--only", name, "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "contact_motion.json").read_text())["results"]
    assert list(results) == ["spin", "fall"]  # as in a whole run; the second run keeps the first
    rows = [row for group in results.values() for row in group["rows"]]
    assert len(rows) == 3
    for row in rows:
        assert row["error"] is None and row["crossings"] == row["nonfinite"] == 0 < row["ms_per_step"]
    assert all(row["met"] for row in results["fall"]["rows"])
    assert results["spin"]["rows"][0]["met"] and 0 < results["spin"]["rows"][0]["reference"] < 1
    page = report.results_pages(tmp_path, tmp_path / "images")["contact_motion"]
    assert page.startswith("# contact_motion\n") and "a lone box" in page


def test_a_floor_lets_a_block_slide_as_coulomb_says() -> None:
    assert slide(SURFACES[0], sweeps=100, speed=2.0)["met"]
    slope, newton = slide_gradient(SURFACES[0])
    assert slope["met"] and slope["value"] > 0 and newton["met"]


def test_what_is_unknown_is_refused() -> None:
    with pytest.raises(ValueError, match="only: expected groups among sheet, .*, got nothing"):
        contact_motion.run(True, only="fall,nothing")
    with pytest.raises(ValueError, match="surface: expected one of FloorBarrier, .*, got ice"):
        slide("ice")
