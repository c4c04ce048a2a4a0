"""Scenes of statics, damping, muscles and couplings that tests and benchmarks share, and what they recover."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import mesh as meshes
from ..couplings import Pressure, Springs, Tendons
from ..embedding import Embedding
from ..energies import Anchor, FloorBarrier, StableNeoHookean
from ..mesh import TetMesh
from ..model.material import fibre_contraction, lame
from ..model.model import Model
from ..model.solver import SDIRK2, VBD, Integrator
from ..rollout.rollout import rollout
from .dense_statics import Energy, barrier, coupling_energy, potential

STILL = (0.0, 0.0, 0.0)  # no gravity
MODULI = dict(zip(("mu", "lam"), lame(1e6, 0.3), strict=True))

# --- static problems --------------------------------------------------------------------------------------------------


class Problem(NamedTuple):
    model: Model
    inputs: dict[str, Any]
    more: Energy | None = None  # energies beside that of the tets
    weighs: bool = True


def beam(young: Any, poisson: float = 0.3, shape: tuple[int, int, int] = (7, 3, 3),
         size: tuple[float, float, float] = (0.6, 0.1, 0.1)) -> Problem:  # fmt: skip
    mesh = meshes.beam(*shape, size=size)
    return Problem(Model(mesh, pinned=mesh.points[:, 0] < 1e-9), {"young": young, "poisson": poisson})


def held(place: Callable[[Tensor], Tensor], axis: int = 0) -> Problem:
    """A beam whose two ends are put somewhere else."""
    mesh = meshes.beam(7, 3, 3, size=(0.3, 0.1, 0.1)) if axis == 0 else meshes.cube(4, size=0.2)
    along = mesh.points[:, axis]
    model = Model(mesh, pinned=(along < along.min() + 1e-9) | (along > along.max() - 1e-9))
    where = torch.where(model.pinned[:, None], place(model.rest_points), torch.nan)
    inputs = {"young": 1e5, "poisson": 0.3, "prescribed": where, "gravity": (0.0, 0.0, 0.0)}
    return Problem(model, inputs, weighs=False)


def twisted(x: Tensor) -> Tensor:
    angle, arm = math.pi / 2 * x[:, 0] / 0.3, x[:, 1:] - x[:, 1:].mean(0)
    y, z = arm.unbind(1)
    turned = torch.stack([angle.cos() * y - angle.sin() * z, angle.sin() * y + angle.cos() * z], 1)
    return torch.cat([x[:, :1], x[:, 1:].mean(0) + turned], 1)


def springs(model: Model, stiffness: float, vertices: Tensor) -> Energy:
    points = model.rest_points[vertices]
    return lambda x: stiffness / 2 * (x[vertices] - points).square().sum()


def anchored() -> Problem:
    mesh = meshes.beam(7, 3, 3, size=(0.4, 0.1, 0.1))
    ends = torch.as_tensor((mesh.points[:, 0] < 1e-9) | (mesh.points[:, 0] > 0.4 - 1e-9))
    model = Model(mesh, energies=(StableNeoHookean(), Anchor(200.0, vertices=ends)))
    return Problem(model, {"young": 3e4, "poisson": 0.3}, springs(model, 200.0, ends))


def on_floor() -> Problem:
    mesh = meshes.cube(4, size=0.2)
    top = torch.as_tensor(mesh.points[:, 1] > 0.2 - 1e-9)
    floor = FloorBarrier(height=-0.01, kappa=1e4, dhat=0.02)
    model = Model(mesh, energies=(StableNeoHookean(), floor, Anchor(0.1, vertices=top)))
    hold = springs(model, 0.1, top)
    return Problem(model, {"young": 1e4, "poisson": 0.3},
                   lambda x: hold(x) + barrier(x[:, 1] + 0.01, 1e4, 0.02).sum())  # fmt: skip


def two_materials() -> Problem:
    young = torch.where(torch.arange(120) % 2 == 0, 1e5, 1e6).double()
    return beam(young)


def necked(inner: float, outer: float, density: float = 1000.0) -> Problem:
    """Two blobs that a thin neck joins, and the Young's moduli of the one that is pinned and of the other."""
    mesh = meshes.beam(11, 3, 3, size=(0.5, 0.2, 0.2))
    points = mesh.points - mesh.points.mean(0)
    section = abs(points[:, 0]).clip(0.06, 0.12) * (0.8 / 0.06) - 0.6  # 0.2 in the neck, 1 outside
    points[:, 1:] *= section[:, None]
    young = torch.where(torch.as_tensor(points[mesh.tets].mean(1)[:, 0] > 0), outer, inner).double()
    pinned = points[:, 0] < points[:, 0].min() + 1e-9
    model = Model(TetMesh(points, mesh.tets), density=density, pinned=pinned)
    return Problem(model, {"young": young, "poisson": 0.3})


