"""Renders animations of what diffvbd does into docs/images/gallery: `python docs/images/gallery.py [NAME ...]`.

Small scenes at modest resolution, some minutes in all on one core. Needs the extra [viz].
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import diffvbd as dv
from diffvbd import losses, viz
from diffvbd.tasks import TASKS, Settings, beam, dress, solve
from diffvbd.viz.motion import load_motions

FOLDER = Path(__file__).parent / "gallery"
MOST_BYTES = 400_000
SIZE = (440, 300)


def main() -> None:
    """Render all, or some by name."""
    parser = argparse.ArgumentParser(description="Renders animations.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(SCENES)} (default: all)")
    parser.add_argument(
        "--out", type=Path, default=FOLDER, help="folder of the animations (default: docs/images/gallery)"
    )
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in SCENES]:
        parser.error(f"NAME: expected names among {', '.join(SCENES)}, got {', '.join(unknown)}")
    options.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    for name in options.names or SCENES:
        begun, path = time.perf_counter(), options.out / f"{name}.webp"
        SCENES[name](path)
        size = path.stat().st_size
        print(f"{path}: {size / 1e3:.0f} kB, {time.perf_counter() - begun:.0f} s", flush=True)
        if size > MOST_BYTES:
            sys.exit(f"{path}: expected at most {MOST_BYTES} bytes, got {size}")


def still(model: dv.Model) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and velocities of a Model at rest."""
    return model.rest_points, torch.zeros_like(model.rest_points)


def twisted_beam(path: Path) -> None:
    """A twisted beam with the first guess of its shear modulus, the observed one and the identified one."""
    mesh = dv.mesh.beam(17, 6, 6, size=beam.SIZE, split="kuhn")
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9)
    x = beam.twisted(model.rest_points, beam.TWIST)

    def simulate(mu: torch.Tensor) -> torch.Tensor:
        solver = dv.VBD(beam.TIME_STEP, beam.SWEEPS, relaxation=beam.RELAXATION, subspace="coarse")
        return dv.rollout(model, x, torch.zeros_like(x), solver, steps=80, mu=mu, lam=beam.LAM,
                          gravity=(0.0, 0.0, 0.0)).x  # fmt: skip

    with torch.no_grad():
        start, true = (simulate(torch.tensor(mu, dtype=x.dtype)) for mu in (beam.START_MU, beam.TRUE_MU))
    log_mu = torch.tensor(beam.START_MU, dtype=x.dtype).log().requires_grad_()
    optimizer = torch.optim.Adam([log_mu], 0.3, betas=(0.7, 0.9), eps=1e-20)
    for _ in range(20):
        optimizer.zero_grad()
        losses.vertex_distance(simulate(log_mu.exp()), true).backward()
        optimizer.step()
    with torch.no_grad():
        found = simulate(log_mu.exp())
    print(f"mu = {log_mu.exp().item():.4g} Pa", file=sys.stderr)
    motions = {"first guess": start, "target": true, "identified": found}
    viz.render(path, motions, mesh, size=SIZE, seconds=3.2, apart=(0.0, 0.0, 0.36), view=(22.0, 35.0), zoom=1.35)


def throw(path: Path) -> None:
    """A ball thrown into a box by the motion of a sheet that L-BFGS has found."""
    task(path, "throw", seconds=3.4, view=(38.0, 62.0), zoom=1.05, ground=0.0)


def bounce(path: Path) -> None:
    """A bunny thrown so that it meets a target after its bounce."""
    task(path, "bunny-bounce", seconds=3.0, view=(12.0, 65.0), zoom=1.25)


def controller(path: Path) -> None:
    """Soft arms that a trained network drives to where they must be."""
    task(path, "learn-controller", seconds=3.0, view=(16.0, 40.0), zoom=1.5)


def many_cubes(path: Path) -> None:
    """Soft cubes that fall in a heap."""
    random, edge = np.random.default_rng(0), 0.1
    one, cubes = dv.mesh.cube(2, edge, split="kuhn").translate((-edge / 2,) * 3), []
    for i, j, k in itertools.product(range(4), range(6), range(4)):
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        place = 0.18 * np.array([i - 1.5, j + 0.6, k - 1.5]) + random.uniform(-0.004, 0.004, 3)
        cubes.append(one.transform(turn).translate(place))
    energies = (
        dv.StableNeoHookean(),
        dv.FloorBarrier(kappa=400.0, dhat=0.008, damping=1.0),
        dv.PairBarrier(400.0, 0.008, self_contact=False, damping=1.0, reach=0.03),
        dv.Friction(0.4, velocity=0.05),
    )
    model = dv.Model(dv.mesh.join(cubes), density=300.0, energies=energies)
    motion = dv.rollout(model, *still(model), solver=dv.VBD(0.005, 20), steps=240, mu=3e4, lam=3e4)
    viz.render(path, motion, model, time_step=0.005, size=SIZE, seconds=3.0, view=(18.0, 50.0), zoom=1.5)


