"""Claim: of a long list the pairs that push are found first, which changes nothing."""

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

    def results(least: int) -> list[Tensor]:
        monkeypatch.setattr(step, "LONG_LIST", least)
        x, speed = start.clone().requires_grad_(), v.clone().requires_grad_()
        with dv.contact.record() as parts:
            end, _ = dv.step(model, x, speed, mu=1e5, lam=2e5, time_step=0.01, sweeps=3)
        assert len(parts[0].listed.pairs) > 0
        return [end, *torch.autograd.grad(end.square().sum(), (x, speed))]

    for filtered, whole in zip(results(0), results(1 << 30), strict=True):
        assert filtered.abs().max() > 0 and torch.equal(filtered, whole)
