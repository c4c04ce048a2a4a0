"""A picture of contact before and after its limits by planes: five boxes, a block that slides, a pinned sheet.

`python -m bench.contact_picture` steps scenes of `bench.contact_motion` and draws them beside what the library did
before, which bench/meshes/contact_before.json holds: positions that `--save` of this module wrote at commit d8c5ba8.
"""

from __future__ import annotations

import argparse
import io
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import RESULTS
from bench.contact_motion_piles import tower
from bench.contact_motion_run import GRAVITY, Array, march
from bench.contact_motion_scenes import block, hanging, thrown
from bench.plots import keep_picture
from diffvbd import mesh, viz
from diffvbd.viz.drawing import INK, new_figure

BEFORE = RESULTS.parent / "meshes" / "contact_before.json"
PICTURE = RESULTS.parents[1] / "docs" / "images" / "contact_before_after.png"
COLORS = ("#4c78a8", "#e4704f", "#4f9d5b", "#d9a93f", "#8a69b0")
WRONG, RIGHT, GHOST = "#b3392c", "#2e7d3b", "#9a9a9a"
SPEED, FRICTION, SLIDE_STEP = 10.0, 0.5, 1 / 60  # [m/s], -, [s]
EVERY = 12  # steps of the slide between two blocks that are drawn: 0.2 s
COULOMB = 0.5 * SPEED**2 / (FRICTION * GRAVITY)  # [m]
BEFORE_STACKS = "fell at K = 80, stood at K = 160"  # piles.stack at the commit of BEFORE
SWEEPS = {"tower": 5, "slide": 20, "sheet": 20}
States = dict[str, Array]  # positions [m] of each scene, shape [N, V, 3]


# --- states -----------------------------------------------------------------------------------------------------------


def states() -> States:
    """Boxes at the start, after 1 s and after 2 s, a block every 0.2 s and where it stops, a sheet at the start and
    0.25 s later, with self-contact and without."""
    boxes = march(tower(sweeps=SWEEPS["tower"]), 200, keep=100).x
    slide = block("Plane", FRICTION, SWEEPS["slide"], SLIDE_STEP, "cpu", None)
    blocks = march(thrown(slide, SPEED), 250, until=lambda v: float(v[:, 0].mean()) < 0.01).x
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # thin tets, as in the benchmark
        own, free = (march(hanging(on, SWEEPS["sheet"], 1 / 60, "cpu", None), 15, keep=15).x for on in (True, False))
    kept = {"tower": boxes, "slide": [*blocks[:-1:EVERY], blocks[-1]], "sheet": own, "free": free}
    found = {name: np.stack([x.numpy() for x in shown]) for name, shown in kept.items()}
    return found | {"slide_time": np.array(SLIDE_STEP * (len(blocks) - 1))}


def save(found: States, path: Path) -> None:
    """Positions to 0.1 mm."""
    rows = [f'"{name}": {json.dumps(np.round(values, 4).tolist())}' for name, values in found.items()]
    path.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


def load(path: Path) -> States:
    return {name: np.array(values) for name, values in json.loads(path.read_text(encoding="utf-8")).items()}


# --- drawing ----------------------------------------------------------------------------------------------------------


def panel(figure: Any, middle: tuple[float, float], size: float) -> Any:
    """3D axes about a point of the figure, `size` of its width wide; they are square, and draw beyond their edges."""
    width, height = figure.get_size_inches()
    tall = size * width / height
    rect = (middle[0] - 0.5 * size, middle[1] - 0.5 * tall, size, tall)
    axes = figure.add_axes(rect, projection="3d", computed_zorder=False)
    axes.set_proj_type("ortho")
    axes.patch.set_visible(False)
    return axes


def outline(axes: Any, points: Array, color: str = GHOST, **style: Any) -> None:
    """A dashed line through points [m], y up."""
    axes.plot(points[:, 2], points[:, 0], points[:, 1], "--", color=color, lw=1.2, clip_on=False, **style)


def edges_of_box(low: Array, high: Array) -> list[Array]:
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    return [corners[[a, b]] for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]


