"""Claim: dv.equilibrium finds the rest states that an independent dense Newton solver finds on its own energy."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from helpers.dense_statics import Energy, barrier, newton, potential, residual, weight
from torch import Tensor

import diffvbd as dv
from diffvbd.reference.distance import EDGE_EDGE, POINT_TRIANGLE, distance, log_barrier, mollifier

SOLVER = dv.VBD(1.0, 0, subspace="coarse")


class Problem(NamedTuple):
    model: dv.Model
    inputs: dict[str, Any]
    more: Energy | None = None  # energies beside that of the tets
    weighs: bool = True


def beam(young: Any, poisson: float = 0.3, shape: tuple[int, int, int] = (7, 3, 3),
         size: tuple[float, float, float] = (0.6, 0.1, 0.1)) -> Problem:  # fmt: skip
    mesh = dv.mesh.beam(*shape, size=size)
    return Problem(dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9), {"young": young, "poisson": poisson})


def held(place: Callable[[Tensor], Tensor], axis: int = 0) -> Problem:
    """A beam whose two ends are put somewhere else."""
    mesh = dv.mesh.beam(7, 3, 3, size=(0.3, 0.1, 0.1)) if axis == 0 else dv.mesh.cube(4, size=0.2)
    along = mesh.points[:, axis]
    model = dv.Model(mesh, pinned=(along < along.min() + 1e-9) | (along > along.max() - 1e-9))
    where = torch.where(model.pinned[:, None], place(model.rest_points), torch.nan)
    inputs = {"young": 1e5, "poisson": 0.3, "prescribed": where, "gravity": (0.0, 0.0, 0.0)}
    return Problem(model, inputs, weighs=False)


def twisted(x: Tensor) -> Tensor:
    angle, arm = math.pi / 2 * x[:, 0] / 0.3, x[:, 1:] - x[:, 1:].mean(0)
    y, z = arm.unbind(1)
    turned = torch.stack([angle.cos() * y - angle.sin() * z, angle.sin() * y + angle.cos() * z], 1)
    return torch.cat([x[:, :1], x[:, 1:].mean(0) + turned], 1)


def springs(model: dv.Model, stiffness: float, vertices: Tensor) -> Energy:
    points = model.rest_points[vertices]
    return lambda x: stiffness / 2 * (x[vertices] - points).square().sum()


def anchored() -> Problem:
    mesh = dv.mesh.beam(7, 3, 3, size=(0.4, 0.1, 0.1))
    ends = torch.as_tensor((mesh.points[:, 0] < 1e-9) | (mesh.points[:, 0] > 0.4 - 1e-9))
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.Anchor(200.0, vertices=ends)))
    return Problem(model, {"young": 3e4, "poisson": 0.3}, springs(model, 200.0, ends))


def on_floor() -> Problem:
    mesh = dv.mesh.cube(4, size=0.2)
    top = torch.as_tensor(mesh.points[:, 1] > 0.2 - 1e-9)
    floor = dv.FloorBarrier(height=-0.01, kappa=1e4, dhat=0.02)
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), floor, dv.Anchor(0.1, vertices=top)))
    hold = springs(model, 0.1, top)
    return Problem(model, {"young": 1e4, "poisson": 0.3},
                   lambda x: hold(x) + barrier(x[:, 1] + 0.01, 1e4, 0.02).sum())  # fmt: skip


def two_materials() -> Problem:
    young = torch.where(torch.arange(120) % 2 == 0, 1e5, 1e6).double()
    return beam(young)


def necked(inner: float, outer: float, density: float = 1000.0) -> Problem:
    """Two blobs that a thin neck joins, and the Young's moduli of the one that is pinned and of the other."""
    mesh = dv.mesh.beam(11, 3, 3, size=(0.5, 0.2, 0.2))
    points = mesh.points - mesh.points.mean(0)
    section = abs(points[:, 0]).clip(0.06, 0.12) * (0.8 / 0.06) - 0.6  # 0.2 in the neck, 1 outside
    points[:, 1:] *= section[:, None]
    young = torch.where(torch.as_tensor(points[mesh.tets].mean(1)[:, 0] > 0), outer, inner).double()
    pinned = points[:, 0] < points[:, 0].min() + 1e-9
    model = dv.Model(dv.TetMesh(points, mesh.tets), density=density, pinned=pinned)
    return Problem(model, {"young": young, "poisson": 0.3})


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
}


def check(problem: Problem, from_rest: bool = True) -> None:
    """from_rest: Whether the dense solver starts there too, or looks for the nearest minimum."""
    model, inputs, x = problem.model, problem.inputs, problem.model.rest_points
    done = dv.equilibrium(model, x, SOLVER, tolerance=1e-10, **inputs)
    moved = float((done.x - x).abs().max())
    assert done.converged and moved > 0.01
    mu, lam = dv.lame(inputs["young"], inputs["poisson"])
    load = weight(model) if problem.weighs else torch.zeros_like(x)
    energy = potential(model, load, mu, lam, problem.more)
    assert residual(model, energy, load, done.x) < 1e-8
    start = torch.where(model.pinned[:, None], inputs.get("prescribed", x), x)
    assert float((done.x - newton(model, energy, start if from_rest else done.x)).abs().max()) < 1e-6 * moved


