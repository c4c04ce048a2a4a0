"""Claim: torch's compiled autograd, which traces a backward, takes that of a step with contact."""

import pytest
import torch
from torch import Tensor
from torch._dynamo import compiled_autograd

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance


@pytest.mark.parametrize("floor", [False, True])
def test_gradients_are_those_of_a_plain_backward(device: str, floor: bool) -> None:
    boxes = [dv.mesh.box(2, 0.2), dv.mesh.box(2, 0.2).translate((0.01, 0.21, 0.0))]
    floors = (dv.FloorBarrier(height=-0.005),) if floor else ()
    energies = (dv.StableNeoHookean(), *floors, dv.PairBarrier(dhat=0.02), dv.Friction(0.3))
    model = dv.Model(dv.mesh.join(boxes), energies=energies, device=device)

    def gradient(compiled: bool) -> Tensor:
        x = model.rest_points.clone().requires_grad_()
        end, v = dv.step(model, x, torch.zeros_like(x), mu=2e4, lam=4e4, time_step=0.01, sweeps=3)
        loss = end.square().sum() + v.sum()
        if compiled:
            with compiled_autograd._enable(torch.compile(backend="eager")):
                loss.backward()
        else:
            loss.backward()
        assert x.grad is not None and x.grad.abs().max() > 0
        return x.grad

    torch._dynamo.reset()
    assert relative_error(gradient(True), gradient(False)) <= tolerance("adjoint")