def draw_tower(axes: Any, frames: Array, at: int) -> None:
    """Boxes of one state, and the room that they took up at the start."""
    low, high = np.array([-0.72, 0.0, -0.08]), np.array([0.42, 1.05, 0.75])
    ground, view = viz.floor((low[0], low[2]), (high[0], high[2])), (10.0, 14.0)
    viz.draw(axes, ground.points, ground.triangles, ground.color, (low, high), view=view)
    box = mesh.box(2, 0.2, split="kuhn")
    size = box.num_vertices
    count = frames.shape[1] // size
    for edge in edges_of_box(frames[0].min(0), frames[0].max(0)):
        outline(axes, edge, zorder=1)  # behind the boxes
    surface = np.concatenate([box.surface + k * size for k in range(count)])
    rgb = np.array([_rgb(COLORS[k % len(COLORS)]) for k in range(count)]).repeat(len(box.surface), 0)
    viz.draw(axes, frames[at], surface, rgb, (low, high), view=view)


def draw_sheet(axes: Any, found: States, surface: Any) -> None:
    """The sheet 0.25 s after it was let go, and where its front edge is without self-contact and at the start."""
    low, high, view = np.array([-0.03, -0.36, -0.03]), np.array([0.43, 0.04, 0.43]), (16.0, 24.0)
    sheet, free = found["sheet"], found["free"]
    first = sheet[0]
    pin = first[first[:, 0] < 1e-9]
    front = (first[:, 2] > 0.4 - 1e-9) & (first[:, 1] > first[:, 1].mean())
    order = np.flatnonzero(front)[np.argsort(first[front][:, 0])]
    viz.draw(axes, sheet[-1], surface, COLORS[0], (low, high), view=view)
    back = np.array([pin[pin[:, 2].argmin()], pin[pin[:, 2].argmax()]])
    axes.plot(back[:, 2], back[:, 0], back[:, 1], color=INK, lw=4, clip_on=False, solid_capstyle="round")
    outline(axes, first[order])
    outline(axes, free[-1][order], RIGHT)
    outline(axes, free[-1][order[-1]] * [[1, 1, 1], [1, 1, 0]], RIGHT)


def draw_slide(axes: Any, found: States) -> None:
    """A block every 0.2 s, fainter the earlier, on a floor with a mark every 2 m."""
    low, high, view = np.array([-0.4, -0.05, -0.4]), np.array([10.8, 0.25, 0.4]), (14.0, 0.0)
    ground = viz.floor((low[0], low[2]), (high[0], high[2]), cells=1)
    viz.draw(axes, ground.points, ground.triangles, "#eeeeee", (low, high), view=view)
    axes.collections[-1].set_linewidth(0)  # of so long a floor the triangles look odd
    for x in range(0, 11, 2):
        axes.text(high[2] + 0.45, x, 0, f"{x} m", ha="center", va="top", fontsize=9, color="#666666")
        axes.plot([low[2], high[2]], [x, x], [0, 0], color="#bbbbbb", lw=0.8, clip_on=False, zorder=1)
    outline(axes, np.array([[COULOMB, 0, high[2]], [COULOMB, 0, low[2]], [COULOMB, 0.45, low[2]]]), RIGHT)
    scene = block("Plane", FRICTION, 1, SLIDE_STEP, "cpu", None)
    surface, blocks = scene.model.mesh.surface, found["slide"] - [found["slide"][0][:, 0].mean(), 0, 0]
    for k, points in enumerate(blocks):
        share = 0.35 + 0.65 * k / (len(blocks) - 1)
        rgb = 1 - share * (1 - np.array(_rgb(COLORS[1])))
        viz.draw(axes, points, surface, np.broadcast_to(rgb, (len(surface), 3)), (low, high), view=view)


def _rgb(color: str) -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    return to_rgb(color)


# --- figures ----------------------------------------------------------------------------------------------------------


def tip(frames: Array) -> float:
    """How far the free edge of a sheet has fallen [m]."""
    edge = frames[0][:, 0] > 0.4 - 1e-9
    return float((frames[0] - frames[-1])[edge, 1].mean())


# each says what a panel shows, and whether that is right


