"""Claim: torch's compiled autograd, which traces a backward, takes that of a step, with contact and without."""

import pytest
import torch
from torch import Tensor
from torch._dynamo import compiled_autograd

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance

PAIRS = (dv.PairBarrier(dhat=0.02), dv.Friction(0.3))
FLOOR = dv.FloorBarrier(height=-0.005)


@pytest.mark.slow
@pytest.mark.parametrize("energies", [(), (FLOOR,), PAIRS, (FLOOR, *PAIRS)])
def test_gradients_are_those_of_a_plain_backward(device: str, energies: tuple) -> None:
    boxes = [dv.mesh.box(2, 0.2), dv.mesh.box(2, 0.2).translate((0.01, 0.21, 0.0))]
    model = dv.Model(dv.mesh.join(boxes), energies=(dv.StableNeoHookean(), *energies), device=device)

    def gradients(compiled: bool) -> list[Tensor]:
        x = model.rest_points.clone()
        given = {"x": x, "v": torch.zeros_like(x), "force": torch.zeros_like(x), "rest_points": x.clone()}
        given |= {"mu": x.new_tensor(2e4), "lam": x.new_tensor(4e4), "density": x.new_tensor(1e3)}
        given = {name: value.requires_grad_() for name, value in given.items()}
        end, v = dv.step(model, **given, time_step=0.01, sweeps=3)
        loss = end.square().sum() + v.sum()
        if compiled:
            with compiled_autograd._enable(torch.compile(backend="eager")):
                loss.backward()
        else:
            loss.backward()
        found = [value.grad for value in given.values() if value.grad is not None]
        assert len(found) == len(given) and all(grad.abs().max() > 0 for grad in found)
        return found

    torch._dynamo.reset()
    for got, expected in zip(gradients(True), gradients(False), strict=True):
        assert relative_error(got, expected) <= tolerance("adjoint")
