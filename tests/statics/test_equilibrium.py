"""Claim: dv.equilibrium finds the rest states that an independent dense Newton solver finds on its own energy."""

import itertools

import pytest
import torch
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd.reference.distance import EDGE_EDGE, POINT_TRIANGLE, distance, log_barrier
from diffvbd.reference.distance import weight as pair_weight
from diffvbd.testing.dense_statics import newton, potential, residual, weight
from diffvbd.testing.soft_scenes import PROBLEMS, Problem, necked, on_floor

SOLVER = dv.VBD(1.0, 0, subspace="coarse")


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


# coupled bodies, of which test_equilibrium_couplings.py has small ones
@pytest.mark.parametrize("name", [slow(name) if name == "bent by a tendon" else name for name in PROBLEMS])
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
    points = [side.unique()[:, None] for side in sides]
    lists = []  # kind, sides, how often each pair counts; of a closed surface triangles less edges plus vertices
    for k in (0, 1):
        faces = (sides[1 - k], 1), (edges[1 - k][:, [0, 1, 1]], -1), (points[1 - k].expand(-1, 3), 1)
        lists += [(POINT_TRIANGLE, points[k], *face) for face in faces]
    sharp = [on_two_sides(x, edge, side) for edge, side in zip(edges, points, strict=True)]
    for a, b in itertools.product((True, False), repeat=2):
        lists += [(EDGE_EDGE, edges[0][sharp[0] == a], edges[1][sharp[1] == b], 1 if a and b else 0)]

    def contact(at: Tensor) -> Tensor:
        total = at.new_zeros(())
        for kind, first, second, count in lists:
            pairs = torch.cat([first.repeat_interleave(len(second), 0), second.repeat(len(first), 1)], 1)
            kinds = torch.full((len(pairs),), kind)
            reach = at.new_full((len(pairs),), dhat if kind == POINT_TRIANGLE or count else dhat / 4)
            measure = 1e-3 * edge_squares(x, pairs) if kind == EDGE_EDGE else at.new_full((len(pairs),), count)
            b = log_barrier(distance(kinds, at[pairs]), at.new_tensor(kappa), reach)[0]
            total = total + (pair_weight(kinds, at[pairs], reach, measure) * b).sum()
        return total

    mu, lam = dv.lame(3e4, 0.3)
    load = weight(model)
    assert float(contact(done.x)) > 0
    assert residual(model, potential(model, load, mu, lam, contact), load, done.x) < 1e-8


def on_two_sides(x: Tensor, edges: Tensor, points: Tensor) -> Tensor:
    """Which edges [E] are on two sides of the box of some points [P, 1]: along its own edges."""
    at, box = x[edges], torch.stack([x[points[:, 0]].amin(0), x[points[:, 0]].amax(0)])
    return (at[:, None] == box[None, :, None]).all(2).any(1).sum(1) >= 2


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
