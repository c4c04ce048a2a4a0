"""Maps of a quantity that each tet has."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.tet_mesh import boundary_faces
from diffvbd.viz.drawing import VIEW, as_array, bounds_of, course, draw, new_figure

COLORMAP = "viridis"


def field(
    path: str | Path,
    points: Any,
    tets: NDArray[np.int64],
    values: Mapping[str, Any],
    label: str = "",
    cut: tuple[Sequence[float], Sequence[float]] | None = None,
    history: Sequence[Mapping[str, float]] = (),
    truth: Mapping[str, float] | None = None,
    view: tuple[float, float] = VIEW,
) -> None:
    """Save maps of fields beside each other, on the surface and on a cut, with one colorbar of logarithmic scale.

    Args:
        path: The picture to write; the suffix chooses the format.
        points: Positions [m], shape [V, 3], array or tensor; y points up.
        tets: Vertex indices of each tet, positively oriented, shape [T, 4].
        values: Positive values of each field by name, shape [T] each; colors span their 1st to 99th percentile.
        label: Of the colorbar, with the unit.
        cut: A point [m] and the normal of a plane; a second row shows the tets with centroids behind it.
        history: Rows with "loss" and the estimates named in truth; draws the course of an optimisation.
        truth: True values of estimates; their relative error is drawn.
        view: Elevation and azimuth of the eye [degrees].

    Raises:
        ValueError: values are not one positive number for each tet, or no tet lies behind the cut.
        ImportError: matplotlib is not installed.
    """
    corners, maps = as_array(points), {name: as_array(value) for name, value in values.items()}
    for name, value in maps.items():
        if value.shape != (len(tets),) or not (value > 0).all():
            raise ValueError(f"values: expected {len(tets)} positive numbers in {name!r}, got shape {value.shape}")
    rows = {"surface": np.arange(len(tets))}
    if cut is not None:
        rows["cut"] = behind(corners, tets, *cut)
    width = 3.4 * len(maps) + 1.2
    figure = new_figure(width + (4.2 if history else 0.0), 3.0 * len(rows))
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    everything = np.concatenate(list(maps.values()))
    low, high = np.percentile(everything, [1, 99])
    # a logarithmic scale needs some extent
    paint = ScalarMappable(LogNorm(low, max(high, 1.01 * low)), COLORMAP)
    shapes, charts = figure, None
    if history:
        shapes, charts = figure.subfigures(1, 2, width_ratios=(width, 4.2))
    left, right, top = 0.06, 1.0 - 1.3 / width, 0.93
    bounds = bounds_of([corners])
    for row, (kind, kept) in enumerate(rows.items()):
        triangles, owner = boundary_faces(tets[kept], len(corners))
        for column, value in enumerate(maps.values()):
            axes = shapes.add_subplot(len(rows), len(maps), row * len(maps) + column + 1, projection="3d")
            draw(axes, corners, triangles, paint.to_rgba(value[kept][owner])[:, :3], bounds, view=view)
        height = top * (1.0 - (row + 0.5) / len(rows))
        shapes.text(0.5 * left, height, kind, rotation=90, ha="center", va="center", fontsize=13)
    shapes.subplots_adjust(left=left, right=right, bottom=0.0, top=top, wspace=0.0, hspace=0.0)
    for column, name in enumerate(maps):
        middle = left + (right - left) * (column + 0.5) / len(maps)
        shapes.text(middle, 0.96, name, ha="center", va="center", fontsize=13)
    place = shapes.add_axes((right + 0.02, 0.15, 0.025, 0.65))
    shapes.colorbar(paint, cax=place, extend="both").set_label(label)
    if charts is not None:
        course(charts, history, truth or {})
    figure.savefig(path)


def behind(
    points: NDArray[np.float64], tets: NDArray[np.int64], origin: Sequence[float], normal: Sequence[float]
) -> NDArray[np.int64]:
    """Tets whose centroids lie on the side of a plane that its normal points away from.

    Raises:
        ValueError: there are none.
    """
    height = (points[tets].mean(1) - np.asarray(origin)) @ np.asarray(normal)
    kept = np.flatnonzero(height <= 0)
    if len(kept) == 0:
        raise ValueError(f"cut: expected tets behind the plane through {list(origin)}, got none")
    return kept
