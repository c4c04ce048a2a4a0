"""Scenes with contact, and the two executions of a rollout that the tests compare: compiled, and autograd through the
reference with the detections of the compiled one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from .. import mesh
from .._common.checks import input_name
from .._contact import colliders
from .._contact.barrier import Friction, PairBarrier
from ..energies import FloorBarrier, StableNeoHookean
from ..inspect.record import record
from ..model.model import Model
from ..model.solver import VBD
from ..ops.fields import NO_MOVE
from ..reference import contact as reference
from ..step.step import step
from .scenes import generator

GRAVITY = (0.3, -9.81, 0.2)


@dataclass
class Scene:
    """A Model with contact and everything that a step is differentiated in; tensors of float64 on the CPU."""

    model: Model
    x: Tensor
    v: Tensor
    time_step: float = 1 / 100
    inputs: dict[str, Any] = field(default_factory=dict)  # mu, lam, force, prescribed, colliders, ...
    parameters: dict[str, Tensor] = field(default_factory=dict)

    def solver(self, sweeps: int, **options: Any) -> VBD:
        """A solver with the scene's time step."""
        return VBD(self.time_step, sweeps, **options)

    def leaves(self) -> dict[str, Tensor]:
        """Fresh differentiable copies of all inputs, parameters by their names."""
        given = {"x": self.x, "v": self.v, **self.inputs, **self.parameters}
        return {name: value.detach().clone().requires_grad_() for name, value in given.items()}


def noise(*key: Any, shape: Sequence[int], size: float) -> Tensor:
    return torch.from_numpy(generator("contact", *key).normal(scale=size, size=tuple(shape)))


def boxes(*offsets: tuple[float, float, float], points: Any = 3, size: Any = 0.2) -> mesh.TetMesh:
    return mesh.join([mesh.box(points, size, split="kuhn").translate(offset) for offset in offsets])


def build(name: str, tets: mesh.TetMesh, energies: Sequence[Any], speed: float = 0.1, batch: tuple[int, ...] = (),
          jitter: float = 2e-3, time_step: float = 1 / 100, **options: Any) -> Scene:  # fmt: skip
    """Bodies slightly out of shape, moving a little, of soft material that differs from tet to tet."""
    model = Model(tets, energies=(StableNeoHookean(), *energies), **options)
    shape = (*batch, model.num_vertices, 3)
    x = torch.from_numpy(tets.points.copy()) + noise(name, "x", shape=shape, size=jitter)
    v = noise(name, "v", shape=shape, size=speed)
    tet_shape = (*batch, model.num_tets)
    inputs = {
        "mu": 2e4 * torch.exp(noise(name, "mu", shape=tet_shape, size=0.2)),
        "lam": 4e4 * torch.exp(noise(name, "lam", shape=tet_shape, size=0.2)),
        "force": noise(name, "force", shape=shape, size=0.5),
        "density": 1000 * torch.exp(noise(name, "density", shape=tet_shape, size=0.1)),
    }
    constants = {input_name(e, k): v for e in model.parametric_energies for k, v in model.constants(e).items()}
    wanted = ("pair_kappa", "pair_damping", "friction", "floor_kappa", "floor_height")
    parameters = {k: v.clone() for k, v in constants.items() if k in wanted}
    return Scene(model, x, v, time_step, inputs, parameters)


def stacked() -> Scene:
    """A box that has landed on a box on the floor, a little turned: faces, edges and corners touch."""
    energies = (FloorBarrier(height=-0.015, kappa=3e4, dhat=0.02, damping=2.0),
                PairBarrier(kappa=3e4, dhat=0.02, damping=3.0), Friction(0.4, 0.05))  # fmt: skip
    scene = build("stacked", boxes((0, 0, 0), (0.03, 0.213, 0.02)), energies, jitter=3e-3)
    scene.v[27:] += torch.tensor([0.4, -0.8, 0.2])
    return scene


def crossed() -> Scene:
    """Two beams that cross like the sticks of a fire: edges meet edges, inside a short motion."""
    under, over = (mesh.box(n, size, split="kuhn") for n, size in (((5, 2, 2), (0.4, 0.08, 0.08)),
                                                                  ((2, 2, 5), (0.08, 0.08, 0.4))))  # fmt: skip
    tets = mesh.join([under, over.translate((0.163, 0.094, -0.157))])
    scene = build("crossed", tets, (PairBarrier(kappa=1e4, dhat=0.03, damping=1.0), Friction(0.3, 0.1)),
                  jitter=4e-3)  # fmt: skip
    scene.v[:, 1] += torch.where(scene.model.body == 0, 1.5, -1.5)
    return scene


