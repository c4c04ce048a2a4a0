"""Colors of triangles: values of each frame, with their units, as levels of a palette."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .._common.checks import fail, is_word
from ..inspect.forces import forces, stress
from ..mesh.tet_mesh import TetMesh
from ..model.model import Model
from ..model.solver import VBD
from .motion import Mesh, Motion
from .scenery import as_array

# What each name means, and its unit.
QUANTITIES = {
    "body": ("body", ""),
    "speed": ("speed", "m/s"),
    "stress": ("von Mises stress", "Pa"),
    "stiffness": ("stiffness mu", "Pa"),
    "contact": ("contact force", "N"),
}
BODY_COLORS = ("#4c78a8", "#e4704f", "#4f9d5b", "#e0b13c", "#8a63a6", "#3fa7a3", "#c75c8a", "#8d7355")
RAMP = ("#2b2f6b", "#2f6f9f", "#36a28d", "#9ccb57", "#f7e25a")  # from low to high
LEVELS = 24
_CHUNK = 200_000  # tets times frames whose stresses are computed at once


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue of 0 to 255 from "#rrggbb"."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def palette() -> NDArray[np.uint8]:
    """Colors of the levels, shape [LEVELS, 3]."""
    anchors = np.array([rgb(color) for color in RAMP], dtype=np.float64)
    at = np.linspace(0, len(RAMP) - 1, LEVELS)
    return np.stack([np.interp(at, np.arange(len(RAMP)), anchors[:, c]) for c in range(3)], 1).round().astype(np.uint8)


@dataclass(frozen=True)
class Colors:
    """Colors of the triangles of a motion."""

    palette: NDArray[np.uint8]  # [K, 3]
    levels: NDArray[np.int64]  # row of the palette of each triangle [F], or [N, F] where it changes
    title: str  # of the legend, as are the others
    unit: str = ""  # "" is a color that means no number
    low: float = 0.0
    high: float = 0.0

    def at(self, frame: int) -> NDArray[np.int64]:
        """Level of each triangle in a frame, shape [F]."""
        return self.levels if self.levels.ndim == 1 else self.levels[frame]


@dataclass
class Values:
    """The quantities of motions, computed when they are asked for."""

    model: Model | None = None  # scene of the motions; None: there is no stress and no contact
    mu: Any = None  # [Pa], a number or [T] or [B, T]; None: there is no stress and no stiffness
    lam: Any = None
    colliders: Any = None  # where their corner points are in each frame [m] [N, Vc, 3]; None: at rest
    _kept: dict[tuple[int, str], tuple[Motion, Colors]] = field(default_factory=dict, repr=False)

    def colors(self, name: str, motion: Motion) -> Colors:
        """Colors of a motion; ValueError for an unknown name, or a quantity that these arguments do not tell."""
        if not is_word(name, *QUANTITIES):
            fail("color", f"one of {', '.join(QUANTITIES)}", repr(name))
        kept = self._kept.get((id(motion), name))
        if kept is not None and kept[0] is motion:
            return kept[1]
        title, unit = QUANTITIES[name]
        if name == "body":
            labels = np.zeros(motion.points.shape[1], np.int64) if motion.body is None else motion.body
            _, rank = np.unique(labels, return_inverse=True)
            rows = np.array([rgb(color) for color in BODY_COLORS], np.uint8)
            found = Colors(rows, (rank % len(rows))[motion.triangles[:, 0]], title)
        else:
            values = self.values(name, motion)
            low, high = float(values.min(initial=np.inf)), float(values.max(initial=-np.inf))
            span = high - low if high > low else 1.0
            levels = np.clip((LEVELS * (values - low) / span).astype(np.int64), 0, LEVELS - 1)
            found = Colors(palette(), levels, title, unit, low, high)
        if len(self._kept) > 8:
            self._kept.clear()
        self._kept[id(motion), name] = (motion, found)
        return found

    def values(self, name: str, motion: Motion) -> NDArray[np.float64]:
        """A quantity of each triangle, shape [N, F], or [F] where it is constant."""
        compute = {"speed": self._speed, "stress": self._stress, "stiffness": self._stiffness, "contact": self._contact}
        return compute[name](motion)

    def _speed(self, motion: Motion) -> NDArray[np.float64]:
        velocities = motion.velocities
        if velocities is None:
            if motion.times is None:
                raise ValueError("color: speed [m/s] needs a time_step [s] or velocities, got neither")
            velocities = np.zeros_like(motion.points)
            if len(motion) > 1:
                velocities[1:] = np.diff(motion.points, axis=0) / np.diff(motion.times)[:, None, None]
                velocities[0] = velocities[1]
        return np.linalg.norm(velocities, axis=-1)[:, motion.triangles].mean(-1)

    def _tets_of(self, motion: Motion, what: str) -> NDArray[np.int64]:
        if motion.tets is None:
            raise ValueError(f"color: {what} needs the tets, got a surface")
        return motion.tets

    def _material(self, name: str, motion: Motion, what: str) -> Any:
        value = getattr(self, name)
        if value is None:
            raise ValueError(f"color: {what} needs {name} [Pa], got None")
        values = as_array(value)
        if values.ndim == 2 and len(values) > 1:
            values = values[motion.scene]
        values = values.reshape(-1)
        tets = self.model.num_tets if self.model is not None else int(self._tets_of(motion, what).max()) + 1
        if self.model is not None and len(values) not in (1, tets) or len(values) not in (1,) and len(values) < tets:
            fail(name, f"a number or one for each of {tets} tets", f"shape {list(as_array(value).shape)}")
        if not np.isfinite(values).all():
            fail(name, "finite numbers", float(values[~np.isfinite(values)][0]))
        return values

    def _stiffness(self, motion: Motion) -> NDArray[np.float64]:
        tets, mu = self._tets_of(motion, "stiffness"), self._material("mu", motion, "stiffness")
        return np.full(len(tets), mu[0]) if len(mu) == 1 else mu[tets]

    def _needed(self, what: str) -> Model:
        if self.model is None:
            stress = what == "stress"
            found = ", or a mesh with mu and lam [Pa], got neither" if stress else ", got a mesh without one"
            raise ValueError(f"color: {what} needs a dv.Model{found}")
        return self.model

    def _stress(self, motion: Motion) -> NDArray[np.float64]:
        model, tets = self._needed("stress"), self._tets_of(motion, "stress")
        mu, lam = (_like(model, self._material(name, motion, "stress")) for name in ("mu", "lam"))
        rows, out = max(1, _CHUNK // max(1, model.num_tets)), []
        for k in range(0, len(motion), rows):
            with torch.no_grad():
                found = stress(model, _like(model, motion.points[k : k + rows]), mu=mu, lam=lam)
            out.append(as_array(found.von_mises)[:, tets])
        return np.concatenate(out)

    def _contact(self, motion: Motion) -> NDArray[np.float64]:
        model = self._needed("contact")
        found = np.zeros(motion.points.shape[:2])
        x = _like(model, motion.points)
        step = _step_between(motion)
        places = None if self.colliders is None else _like(model, as_array(self.colliders))
        if places is not None and len(places) != len(motion):
            fail("colliders", f"{len(motion)} frames", f"shape {list(places.shape)}")
        for k in range(len(motion)):
            given: dict[str, Any] = {} if places is None else {"colliders": places[k]}
            if step is not None and k:
                given |= {"previous": (x[k - 1], x[k - 1]), "solver": VBD(step, 1)}
                given |= {} if places is None else {"colliders_before": places[k - 1]}
            with torch.no_grad():
                found[k] = as_array(forces(model, x[k], **given).vertices.total.norm(dim=-1))
        return found[:, motion.triangles].mean(-1)


def values_of(mesh: Mesh | None, mu: Any, lam: Any, colliders: Any) -> Values:
    """Quantities of motions of a mesh; with a material it becomes a Model, for stresses."""
    if isinstance(mesh, TetMesh) and mu is not None and lam is not None:
        mesh = Model(mesh)
    return Values(mesh if isinstance(mesh, Model) else None, mu, lam, colliders)


def _like(model: Model, points: NDArray[np.float64]) -> torch.Tensor:
    return torch.as_tensor(points, dtype=model.dtype, device=model.device)


def _step_between(motion: Motion) -> float | None:
    """The time [s] of one step where every frame is one; contact has friction and damping then, else none."""
    if motion.times is None or motion.steps is None or len(motion) < 2 or (np.diff(motion.steps) != 1).any():
        return None
    return float(motion.times[1] - motion.times[0])


def legend(colors: Colors, bodies: int) -> str:
    """The legend of colors as HTML."""
    box = "<div style='padding:4px 12px;font-size:13px'>"
    if not colors.unit:
        return f"{box}{'one color for each body' if bodies > 1 else 'one body'}</div>"
    middle = 0.5 * (colors.low + colors.high)
    ends = "".join(f"<span>{value:.4g}</span>" for value in (colors.low, middle, colors.high))
    return (
        f"{box}{colors.title} [{colors.unit}]"
        f"<div style='height:12px;margin:4px 0;background:linear-gradient(to right, {', '.join(RAMP)})'></div>"
        f"<div style='display:flex;justify-content:space-between'>{ends}</div></div>"
    )
