"""Claim: no step and no gradient depends on memory that nobody has written.

torch fills what `empty` gives with NaN and with the largest integers, if it is asked to: the same bits come out.
"""

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv

FLOOR, FRICTION = dv.FloorBarrier(height=-0.003, kappa=1e4, dhat=2e-3), dv.Friction(0.5)
PAIRS = dv.PairBarrier(kappa=1e4, dhat=2e-3)
PLANE = dv.colliders.Plane((0.0, -0.003, 0.0))
SCENES: dict[str, dict[str, Any]] = {
    "plain": {},
    "floor, friction": {"energies": (FLOOR, FRICTION)},
    "coarse": {"coarse": "auto"},
    "pairs": {"energies": (PAIRS,)},
    "pairs, coarse": {"energies": (PAIRS,), "coarse": "auto"},
    "pairs, friction, a collider": {"energies": (PAIRS, FRICTION), "colliders": (PLANE,)},
    "pairs, floor, float32": {"energies": (PAIRS, FLOOR), "dtype": torch.float32},
}


@pytest.fixture
def filled() -> Iterator[None]:
    """As with torch.use_deterministic_algorithms, without which memory is never filled."""
    before, warns = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    fills = torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True, warn_only=True)
    yield
    torch.use_deterministic_algorithms(before, warn_only=warns)
    torch.utils.deterministic.fill_uninitialized_memory = fills


def run(name: str, scenes: int, device: str, fill: bool) -> list[Tensor]:
    """Three cubes that fly into one another, two steps on; and gradients."""
    torch.utils.deterministic.fill_uninitialized_memory = fill
    assert not fill or bool(torch.empty((1000,), device=device).isnan().all())
    cube = dv.mesh.box(3, 0.1)
    bodies = dv.mesh.join([cube.translate((0.104 * k, 0.103 * (k == 2) + 0.004, 0.01 * k)) for k in range(3)])
    options: dict[str, Any] = {"energies": (), **SCENES[name]}
    options["energies"] = (dv.StableNeoHookean(), *options["energies"])
    model = dv.Model(bodies, device=device, **options)
    x = model.rest_points
    v = 3.0 * (x.mean(0) - x) / x.std() * torch.linspace(0.5, 1.0, scenes).to(x)[:, None, None]
    leaves = [t.clone().requires_grad_() for t in (x.expand_as(v), v, x.new_full((1, model.num_tets), 1e5))]
    now, speed, mu = leaves
    for _ in range(2):
        now, speed = dv.step(model, now, speed, mu=mu, lam=1e5, time_step=0.005, sweeps=3)
    return [now.detach(), speed.detach(), *torch.autograd.grad((now - x).square().sum(), leaves)]


@pytest.mark.filterwarnings("ignore:.*does not have a deterministic implementation")
@pytest.mark.parametrize("scenes", [1, 2])
@pytest.mark.parametrize("name", SCENES)
def test_what_memory_held_before_does_not_matter(filled: None, name: str, scenes: int, device: str) -> None:
    first, second = (run(name, scenes, device, fill) for fill in (False, True))
    for one, other in zip(first, second, strict=True):
        assert bool(one.isfinite().all()) and float(one.abs().max()) > 0
        assert torch.equal(one, other)
