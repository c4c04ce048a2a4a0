"""Motions as a .gif."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.checks import check_positive
from diffvbd.mesh.arrays import to_path
from diffvbd.viz.drawing import (
    COLORS,
    OTHER,
    VIEW,
    Scenery,
    bounds_of,
    draw,
    motions_as_arrays,
    new_figure,
    save_motion,
)
from diffvbd.viz.motion import save_motions

FRAMES = 40  # of a longer motion so many are shown


def animation(
    path: str | Path,
    surface: NDArray[np.int64],
    motions: Mapping[str, Any],
    time_step: float,
    scenery: Sequence[Scenery] = (),
    view: tuple[float, float] = VIEW,
    color: Any = None,
) -> None:
    """Save motions beside each other as a .gif that runs in real time, or slower where it would last less than 2 s; or
    as an .npz, which :func:`live` shows.

    Args:
        path: The .gif or .npz to write.
        surface: Boundary triangles, shape [F, 3], as `TetMesh.surface`.
        motions: Positions [m] of each motion by name, shape [N, V, 3], array or tensor; y points up.
        time_step: Between frames [s].
        scenery: What else stands in every picture, for example `floor(...)`.
        view: Elevation and azimuth of the eye [degrees].
        color: Of the body, as in `draw`; default: one for each motion.

    Raises:
        ImportError: matplotlib is not installed, for a .gif.
        ValueError: motions or triangles of another shape.
    """
    path, time_step = to_path("path", path), check_positive("time_step", time_step, "s")
    if path.suffix == ".npz":
        save_motions(path, surface, motions_as_arrays(motions, surface), time_step, scenery)
        return
    figure = new_figure(3.4 * len(motions), 3.2, dots=70)
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    frames = motions_as_arrays(motions, surface)
    count = min(len(motion) for motion in frames.values())
    shown = np.unique(np.linspace(0, count - 1, min(count, FRAMES)).round().astype(int))
    bounds = bounds_of([*frames.values(), *(thing.points for thing in scenery)])
    panels = [figure.add_subplot(1, len(frames), k + 1, projection="3d") for k in range(len(frames))]
    figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.92, wspace=0.0)

    def show(k: int) -> None:
        for axes, (name, motion) in zip(panels, frames.items(), strict=True):
            axes.clear()
            paint = COLORS.get(name, OTHER) if color is None else color
            draw(axes, motion[k], surface, paint, bounds, scenery, view)
            axes.set_title(f"{name}, {1e3 * k * time_step:.0f} ms", fontsize=10, y=1.0)

    save_motion(path, figure, show, shown.tolist(), (count - 1) * time_step)