def fast() -> Scene:
    """Two boxes at 12 m/s against each other, with spin: pairs hold most vertices up."""
    scene = build("fast", boxes((0, 0, 0), (0.05, 0.23, 0.03)), (PairBarrier(kappa=1e4, dhat=0.02, detections=3),
                                                                Friction(0.2, 0.1)))  # fmt: skip
    spin = torch.tensor([[3.0, 9.0, -5.0]], dtype=torch.float64)
    scene.v += torch.linalg.cross(scene.x - scene.x.mean(0), spin, dim=-1)
    scene.v[27:, 1] -= 12.0
    scene.v[:27, 1] += 12.0
    return scene


def folded() -> Scene:
    """A thin strip folded over itself: self-contact, and pairs that are closer than dhat at rest."""
    tets = mesh.box((9, 2, 3), (0.8, 0.02, 0.2), split="kuhn")
    scene = build("folded", tets, (PairBarrier(kappa=5e3, dhat=0.03, damping=0.5),), jitter=0.0)
    points = scene.x.clone()
    radius, bend = 0.02, torch.pi
    along = points[:, 0] - 0.4
    angle = (along / radius).clamp(0, bend)
    beyond = (along - bend * radius).clamp(min=0)
    height = points[:, 1] + radius - 0.01
    turned_x = 0.4 + torch.where(along > 0, height.new_tensor(0.0), along) + (radius + 0.01) * torch.sin(angle) - beyond
    middle = 0.02
    offset = points[:, 1] - 0.01
    turned_y = middle - (middle - offset) * torch.cos(angle)
    scene.x = torch.stack([turned_x, turned_y, points[:, 2]], 1) + noise("folded", shape=points.shape, size=5e-4)
    return scene


def obstacles() -> Scene:
    """A box among a sphere, a capsule, a wedge and a plane, all moving; some vertices are prescribed."""
    wedge = colliders.Obstacle([[-0.02, 0.1, 0.24], [0.22, 0.1, 0.24], [0.1, 0.32, 0.25]], [[0, 1, 2]])
    things = (colliders.Sphere((0.1, -0.061, 0.1), 0.05), colliders.Capsule((0.31, 0.0, 0.0), (0.31, 0.2, 0.1), 0.1),
              wedge, colliders.Plane((0, 0, -0.012), (0.02, 0.03, 1.0)))  # fmt: skip
    barrier = PairBarrier(kappa=2e4, dhat=0.03, self_contact=False, damping=2.0)
    scene = build("obstacles", boxes((0, 0, 0)), (barrier, Friction(0.5, 0.05)), colliders=things, pinned=[8, 17],
                  jitter=1e-3)  # fmt: skip
    points = scene.model.collider_points
    scene.inputs["colliders_before"] = points + noise("obstacles", "before", shape=points.shape, size=2e-4)
    moved = noise("obstacles", "move", shape=points.shape, size=5e-4)
    scene.inputs["colliders"] = scene.inputs["colliders_before"] + moved
    moved = scene.x + noise("obstacles", "held", shape=scene.x.shape, size=5e-4)
    scene.inputs["prescribed"] = torch.where(scene.model.pinned[:, None], moved, torch.nan)
    return scene


def batched() -> Scene:
    """Three scenes of two boxes, each with its own material and parameters."""
    scene = build("batched", boxes((0, 0, 0), (0.04, 0.212, -0.03), points=2), (
        FloorBarrier(height=-0.012, kappa=2e4, dhat=0.02), PairBarrier(kappa=2e4, dhat=0.02, damping=1.0),
        Friction(0.3, 0.05)), batch=(3,), jitter=4e-3)  # fmt: skip
    for name in ("pair_kappa", "pair_damping", "friction"):
        scene.parameters[name] = scene.parameters[name] * torch.tensor([0.8, 1.0, 1.3], dtype=torch.float64)
    return scene


def thrown() -> Scene:
    """Two boxes that meet at 10 m/s, one beside a sphere that moves; a vertex is prescribed. Nobody says
    how many detections that takes."""
    barrier = PairBarrier(kappa=1e4, dhat=0.02, self_contact=False, damping=1.0)
    sphere = colliders.Sphere((0.26, 0.1, 0.1), 0.05)
    scene = build("thrown", boxes((0, 0, 0), (0.05, 0.23, 0.03), points=2), (barrier, Friction(0.2, 0.1)),
                  colliders=(sphere,), pinned=[0], jitter=2e-3)  # fmt: skip
    scene.v[8:, 1] -= 10.0
    points = scene.model.collider_points
    scene.inputs["colliders_before"] = points + noise("thrown", "before", shape=points.shape, size=2e-4)
    scene.inputs["colliders"] = scene.inputs["colliders_before"] + torch.tensor([-0.001, 0.002, 0.0])
    moved = scene.x + torch.tensor([0.002, -0.001, 0.001])
    scene.inputs["prescribed"] = torch.where(scene.model.pinned[:, None], moved, torch.nan)
    return scene


