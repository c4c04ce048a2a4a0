"""Claim: pictures refuse what they cannot draw, before anything is written, and draw every curve they are given."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import diffvbd as dv
from diffvbd import viz
from diffvbd.viz.values import BODY_COLORS, rgb

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


# --- renderings -------------------------------------------------------------------------------------------------------


BODY = dv.mesh.join([dv.mesh.cube(2, 0.2), dv.mesh.cube(2, 0.2).translate((0.3, 0.1, 0.0))])
FRAMES = BODY.points + np.linspace(0.0, 0.3, 5)[:, None, None] * [0.0, 1.0, 0.0]
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
    dv.viz.render(tmp_path / "ground.png", FRAMES, BODY, size=SIZE)
    dv.viz.render(tmp_path / "none.png", FRAMES, BODY, size=SIZE, ground=None)
    with_ground, without = (np.asarray(images.open(tmp_path / name), dtype=int) for name in ("ground.png", "none.png"))
    assert with_ground.shape == (90, 120, 3)
    for color in BODY_COLORS[:2]:
        assert share(with_ground, color) > 0.02
    grays = [(np.ptp(picture, axis=-1) < 20) & (picture.mean(-1) < 215) for picture in (with_ground, without)]
    assert grays[0].mean() > 0.02 + grays[1].mean()


def test_animations_move_and_last_as_told(tmp_path: Path) -> None:
    pytest.importorskip("pyvista")
    images = pytest.importorskip("PIL.Image")
    dv.viz.render(tmp_path / "move.webp", FRAMES, BODY, time_step=0.1, seconds=1.0, size=SIZE)
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
        ({"source": FRAMES[:, :3]}, r"source: expected shape \[16, 3\]"),
        ({"color": "heat"}, "color: expected one of"),
    ],
)
def test_what_cannot_be_drawn_is_refused(arguments: dict[str, Any], expected: str, tmp_path: Path) -> None:
    pytest.importorskip("pyvista")
    given = {"path": "a.png", "source": FRAMES, "mesh": BODY} | arguments
    given["path"] = tmp_path / given["path"]
    with pytest.raises(ValueError, match=expected):
        dv.viz.render(**given)
    assert not list(tmp_path.iterdir())
