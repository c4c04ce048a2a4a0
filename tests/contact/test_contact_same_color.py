"""Claim: vertices of one color move together even where contact couples them, forward and reverse.

Colors separate the vertices of a tet, not those that a pair brings together. Two situations are asserted to occur: two
vertices of one color in one pair, and two of one color in two pairs that share a third vertex. The compiled sweep must
read both before either moves, and the reverse must know both adjoints before it adds what they send. And two that close
the same gap at once must not overshoot.
"""

import functools
import itertools
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers.colors import colors
from helpers.marks import slow
from helpers.spreads import assert_near_contact
from torch import Tensor

import diffvbd as dv
from diffvbd.mesh import TetMesh, join
from diffvbd.reference.contact import Substep
from diffvbd.reference.distance import distance
from diffvbd.testing import contact_scenes, relative_error, tolerance
from diffvbd.testing.contact_scenes import Scene, boxes, build, compiled, unrolled


def corner_above(*corners: tuple[float, float, float]) -> Scene:
    """Tets that stand on a corner above the face of another one, 6 mm from it."""
    lower = TetMesh([[0, 0, 0], [0.3, 0, 0.02], [0.02, 0, 0.3], [0.1, -0.25, 0.1]], [[0, 1, 2, 3]], orient=True)
    upper = TetMesh([[0, 0.006, 0], [0.02, 0.12, 0.01], [-0.01, 0.13, 0.02], [-0.01, 0.12, -0.02]], [[0, 1, 2, 3]],
                    orient=True)  # fmt: skip
    energies = (dv.PairBarrier(1e4, 0.02, damping=1.0, detections=1), dv.Friction(0.3, 0.05))
    scene = build(f"above {corners}", join([lower, *(upper.translate(c) for c in corners)]), energies, jitter=5e-4)
    scene.v[4:, 1] -= 0.5
    return scene


def two_tets() -> Scene:
    return corner_above((0.1, 0.0, 0.09))


def two_on_one() -> Scene:
    """Both upper corners have one color, and meet the corners of one triangle."""
    return corner_above((0.13, 0.0, 0.05), (0.06, 0.0, 0.13))


def twins() -> Scene:
    """Two boxes of the same mesh face to face: each vertex meets its own color."""
    scene = build("twins", boxes((0, 0, 0), (1e-3, 0.208, 2e-3), points=2), (
        dv.PairBarrier(1e4, 0.02, damping=1.0), dv.Friction(0.3, 0.05)), jitter=1e-3)  # fmt: skip
    scene.v[8:, 1] -= 0.6
    return scene


def batch_of_stacks() -> Scene:
    return contact_scenes.batched()


def folded() -> Scene:
    """One body: colors of a strip repeat along it, and it lies on itself."""
    return contact_scenes.folded()


SCENES: dict[str, Callable[[], Scene]] = {f.__name__: f for f in (two_tets, two_on_one, twins, batch_of_stacks, folded)}


def met(model: dv.Model, part: Substep, x: Tensor) -> tuple[int, int]:
    """How often listed pairs hold two vertices of one color, and how many third vertices see two vertices of one color
    through different pairs; pairs farther apart than dhat do nothing and do not count."""
    color, inside, third = colors(model, model.num_vertices + len(model.collider_points)), 0, 0
    points = torch.cat([x, model.collider_points.expand(len(x), -1, -1)], 1)
    corners = points[part.pairs[:, 5:6], part.pairs[:, :4]]
    active = distance(part.pairs[:, 4], corners) - part.constants[:, 1] < part.constants[:, 0]
    neighbors: dict[tuple[int, int, int], dict[int, set[int]]] = {}
    for index, (*vertices, _, scene) in enumerate(part.pairs.tolist()):
        if not active[index]:
            continue
        for a, b in itertools.permutations(vertices, 2):
            if color[a] < 0 or color[b] < 0:
                continue
            inside += bool(color[a] == color[b] and a < b)
            neighbors.setdefault((scene, a, int(color[b])), {}).setdefault(index, set()).add(b)
    for by_pair in neighbors.values():
        seen = list(by_pair.values())
        third += any(len(a | b) > 1 and a != b for a, b in itertools.combinations(seen, 2))
    return inside, third