def held_up() -> Scene:
    """Two scenes of boxes that meet; in one so fast that pairs still hold them up after the parts that were planned."""
    barrier = PairBarrier(kappa=1e4, dhat=0.02, self_contact=False, damping=1.0, detections=2)
    scene = build("held_up", boxes((0, 0, 0), (0.05, 0.23, 0.03), points=2), (barrier, Friction(0.2, 0.1)),
                  batch=(2,), jitter=2e-3)  # fmt: skip
    scene.v[0, 8:, 1] -= 64.0
    return scene


def on_held() -> Scene:
    """Two scenes of a box on one whose bottom is pinned; in the first it is stiff and rests, in the second it falls."""
    tets = boxes((0, 0, 0), (0.03, 0.213, 0.02), points=2)
    barrier = PairBarrier(kappa=3e4, dhat=0.02, self_contact=False, damping=1.0)
    scene = build("on_held", tets, (barrier, Friction(0.4, 0.05)), batch=(2,), speed=0.02, jitter=1e-5,
                  pinned=(tets.body == 0) & (tets.points[:, 1] < 1e-9))  # fmt: skip
    for modulus in ("mu", "lam"):
        scene.inputs[modulus] = scene.inputs[modulus] * torch.tensor([[100.0], [1.0]], dtype=torch.float64)
    return scene


SCENES: dict[str, Callable[[], Scene]] = {f.__name__: f for f in (stacked, crossed, fast, folded, obstacles, batched,
                                                                 thrown, held_up, on_held)}  # fmt: skip


def substep_of(detection: Any) -> reference.Substep:
    """Index data of a detection as the reference takes it."""
    count = int(detection.counts[0])
    limits = None
    if detection.limits is not None:
        exponents = detection.limits.cpu().double().movedim(1, 0)
        limits = torch.where(exponents < NO_MOVE, 0.5**exponents, 0.0)
    pairs, constants = detection.listed.pairs[:count].cpu().long(), detection.listed.constants[:count].cpu()
    if detection.kept is not None:  # those that the sweeps can reach, and those that friction at the start is of
        rows = constants[:, -1] < constants[:, 0]
        rows[detection.kept] = True
        pairs, constants = pairs[rows], constants[rows]
    return reference.Substep(pairs, constants, detection.u.cpu(), detection.fractions.cpu(), detection.truncated.cpu(),
                             torch.stack(detection.corrections).cpu(), limits,
                             lengths=None if detection.lengths is None else detection.lengths.cpu(),
                             sweeps=detection.sweeps, going=None if detection.going is None else detection.going.cpu(),
                             resting=None if detection.resting is None else detection.resting.cpu())  # fmt: skip


def objective(x: Tensor, v: Tensor) -> Tensor:
    """A sum that weighs every component of the end state differently."""
    weights = [noise("objective", name, shape=x.shape, size=1.0).to(x) for name in ("x", "v")]
    return (weights[0] * x).sum() + 1e-2 * (weights[1] * v).sum()


def compiled(scene: Scene, steps: int, solver: VBD, model: Model | None = None
             ) -> tuple[dict[str, Tensor], list[list[reference.Substep]]]:  # fmt: skip
    """End state and gradients of the package's steps, and the detections of each of them."""
    model = scene.model if model is None else model
    leaves = {k: v.detach().to(model.device, model.dtype).requires_grad_() for k, v in scene.leaves().items()}
    inputs: dict[str, Any] = dict(leaves)
    x, v = inputs.pop("x"), inputs.pop("v")
    substeps = []
    for _ in range(steps):
        with record("contact") as found:
            x, v = step(model, x, v, solver, gravity=GRAVITY, **inputs)
        substeps.append([substep_of(d) for d in found])
    return _result(x, v, leaves), substeps


def unrolled(scene: Scene, steps: int, solver: VBD, substeps: list[list[reference.Substep]], seed: int | None = None
             ) -> dict[str, Tensor]:  # fmt: skip
    """The same by autograd through the reference; ``seed`` permutes pairs and tets, which changes rounding alone."""
    leaves = scene.leaves()
    inputs: dict[str, Any] = dict(leaves)
    x, v = inputs.pop("x"), inputs.pop("v")
    for own in substeps[:steps]:
        order = tets = None
        if seed is not None:
            rng = generator("order", seed)
            order = [torch.from_numpy(rng.permutation(len(p.pairs))) for p in own]
            tets = torch.from_numpy(rng.permutation(scene.model.num_tets))
        x, v = reference.contact_step(scene.model, x, v, solver, gravity=GRAVITY, substeps=own, order=order,
                                      tet_order=tets, **inputs)  # fmt: skip
    return _result(x, v, leaves)


def _result(x: Tensor, v: Tensor, leaves: dict[str, Tensor]) -> dict[str, Tensor]:
    grads = torch.autograd.grad(objective(x, v), list(leaves.values()), allow_unused=True, materialize_grads=True)
    out = {"x": x, "v": v, **{f"grad_{k}": g for k, g in zip(leaves, grads, strict=True)}}
    return {k: t.detach().cpu() for k, t in out.items()}