def coupled(model: Model, values: dict[str, Any], **inputs: Any) -> Problem:
    """A Model with couplings, without gravity; values: inputs of the couplings, all of them."""
    values = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in values.items()}
    return Problem(model, {"gravity": STILL, **inputs, **values}, lambda x: coupling_energy(model, x, values), False)


def hung() -> Problem:
    """A beam that hangs on two springs at each end."""
    mesh = meshes.beam(7, 3, 3, size=(0.6, 0.1, 0.1))
    ends = Embedding.of_points(mesh, [[x, 0.05, z] for x in (0.0, 0.6) for z in (0.0, 0.1)])
    places = ends.at(torch.from_numpy(mesh.points.copy())) + torch.tensor([0.0, 0.3, 0.0])
    model = Model(mesh, energies=(StableNeoHookean(), Springs(ends, places, 1.0)))
    values = {"spring_points": places, "spring_stiffness": [200.0, 300.0, 500.0, 400.0], "spring_rest_length": 0.3}
    problem = coupled(model, values, young=1e5, poisson=0.3)
    return problem._replace(inputs={k: v for k, v in problem.inputs.items() if k != "gravity"}, weighs=True)


def finger_on_palm(shortened: float = 0.026) -> tuple[Model, Embedding]:
    """A free finger that nine attachments hold on a palm and a tendon bends, and its tip."""
    palm = meshes.beam(4, 3, 3, size=(0.03, 0.02, 0.02))
    mesh = meshes.join([palm, meshes.beam(13, 3, 3, size=(0.1, 0.02, 0.02)).translate((0.031, 0, 0))])
    face = [[y, z] for y in (0.002, 0.01, 0.018) for z in (0.002, 0.01, 0.018)]
    sides = [Embedding.of_points(mesh, [[x, *at] for at in face]) for x in (0.03, 0.031)]
    route = [[x, 0.018, 0.01] for x in (0.002, 0.02, *np.linspace(0.04, 0.128, 6))]
    tendon = Tendons(Embedding.of_points(mesh, route), [range(8)], 100.0, 0.126 - shortened)
    energies = (StableNeoHookean(), Springs(*sides, stiffness=600.0), tendon)
    model = Model(mesh, density=1100.0, pinned=mesh.points[:, 0] < 1e-9, energies=energies)
    return model, Embedding.of_points(mesh, [[0.131, 0.01, 0.01]])


def hollow_finger() -> Model:
    """A finger of 0.08 m whose cavity, filled with gas, is nearer to its upper side."""
    box = meshes.box((9, 5, 5), (0.08, 0.02, 0.02))
    middle = box.points[box.tets].mean(1)
    hole = ((middle > (0.01, 0.01, 0.005)) & (middle < (0.07, 0.015, 0.015))).all(1)
    used, tets = np.unique(box.tets[~hole], return_inverse=True)
    mesh = TetMesh(box.points[used], tets.reshape(-1, 4))
    return Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=(StableNeoHookean(), Pressure(gas=True)))


