"""Draws the pictures of the pages on statics, muscles, damping and attachments into docs/images/soft: `python
docs/images/soft.py`. Half a minute on one core; needs matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from torch import Tensor

import diffvbd as dv

FOLDER = Path(__file__).parent / "soft"
BLUE, RED, GREY = "#3b6ea8", "#d0563f", "#b8bec6"
STATIC, STILL = dv.VBD(1.0, 0, subspace="coarse"), (0.0, 0.0, 0.0)


def rest(model: dv.Model, start: Tensor | None = None, **inputs: Any) -> Tensor:
    return dv.equilibrium(model, model.rest_points if start is None else start, STATIC, **inputs).x


def side(ax: Any, mesh: dv.TetMesh, x: Tensor, shift: tuple[float, float] = (0.0, 0.0), color: Any = BLUE) -> None:
    """A body seen along -z; color: one, or one for each vertex."""
    points, triangles = x.numpy() + (*shift, 0.0), mesh.surface
    a, b, c = (points[triangles[:, k]] for k in range(3))
    front = np.flatnonzero(np.cross(b - a, c - a)[:, 2] > 0)
    front = front[points[triangles[front], 2].mean(1).argsort(kind="stable")]
    of_faces = color if isinstance(color, str) else np.asarray(color)[triangles[front]].mean(1)
    ax.add_collection(PolyCollection(points[triangles[front], :2], facecolors=of_faces, edgecolors="#ffffff90", lw=0.3))
    ax.set_aspect("equal")
    ax.axis("off")
    ax.autoscale_view()


def row(figure: Any, count: int) -> Any:
    return figure.subplots(1, count, sharex=True, sharey=True)


def statics(figure: Any) -> None:
    mesh = dv.mesh.beam(25, 5, 5, size=(0.6, 0.1, 0.1))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9)
    for ax, young in zip(row(figure, 3), (2e6, 4e5, 1e5), strict=True):
        x = rest(model, young=young, poisson=0.3)
        stress = dv.stress(model, x, young=young, poisson=0.3).von_mises
        values = torch.stack([stress, torch.ones_like(stress)]).repeat_interleave(4, 1)
        total, count = torch.zeros(2, len(x), dtype=x.dtype).index_add(1, model.tets.reshape(-1), values)
        side(ax, mesh, model.rest_points, color="#e6e9ed")
        side(ax, mesh, x, color=colormaps["viridis"]((total / count / 4e4).clamp(max=1).numpy()))
        ax.set_title(f"E = {young / 1e3:g} kPa, {1e3 * float((model.rest_points - x)[-1, 1]):.0f} mm", fontsize=9)


def muscles(figure: Any) -> None:
    mesh = dv.mesh.beam(25, 5, 3, size=(0.4, 0.06, 0.06))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9)
    upper = torch.from_numpy(mesh.points[mesh.tets].mean(1)[:, 1] > 0.03)
    fibres = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(mesh.num_tets, 3)
    color = np.where((mesh.points[:, 1] > 0.029)[:, None], [0.82, 0.34, 0.25, 1.0], [0.72, 0.75, 0.78, 1.0])
    x = model.rest_points
    for ax, activation in zip(row(figure, 4), (0.0, 0.1, 0.2, 0.3), strict=True):
        grown = dv.fibre_contraction(fibres, activation * upper.double())
        x = rest(model, x, young=1e5, poisson=0.4, stress_free=grown, gravity=STILL)
        side(ax, mesh, x, color=color)
        ax.set_title(f"activation {activation:g}", fontsize=9)


def damping(figure: Any) -> None:
    mesh = dv.mesh.beam(9, 3, 3, size=(0.6, 0.1, 0.1))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9)
    x = model.rest_points
    v = torch.stack([torch.zeros_like(x[:, 0]), 0.5 * (x[:, 0] / 0.6) ** 2, torch.zeros_like(x[:, 0])], 1)
    (mu, lam), h, ax = dv.lame(1e6, 0.3), 5e-3, figure.subplots()
    solver = dv.VBD(h, sweeps=12, relaxation=1.5, subspace="coarse", integrator=dv.SDIRK2())
    cases = {"no damping": (0.0, 0.0), "viscosity, b = 10 ms": (0.01, 0.0), "drag 5 / s": (0.0, 5.0)}
    for (name, (b, drag)), color in zip(cases.items(), (GREY, RED, BLUE), strict=True):
        given = {"viscosity": b * mu, "volume_viscosity": b * lam, "drag": drag}
        motion = dv.rollout(model, x, v, solver, duration=1.0, mu=mu, lam=lam, gravity=STILL, **given)
        height = 1e3 * (motion.x - x)[:, x[:, 0] > 0.59, 1].mean(1)
        ax.plot(h * np.arange(len(height)), height, color=color, label=name)
    ax.set(xlabel="time [s]", ylabel="height of the tip [mm]")
    ax.legend(frameon=False, fontsize=9, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.18))
    ax.spines[["top", "right"]].set_visible(False)


def tendon(figure: Any) -> None:
    mesh = dv.mesh.beam(25, 5, 5, size=(0.1, 0.02, 0.02))
    route = dv.Embedding.of_points(mesh, [[s, 0.021, 0.01] for s in np.linspace(0, 0.1, 6)])
    energies = (dv.StableNeoHookean(), dv.Tendons(route, [range(6)], stiffness=100.0, rest_length=0.1))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=energies)
    x = model.rest_points
    for ax, length in zip(row(figure, 4), (0.1, 0.09, 0.08, 0.07), strict=True):
        x = rest(model, x, young=1e5, poisson=0.4, gravity=STILL, tendon_rest_length=length)
        tension = dv.coupling_forces(model, x, tendon_rest_length=length).tendons
        assert tension is not None
        side(ax, mesh, x, color=GREY)
        ax.plot(*route.at(x)[:, :2].T, color=RED, lw=1.5, marker="o", ms=3)
        ax.set_title(f"L = {1e3 * length:.0f} mm: {float(tension):.2f} N", fontsize=9)


def pressure(figure: Any) -> None:
    box = dv.mesh.box((25, 9, 9), (0.12, 0.02, 0.02))
    middle = box.points[box.tets].mean(1)
    hole = ((middle > (0.005, 0.0075, 0.0025)) & (middle < (0.115, 0.0175, 0.0175))).all(1)
    used, tets = np.unique(box.tets[~hole], return_inverse=True)
    mesh = dv.TetMesh(box.points[used], tets.reshape(-1, 4))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=(dv.StableNeoHookean(), dv.Pressure()))
    x, rest_volume, half = model.rest_points, None, mesh.points[mesh.tets].mean(1)[:, 2] < 0.01
    section = dv.TetMesh(mesh.points, mesh.tets[half])
    color = np.where((mesh.points[:, 2] > 0.0099)[:, None], [0.23, 0.43, 0.66, 1.0], [0.87, 0.9, 0.94, 1.0])
    for ax, p in zip(row(figure, 4), (0.0, 4e3, 8e3, 1.2e4), strict=True):
        x = rest(model, x, young=2e5, poisson=0.4, gravity=STILL, pressure=p)
        volume = dv.coupling_forces(model, x).volume
        assert volume is not None
        rest_volume = float(volume) if rest_volume is None else rest_volume
        side(ax, section, x, color=color)
        ax.set_title(f"{p / 1e3:g} kPa, V = {float(volume) / rest_volume:.2f} V$_0$", fontsize=9)


PICTURES: dict[Callable[[Any], None], tuple[float, float]] = {
    statics: (8, 2.4),
    muscles: (8, 2.2),
    damping: (7, 2.6),
    tendon: (8, 2.2),
    pressure: (8, 1.6),
}


def main() -> None:
    from PIL import Image  # matplotlib needs it, too

    FOLDER.mkdir(exist_ok=True)
    for draw, size in PICTURES.items():
        figure, path = Figure(figsize=size, layout="constrained", dpi=120), FOLDER / f"{draw.__name__}.png"
        draw(figure)
        figure.savefig(path)
        Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)  # an eighth of the bytes


if __name__ == "__main__":
    main()
