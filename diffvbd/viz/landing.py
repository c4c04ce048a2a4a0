"""Bodies that land on a round target."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.viz.drawing import BODIES, INK, as_array, draw, new_figure


def landing(
    path: str | Path,
    surfaces: Sequence[NDArray[np.int64]],
    frames: Any,
    times: Sequence[float],
    radius: float,
    history: Sequence[Mapping[str, float]],
) -> None:
    """Save bodies and the round target they land on: the last frame from above, the course of the optimisation, and
    every frame from the side.

    Args:
        path: The picture to write; the suffix chooses the format.
        surfaces: Boundary triangles of each body, shape [F, 3], as rows of the frames.
        frames: Positions [m], shape [N, V, 3], array or tensor; y points up, and the floor is at y = 0.
        times: Their times [s], length N.
        radius: Of the target about the y axis [m].
        history: Rows with "loss" and "uncovered", a share.

    Raises:
        ImportError: matplotlib is not installed.
    """
    shown = as_array(frames)
    figure = new_figure(3.3 * len(times), 8.0)
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Circle

    colors = [BODIES[k % len(BODIES)] for k in range(len(surfaces))]
    above, below = figure.subfigures(2, 1, height_ratios=(1.0, 1.3))
    left, right = above.subfigures(1, 2, width_ratios=(1.0, 1.5))
    view = left.add_subplot()
    view.add_patch(Circle((0.0, 0.0), radius, color="#cccccc"))
    for surface, color in zip(surfaces, colors, strict=True):
        triangles = shown[-1][surface][..., ::2]
        edges = np.diff(triangles, axis=1)
        # those that face up: one transparent layer for each body
        up = edges[:, 0, 1] * edges[:, 1, 0] > edges[:, 0, 0] * edges[:, 1, 1]
        view.add_collection(PolyCollection(triangles[up], facecolors=color, edgecolors=color, lw=0.5, alpha=0.4))
    view.add_patch(Circle((0.0, 0.0), radius, fill=False, color="black", linewidth=1.5))
    view.set(aspect="equal", xlabel="x [m]", ylabel="z [m]")
    view.autoscale_view()
    view.invert_yaxis()
    left.subplots_adjust(left=0.2, right=0.98, bottom=0.16, top=0.96)

    charts = right.subplots(2, 1, sharex=True)
    for axes, key, scale, label in zip(charts, ("loss", "uncovered"), (1, 100), ("loss", "uncovered [%]"), strict=True):
        axes.plot([scale * row[key] for row in history], color=INK)
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    charts[0].set_yscale("log")
    charts[0].tick_params(which="minor", labelleft=False)
    charts[1].set_xlabel("iteration")
    right.subplots_adjust(left=0.14, right=0.97, bottom=0.16, top=0.96, hspace=0.12)

    corners = shown.reshape(-1, 3)
    bounds = np.minimum(corners.min(0), [-radius, 0.0, -radius]), np.maximum(corners.max(0), [radius, 0.0, radius])
    angle = np.linspace(0, 2 * np.pi, 73)
    for column, (points, time) in enumerate(zip(shown, times, strict=True)):
        axes = below.add_subplot(1, len(times), column + 1, projection="3d", computed_zorder=False)
        axes.plot(radius * np.sin(angle), radius * np.cos(angle), 0.0, color="black", linewidth=1.0, clip_on=False)
        # upper bodies hide lower ones: matplotlib sorts whole bodies by their distance, which fails in a stack
        for surface, color in sorted(zip(surfaces, colors, strict=True), key=lambda body: points[body[0], 1].mean()):
            draw(axes, points, surface, color, bounds)
        below.text((column + 0.5) / len(times), 0.96, f"t = {time:.2f} s", ha="center", va="center", fontsize=12)
    below.subplots_adjust(left=0.0, right=1.0, bottom=0.06, top=0.86, wspace=0.0)
    figure.savefig(path)