@pytest.mark.parametrize("name", PROBLEMS)
def test_rest_states(name: str) -> None:
    check(PROBLEMS[name]())


def test_a_stiff_body_that_turns_on_a_soft_hinge() -> None:
    """Downhill alone, as the dense solver goes, this takes hundreds of iterations."""
    problem = necked(1e4, 1e8, density=1.5)
    check(problem, from_rest=False)
    assert dv.equilibrium(problem.model, problem.model.rest_points, SOLVER, **problem.inputs).iterations < 50


def on_plane() -> Problem:
    """As on a floor, of which the barrier of a Plane has the formula."""
    problem = on_floor()
    top = torch.as_tensor(problem.model.mesh.points[:, 1] > 0.2 - 1e-9)
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e4, dhat=0.02), dv.Anchor(0.1, vertices=top))
    model = dv.Model(problem.model.mesh, energies=energies, colliders=[dv.colliders.Plane((0, -0.01, 0))])
    return problem._replace(model=model)


def test_a_body_on_a_plane() -> None:
    check(on_plane())


def test_two_blocks_pressed_together() -> None:
    """Balanced by the barrier of all pairs of their surfaces, by the reference's distances."""
    low, high = dv.mesh.cube(3, size=0.2), dv.mesh.cube(3, size=0.16).translate([0.013, 0.21, 0.009])
    mesh, kappa, dhat = dv.mesh.join([low, high]), 1e4, 0.02
    y = torch.as_tensor(mesh.points[:, 1])
    top = y > float(y.max()) - 1e-9
    model = dv.Model(mesh, pinned=top | (y < 1e-9), energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa, dhat=dhat)))
    x = model.rest_points
    where = torch.where(top[:, None], x - x.new_tensor([0, 0.03, 0]), x)
    done = dv.equilibrium(model, x, SOLVER, tolerance=1e-10, young=3e4, poisson=0.3, prescribed=where)
    assert done.converged and not bool(dv.contact.intersections(model, done.x).any())

    faces, count = torch.as_tensor(mesh.surface), low.num_vertices
    sides = [faces[faces[:, 0] < count], faces[faces[:, 0] >= count]]
    edges = [torch.unique(side[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(1).values, dim=0) for side in sides]
    lists = [(EDGE_EDGE, edges[0], edges[1])]
    lists += [(POINT_TRIANGLE, sides[k].unique()[:, None], sides[1 - k]) for k in (0, 1)]

    def contact(at: Tensor) -> Tensor:
        total = at.new_zeros(())
        for kind, first, second in lists:
            pairs = torch.cat([first.repeat_interleave(len(second), 0), second.repeat(len(first), 1)], 1)
            kinds, threshold = torch.full((len(pairs),), kind), 1e-3 * edge_squares(x, pairs)
            gap = distance(kinds, at[pairs])
            b = log_barrier(gap, gap.new_tensor(kappa), gap.new_tensor(dhat))[0]
            total = total + (mollifier(kinds, at[pairs], threshold) * b).sum()
        return total

    mu, lam = dv.lame(3e4, 0.3)
    load = weight(model)
    assert float(contact(done.x)) > 0
    assert residual(model, potential(model, load, mu, lam, contact), load, done.x) < 1e-8


def edge_squares(x: Tensor, pairs: Tensor) -> Tensor:
    """|u|^2 |v|^2 of the two edges of each pair of edges."""
    a, b, c, d = x[pairs].unbind(1)
    return (b - a).square().sum(-1) * (d - c).square().sum(-1)


@pytest.mark.parametrize("pins", ([0], [0, 1, 2, 3]))
@pytest.mark.parametrize("factor", (0.8, 1.1, 2.0))
def test_what_swells_freely_ends_without_stress(factor: float, pins: list[int]) -> None:
    """Where no force is left to compare a residual with."""
    model = dv.Model(dv.mesh.cube(3, size=0.1), pinned=pins)
    inputs = {"stress_free": factor * torch.eye(3, dtype=torch.float64), "mu": 4e4, "lam": 9e4}
    end = dv.equilibrium(model, model.rest_points, dv.VBD(1.0, 0, subspace="coarse"), gravity=(0.0, 0.0, 0.0), **inputs)
    assert end.converged and end.residual < 1e-8 and end.iterations < 30
    if len(pins) == 1:
        assert float(dv.stress(model, end.x, **inputs).von_mises.max()) < 1e-2
        size = end.x.amax(0) - end.x.amin(0)
        assert float(size.norm()) == pytest.approx(0.1 * factor * 3**0.5, rel=1e-4)


def test_what_equilibrium_does_not_know_is_refused() -> None:
    mesh = dv.mesh.cube(2, size=0.1)
    solver = dv.VBD(1.0, 0)
    model = dv.Model(mesh, pinned=[0])
    for name in ("viscosity", "drag"):
        with pytest.raises(ValueError, match=f"{name}: expected none: at rest nothing has moved"):
            dv.equilibrium(model, model.rest_points, solver, mu=1e4, lam=1e4, **{name: 1.0})
    with pytest.raises(ValueError, match="prescribed: expected a shape"):
        dv.equilibrium(model, model.rest_points, solver, mu=1e4, lam=1e4, prescribed=model.rest_points[:3])
