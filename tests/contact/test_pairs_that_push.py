"""Claim: finding the pairs that push first changes nothing; a scene alone has the bits that it has in a batch."""

import importlib

import pytest
import torch
from torch import Tensor

import diffvbd as dv

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
            monkeypatch.setattr(step.ContactStep, "_pushing", lambda self, listed: listed)
        x, speed = start.clone().requires_grad_(), v.clone().requires_grad_()
        with dv.contact.record() as parts:
            end, _ = dv.step(model, x, speed, mu=1e5, lam=2e5, time_step=0.01, sweeps=3)
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
            end = dv.step(model, *leaves, mu=1e5, lam=1e5, time_step=0.01, sweeps=2)[0]
            bars = torch.autograd.grad(end.square().sum(), leaves)
            ends.append([t.reshape(-1, *apart.shape)[0] for t in (end, *bars)])
        for alone, beside in zip(*ends, strict=True):
            assert alone.abs().max() > 0 and torch.equal(alone, beside)
