"""Claim: pairs that sweeps leave out because nothing brings them into reach change nothing: a list whose gaps say that
every pair is close, so that each is looked at in every color, gives the same bits of positions, limits and adjoints."""

import importlib
import sys
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import ops
from diffvbd.mesh import box, join, sheet
from diffvbd.testing import generator

HELD, FRICTION = "sheet", 0.3


def thrown(speed: float) -> tuple[dv.Model, Tensor, Tensor]:
    """Four boxes above each other, each askew, thrown together above a floor."""
    cube, shifts = box(2, 0.2), torch.linspace(0.0, 0.03, 4).tolist()
    bodies = join([cube.translate((a, 0.004 + 0.204 * k, 0.5 * a)) for k, a in enumerate(shifts)])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.01), dv.FloorBarrier(0.0, kappa=1e4, dhat=0.01),
                dv.Friction(FRICTION))  # fmt: skip
    model = dv.Model(bodies, energies=energies)
    v = torch.zeros_like(model.rest_points)
    v[:, 1] = -speed * model.rest_points[:, 1]
    return model, model.rest_points, v


def folding() -> tuple[dv.Model, Tensor, Tensor]:
    """A pinned sheet whose pairs are its own."""
    body = sheet(9, 9, (0.4, 0.4), 0.005)
    model = dv.Model(body, pinned=torch.from_numpy(body.points[:, 0] < 1e-9),
                     energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.02)))  # fmt: skip
    v = torch.zeros_like(model.rest_points)
    v[:, 1] = -30.0 * model.rest_points[:, 0] ** 2  # fast enough for its pairs to push within three steps
    return model, model.rest_points, torch.where(model.pinned[:, None], 0.0, v)


def run(fields: ops.SweepFields, rest: Tensor, plan: Tensor, settings: ops.SweepSettings) -> dict[str, Tensor]:
    x, tape, cut, corrections = ops.run_sweep(*fields, rest, plan, settings, ops.FULL_TAPE, -1, False)
    bar = torch.from_numpy(generator(0).standard_normal(x.shape))
    wants: dict[str, bool] = {name: True for name in ops.SWEEP_ADJOINTS}
    bars = ops.sweep_backward(bar, x, tape, corrections, cut, fields, rest, plan, settings, ops.FULL_TAPE, wants)
    return {"x": x, "cut": cut, **bars}


@pytest.mark.filterwarnings("ignore:tets")
@pytest.mark.parametrize("scene", ["slow", "fast", "sheet"])
def test_what_is_left_out_changes_nothing(monkeypatch: pytest.MonkeyPatch, scene: str) -> None:
    model, x, v = folding() if scene == HELD else thrown(1.0 if scene == "slow" else 20.0)
    step, calls = sys.modules["diffvbd.step.contact"], []
    own = step.sweep

    def noted(*arguments: Any, **options: Any) -> Any:
        calls.append(arguments)
        return own(*arguments, **options)

    monkeypatch.setattr(step, "sweep", noted)
    for _ in range(3):
        x, v = dv.step(model, x, v, dv.VBD(1 / 60, 6, start="predictor"), mu=1e5, lam=2e5)
    active = moved = 0
    for fields, rest, plan, settings in calls:
        constants = fields.constants.clone()
        constants[:, -1] = -1.0
        near, all_of_them = (run(fields._replace(constants=c), rest, plan, settings)
                             for c in (fields.constants, constants))  # fmt: skip
        for name, value in near.items():
            assert torch.equal(value, all_of_them[name]), name
        active += int(near["kappa"].count_nonzero())
        moved += int((fields.constants[:, -1] > fields.constants[:, 0]).count_nonzero())
    assert active > 0 and moved > 0  # some pairs push, and some are out of reach at first


# --- pairs that push --------------------------------------------------------------------------------------------------


step = importlib.import_module("diffvbd.step.contact")


def test_a_step_and_its_gradients_are_those_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    lower, upper = dv.mesh.cube(3, size=0.2), dv.mesh.cube(3, size=0.2).translate((0.03, 0.212, 0.02))
    pairs = dv.PairBarrier(kappa=1e4, dhat=0.02, damping=5.0, self_contact=False)
    energies = (dv.StableNeoHookean(), pairs, dv.FloorBarrier(-0.015, kappa=1e4, dhat=0.02), dv.Friction(0.4))
    model = dv.Model(dv.mesh.join([lower, upper]), energies=energies)
    start = model.rest_points
    v = torch.zeros_like(start)
    v[27:] = torch.tensor([0.5, -0.3, 0.1])

    def results(finds: bool) -> list[Tensor]:
        if not finds:
            own = step.within
            monkeypatch.setattr(step, "within", lambda radius, *given: own(torch.inf, *given))
        x, speed = start.clone().requires_grad_(), v.clone().requires_grad_()
        with dv.record("contact") as parts:
            end, _ = dv.step(model, x, speed, dv.VBD(0.01, 3), mu=1e5, lam=2e5)
        assert len(parts[0].listed.pairs) > 0
        return [end, *torch.autograd.grad(end.square().sum(), (x, speed))]

    for filtered, whole in zip(results(True), results(False), strict=True):
        assert filtered.abs().max() > 0 and torch.equal(filtered, whole)


@pytest.mark.usefixtures("one_regime")
@pytest.mark.parametrize("bodies", [2, 5])  # of up to three bodies a scene is one group
def test_a_scene_without_pairs_has_the_same_bits_beside_one_with_pairs(bodies: int, device: str) -> None:
    """Friction is looked for in a scene of its own: whether another scene has any must not matter."""
    cube = dv.mesh.cube(2, size=0.1)
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e4, 0.01, detections=1), dv.Friction(0.3))
    mesh = dv.mesh.join([cube.translate((0.115 * k, 0.004 * k, -0.003 * k)) for k in range(bodies)])
    model = dv.Model(mesh, energies=energies, device=device)
    apart = model.rest_points
    near = apart.clone()
    near[model.body == 1, 0] -= 0.01
    generator = torch.Generator().manual_seed(1)
    for _ in range(10):
        v = (0.1 * torch.randn(apart.shape, generator=generator, dtype=apart.dtype)).to(device)
        ends = []
        for x, speed in ((apart, v), (torch.stack([apart, near]), torch.stack([v, torch.zeros_like(v)]))):
            leaves = [t.clone().requires_grad_() for t in (x, speed)]
            end = dv.step(model, *leaves, solver=dv.VBD(0.01, 2), mu=1e5, lam=1e5)[0]
            bars = torch.autograd.grad(end.square().sum(), leaves)
            ends.append([t.reshape(-1, *apart.shape)[0] for t in (end, *bars)])
        for alone, beside in zip(*ends, strict=True):
            assert alone.abs().max() > 0 and torch.equal(alone, beside)