def bent_by_tendon() -> Problem:
    model = finger((16, 4, 4), (0.1, 0.02, 0.02), 6, 100.0)
    return coupled(model, {"tendon_stiffness": 100.0, "tendon_rest_length": 0.07}, young=1e5, poisson=0.3)


def balloon(gas: bool) -> Problem:
    mesh = meshes.shell(*icosphere(1), 0.1)
    model = Model(mesh, pinned=mesh.points[:, 1] < -0.5, energies=(StableNeoHookean(), Pressure(gas=gas)))
    return coupled(model, {"pressure": 3e4 if gas else 3e3}, young=1e5, poisson=0.4)


def slender(young: float) -> Problem:
    """40 times as long as thick."""
    return beam(young, shape=(31, 2, 2), size=(1.2, 0.03, 0.03))


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "small sag": lambda: beam(1e6),
    "large sag": lambda: beam(5e4),
    "twisted": lambda: held(twisted),
    "stretched": lambda: held(lambda x: x * x.new_tensor([2.0, 1.0, 1.0])),
    "compressed": lambda: held(lambda x: x * x.new_tensor([1.0, 0.7, 1.0]), axis=1),
    "anchors": anchored,
    "floor": on_floor,
    "two materials": two_materials,
    "neck": lambda: necked(1e6, 1e6),
    "neck, contrast": lambda: necked(1e8, 1e4),
    "slender": lambda: slender(2.4e7),
    "hanging": lambda: slender(4.5e4),  # and stretched by its weight
    "incompressible": lambda: beam(1e6, 0.4999),
    "hung on springs": hung,
    "bent by a tendon": bent_by_tendon,
    "balloon": lambda: balloon(False),
    "balloon of gas": lambda: balloon(True),
}


# --- damping ----------------------------------------------------------------------------------------------------------


class Mode:
    """The lowest mode of a clamped beam and its motion from a small velocity."""

    def __init__(self) -> None:
        self.model = model = beam(1e6, shape=(7, 2, 2)).model
        free, x = ~model.pinned, model.rest_points
        stiffness = torch.func.hessian(potential(model, torch.zeros_like(x), **MODULI))(x).reshape(x.numel(), -1)
        keep = free.repeat_interleave(3)
        root = np.sqrt(model.mass.repeat_interleave(3)[keep].numpy())
        values, vectors = np.linalg.eigh(stiffness[keep][:, keep].numpy() / np.outer(root, root))
        self.frequency = float(np.sqrt(values[0]))
        self.shape = torch.zeros_like(x)
        self.shape[free] = torch.from_numpy(vectors[:, 0] / root).reshape(-1, 3)

    def solver(self, per_period: int, sweeps: int, integrator: Integrator) -> VBD:
        h = 2 * math.pi / self.frequency / per_period
        return VBD(h, sweeps, relaxation=1.5, subspace="coarse", integrator=integrator)

    def amplitudes(self, solver: VBD, steps: int, **damping: Any) -> Tensor:
        x = self.model.rest_points
        motion = rollout(self.model, x, 1e-5 * self.shape, solver, steps=steps, gravity=STILL, **MODULI, **damping)
        weight = self.model.mass[:, None] * self.shape
        return ((motion.x - x) * weight).sum((-2, -1)) * 1e5

    def viscosities(self, ratio: Any) -> dict[str, Any]:
        """Those that give the mode a damping ratio."""
        rate = 2 * ratio / self.frequency
        return {"viscosity": rate * MODULI["mu"], "volume_viscosity": rate * MODULI["lam"]}

    def ring(self, solver: VBD, steps: int, ratio: Any) -> Tensor:
        """Displacement of the damped mode with unit velocity at t = 0, by the formula."""
        t, w = solver.time_step * torch.arange(steps + 1, dtype=torch.float64), self.frequency
        damped = w * (1 - ratio**2) ** 0.5
        return torch.exp(-ratio * w * t) * torch.sin(damped * t) / damped

    def recovered(self, true: float, seed: int = 3, noise: float = 0.01) -> float:
        """Damping ratio recovered from a noisy motion, by the gradient of the rollout. It is seen until it has decayed
        to 1 / e, three periods at least."""
        per_period = 40
        steps = per_period * max(3, round(1 / (2 * math.pi * true)))
        solver = self.solver(per_period, 20, SDIRK2())
        clean, random = self.ring(solver, steps, true), torch.Generator().manual_seed(seed)
        seen = clean + noise * clean.abs().max() * torch.randn(steps + 1, dtype=torch.float64, generator=random)
        ratio = torch.tensor(1.5 * true, dtype=torch.float64, requires_grad=True)
        for _ in range(3):  # Newton's method on a curve that is almost linear in log(ratio)
            found, at = self.amplitudes(solver, steps, **self.viscosities(ratio)), ratio.detach()
            weight = self.ring(solver, steps, at * 1.02) - self.ring(solver, steps, at / 1.02)
            miss = ((found - seen) * weight).sum()
            (slope,) = torch.autograd.grad(miss, ratio)
            assert float(slope) != 0
            ratio = (at - miss.detach() / slope).requires_grad_()
        return float(ratio.detach())


