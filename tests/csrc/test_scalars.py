"""Claim: what an energy computes with, numbers, packs of lanes and Dual, has the same comparisons and assignments."""

import subprocess
from pathlib import Path

from helpers.compiler import cxx
from helpers.paths import CSRC, needs_csrc


@needs_csrc
def test_one_formula_of_every_scalar(tmp_path: Path) -> None:
    program, source = tmp_path / "scalars", Path(__file__).with_name("scalars.cpp")
    subprocess.run([*cxx(), "-std=c++17", "-w", f"-I{CSRC}", str(source), "-o", str(program)], check=True)
    found = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert found.split("\n")[:2] == ["10 10 10 10 7", "8 8 8 8 1"]