def task(path: Path, name: str, *, seconds: float, view: tuple[float, float], zoom: float,
         ground: float | None = None) -> None:  # fmt: skip
    """The last motion that a task keeps."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(Path(folder))
        problem = TASKS[name].build(settings)
        problem.picture, animation = None, problem.animation
        assert animation is not None
        problem.animation = None
        solve(problem, settings)
        animation(settings.out / "motion.npz")
        *_, last = load_motions(settings.out / "motion.npz").values()
        viz.render(path, last, size=SIZE, seconds=seconds, view=view, zoom=zoom,
                   ground="auto" if ground is None else ground)  # fmt: skip


def stacked_boxes(path: Path) -> None:
    """Boxes that land on each other and stand."""
    side, gap = 0.2, 0.004
    places = [(0.0, k) for k in (-1.0, 0.0, 1.0)] + [(1.0, -0.5), (1.0, 0.5), (2.0, 0.0)]
    centers = [(1.04 * side * k, 0.5 * side + level * (side + 0.05) + 0.08, 0.02 * level) for level, k in places]
    box = dv.mesh.cube(4, side, split="kuhn").translate((-side / 2,) * 3)
    mesh = dv.mesh.join([box.translate(center) for center in centers])
    energies = (
        dv.StableNeoHookean(),
        dv.FloorBarrier(kappa=2e3, dhat=2 * gap, damping=10.0),
        dv.PairBarrier(2e3, 2 * gap, self_contact=False, damping=10.0),
        dv.Friction(0.6, velocity=0.01),
    )
    model = dv.Model(mesh, density=500.0, energies=energies)
    motion = dv.rollout(model, *still(model), solver=dv.VBD(0.01, 24, subspace="coarse"), steps=110, mu=2e5, lam=2e5)
    viz.render(path, motion, model, time_step=0.01, size=SIZE, seconds=2.6, view=(12.0, 75.0), zoom=1.15)


def cloth(path: Path) -> None:
    """A cloth that falls onto a ball and drapes."""
    sheet = dv.mesh.sheet(26, 26, (0.8, 0.8), 0.012).translate((-0.4, 0.62, -0.4))
    energies = (
        dv.StableNeoHookean(),
        dv.FloorBarrier(kappa=400.0, dhat=0.012, damping=1.0),
        dv.PairBarrier(400.0, 0.012, damping=1.0, reach=0.05),
        dv.Friction(0.3, velocity=0.02),
    )
    ball = dv.colliders.Sphere((0.02, 0.32, 0.01), 0.2)
    model = dv.Model(sheet, density=120.0, energies=energies, colliders=[ball])
    motion = dv.rollout(model, *still(model), solver=dv.VBD(0.01, 15), steps=110, mu=1.5e3, lam=1e3)
    viz.render(path, motion, model, time_step=0.01, size=SIZE, seconds=3.0, view=(22.0, 50.0), zoom=1.2)


def gown(path: Path) -> None:
    """A dress that falls onto a mannequin."""
    drape = dress.Drape(Settings(Path()), lambda x: x, dress.FULL)
    times = dress.TIME_STEP
    viz.render(path, drape.target, drape.mesh, time_step=times, scenery=dress.scenery(), size=(320, 400), seconds=2.8,
               view=(12.0, 40.0), zoom=1.1, ground=0.0)  # fmt: skip


def gripper(path: Path) -> None:
    """Two fingers that close on a soft ball, lift it and set it down."""
    radius, finger = 0.06, viz.box((-0.012, 0.0, -0.05), (0.012, 0.14, 0.05))
    ball = dv.mesh.capsule(radius, 0.0, resolution=4).translate((0.0, radius + 0.006, 0.0))
    fingers = [dv.colliders.Obstacle(finger.points + (x, 0.02, 0.0), finger.triangles) for x in (-0.1, 0.1)]
    energies = (
        dv.StableNeoHookean(),
        dv.FloorBarrier(kappa=300.0, dhat=0.006, damping=1.0),
        dv.PairBarrier(1e3, 0.006, self_contact=False, damping=1.0, reach=0.02),
        dv.Friction(0.8, velocity=0.005),
    )
    model = dv.Model(ball, density=200.0, energies=energies, colliders=fingers)
    steps, h = 260, 0.005
    t = h * torch.arange(steps + 1, dtype=torch.float64)

    def ramp(begin: float, end: float) -> torch.Tensor:
        share = ((t - begin) / (end - begin)).clamp(0.0, 1.0)
        return share * share * (3 - 2 * share)

    close = 0.04 * (ramp(0.1, 0.4) - ramp(1.1, 1.25))
    lift = 0.12 * (ramp(0.45, 0.7) - ramp(0.85, 1.08))
    rest, half = model.collider_points, len(finger.points)
    sign = torch.ones(len(rest), dtype=torch.float64).index_fill(0, torch.arange(half, len(rest)), -1.0)
    places = rest + torch.stack(
        [close[:, None] * sign, lift[:, None].expand(-1, len(rest)), 0 * sign.expand(steps + 1, -1)], -1
    )
    motion = dv.rollout(model, *still(model), solver=dv.VBD(h, 15), steps=steps, mu=1e4, lam=1e4,
                        colliders=dv.per_step(places[1:]))  # fmt: skip
    viz.render(path, motion, model, time_step=h, colliders=places, size=SIZE, seconds=3.2, view=(14.0, 70.0), zoom=1.1)


SCENES: dict[str, Callable[[Path], None]] = {
    "beam_mu": twisted_beam,
    "throw": throw,
    "boxes": stacked_boxes,
    "cloth": cloth,
    "dress_mu_lam": gown,
    "gripper": gripper,
    "learn_controller": controller,
    "bunny_bounce": bounce,
    "cubes": many_cubes,
}


if __name__ == "__main__":
    main()