# --- muscles ----------------------------------------------------------------------------------------------------------


def recovered_activation(true: Tensor, noise: float = 1e-5) -> Tensor:
    """Activations of four muscles of a bar recovered from the noisy frames [m] of a motion, by L-BFGS."""
    mesh = meshes.beam(5, 2, 2, size=(0.4, 0.1, 0.1))
    model, center = Model(mesh, pinned=mesh.points[:, 0] == 0), torch.from_numpy(mesh.points[mesh.tets].mean(1))
    muscle = (center[:, 0] > 0.2).long() + 2 * (center[:, 1] > center[:, 1].mean()).long()
    along = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(mesh.num_tets, 3)
    x, solver = model.rest_points, VBD(0.01, sweeps=8)

    def frames(activation: Tensor) -> Tensor:
        g = fibre_contraction(along, activation[muscle])
        return rollout(model, x, torch.zeros_like(x), solver, steps=12, stress_free=lambda k, x, v: g, gravity=STILL,
                       young=1e5, poisson=0.3).x  # fmt: skip

    seen = frames(true)
    seen = seen + noise * torch.randn(seen.shape, dtype=seen.dtype, generator=torch.Generator().manual_seed(0))
    found = torch.full_like(true, 0.1, requires_grad=True)
    optimizer = torch.optim.LBFGS([found], max_iter=16, line_search_fn="strong_wolfe", tolerance_grad=1e-14,
                                  tolerance_change=1e-16)  # fmt: skip

    def loss() -> Tensor:
        optimizer.zero_grad()
        error = 1e4 * (frames(found) - seen).square().sum()
        error.backward()
        return error

    optimizer.step(loss)
    return found.detach()


# --- tendons and pressure ---------------------------------------------------------------------------------------------


def finger(nodes: tuple[int, int, int], size: tuple[float, float, float], points: int, k: float) -> Model:
    """A beam along x with a tendon along its upper side."""
    mesh = meshes.beam(*nodes, size=size)
    route = np.stack([np.linspace(0, size[0], points), np.full(points, size[1]), np.full(points, size[2] / 2)], 1)
    tendon = Tendons(Embedding.of_points(mesh, route), [range(points)], k, size[0])
    return Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=(StableNeoHookean(), tendon))


