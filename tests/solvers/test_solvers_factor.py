"""Claim: a factor of projective dynamics is made once for many steps, and refused once its values have changed."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.solvers import ProjectiveDynamics
from diffvbd.testing import evaluate, generator, relative_error, tolerance

MESH = dv.mesh.cube(3, size=0.5)
H = 1 / 60


def body(device: str = "cpu") -> ProjectiveDynamics:
    """Springs and tets, held where x < 0.1 m."""
    return ProjectiveDynamics.from_mesh(MESH, pinned=MESH.points[:, 0] < 0.1, springs=True, device=device)


def constants(solver: ProjectiveDynamics) -> dict[str, Tensor]:
    """What a factor is made of, one value for each spring, tet and particle."""
    rng = generator("factor")
    sizes = {"stiffness": len(solver.edges), "tet_stiffness": MESH.num_tets}
    found = {name: 10 ** rng.uniform(3.5, 4.5, n) for name, n in sizes.items()}
    return {name: torch.from_numpy(a).to(solver.mass.device) for name, a in found.items()} | {"mass": solver.mass * 1.1}


def state(device: str = "cpu") -> dict[str, Tensor]:
    x = torch.from_numpy(MESH.points.copy()).to(device)
    return {"x": x * x.new_tensor([1.2, 0.9, 1.0]), "v": torch.sin(5 * x)}


def test_a_factor_serves_many_steps(device: str) -> None:
    solver = body(device)
    given = constants(solver)

    def run(x: Tensor, v: Tensor, time_step: float, *, once: bool, **own: Tensor) -> tuple[Tensor, Tensor]:
        options: dict[str, Any] = own | {"time_step": time_step}
        if once:
            options = {"factor": solver.factor(**options)}
            assert not options["factor"].lower.requires_grad
        for _ in range(3):
            x, v = solver.step(x, v, sweeps=2, **options)
        return x, v

    inputs = state(device) | given | {"time_step": H}
    found, expected = (evaluate(lambda once=once, **i: run(once=once, **i), inputs) for once in (True, False))
    assert all(torch.equal(found[n], expected[n]) for n in ("x", "v"))
    assert all(relative_error(found[n], expected[n]) <= tolerance("other_solvers") and found[n].any() for n in found)


def optimizers(leaf: Tensor) -> list[torch.optim.Optimizer]:
    kinds: list[dict[str, Any]] = [{"foreach": False}, {"foreach": True}]
    if not leaf.is_cuda:
        kinds.append({"fused": True})  # which torch does not count as a change: seen by values
    return [torch.optim.Adam([leaf], lr=0.01 * float(leaf.detach().mean()), **kind) for kind in kinds]


@pytest.mark.parametrize("shape", ["scalar", "each"])
@pytest.mark.parametrize("name", ["stiffness", "tet_stiffness", "mass"])
def test_a_factor_of_values_that_have_changed_is_refused(name: str, shape: str, device: str) -> None:
    """Forward and gradient would mix the matrix of the old values with the new ones."""
    solver = body(device)
    given = constants(solver)
    leaf = (given[name] if shape == "each" else given[name].mean()).clone().requires_grad_()
    refused = f"^{name}: expected the values that were factored.*factor again"
    ends = []
    for optimizer in optimizers(leaf):
        factor = solver.factor(time_step=H, **(given | {name: leaf}))
        for _ in range(2):  # what does not change them leaves the factor as it is
            end, _ = solver.step(**state(device), factor=factor, sweeps=2)
        optimizer.zero_grad()
        (end**2).sum().backward()
        assert leaf.grad is not None and leaf.grad.any()
        optimizer.step()
        for mode in (torch.enable_grad(), torch.no_grad(), torch.inference_mode()):
            with mode, pytest.raises(ValueError, match=refused):
                solver.step(**state(device), factor=factor, sweeps=2)
        ends.append(end.detach())
    assert all(not torch.equal(ends[0], end) for end in ends[1:])


def test_views_of_what_has_changed_are_refused_too() -> None:
    solver = body()
    given = constants(solver)
    both = torch.stack((given["stiffness"], given["stiffness"]))
    factor = solver.factor(time_step=H, **(given | {"stiffness": both[1]}))
    both.mul_(2)
    with pytest.raises(ValueError, match="stiffness: expected the values that were factored"):
        solver.step(**state(), factor=factor, sweeps=1)
    factor = solver.factor(time_step=H, stiffness=1e3, tet_stiffness=1e4)
    solver.mass.mul_(2)  # None stands for it
    with pytest.raises(ValueError, match="mass: expected the values that were factored"):
        solver.step(**state(), factor=factor, sweeps=1)
