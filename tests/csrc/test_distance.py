"""Claim: the derivative of a distance by the feature that values have chosen has the bits of one that chooses anew."""

import subprocess
from pathlib import Path

from helpers.compiler import cxx
from helpers.paths import CSRC, needs_csrc


@needs_csrc
def test_the_derivative_of_the_closest_feature(tmp_path: Path) -> None:
    program = tmp_path / "distance"
    source = Path(__file__).with_name("distance.cpp")
    flags = ["-std=c++17", "-O1", "-ffp-contract=off", "-w", f"-I{CSRC}"]
    subprocess.run([*cxx(), *flags, str(source), "-o", str(program)], check=True)
    *features, different, moving = map(
        int, subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    )
    point_triangle, edge_edge, plane = features[:5], features[5:10], features[10:]
    # inside a face, and the three edges around it; inside both edges, and the four ends; a plane has no end
    assert min(point_triangle[:4]) > 500 and point_triangle[4] == 0 and min(edge_edge) > 500
    assert plane == [20000, 0, 0, 0, 0]
    assert different == 0 and moving > 40000
