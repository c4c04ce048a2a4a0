"""The potential of bodies in two states, which decides about motions in contact."""

import numpy as np
import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.adjoint.rise import RiseParts, rise_of_bodies, rise_parts
from diffvbd.adjoint.sweep import sweep
from diffvbd.model.moving import moving_bodies, moving_vertices
from diffvbd.reference.energies import build_energies
from diffvbd.reference.scene import Scene, build_layout, dot
from diffvbd.reference.scene import build_scene as reference_scene
from diffvbd.step.arguments import GRAVITY, acceleration_of, prepare
from diffvbd.step.predict import begin
from diffvbd.testing import build_scene, tolerance


def by_the_reference(scene: Scene, of: Tensor, count: int, x: Tensor, to: Tensor, y: Tensor, x_prev: Tensor) -> Tensor:
    """Rise of the potential of each body from x to ``to`` [..., 3, V], and sum of the sizes of its terms."""

    def terms(z: Tensor) -> list[tuple[Tensor, Tensor]]:
        inertia = scene.mass / 2 * dot(z - y, z - y)
        parts = [energy.terms(z, x_prev) for energy in build_energies(scene)]
        return [(inertia, of), *((term, of[vertex]) for term, vertex in parts)]

    out = x.new_zeros((*x.shape[:-2], count + 1, 2))
    for (before, body), (after, _) in zip(terms(x), terms(to), strict=True):
        values = torch.stack([after - before, before.abs()], -1)
        out = out.index_add(-2, body, values.expand(*out.shape[:-2], -1, 2))
    return out[..., :-1, :]


@pytest.mark.parametrize("case", ("plain", "floor_active", "free_anchored", "free_batch", "violent"))
def test_the_potential_of_two_states(case: str, device: str) -> None:
    scene = build_scene(case, "structured", "small")
    model, inputs = scene.model(), scene.inputs()
    model._moving = moving_bodies(model._rest_points, model._topology[0], model._pinned, elastic=True)
    material = {k: inputs[k] for k in ("mu", "lam", "rest_points", "density")}
    h, scenes = inputs["time_step"], inputs["x"].shape[:-2]
    prepared = prepare(model, scenes, time_step=h, sweeps=1, parameters=None, **material)
    begun = begin(model, inputs["x"], inputs["v"], prepared, inputs["force"], acceleration_of(GRAVITY, inputs["x"]),
                  inputs["prescribed"])  # fmt: skip
    fields, x = begun.fields(model, prepared), begun.x_start
    to = sweep(fields, model._packed_rest, model._plan, prepared.settings, tape_policy=0)[0]
    parts = rise_parts(model, fields, h)
    twin = reference_scene(model, build_layout(model), inputs["x"], parameters=None, time_step=h, **material)
    rows = (t.transpose(-1, -2) for t in (x, to, parts.fields.y, parts.fields.x_prev))
    # tets of pinned vertices count for the body that moves
    of, number = moving_vertices(model.tets, model.pinned).body, model._moving.number
    expected, size = by_the_reference(twin, torch.where(of < 0, number, of), number, *rows).unbind(-1)
    assert (expected < 0).any()
    there = RiseParts(model.to(device), type(parts.fields)(*(t if t is None else t.to(device) for t in parts.fields)),
                      parts.material.to(device), parts.rest.to(device), h)  # fmt: skip
    found = rise_of_bodies(there, x.to(device), to.to(device)).to(expected)
    finite = torch.isfinite(found[..., 0])
    assert finite.any() and (found[..., 1] > 0).all()
    apart = (found[..., 0] - expected).abs()[finite]
    assert (apart <= tolerance("sum") * size[finite]).all(), apart / size[finite]
    assert parts.admits(x, to)[expected < 0].all() and not parts.admits(to, x)[expected < 0].any()


def test_the_vertices_of_bodies_whose_potential_rises() -> None:
    """Of two scenes of two bodies, of which each raises another; what does not move raises nothing."""
    mesh = dv.mesh.replicate(dv.mesh.cube(2), np.array([[0.0, 0, 0], [3, 0, 0]]))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=100.0, dhat=0.01))
    model = dv.Model(mesh, pinned=[0], energies=energies)
    x = model.rest_points.expand(2, -1, -1).contiguous()
    given = {"mu": 1e5, "lam": 1e5, "rest_points": None, "density": None}
    prepared = prepare(model, (2,), time_step=0.01, sweeps=1, parameters=None, **given)
    begun = begin(model, x, torch.zeros_like(x), prepared, None, acceleration_of((0.0, 0.0, 0.0), x), None)
    parts = rise_parts(model, begun.fields(model, prepared), 0.01)
    to = x.clone()
    to[0, :8] *= 1.1  # away from the predictor, and stretched
    to[1, 8:] *= 1.1
    expected = torch.zeros((2, 16), dtype=torch.bool)
    expected[0, 1:8] = expected[1, 8:] = True
    assert torch.equal(parts.raises(x, to), expected)
    still = dv.Model(mesh, pinned=list(range(16)), energies=energies)
    prepared = prepare(still, (2,), time_step=0.01, sweeps=1, parameters=None, **given)
    begun = begin(still, x, torch.zeros_like(x), prepared, None, acceleration_of((0.0, 0.0, 0.0), x), None)
    assert not rise_parts(still, begun.fields(still, prepared), 0.01).raises(x, to).any()
