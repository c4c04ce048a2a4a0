"""Claim: every instruction set that the CPU kernels are compiled for gives the same bits."""

import os
import subprocess
import sys

SCRIPT = """
import torch
import diffvbd as dv
from bench.bits import of_case
for dtype in (torch.float64, torch.float32):
    for name in ("plain", "paper", "floor_corner", "free_anchored"):
        print(of_case(name, "cpu", dtype))
"""


def hashes(name: str | None) -> str:
    environment = {key: value for key, value in os.environ.items() if key != "DIFFVBD_ISA"}
    if name is not None:
        environment["DIFFVBD_ISA"] = name
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True)
    if done.returncode and "DIFFVBD_ISA: expected" in done.stderr:
        return ""
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_the_same_bits() -> None:
    newest = hashes(None)
    assert len(set(newest.split())) == 8
    assert hashes("baseline") == newest
    assert hashes("v3") in (newest, "")  # an older processor, or a build without it


def test_an_unknown_set_is_refused() -> None:
    assert hashes("v9") == ""
