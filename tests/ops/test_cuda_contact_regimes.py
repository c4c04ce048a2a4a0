"""Claim: sweeps with contact give the same bits in one launch and color by color, and what some threads a vertex give
differs by rounding. Scenes with more vertices in a color than the device holds blocks are among them."""

import pytest
import torch
from helpers.regimes import forced
from helpers.results import TAPES, assert_same_bits
from torch import Tensor

import diffvbd as dv
from diffvbd.ops import regimes
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import SCENES, compiled

pytestmark = pytest.mark.cuda


@pytest.mark.parametrize("tape", TAPES)
@pytest.mark.parametrize("sweeps", (1, 4))
@pytest.mark.parametrize("name", list(SCENES))
def test_one_launch_and_a_launch_for_each_color_give_the_same_bits(name: str, sweeps: int, tape: str) -> None:
    scene = SCENES[name]()
    model, found = scene.model.to("cuda"), []
    for regime in ("grid", "color"):
        with forced(regime):
            found.append(compiled(scene, 2, sweeps, tape, model)[0])
    for key, value in found[0].items():
        assert torch.equal(value, found[1][key]), key
    assert all(found[0][key].any() for key in ("x", "v", "grad_x", "grad_v"))


def cubes(scenes: int) -> tuple[dv.Model, dict[str, Tensor]]:
    """A cube that falls on another one, with friction, over a floor, in scenes that differ."""
    cube = dv.mesh.cube(3, size=0.2)
    mesh = dv.mesh.join([cube, cube.translate((0.03, 0.205, 0.02))])
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.005, kappa=1e4, dhat=0.01),
                dv.PairBarrier(1e4, 0.01, damping=1.0, detections=1), dv.Friction(0.3, 0.05))  # fmt: skip
    model = dv.Model(mesh, energies=energies, coarse=dv.CoarseSpace(every=3)).to("cuda")
    shares = torch.linspace(0.5, 1.5, scenes + 1, dtype=torch.float64, device="cuda")[:scenes, None]
    x = model.rest_points.expand(scenes, -1, -1).clone()
    v = torch.zeros_like(x)
    v[:, cube.num_vertices :, 1] = -0.5 * shares
    return model, {"x": x, "v": v, "mu": 1e5 * shares.expand(-1, model.num_tets).clone()}


def evaluated(model: dv.Model, given: dict[str, Tensor], tape: str, scenes: int | None = None) -> dict[str, Tensor]:
    """The state after a step of the first scenes, and gradients of a fixed sum of it for each scene."""
    leaves = {key: value[:scenes].clone().requires_grad_() for key, value in given.items()}
    x, v = dv.step(model, **leaves, lam=1e5, time_step=0.01, sweeps=5, adjoint=dv.ReverseSweep(tape))
    weights = torch.linspace(-1, 1, x[0].numel(), dtype=x.dtype, device=x.device).view_as(x[0])
    grads = torch.autograd.grad((weights * (x + 0.01 * v)).sum(), list(leaves.values()))
    return {"x": x.detach(), "v": v.detach(), **{f"grad_{k}": g for k, g in zip(leaves, grads, strict=True)}}


@pytest.mark.parametrize("tape", TAPES)
def test_more_vertices_than_blocks(tape: str) -> None:
    """With coarse corrections between launches of an odd and of an even number of sweeps."""
    scenes = 100
    model, given = cubes(scenes)
    blocks = 4 * torch.cuda.get_device_properties("cuda").multi_processor_count
    assert blocks < model.num_vertices * scenes / model.num_colors <= regimes.MANY_LANES_VERTICES[0]
    found = []
    for regime in ("grid", "color"):
        with forced(regime):
            found.append(evaluated(model, given, tape))
    assert_same_bits(*found)
    assert dv.contact.status(model).pairs > scenes


@pytest.mark.parametrize("tape", TAPES)
def test_some_threads_a_vertex(tape: str) -> None:
    model, given = cubes(400)
    launch = model.settings(0.01, 5, 400).launch
    assert launch == (regimes.COLOR, regimes.COLOR, regimes.SOME_LANES, regimes.SOME_REVERSE_LANES)
    assert model.settings(0.01, 5, 1).launch == (regimes.GRID, regimes.GRID, regimes.MANY_LANES, regimes.MANY_LANES)
    many, one = evaluated(model, given, tape), evaluated(model, given, tape, 1)
    for key, value in one.items():
        assert value.any(), key
        bar = tolerance("contact_adjoint" if key.startswith("grad") else "contact_forward")
        assert relative_error(many[key][:1], value) <= tolerance("property_factor") * bar, key
