"""Claim: coarse corrections on CUDA are those of the CPU, in every regime, with the same bits each time, without a host
in the loop."""

from typing import Any

import pytest
import torch
from helpers.regimes import captured, forced
from helpers.results import assert_same_bits
from torch import Tensor

import diffvbd as dv
from diffvbd.model.system import system_of
from diffvbd.testing import debug_checks, relative_error, tolerance

pytestmark = pytest.mark.cuda
REGIMES = (None, "block", "grid", "color")


def bodies(device: str, **options: Any) -> dv.Model:
    """A pinned beam above a floor, a free box of other size, and one that has a constant alone."""
    beam = dv.mesh.box((13, 5, 4), (1.0, 0.2, 0.2)).translate((0.0, 0.0, 0.3))
    box = dv.mesh.box((5, 5, 5), (0.3, 0.3, 0.3)).translate((3.0, 0.0, 0.01))
    small = dv.mesh.box((2, 2, 2), (0.1, 0.1, 0.1)).translate((5.0, 0.0, 0.01))
    mesh = dv.mesh.join([beam, box, small])
    floor = dv.FloorBarrier(kappa=400.0, dhat=0.02, normal=(0.0, 0.0, 1.0))
    energies = (dv.StableNeoHookean(), *((floor,) if options.pop("floor", False) else ()))
    held = mesh.points[:, 0] < 1e-9
    return dv.Model(mesh, energies=energies, pinned=held, device=device, **options)


def solver_of(sweeps: int, **space: int) -> dv.VBD:
    return dv.VBD(1 / 60, sweeps, relaxation=1.5, subspace=dv.CoarseSpace(**space or {"every": 2}))


def run(model: dv.Model, scenes: int) -> tuple[dict[str, Tensor], list[Tensor]]:
    """End and gradients of every argument, and the lengths of the corrections."""
    x = model.rest_points + 0.002 * torch.sin(40 * model.rest_points.flip(-1))
    x = torch.stack([x + 0.001 * i * torch.cos(20 * x) for i in range(scenes)])
    like = {"dtype": model.dtype, "device": model.device}
    moduli = torch.linspace(1, 2, model.num_tets, **like)
    leaves = {"x": x, "v": torch.cos(30 * x), "mu": 1e6 * moduli, "lam": 2e6 * moduli, "density": 1e3 * moduli,
              "rest_points": model.rest_points.clone(), "prescribed": x.clone()}  # fmt: skip
    leaves = {name: t.detach().requires_grad_() for name, t in leaves.items()}
    with dv.record("subspace") as lengths:
        end = dv.rollout(model, solver=solver_of(6), steps=2, save="last", **leaves)
    loss = (end.x[-1] * torch.cos(7 * x)).sum() + 0.01 * (end.v[-1] * torch.sin(9 * x)).sum()
    grads = torch.autograd.grad(loss, list(leaves.values()))
    out = {"x_end": end.x[-1].detach(), "v_end": end.v[-1].detach()}
    return out | {f"grad_{name}": g for name, g in zip(leaves, grads, strict=True)}, lengths


@pytest.mark.parametrize("floor", [False, True])
@pytest.mark.parametrize("scenes", [1, 3])
@pytest.mark.parametrize("regime", REGIMES)
def test_equals_the_cpu(regime: str | None, scenes: int, floor: bool) -> None:
    expected, taken = run(bodies("cpu", floor=floor), scenes)
    with forced(regime):
        found, lengths = run(bodies("cuda", floor=floor), scenes)
        again, _ = run(bodies("cuda", floor=floor), scenes)
    assert_same_bits(found, again)
    assert all(torch.equal(a.cpu(), b) for a, b in zip(lengths, taken, strict=True))
    for name, value in expected.items():
        assert value.abs().max() > 0, name
        assert relative_error(found[name].cpu(), value) <= tolerance("cancelling"), name


def test_float32() -> None:
    """As near to float64 as on the CPU."""
    exact, _ = run(bodies("cpu"), 1)
    errors = []
    for device in ("cpu", "cuda"):
        found, _ = run(bodies(device, dtype=torch.float32), 1)
        errors.append({name: relative_error(found[name].cpu().double(), value) for name, value in exact.items()})
    cpu, cuda = errors
    assert all(cuda[name] <= 10 * cpu[name] + tolerance("float32_forward") for name in exact), (cpu, cuda)


def test_a_large_matrix() -> None:
    """Of 384 unknowns, twelve tiles, beside the CPU's Cholesky factors."""
    ends = []
    for device in ("cpu", "cuda"):
        mesh = dv.mesh.box((24, 12, 12), (1.0, 0.5, 0.5))
        model, solver = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, device=device), solver_of(4, functions=128)
        assert system_of(model, solver).coarse_geometry.functions > 96
        x = model.rest_points
        end, _ = dv.step(model, x, torch.zeros_like(x), solver, mu=1e7, lam=1e7)
        ends.append((end - x).cpu())
    assert relative_error(ends[1], ends[0]) <= tolerance("cancelling")


def test_a_graph_of_a_step_and_its_backward() -> None:
    model = bodies("cuda", floor=True)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    leaves = [torch.full((model.num_tets,), 1e6, dtype=torch.float64, device="cuda").requires_grad_() for _ in range(2)]
    out = [torch.zeros_like(x), *(torch.zeros_like(t) for t in leaves)]

    def iteration() -> None:
        end, _ = dv.step(model, x, v, solver_of(5), mu=leaves[0], lam=leaves[1])
        bars = torch.autograd.grad(end.square().sum(), leaves)
        for to, value in zip(out, (end.detach(), *bars), strict=True):
            to.copy_(value)

    iteration()
    eager = [t.clone() for t in out]
    graph = captured(iteration)
    graph.replay()
    torch.cuda.synchronize()
    assert all(torch.equal(a, b) for a, b in zip(eager, out, strict=True)) and out[1].abs().max() > 0


def test_debug_checks_name_a_wrong_step() -> None:
    model = bodies("cuda")
    x = model.rest_points.clone()
    x[3, 0] = float("nan")
    with debug_checks(), pytest.raises((ValueError, RuntimeError)):
        dv.step(model, x, torch.zeros_like(x), solver_of(3), mu=1e6, lam=1e6)