@pytest.mark.parametrize(("name", "sweeps"), [("two_tets", 1), ("two_on_one", 1), slow("two_on_one", 5), ("twins", 1),
                                              ("twins", 5), ("batch_of_stacks", 2), ("folded", 2)])  # fmt: skip
def test_the_color_moves_as_one(device: str, name: str, sweeps: int) -> None:
    scene, steps = SCENES[name](), 1 if name == "folded" else 2
    model = scene.model.to(device)
    solver = scene.solver(sweeps)
    _, parts = compiled(scene, steps, solver)
    expected = unrolled(scene, steps, solver, parts)

    @functools.cache
    def other(seed: int) -> dict[str, Tensor]:
        if seed == 3:
            return unrolled(scene, steps, solver, parts, seed=1)
        # what roundings of the start make of the same executed sequence
        toward = scene.x + contact_scenes.noise("rounding", seed, shape=scene.x.shape, size=1.0)
        return unrolled(replace(scene, x=torch.nextafter(scene.x, toward)), steps, solver, parts)

    start = scene.x.reshape(-1, *scene.x.shape[-2:])
    inside, third = met(scene.model, parts[0][0], start)
    assert inside > 0 and (third > 0 or name == "two_tets"), (inside, third)
    for tape in ("full", "recompute"):
        result, found = compiled(scene, steps, replace(solver, tape=tape), model)
        assert len(found) == len(parts)
        if device == "cpu":  # elsewhere lists keep what is out of reach
            sizes = ([[len(p.pairs) for p in own] for own in of] for of in (found, parts))
            assert next(sizes) == next(sizes)
        assert result.keys() == expected.keys()
        others = [functools.partial(other, seed) for seed in (3, 0, 1, 2)]
        forward, adjoint = tolerance("contact_forward"), tolerance("contact_adjoint")
        if name == "two_tets":
            # they fly apart, in contact, farther than a thousand times what friction is smoothed by
            adjoint = tolerance("far_slip_adjoint")
        assert_near_contact(result, expected, forward, adjoint, scene.time_step, others)
        assert all(result[key].any() for key in ("grad_x", "grad_v", "grad_pair_kappa"))


@pytest.mark.parametrize("name", ("two_on_one", "twins"))
def test_the_order_inside_a_color_does_not_matter(name: str) -> None:
    """Another numbering of the vertices, the same colors: the same step but for rounding. An update that saw its
    neighbor's new place would depend on who comes first."""
    scene = SCENES[name]()
    result, _ = compiled(scene, 1, scene.solver(3))
    model, count = scene.model, scene.model.num_vertices
    rank = torch.arange(count)
    for first, end in itertools.pairwise(model.color_ptr.tolist()):
        own = model.color_vertices[first:end].cpu().sort().values
        rank[own] = own.flip(0)
    assert not torch.equal(rank, torch.arange(count))
    mesh = TetMesh(model.mesh.points[rank.argsort().numpy()], rank[model.tets.cpu()].numpy(),
                   body=model.mesh.body[rank.argsort().numpy()])  # fmt: skip
    other = Scene(dv.Model(mesh, energies=model.energies), scene.x[rank.argsort()], scene.v[rank.argsort()],
                  inputs=dict(scene.inputs), parameters=scene.parameters)  # fmt: skip
    other.inputs["force"] = scene.inputs["force"][rank.argsort()]
    turned, _ = compiled(other, 1, other.solver(3))
    assert set(map(frozenset, _members(other.model))) == {
        frozenset(rank[torch.tensor(sorted(m))].tolist()) for m in _members(model)
    }
    assert relative_error(turned["x"][rank], result["x"]) <= tolerance("contact_forward")


def _members(model: dv.Model) -> list[set[int]]:
    return [set(model.color_vertices[a:b].tolist()) for a, b in itertools.pairwise(model.color_ptr.tolist())]
