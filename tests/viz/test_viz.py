"""Claim: pictures refuse what they cannot draw, before anything is written, and draw every curve they are given."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import diffvbd as dv
from diffvbd import viz

MESH = dv.mesh.cube(3, 0.1, split="kuhn")
MOTION = np.stack([MESH.points, MESH.points + 0.01])


def comparison(path: Path, surface: Any, motion: Any, times: list[float]) -> None:
    viz.comparison(path, surface, {"target": motion}, times)


def learning(path: Path, surface: Any, motion: Any, times: list[float]) -> None:
    viz.learning(path, surface, {"target": motion}, times, {"gradient": [(0.1, 1.0), (0.2, 0.5)]})


def animation(path: Path, surface: Any, motion: Any, times: list[float]) -> None:
    viz.animation(path, surface, {"target": motion}, 0.01)


@pytest.mark.parametrize("draw", [comparison, learning, animation])
@pytest.mark.parametrize(
    ("surface", "motion", "expected"),
    [
        (MESH.surface, MESH.points, r"motions\['target'\]: expected shape \[N.*, V, 3\], got \[27, 3\]"),
        (MESH.surface, MOTION[..., :2], r"motions\['target'\]: expected shape .* got \[2, 27, 2\]"),
        (MESH.tets, MOTION, r"surface: expected triangles \[F, 3\] of 27 vertices, got shape \[48, 4\]"),
        (MESH.surface + 27, MOTION, "surface: expected .* with indices up to 53"),
    ],
)
def test_other_shapes_are_refused(draw: Callable, surface: Any, motion: Any, expected: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=expected):
        draw(tmp_path / "picture.gif", surface, motion, [0.0, 0.1])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("draw", [comparison, learning])
def test_every_shape_has_a_time(draw: Callable, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected shape \[N = 3, V, 3\], got \[2, 27, 3\]"):
        draw(tmp_path / "picture.png", MESH.surface, MOTION, [0.0, 0.1, 0.2])


def test_more_curves_than_colors_are_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    sizes = []
    for count in (3, 4):
        curves = {f"curve {k}": [(0.1, 1.0 + k), (0.2, 0.5 + k)] for k in range(count)}
        path = tmp_path / f"{count}.svg"
        viz.learning(path, MESH.surface, {"target": MOTION}, [0.0, 0.1], curves)
        sizes.append(path.stat().st_size)
    assert sizes[1] > sizes[0]
