"""Claim: what is measured over ranks has the bits of one rank, and says what each rank took."""

import json
from pathlib import Path

import pytest

from bench.__main__ import main


@pytest.mark.slow
def test_two_ranks_have_the_bits_of_one(tmp_path: Path) -> None:
    assert main(["scale", "--device", "cpu", "--quick", "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "scale.json").read_text())
    assert {"date", "commit", "torch", "device"} <= set(content["environment"])
    rows = [row for rows in content["results"].values() for row in rows]
    assert [row["ranks"] for row in rows] == [1, 1, 2, 2, 1, 2]
    assert all(len(row["peak_bytes"]) == row["ranks"] and min(row["peak_bytes"]) > 0 for row in rows)
    assert [row["same_bits"] for row in rows] == [None, None, True, None, None, True]
    assert all(row["repeats"] for row in rows)
    assert "times one rank" in (tmp_path / "scale.md").read_text()


def test_without_a_gpu_it_only_tries_out() -> None:
    with pytest.raises(SystemExit, match="the CPU only tries the script out"):
        main(["scale", "--device", "cpu"])
