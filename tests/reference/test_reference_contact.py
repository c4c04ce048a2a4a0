"""Claim: forces and blocks of contact in the reference are derivatives of the potentials that its formulas say.

The scene is two tets with a few colliders; a detection is brute force over all of their pairs.
"""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.colors import colors
from helpers.two_tets import COLLIDERS, DHAT, detect, moved_state, scene_of, stand_in, two_tets
from torch import Tensor

import diffvbd as dv
from diffvbd.reference import distance
from diffvbd.reference.contact import LaggedPairForces, PairBarrier, Pairs
from diffvbd.reference.energies import build_energies, floor_friction
from diffvbd.reference.scene import build_layout
from diffvbd.testing import generator, relative_error, tolerance

# --- two tets, a sphere, a capsule, a plane ---------------------------------------------------------------------------


def blocks(model: Any, energy: Any, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient [V, 3] and blocks [V, 3, 3] of all vertices from an energy's colors, all at the state x."""
    gradient, hessian = x.new_zeros(8, 3), x.new_zeros(8, 3, 3)
    for k, color in enumerate(build_layout(model).colors):
        g, h = energy.block(k, x.T, x_prev.T).split((3, 6))
        gradient[color.vertices] = g.T
        hessian[color.vertices] = h[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3)
    return gradient, hessian


def setup(**changes: Any) -> tuple[Any, Tensor, Pairs]:
    model = stand_in(dv.Model(two_tets()), **changes)
    x = moved_state(model)
    part = detect(model, x[None], COLLIDERS[None], COLLIDERS[None])
    assert len(part.pairs) > 20 and {0, 1, 2} == set(part.pairs[:, 4].tolist())
    return model, x, Pairs(scene_of(model, x), part, None)


def lagged(model: Any, x: Tensor, pairs: Pairs, start: Tensor, now: Tensor) -> LaggedPairForces:
    """Of one body, so that no face bears the load of others."""
    model.surface_of_contact = SimpleNamespace(body=torch.zeros(start.shape[1]))
    return LaggedPairForces(scene_of(model, x), pairs, start, now)


@pytest.mark.parametrize("mollified", (False, True))
def test_barrier_force_is_the_gradient_of_its_energy(mollified: bool) -> None:
    model, x, pairs = setup()
    if mollified:  # thresholds above where the edges are
        a, b, c, d = torch.cat((x, COLLIDERS))[pairs.corners].unbind(1)
        edges = 1.7 * torch.linalg.cross(b - a, d - c).square().sum(-1)
        pairs.measure = torch.where(pairs.kind == distance.EDGE_EDGE, edges, 1.0)
    barrier = PairBarrier(scene_of(model, x), pairs, COLLIDERS[None])
    state = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad(barrier.energy(state.T, x.T), state)
    gradient, hessian = blocks(model, barrier, x, x)
    assert relative_error(gradient, expected) <= tolerance("hessian")
    assert expected.abs().max() > 1e-4
    least = torch.linalg.eigvalsh(hessian)
    assert (least[:, 0] >= -tolerance("formula") * least[:, 2]).all() and (least[:, 2] > 0).any()


def test_barrier_block_is_that_of_the_manual() -> None:
    """Of one pair at a time; N of its corners share the vertex's color. With E = e b, its gradient F and that s of the
    gap, H is N h^2 times e b'' s s' of a point and a face, and where e < 0 also b' e / d (s's I - s s'); and of two
    edges F F' / E + e (b'' - 2/3 b'^2 / b) s s'."""
    model, x, _ = setup()
    part = detect(model, x[None], COLLIDERS[None], COLLIDERS[None])
    vertex, kappa = 4, torch.tensor(200.0, dtype=torch.float64)
    color, found = colors(model, len(x) + len(COLLIDERS)), []
    for row in (part.pairs[:, :4] == vertex).any(1).nonzero()[:, 0].tolist():
        one = part._replace(pairs=part.pairs[row : row + 1], constants=part.constants[row : row + 1].clone())
        kind, (dhat, offset, measure) = int(one.pairs[0, 4]), one.constants[0, :3]
        for e in (1.0, -1.0) if kind == distance.POINT_TRIANGLE else (1.0,):
            one.constants[0, 2] = measure if kind == distance.EDGE_EDGE else e
            barrier = PairBarrier(scene_of(model, x), Pairs(scene_of(model, x), one, None), COLLIDERS[None])
            at = x[vertex].clone().requires_grad_()
            state = torch.cat((x[:vertex], at[None], x[vertex + 1 :]))
            d = distance.distance(one.pairs[:, 4], torch.cat((state, COLLIDERS))[one.pairs[:, :4]])[0]
            b, first, second = (1e-4 * value for value in distance.log_barrier(d - offset, kappa, dhat))
            energy = barrier.energy(state.T, x.T).sum()
            (F,) = torch.autograd.grad(energy, at, retain_graph=True)
            (s,) = torch.autograd.grad(d, at)
            normal, b = s.outer(s), b.detach()
            if float(energy) == 0:
                expected = 0 * normal
            elif kind == distance.EDGE_EDGE:
                expected = F.outer(F) / energy + energy / b * (second - 2 / 3 * first**2 / b) * normal
            else:
                expected = e * second * normal
                expected = expected + (e < 0) * e * first / d * (s.dot(s) * torch.eye(3).double() - normal)
            together = int((color[one.pairs[0, :4]] == color[vertex]).sum())
            _, hessian = blocks(model, barrier, x, x)
            assert relative_error(hessian[vertex], together * expected.detach()) <= tolerance("cancelling")
            found.append((kind, together, e, bool(energy != 0)))
    assert {1, 2} <= {n for _, n, _, acts in found if acts} and {-1.0, 1.0} == {e for *_, e, acts in found if acts}
    assert {0, 1} <= {kind for kind, *_, acts in found if acts}


@pytest.mark.parametrize("travel", (1e-4, 1e-2))
def test_friction_force_is_the_gradient_of_its_potential(travel: float) -> None:
    """mu lambda f0(|u|) by a formula of its own, below and above the travel at which friction is full."""
    model, x_prev, pairs = setup(
        contact=SimpleNamespace(name="pair", kappa=200.0, dhat=DHAT, damping=0.0, detections=1)
    )
    x = x_prev + travel * torch.as_tensor(generator("travel").standard_normal((8, 3)))
    start = torch.cat((x_prev, COLLIDERS))[None]
    now = COLLIDERS + travel * 0.3
    friction = lagged(model, x, pairs, start, now[None])
    corners = start[0][pairs.corners].requires_grad_()
    d = distance.distance(pairs.kind, corners)
    (slope,) = torch.autograd.grad(d.sum(), corners)
    normal = slope[:, 0] + (pairs.kind == distance.EDGE_EDGE)[:, None] * slope[:, 1]
    weights = (slope * normal[:, None]).sum(-1)
    gap = (d - pairs.offset).detach().requires_grad_()
    e = distance.weight(pairs.kind, corners.detach(), pairs.dhat, pairs.measure)
    inside = gap < DHAT
    (force,) = torch.autograd.grad((200 * inside * e * (gap - DHAT) ** 2 * (gap / DHAT).log()).sum(), gap)
    reach = 0.01 * 0.05

    def potential(state: Tensor) -> Tensor:
        m = (weights[..., None] * (torch.cat((state, now))[pairs.corners] - start[0][pairs.corners])).sum(1)
        slip = (m - (m * normal).sum(-1, keepdim=True) * normal).norm(dim=-1)
        slow = -(slip**3) / (3 * reach**2) + slip**2 / reach + reach / 3
        return 1e-4 * 0.4 * (force * torch.where(slip < reach, slow, slip)).sum()

    state = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad(potential(state), state)
    gradient, hessian = blocks(model, friction, x, x_prev)
    assert relative_error(gradient, expected) <= tolerance("hessian")
    assert relative_error(friction.energy(x.T, x_prev.T), potential(x)) <= tolerance("hessian")
    assert expected.abs().max() > 1e-6
    least = torch.linalg.eigvalsh(hessian)
    assert (least[:, 0] >= -tolerance("sum") * least[:, 2]).all() and (least[:, 2] > 0).any()


def test_damping_opposes_approach_alone() -> None:
    """h c w / 2 (n.m)^2 where n.m < 0, with n.m the distance's change to first order and w = N / (N + kappa dhat / 10)
    of the normal force N at the start."""
    model, x_prev, pairs = setup(friction=None)
    start = torch.cat((x_prev, COLLIDERS))[None]
    x = x_prev + 1e-3 * torch.as_tensor(generator("approach").standard_normal((8, 3)))
    damping = lagged(model, x, pairs, start, COLLIDERS[None])

    corners = start[0][pairs.corners].requires_grad_()
    (slope,) = torch.autograd.grad(distance.distance(pairs.kind, corners).sum(), corners)

    def change(state: Tensor) -> Tensor:
        moved = (slope * (torch.cat((state, COLLIDERS))[pairs.corners] - corners.detach())).sum((1, 2))
        return torch.where(gap < DHAT, moved, 0.0)

    gap = distance.distance(pairs.kind, corners.detach()) - pairs.offset
    e = distance.weight(pairs.kind, corners.detach(), pairs.dhat, pairs.measure)
    size = 200 * e * (2 * (gap - DHAT) * (gap / DHAT).log() + (gap - DHAT) ** 2 / gap) * (gap < DHAT)
    share = size / (size + 20 * DHAT)
    assert (gap > DHAT).any()
    along = change(x)
    assert (along < 0).sum() > 5 and (along > 0).sum() > 5
    state = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad((0.01 * 3 / 2 * share * change(state).clamp(max=0) ** 2).sum(), state)
    gradient, hessian = blocks(model, damping, x, x_prev)
    assert relative_error(gradient, expected) <= tolerance("hessian")
    least = torch.linalg.eigvalsh(hessian)
    assert (least[:, 0] >= -tolerance("formula") * least[:, 2]).all() and (least[:, 2] > 0).any()


@pytest.mark.parametrize("travel", (1e-4, 1e-2))
def test_floor_friction_is_the_gradient_of_its_potential(travel: float) -> None:
    """Of two planes, against the force of the barrier at the start of the step."""
    floor = dv.FloorBarrier(height=(-1.0, -1.1), normal=((0.0, 1, 0), (0.6, 0.8, 0)), kappa=300.0, dhat=0.5)
    model = stand_in(dv.Model(two_tets(), energies=(dv.StableNeoHookean(), floor)))
    x_prev = moved_state(model)
    x = x_prev + travel * torch.as_tensor(generator("slide").standard_normal((8, 3)))
    scene = scene_of(model, x)
    (friction,) = floor_friction(scene, build_energies(scene))

    def potential(state: Tensor) -> Tensor:
        total, reach = state.new_zeros(()), 0.01 * 0.05
        for normal, height in zip(torch.tensor(floor.normal).double(), floor.height, strict=True):
            gap = x_prev @ normal - height
            force = 300 * (2 * (gap - 0.5) * (gap / 0.5).log() + (gap - 0.5) ** 2 / gap) * (gap < 0.5)
            m = state - x_prev
            slip = (m - (m @ normal)[:, None] * normal).norm(dim=-1)
            slow = -(slip**3) / (3 * reach**2) + slip**2 / reach + reach / 3
            total = total + 1e-4 * 0.4 * (force * torch.where(slip < reach, slow, slip)).sum()
        return total

    state = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad(potential(state), state)
    gradient, hessian = blocks(model, friction, x, x_prev)
    assert expected.any() and relative_error(gradient, expected) <= tolerance("hessian")
    assert relative_error(friction.energy(x.T, x_prev.T), potential(x)) <= tolerance("hessian")
    least = torch.linalg.eigvalsh(hessian)
    assert (least[:, 0] >= -tolerance("sum") * least[:, 2]).all() and (least[:, 2] > 0).any()


# --- distances --------------------------------------------------------------------------------------------------------


def sampled(kind: int, corners: Tensor, n: int = 240) -> float:
    """Distance of the closest samples on two primitives."""
    t = torch.linspace(0, 1, n + 1, dtype=torch.float64)[:, None]
    if kind == distance.EDGE_EDGE:
        first, second = (a + t * (b - a) for a, b in corners.unflatten(0, (2, 2)))
    else:
        u, v = torch.meshgrid(t[:, 0], t[:, 0], indexing="ij")
        inside = u + v <= 1 + 1e-9
        u, v = u[inside][:, None], v[inside][:, None]
        first, second = corners[:1], corners[1] + u * (corners[2] - corners[1]) + v * (corners[3] - corners[1])
    return float(torch.cdist(first, second).min())


def random_pairs(kind: int, count: int) -> Tensor:
    """Corners [count, 4, 3] of edges of some meters, as far apart."""
    return torch.as_tensor(generator("pairs", kind).standard_normal((count, 4, 3)))


@pytest.mark.parametrize(
    ("kind", "features"),
    [
        (distance.POINT_TRIANGLE, {distance.TO_POINT, distance.TO_EDGE, distance.TO_FACE}),
        (distance.EDGE_EDGE, {distance.TO_POINT, distance.TO_EDGE, distance.BETWEEN_EDGES}),
    ],
)
def test_distance_of_every_feature(kind: int, features: set[int]) -> None:
    corners = random_pairs(kind, 60)
    kinds = torch.full((60,), kind)
    feature, _ = distance.closest_features(kinds, corners)
    assert set(feature.tolist()) == features
    d = distance.distance(kinds, corners)
    for value, pair in zip(d, corners, strict=True):
        expected = sampled(kind, pair)
        # a sample is off by half a spacing s along each primitive, which costs at most s^2 / (2 d), or s
        spacing = float((pair[1:] - pair[:-1]).norm(dim=-1).max()) / 240 * 3
        assert -tolerance("geometry") <= expected - value <= min(spacing, spacing**2 / (2 * float(value)))
    atol = tolerance("gradcheck_of_a_distance")
    assert torch.autograd.gradcheck(lambda c: distance.distance(kinds, c), corners.requires_grad_(), atol=atol)


def test_gradient_of_the_distance_is_weights_times_normal() -> None:
    """Forces of a pair sum to zero, without torque, and those on one primitive sum to a unit vector."""
    for kind in range(3):
        corners = random_pairs(kind, 100)
        kinds = torch.full((100,), kind)
        d, slope = distance.with_gradient(lambda c, kinds=kinds: distance.distance(kinds, c), corners)
        assert not d.requires_grad and not slope.requires_grad
        assert slope.sum(1).abs().max() <= tolerance("sum")
        assert torch.linalg.cross(corners, slope).sum(1).abs().max() <= tolerance("geometry")
        normal = slope[:, 0] + (slope[:, 1] if kind == distance.EDGE_EDGE else 0)
        assert (normal.norm(dim=-1) - 1).abs().max() <= tolerance("geometry")
        along = (slope * normal[:, None]).sum(-1, keepdim=True)
        assert (slope - along * normal[:, None]).abs().max() <= tolerance("geometry")


def test_plane_has_a_side() -> None:
    plane = [[0.0, 0, 0], [0, 0, 1], [1, 0, 0]]
    corners = torch.tensor([[[5.0, 0.3, -7.0], *plane], [[5.0, -0.3, 2.0], *plane]])
    d = distance.distance(torch.tensor([distance.POINT_PLANE] * 2), corners)
    assert torch.allclose(d, torch.tensor([0.3, -0.3]))


def test_pairs_without_one_closest_point_are_finite() -> None:
    """Parallel edges, an edge and a triangle without extent."""
    edges = [[[0.0, 0, 0], [1, 0, 0], [a, 0.1, 0], [b, 0.1, 0]] for a, b in ((0.2, 0.7), (0.3, 0.3))]
    sliver = [[[0.5, 0.1, 0], [0.0, 0, 0], [1, 0, 0], [2, 0, 0]]]
    kinds = torch.tensor([distance.EDGE_EDGE] * 2 + [distance.POINT_TRIANGLE])
    corners = torch.tensor(edges + sliver, dtype=torch.float64)
    d, slope = distance.with_gradient(lambda c: distance.distance(kinds, c), corners)
    assert torch.allclose(d, torch.full((3,), 0.1, dtype=torch.float64))
    assert torch.isfinite(slope).all()
