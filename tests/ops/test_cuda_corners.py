"""Claim: regimes, transforms and degenerate scenes may meet on CUDA in any order without a wrong number."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.regimes import forced
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance

pytestmark = pytest.mark.cuda

SOLVER = dv.VBD(0.01, 3)


def small(scenes: int = 5) -> tuple[dv.Model, Tensor, Tensor]:
    model = dv.Model(dv.mesh.cube(), pinned=[0], device="cuda")
    noise = torch.randn((scenes, 8, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return model, model.rest_points + 0.05 * noise.to("cuda"), 0.3 * noise.to("cuda")


@pytest.mark.parametrize(("first", "second"), [("thread", None), (None, "thread"), ("color", "thread")])
def test_a_checkpoint_runs_again_as_it_ran(first: str | None, second: str | None) -> None:
    """The regime of a rollout is the one at its start, also for what its backward runs again."""
    model, x, v = small()
    mu = torch.linspace(1e4, 2e4, 4, dtype=torch.float64, device="cuda").requires_grad_()

    def loss() -> Tensor:
        run = dv.rollout(model, x, v, SOLVER, steps=4, mu=dv.per_step(mu), lam=2e4, checkpoint_every=2)
        return run.x[-1].sum()

    (expected,) = torch.autograd.grad(loss(), mu)
    with forced(first):
        value = loss()
    with forced(second):
        (gradient,) = torch.autograd.grad(value, mu)
    assert expected.any() and relative_error(gradient, expected) <= tolerance("adjoint")


@pytest.mark.parametrize("regime", ("thread", "block", "color"))
def test_jacobians_in_every_regime(regime: str) -> None:
    model, x, v = small(2)

    def end(mu: Tensor) -> Tensor:
        return dv.step(model, x, v, SOLVER, mu=mu, lam=2e4)[0].sum((1, 2))

    mu = torch.tensor([[1e4], [3e4]], dtype=torch.float64, device="cuda")
    rows = []
    for i in range(2):
        leaf = mu.clone().requires_grad_()
        rows.append(torch.autograd.grad(end(leaf)[i], leaf)[0])
    with forced(regime):
        jacobian = torch.func.jacrev(end)(mu)
    assert isinstance(jacobian, Tensor) and jacobian.any()
    assert relative_error(jacobian, torch.stack(rows)) <= tolerance("adjoint")


@pytest.mark.parametrize("start", ("auto", "predictor"))  # of which the latter is one operator
def test_several_adjoints_of_one_step(start: Any) -> None:
    model, x, v = small(2)
    leaf = x.clone().requires_grad_()
    end, _ = dv.step(model, leaf, v, dv.VBD(0.01, 3, start=start), mu=1e4, lam=2e4)
    weights = torch.randn((3, *end.shape), dtype=torch.float64, device="cuda")

    def one(w: Tensor) -> Tensor:
        return torch.autograd.grad(end, leaf, w, retain_graph=True)[0]

    together = torch.func.vmap(one)(weights)
    apart = torch.stack([one(w) for w in weights])
    # a scene per thread has its tape with scenes last: several adjoints at once run in another regime, which rounds
    # differently
    assert apart.any() and relative_error(together, apart) <= tolerance("adjoint")


@pytest.mark.parametrize("regime", ("thread", "block", "grid", "color"))
@pytest.mark.parametrize("vertices", (0, 3))
@pytest.mark.parametrize("shape", ((), (0,)))
def test_no_tets(regime: str, vertices: int, shape: tuple[int, ...]) -> None:
    mesh = dv.TetMesh(np.eye(3)[:vertices], np.zeros((0, 4), dtype=int))
    model = dv.Model(mesh, pinned=list(range(vertices)), device="cuda")
    x = model.rest_points.expand(2, -1, -1).clone().requires_grad_()
    mu = torch.full(shape, 1e4, dtype=torch.float64, device="cuda").requires_grad_()
    torch.full((1 << 20,), float("nan"), dtype=torch.float64, device="cuda")  # what memory is reused does not matter
    with forced(regime):
        end, speed = dv.step(model, x, torch.ones_like(x), dv.VBD(0.01, 2), mu=mu, lam=2e4)
        gradients = torch.autograd.grad(end.sum() + speed.sum(), (x, mu), allow_unused=True)
    torch.cuda.synchronize()
    assert torch.equal(end, x) and not speed.any()
    assert gradients[1] is None or torch.equal(gradients[1], torch.zeros_like(mu))
