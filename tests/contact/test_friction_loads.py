"""Claim: of the faces of another body near a point one bears the friction of all, with the sum of their normal forces,
so that no friction counts negative."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import ops
from diffvbd.adjoint.contact import Pairs, friction_lag
from diffvbd.reference.contact import loads
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import SCENES


def listed_of(name: str, device: str) -> tuple[list[Tensor], list[Tensor]]:
    """x, collider, kappa and origin at the start of a step; and its list of pairs with the bodies of corners."""
    scene = SCENES[name]()
    model = scene.model.to(device)
    with dv.record("contact") as found, torch.no_grad():
        dv.step(model, scene.x.to(device), scene.v.to(device), dv.VBD(scene.time_step, 0), mu=1e4, lam=1e4)
    x, surface = scene.x.to(device).reshape(-1, *scene.x.shape[-2:]), model.surface_of_contact
    assert surface is not None
    return [x, x.new_empty((len(x), 0, 3)), x.new_full((1,), 1e4), x.new_empty((0,))], [*found[0].listed, surface.body]


@pytest.mark.parametrize("name", ["stacked", "batched", "folded"])
def test_one_face_bears_the_load_of_all(name: str, device: str) -> None:
    given, listed = listed_of(name, device)
    x, collider, kappa, origin = given
    state, force, _ = ops.direct.contact_lag(x, origin, collider, kappa, *listed)
    rows = listed[0][listed[0][:, 4] >= 0].long().cpu()
    own, found = state[: len(rows), 0].cpu(), force[: len(rows)].cpu()
    expected = loads(own, rows[:, :4], rows[:, 4], rows[:, 5], listed[-1].long().cpu())
    assert relative_error(found, expected) <= tolerance("contact_forward")
    assert relative_error(found.sum(), own.sum()) <= tolerance("contact_forward") and float(found.max()) > 0
    assert bool((found >= 0).all()) and bool((own < 0).any()) == (name == "stacked")


def test_faces_that_sum_to_less_than_nothing_bear_nothing(device: str) -> None:
    """As edges of a crumpled surface do alone. A load that is cut off has no derivative."""
    given, listed = listed_of("stacked", device)
    constants, faces = listed[1].clone(), listed[0][:, 4] == 0
    constants[faces, 2] *= -1
    x, kappa = (given[k].clone().requires_grad_() for k in (0, 2))

    def weighed(counts: Tensor) -> Any:
        own = Pairs(listed[0], counts, *listed[2:4])
        force = friction_lag(x, given[1], kappa, kappa.new_ones((1,)), None, given[3], listed[4], own)[:, 0]
        between = faces & (force.detach() >= 0)
        return force, torch.autograd.grad((force * between).sum(), (x, kappa))

    force, slopes = weighed(constants)
    assert not force[faces].any() and all(float(slope.abs().max()) == 0 for slope in slopes)
    force, slopes = weighed(listed[1])
    assert float(force[faces].max()) > 0 and all(float(slope.abs().max()) > 0 for slope in slopes)
