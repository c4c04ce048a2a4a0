"""Claim: `bench contact_fuzz` draws scenes in which pairs hold vertices up, and nothing crosses in them."""

import json
from pathlib import Path

from bench.__main__ import main


def test_quick(tmp_path: Path) -> None:
    assert main(["contact_fuzz", "--quick", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "contact_fuzz.json").read_text())["results"]["rows"]
    assert sum(row["scene_steps"] for row in rows) >= 150
    assert all(row["crossings"] == row["nonfinite"] == 0 for row in rows)
    assert max(row["cut"] for row in rows) > 0.05
