"""Pictures and animations with light, floor and shadow, by pyvista without a window."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .._common.checks import check_positive, fail
from ..mesh.write import replace
from ..model.model import Model
from .motion import Mesh, Motion, mesh_of, motions_of, opened, scenery_of
from .scenery import Scenery, as_array, optional
from .values import rgb, values_of

ANIMATED = (".webp", ".gif")
STILL = (".png", ".jpg")
RATE = 20  # frames a second
BACKGROUND, GROUND, SHADOW = "#fbfbfa", "#e2e4e6", "#c3c7cc"
VIEW_ANGLE = 24.0  # [degrees]
FADE = 3.2  # radii of the scene from its middle to where the ground has become background
SHARP = 40.0  # [degrees] from which on an edge of a surface is drawn as one


def render(
    path: str | Path,
    source: Any,
    mesh: Mesh | None = None,
    *,
    time_step: float | None = None,
    color: str = "body",
    mu: Any = None,
    lam: Any = None,
    scenery: Sequence[Scenery] = (),
    colliders: Any = None,
    view: tuple[float, float] = (16.0, 32.0),
    zoom: float = 1.0,
    size: tuple[int, int] = (480, 320),
    seconds: float | None = None,
    frame: int = -1,
    quality: int = 60,
    apart: Sequence[float] = (0.0, 0.0, 0.0),
    ground: float | Literal["auto"] | None = "auto",
) -> None:
    """A picture (.png, .jpg) or an animation (.webp, .gif) with light, floor and shadow.

    It is drawn without a window, by vtk 9.5 or newer in software where there is no GPU.

    Args:
        path: The file; the suffix tells which.
        source, mesh, time_step, color, mu, lam, scenery, colliders: As in :func:`live`, except for functions.
            Motions of a dict, and scenes, are drawn into one picture.
        view: Elevation and azimuth of the eye [degrees]; at azimuth 0 it looks along -x, at 90 along -z.
        zoom: Above 1 closer.
        size: Width and height [pixels].
        seconds: How long an animation lasts; default: the time of the motion.
        frame: Of a picture; -1 is the last.
        quality: Of .webp and .jpg, 1 to 100.
        apart: Offset of each motion from the one before [m], shape [3].
        ground: Height [m] of the ground that shadows fall on; "auto": that of the Model's floor, or below the scene;
            None: no ground.

    Raises:
        ImportError: pyvista is not installed.
        ValueError, TypeError: as :func:`live`, or another suffix.
    """
    path, pyvista = Path(path), optional("pyvista", "rendering needs")
    if path.suffix.lower() not in ANIMATED + STILL:
        fail("path", f"a name that ends in {', '.join(ANIMATED + STILL)}", repr(path.name))
    offset = as_array(apart)
    if offset.shape != (3,):
        fail("apart", "shape [3]", f"shape {list(offset.shape)}")
    if isinstance(source, (str, Path)):
        found = opened(Path(source), time_step)
        motions, mesh = [*found.motions.values()], found.mesh if mesh is None else mesh
    else:
        motions = [*motions_of(source, mesh, time_step).values()]
    things = [*scenery, *motions[0].scenery]
    mesh_of(mesh)  # raises for anything else
    values = values_of(mesh, mu, lam, colliders)
    places = [k * offset for k in range(len(motions))]
    corners = np.stack([motion.bounds + place for motion, place in zip(motions, places, strict=True)])
    low, high = corners[:, 0].min(0), corners[:, 1].max(0)
    height = None if ground is None or ground == "auto" else float(ground)
    things += scenery_of(mesh, low, high, colliders) if isinstance(mesh, Model) else ()
    level = [thing for thing in things if np.ptp(as_array(thing.points)[..., 1]) == 0]
    if ground == "auto" and level:
        height = float(level[0].points[0, 1])
    if height is not None:  # the ground stands for floors
        things = [thing for thing in things if not any(thing is floor for floor in level)]
    for points in (as_array(thing.points).reshape(-1, 3) for thing in things if np.ptp(as_array(thing.points)[..., 1])):
        low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
    if height is None and ground == "auto":
        height = float(low[1])
    colored = [values.colors(color, motion) for motion in motions]
    shift = _shift(motions) if color == "body" else [0] * len(motions)

    stage = _Stage(pyvista, size, low, high, view, zoom, height)
    try:

        def picture(k: int) -> NDArray[np.uint8]:
            for n, (motion, colors) in enumerate(zip(motions, colored, strict=True)):
                points = motion.points[min(k, len(motion) - 1)] + places[n]
                rows = colors.palette[(colors.at(min(k, len(motion) - 1)) + shift[n]) % len(colors.palette)]
                stage.draw(f"body {n}", points, motion.triangles, rows, smooth=not colors.unit)
            for n, thing in enumerate(things):
                points = as_array(thing.points)
                points = points if points.ndim == 2 else points[min(k, len(points) - 1)]
                stage.draw(f"thing {n}", points, thing.triangles, np.array([rgb(thing.color)], np.uint8))
            return stage.picture()

        count = max(map(len, motions))
        if path.suffix.lower() in STILL:
            _save(path, [picture(range(count)[frame])], 1.0, quality)
            return
        times = next((motion.times for motion in motions if motion.times is not None), None)
        lasts = float(times[-1] - times[0]) if times is not None else count / RATE
        lasts = check_positive("seconds", lasts if seconds is None else seconds, "s")
        shown = np.linspace(0, count - 1, max(2, min(count, round(lasts * RATE)))).round().astype(int).tolist()
        _save(path, [picture(k) for k in shown], lasts, quality)
    finally:
        stage.plotter.close()


def _shift(motions: Sequence[Motion]) -> list[int]:
    """Rows of the palette by which the bodies of each motion come after those of the motions before."""
    counts = [1 if motion.body is None else len(np.unique(motion.body)) for motion in motions]
    return [0, *np.cumsum(counts)[:-1].tolist()]


class _Stage:
    """Camera, light and ground. Shadows are what stands there, projected on the ground along the light."""

    def __init__(
        self,
        pyvista: Any,
        size: tuple[int, int],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        view: tuple[float, float],
        zoom: float,
        height: float | None,
    ) -> None:
        self.pyvista, self.height = pyvista, height
        self.plotter = plotter = pyvista.Plotter(
            off_screen=True, window_size=[2 * size[0], 2 * size[1]], lighting="none"
        )
        plotter.set_background(BACKGROUND)
        middle, self.radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
        up, around = np.radians(view)
        eye = np.array([np.cos(up) * np.cos(around), np.sin(up), np.cos(up) * np.sin(around)])
        distance = self.radius / np.sin(np.radians(0.5 * VIEW_ANGLE)) / zoom
        camera = plotter.camera
        camera.focal_point, camera.position, camera.up = middle, middle + distance * eye, (0.0, 1.0, 0.0)
        camera.view_angle = VIEW_ANGLE
        camera.clipping_range = (0.05 * distance, 20 * distance)
        side = np.cross((0.0, 1.0, 0.0), eye)  # to the right
        self.light = np.array([0.0, 1.0, 0.0]) + 0.3 * eye - 0.4 * side
        for direction, intensity in ((self.light, 0.65), (eye + 0.6 * side, 0.3), (-eye + 0.5 * self.light, 0.15)):
            light = pyvista.Light(light_type="scene light", intensity=intensity)
            light.position, light.focal_point = middle + self.radius * direction, middle
            plotter.add_light(light)
        if height is not None:
            self._add_ground(middle)

    def _add_ground(self, middle: NDArray[np.float64]) -> None:
        """A disk that fades into the background."""
        rings, around = np.linspace(0.0, 1.0, 24), np.linspace(0.0, 2 * np.pi, 73)
        r, t = np.meshgrid(FADE * self.radius * rings, around, indexing="ij")
        height = np.full_like(r, self.height)
        disk = self.pyvista.StructuredGrid(middle[0] + r * np.cos(t), height, middle[2] + r * np.sin(t))
        share = np.repeat(rings[None], len(around), 0).ravel() ** 1.5
        colors = np.outer(1 - share, rgb(GROUND)) + np.outer(share, rgb(BACKGROUND))
        disk.point_data["color"] = colors.round().astype(np.uint8)
        self.plotter.add_mesh(disk, scalars="color", rgb=True, lighting=False, reset_camera=False, render=False)

    def draw(
        self,
        name: str,
        points: NDArray[np.float64],
        triangles: NDArray[np.int64],
        colors: NDArray[np.uint8],
        smooth: bool = True,
    ) -> None:
        """A surface [V, 3] of triangles [F, 3], in one color [1, 3] or one of each triangle [F, 3]."""
        surface = self._surface(points, triangles)
        surface.cell_data["color"] = np.broadcast_to(colors, (len(triangles), 3)).copy()
        if smooth:
            surface = surface.compute_normals(split_vertices=True, feature_angle=SHARP, cell_normals=False)
        self.plotter.add_mesh(surface, name=name, scalars="color", rgb=True, ambient=0.36, diffuse=0.9, specular=0.12,
                              specular_power=15, smooth_shading=smooth, reset_camera=False, render=False)  # fmt: skip
        if self.height is not None:
            above = np.maximum(points[:, 1] - self.height, 0.0)
            shadow = points - np.outer(above / self.light[1], self.light)
            shadow[:, 1] = self.height + 1e-3 * self.radius
            self.plotter.add_mesh(self._surface(shadow, triangles), name=f"shadow of {name}", color=SHADOW,
                                  lighting=False, reset_camera=False, render=False)  # fmt: skip

    def picture(self) -> NDArray[np.uint8]:
        """Image of the camera, shape [2 height, 2 width, 3]."""
        self.plotter.render()
        return np.asarray(self.plotter.screenshot(None, return_img=True))

    def _surface(self, points: NDArray[np.float64], triangles: NDArray[np.int64]) -> Any:
        faces = np.column_stack([np.full(len(triangles), 3), triangles])
        return self.pyvista.PolyData(points.astype(np.float32), faces.ravel())


def _save(path: Path, pictures: Sequence[NDArray[np.uint8]], seconds: float, quality: int) -> None:
    from PIL import Image  # which pyvista and matplotlib bring

    images = [Image.fromarray(picture) for picture in pictures]
    images = [image.resize((image.width // 2, image.height // 2), Image.Resampling.BOX) for image in images]
    several: dict[str, Any] = {"save_all": True, "append_images": images[1:], "loop": 0, "method": 4,
                               "duration": round(1000 * seconds / len(images))}  # fmt: skip
    replace(path, lambda new: images[0].save(new, quality=quality, **several if len(images) > 1 else {}))