def icosphere(levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a unit sphere."""
    t = (1 + 5**0.5) / 2
    signs = np.array([[-1, t], [1, t], [-1, -t], [1, -t]])
    zero = np.zeros((4, 1))
    points = np.concatenate([np.hstack([signs, zero]), np.hstack([zero, signs]), np.hstack([signs[:, 1:], zero,
                                                                                          signs[:, :1]])])  # fmt: skip
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    near = np.isclose(distance, 2.0)
    triangles = [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k]
                 and near[i, k]]  # fmt: skip
    faces = np.array(triangles)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ni,ni->n", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(levels):
        sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, inverse = np.unique(sides, axis=0, return_inverse=True)
        (a, b, c), (ab, bc, ca) = faces.T, len(points) + inverse.reshape(3, -1)
        points = np.concatenate([points, points[edges].mean(1)])
        faces = np.concatenate([np.stack(f, 1) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return points / np.linalg.norm(points, axis=1, keepdims=True), faces


def pressed_sphere(young: float, poisson: float, pressure: float, thickness: float) -> float:
    """Growth [m] of the middle radius, 1 m, of a sphere under pressure (Lame's thick sphere)."""
    a, b = 1 - thickness / 2, 1 + thickness / 2
    return pressure * a**3 / (young * (b**3 - a**3)) * ((1 - 2 * poisson) + (1 + poisson) * b**3 / 2)


class Linked(NamedTuple):
    """A finger of three stiff links and two soft hinges, that a tendon along its upper side bends in its plane."""

    model: Model
    young: Tensor  # [T] [Pa]
    tip: Tensor  # bool [V], the last link
    hinge: float = 0.04  # length [m]
    height: float = 0.01
    width: float = 0.01
    soft: float = 1e5  # [Pa]

    @classmethod
    def of(cls, over_height: int, contrast: float = 100.0) -> Linked:
        length, link = 0.14, 0.02
        cells = round(length / cls._field_defaults["height"] * over_height)
        size = (length, cls._field_defaults["height"], cls._field_defaults["width"])
        mesh = meshes.beam(cells + 1, over_height + 1, 2, size=size)
        along = mesh.points[mesh.tets].mean(1)[:, 0]
        soft = ((along > link) & (along < link + 0.04)) | ((along > 2 * link + 0.04) & (along < length - link))
        places = [0.0, link, link + 0.04, 2 * link + 0.04, length - link, length]
        route = Embedding.of_points(mesh, [[x, size[1], size[2] / 2] for x in places])
        energies = (StableNeoHookean(), Tendons(route, [range(6)], 1e3, length))
        model = Model(mesh, pinned=mesh.points[:, 0] < link + 1e-9, energies=energies)
        young = torch.where(torch.from_numpy(soft), 1e5, 1e5 * contrast).double()
        return cls(model, young, torch.from_numpy(mesh.points[:, 0] > length - link - 1e-9))

    def angle(self, x: Tensor) -> float:
        """Of the last link, in the plane [rad]."""
        rest, now = self.model.rest_points[self.tip], x[self.tip]
        rest, now = rest - rest.mean(0), now - now.mean(0)
        sine = (rest[:, 0] * now[:, 1] - rest[:, 1] * now[:, 0]).sum()
        return float(torch.atan2(sine, (rest[:, :2] * now[:, :2]).sum()))

    def balanced(self, tension: float) -> float:
        """The angle at which moments balance: each hinge is an arc of a beam, and the tendon its chord, above it."""
        area = self.height * self.width
        inertia, arm = area * self.height**2 / 12, self.height / 2
        state = torch.tensor([0.01, 0.0], dtype=torch.float64)  # angle of a hinge, strain of its middle

        def energy(state: Tensor) -> Tensor:
            angle, strain = state
            length = self.hinge * (1 + strain)
            chord = 2 * (length / angle - arm) * torch.sin(angle / 2)
            bending = inertia * angle**2 / self.hinge**2 + area * strain**2
            return self.soft * self.hinge / 2 * bending + tension * chord

        for _ in range(30):
            state = state - torch.linalg.solve(torch.func.hessian(energy)(state), torch.func.grad(energy)(state))
        return 2 * float(state[0])
