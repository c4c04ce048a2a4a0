"""Claim: pictures show bodies, ground and shadow in their colors, animations move, what cannot be drawn is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import diffvbd as dv
from diffvbd.viz import motion
from diffvbd.viz.values import BODY_COLORS, rgb

MESH = dv.mesh.join([dv.mesh.cube(2, 0.2), dv.mesh.cube(2, 0.2).translate((0.3, 0.1, 0.0))])
MOTION = MESH.points + np.linspace(0.0, 0.3, 5)[:, None, None] * [0.0, 1.0, 0.0]
SIZE = (120, 90)


def share(picture: np.ndarray, color: str) -> float:
    """Of the pixels, those whose hue is that of a color."""
    wanted = np.array(rgb(color)) / max(rgb(color))
    found = picture / np.maximum(picture.max(-1, keepdims=True), 1)
    colored = np.ptp(picture, axis=-1) > 40
    return float((colored & (np.abs(found - wanted).max(-1) < 0.15)).mean())


def test_bodies_have_their_colors_and_a_shadow(tmp_path: Path) -> None:
    pytest.importorskip("pyvista")
    images = pytest.importorskip("PIL.Image")
    dv.viz.render(tmp_path / "ground.png", MOTION, MESH, size=SIZE)
    dv.viz.render(tmp_path / "none.png", MOTION, MESH, size=SIZE, ground=None)
    with_ground, without = (np.asarray(images.open(tmp_path / name), dtype=int) for name in ("ground.png", "none.png"))
    assert with_ground.shape == (90, 120, 3)
    for color in BODY_COLORS[:2]:
        assert share(with_ground, color) > 0.02
    grays = [(np.ptp(picture, axis=-1) < 20) & (picture.mean(-1) < 215) for picture in (with_ground, without)]
    assert grays[0].mean() > 0.02 + grays[1].mean()


def test_animations_move_and_last_as_told(tmp_path: Path) -> None:
    pytest.importorskip("pyvista")
    images = pytest.importorskip("PIL.Image")
    dv.viz.render(tmp_path / "move.webp", MOTION, MESH, time_step=0.1, seconds=1.0, size=SIZE)
    with images.open(tmp_path / "move.webp") as moving:
        assert moving.n_frames == 5
        first = np.asarray(moving.convert("RGB"), dtype=int)
        moving.seek(4)
        last = np.asarray(moving.convert("RGB"), dtype=int)
        assert moving.info["duration"] == 200
    assert (np.abs(first - last).max(-1) > 40).mean() > 0.05


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"path": "a.mp4"}, "path: expected a name that ends in .webp, .gif, .png, .jpg, got 'a.mp4'"),
        ({"apart": (1.0,)}, r"apart: expected shape \[3\]"),
        ({"source": MOTION[:, :3]}, r"source: expected shape \[16, 3\]"),
        ({"color": "heat"}, "color: expected one of"),
    ],
)
def test_what_cannot_be_drawn_is_refused(arguments: dict[str, Any], expected: str, tmp_path: Path) -> None:
    pytest.importorskip("pyvista")
    given = {"path": "a.png", "source": MOTION, "mesh": MESH} | arguments
    given["path"] = tmp_path / given["path"]
    with pytest.raises(ValueError, match=expected):
        dv.viz.render(**given)
    assert not list(tmp_path.iterdir())


def test_parts_of_surfaces() -> None:
    labels = motion.bodies(MESH.surface, MESH.num_vertices)
    assert np.array_equal(labels, np.where(MESH.body == 0, 0, 8))
    sides = motion.smooth_parts(MESH.points, MESH.surface)
    assert np.array_equal(np.unique(sides, return_counts=True)[1], [2] * 12)  # of two triangles each
    ball = dv.mesh.capsule(0.1, 0.0, resolution=6)
    assert len(np.unique(motion.smooth_parts(ball.points, ball.surface))) == 1
