"""Claim: every instruction set that the CPU kernels are compiled for gives the same bits."""

import functools
import os
import subprocess
import sys

import pytest

SETS = ("newest", "baseline", "v3", "v9")
# Other packages are loaded once, which takes seconds; the set is chosen where each child process loads the kernels.
SCRIPT = """
import os, sys, warnings, meshio, torch, torch._dynamo
os.environ.pop("DIFFVBD_ISA", None)
for name in sys.argv[1:]:
    print("set", name, flush=True)
    assert "diffvbd" not in sys.modules
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of threads, which numpy may have started and no import waits for
        child = os.fork()
    if child == 0:
        if name != "newest":
            os.environ["DIFFVBD_ISA"] = name
        try:
            from bench.bits import of_case
            for dtype in (torch.float64, torch.float32):
                for case in ("plain", "paper", "floor_corner", "free_anchored"):
                    print(of_case(case, "cpu", dtype), flush=True)
        except Exception as error:
            print("refused" if "DIFFVBD_ISA: expected" in str(error) else repr(error), flush=True)
        os._exit(0)
    assert os.wait()[1] == 0
"""


@functools.cache
def hashes() -> dict[str, list[str]]:
    """What each set prints: hashes, "refused" where this processor or build lacks it, or what went wrong."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", SCRIPT, *SETS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    parts = [part.split() for part in done.stdout.split("set ")[1:]]
    return {name: lines for name, *lines in parts}


@pytest.mark.slow
def test_the_same_bits() -> None:
    found = hashes()
    newest = found["newest"]
    assert len(newest) == len(set(newest)) == 8
    assert found["baseline"] == newest
    assert found["v3"] in (newest, ["refused"])  # an older processor, or a build without it


def test_an_unknown_set_is_refused() -> None:
    assert hashes()["v9"] == ["refused"]
