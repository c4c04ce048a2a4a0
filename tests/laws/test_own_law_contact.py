"""Claim: a law of one's own has contact as the built-in one has: pairs, friction, floors, rigid and coarse corrections,
with the exact gradient of the executed step."""

from typing import Any

import pytest
import torch
from helpers.laws import LOG, STABLE, compiled_laws
from helpers.paths import needs_csrc
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import evaluate, relative_error
from diffvbd.testing.contact_scenes import GRAVITY, SCENES, Scene, compiled, unrolled
from diffvbd.testing.tolerances import tolerance

pytestmark = [needs_csrc, pytest.mark.slow]  # a law is compiled
__all__ = ["compiled_laws"]


def scene_of(name: str, text: str) -> Scene:
    """A scene of contact whose bodies are of a law of one's own; its inputs mu and lam are the law's."""
    scene = SCENES[name]()
    model = scene.model
    energies = (dv.law(text, mu=2e4, lam=4e4), *(e for e in model.energies if not isinstance(e, dv.StableNeoHookean)))
    scene.model = dv.Model(model.mesh, pinned=model.pinned, energies=energies, colliders=model.colliders)
    return scene


@pytest.mark.hours  # another law is compiled
@pytest.mark.parametrize("subspace", [None, "coarse"])
def test_the_built_in_law_as_ones_own(subspace: Any) -> None:
    scene, own = SCENES["stacked"](), scene_of("stacked", STABLE)
    solver = scene.solver(4, subspace=subspace)

    def end_of(given: Scene) -> dict[str, Tensor]:
        def run(x: Tensor, v: Tensor, **inputs: Any) -> Any:
            return dv.step(given.model, x, v, solver, gravity=GRAVITY, **inputs)

        return evaluate(run, given.leaves(), given.time_step)

    expected, result = end_of(scene), end_of(own)
    for name, value in expected.items():
        assert value.any() and relative_error(result[name], value) < 1e-11, name


@pytest.mark.parametrize(("name", "steps", "sweeps"), [("stacked", 1, 1), ("stacked", 2, 4), ("fast", 1, 4)])
def test_gradients_are_those_of_the_executed_step(name: str, steps: int, sweeps: int) -> None:
    scene = scene_of(name, LOG)
    result, parts = compiled(scene, steps, scene.solver(sweeps))
    expected = unrolled(scene, steps, scene.solver(sweeps), parts)
    for key, value in expected.items():
        assert relative_error(result[key], value) <= tolerance("contact_adjoint"), key
        assert value.any() or key in ("grad_friction", "grad_pair_damping"), key


@pytest.mark.parametrize("subspace", [None, "coarse"])
def test_central_differences(subspace: Any) -> None:
    scene = scene_of("stacked", LOG)
    solver, weight = scene.solver(3, subspace=subspace), torch.linspace(-1, 1, scene.x.numel()).view_as(scene.x)
    leaves = scene.leaves()

    def loss(**given: Tensor) -> Tensor:
        return (
            weight * dv.step(scene.model, given.pop("x"), given.pop("v"), solver, gravity=GRAVITY, **given)[0]
        ).sum()

    gradients = dict(zip(leaves, torch.autograd.grad(loss(**leaves), list(leaves.values())), strict=True))
    for name in ("x", "v", "mu", "lam", "pair_kappa", "friction"):
        value = leaves[name].detach()
        way = torch.cos(torch.arange(value.numel(), dtype=value.dtype)).view_as(value) * value.abs().mean()
        with torch.no_grad():
            ends = [loss(**{**leaves, name: value + sign * 1e-6 * way}) for sign in (1, -1)]
        slope, found = (ends[0] - ends[1]) / 2e-6, (gradients[name] * way).sum()
        assert found.abs() > 0 and relative_error(found, slope) < 1e-5, name
