"""The 3D part of the page: a surface in layers of one color each, scenery, light and camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .drawing import Scenery, as_array
from .motion import Motion
from .surfaces import smooth_parts
from .values import Colors, rgb

EYE = np.array([0.55, 0.4, 1.0])  # direction from the scene to the camera
ROOM = 1.15  # around the scene, in its radii
VIEW_ANGLE = 0.7  # [rad] from the lowest to the highest that the camera sees


class Stage:
    """Draws frames of a motion into a viser server; viser has one color a mesh, so each color is a mesh."""

    def __init__(self, server: Any) -> None:
        self.server = server
        server.scene.set_up_direction("+y")
        self._layers: list[tuple[Any, NDArray[np.int64]]] = []  # meshes of constant color: handle, their vertices
        self._bins: list[Any] = []  # meshes of the levels of a quantity
        self._things: list[tuple[Any, NDArray[np.float64]]] = []  # what moves of the scenery, and where it is
        self._scenery: list[Any] = []
        self._shown: tuple[Any, Any] | None = None

    @property
    def empty(self) -> bool:
        """Whether nothing has been drawn."""
        return self._shown is None

    def look_at(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Puts the camera where it sees all between two corners [m]."""
        middle, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-6)
        eye = middle + EYE / np.linalg.norm(EYE) * ROOM * radius / np.sin(0.5 * VIEW_ANGLE)
        cameras = [self.server.initial_camera, *(c.camera for c in self.server.get_clients().values())]
        for camera in cameras:
            camera.fov, camera.near, camera.far = VIEW_ANGLE, radius / 100, radius * 100
            camera.position, camera.look_at = tuple(eye), tuple(middle)

    def set_scenery(self, things: tuple[Scenery, ...]) -> None:
        """What else is there."""
        for handle in self._scenery:
            handle.remove()
        self._scenery, self._things = [], []
        for k, thing in enumerate(things):
            points = as_array(thing.points)
            handle = self.server.scene.add_mesh_simple(
                f"/scenery/{k}",
                points if points.ndim == 2 else points[0],
                np.asarray(thing.triangles),
                color=rgb(thing.color),
                side="double",
                flat_shading=len(thing.triangles) <= 12,
                receive_shadow=len(thing.triangles) > 2,  # the map of viser's light ends on a large plane
            )
            self._scenery.append(handle)
            if points.ndim == 3:
                self._things.append((handle, points))

    def show(self, motion: Motion, colors: Colors, frame: int) -> None:
        """Draws a frame."""
        with self.server.atomic():
            if self._shown is None or self._shown[0] is not motion.triangles or self._shown[1] is not colors:
                self._begin(motion, colors)
            points = motion.points[frame].astype(np.float32)
            if self._bins:
                self._show_levels(points[motion.triangles], colors.at(frame))
            for handle, vertices in self._layers:
                handle.vertices = points[vertices]
            for handle, places in self._things:
                handle.vertices = places[min(frame, len(places) - 1)].astype(np.float32)

    def _begin(self, motion: Motion, colors: Colors) -> None:
        for handle in (*self._bins, *(handle for handle, _ in self._layers)):
            handle.remove()
        self._bins, self._layers, self._shown = [], [], (motion.triangles, colors)
        start, none = motion.points[0], (np.zeros((3, 3), np.float32), np.array([[0, 1, 2]]))
        part = smooth_parts(start, motion.triangles)[:, None]
        for k, color in enumerate(colors.palette):
            tint = tuple(int(c) for c in color)
            if colors.unit:
                self._bins.append(
                    self.server.scene.add_mesh_simple(
                        f"/level/{k}", *none, color=tint, flat_shading=True, side="double", visible=False
                    )
                )
                continue
            rows = colors.levels == k
            if not rows.any():
                continue
            # a vertex on a sharp edge is one for each side, lest it be shaded as if it were round
            of_parts, faces = np.unique(part[rows] * len(start) + motion.triangles[rows], return_inverse=True)
            vertices = of_parts % len(start)
            handle = self.server.scene.add_mesh_simple(
                f"/body/{k}", start[vertices], faces.reshape(-1, 3), color=tint, side="double"
            )
            self._layers.append((handle, vertices))

    def _show_levels(self, corners: NDArray[np.float32], levels: NDArray[np.int64]) -> None:
        """Triangles [F, 3, 3] in the mesh of their level."""
        order = np.argsort(levels, kind="stable")
        ends = np.searchsorted(levels[order], np.arange(len(self._bins) + 1))
        for k, handle in enumerate(self._bins):
            mine = corners[order[ends[k] : ends[k + 1]]].reshape(-1, 3)
            if handle.visible != bool(len(mine)):
                handle.visible = bool(len(mine))
            if len(mine):
                # a mesh may never have faces beyond its vertices, not even between two messages
                faces = np.arange(len(mine)).reshape(-1, 3)
                if len(mine) >= len(handle.vertices):
                    handle.vertices, handle.faces = mine, faces
                else:
                    handle.faces, handle.vertices = faces, mine