def tower_words(found: States) -> tuple[str, bool]:
    size = len(mesh.box(2, 0.2, split="kuhn").points)
    centers = found["tower"].reshape(len(found["tower"]), -1, size, 3).mean(2)
    away = float(np.linalg.norm((centers[-1] - centers[0])[:, [0, 2]], axis=-1).max())
    fallen = centers[-1, -1, 1] < 0.9 * centers[0, -1, 1]
    if fallen:
        return f"after 1 s; at 2 s they lie {away:.1f} m away\n({BEFORE_STACKS})", False
    return f"after 2 s; no center is more than\n{1e3 * away:.0f} mm to the side of its start", True


def sheet_words(found: States) -> tuple[str, bool]:
    own, free = tip(found["sheet"]), tip(found["free"])
    return f"its tip has fallen {own:.3f} m\nof {free:.3f} m without contact", abs(own - free) < 0.03 * free


def slide_words(found: States) -> tuple[str, bool]:
    way = float((found["slide"][-1] - found["slide"][0])[:, 0].mean())
    words = f"stops after {way:.{3 if way < 1 else 2}f} m, {float(found['slide_time']):.3g} s"
    return words, abs(way - COULOMB) < 0.03 * COULOMB


def say(figure: Any, place: tuple[float, float], text: str, size: float = 11, **style: Any) -> None:
    figure.text(*place, text, fontsize=size, **{"ha": "center", "va": "center", "color": INK, **style})


def picture(before: States, after: States, path: Path) -> None:
    figure = new_figure(1600 / 130, 900 / 130)
    surface = hanging(False, 1, 1 / 60, "cpu", None).model.mesh.surface
    say(figure, (0.25, 0.965), f"Five boxes on a floor, K = {SWEEPS['tower']}, h = 1/100", 14)
    say(figure, (0.75, 0.965), f"Pinned sheet with self-contact after 0.25 s, K = {SWEEPS['sheet']}, h = 1/60", 14)
    slide = f"Block thrown at {SPEED:g} m/s on a plane, friction {FRICTION:g}, K = {SWEEPS['slide']}, h = 1/60"
    say(figure, (0.03, 0.355), slide, 14, ha="left")
    say(figure, (0.97, 0.355), f"- - -  Coulomb's law: {COULOMB:.2f} m", color=RIGHT, ha="right")
    say(figure, (0.75, 0.435), "- - -  without contact", color=RIGHT)
    note = "before: states of commit d8c5ba8; grey dashes: the start; blocks every 0.2 s"
    say(figure, (0.97, 0.022), note, 10, color="#666666", ha="right")
    for found, name, left, lane in ((before, "before", 0.0, 0.24), (after, "after", 0.25, 0.1)):
        color = RIGHT if found is after else WRONG
        draw_tower(panel(figure, (left + 0.125, 0.69), 0.25), found["tower"], 1 if found is before else 2)
        draw_sheet(panel(figure, (left + 0.625, 0.69), 0.25), found, surface)
        draw_slide(panel(figure, (0.5, lane), 0.8), found)
        for x, (words, right) in ((0.125, tower_words(found)), (0.625, sheet_words(found))):
            say(figure, (left + x, 0.915), name, 13, color=color, weight="bold")
            say(figure, (left + x, 0.48), words, color=RIGHT if right else WRONG)
        say(figure, (0.03, lane + 0.055), name, 13, color=color, weight="bold", ha="left")
        words, right = slide_words(found)
        say(figure, (0.09, lane + 0.055), words, color=RIGHT if right else WRONG, ha="left")
    drawn = io.BytesIO()
    figure.savefig(drawn)
    keep_picture(drawn, path, 1600)


def main() -> None:
    parser = argparse.ArgumentParser(description="Draws contact before and after its limits by planes.")
    parser.add_argument("--save", type=Path, help="write the positions of this tree's scenes there, and draw nothing")
    parser.add_argument("--out", type=Path, default=PICTURE, help="the picture (default: that of docs/contact.md)")
    options = parser.parse_args()
    if options.save:
        save(states(), options.save)
    else:
        picture(load(BEFORE), states(), options.out)


if __name__ == "__main__":
    main()
