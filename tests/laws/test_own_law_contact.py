"""Claim: a law of one's own has contact as the built-in one has: pairs, friction, floors, rigid and coarse corrections,
with the exact gradient of the executed step."""

import math
from typing import Any

import pytest
import torch
from helpers.laws import STABLE, TEXT, compiled_laws, law_of
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
    energies = (law_of(text), *(e for e in model.energies if not isinstance(e, dv.StableNeoHookean)))
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
    scene = scene_of(name, TEXT)
    result, parts = compiled(scene, steps, scene.solver(sweeps))
    expected = unrolled(scene, steps, scene.solver(sweeps), parts)
    for key, value in expected.items():
        assert relative_error(result[key], value) <= tolerance("contact_adjoint"), key
        assert value.any() or key in ("grad_friction", "grad_pair_damping"), key


@pytest.mark.parametrize("subspace", [None, "coarse"])
def test_central_differences(subspace: Any) -> None:
    scene = scene_of("stacked", TEXT)
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


def test_a_block_pressed_between_planes_has_its_closed_form_load() -> None:
    """Without friction it thickens freely: its side stress is zero, and the barriers bear what the stretch makes."""
    size, mu, lam, kappa, dhat = 0.2, 2e4, 4e4, 1e7, 5e-4
    planes = [dv.colliders.Plane((0, 0, 0)), dv.colliders.Plane((0, 0.9 * size, 0), (0, -1, 0))]
    mesh, weak = dv.mesh.box(4, size), dv.Anchor(0.05)  # against sliding
    energies = (law_of(TEXT), dv.PairBarrier(kappa, dhat=dhat, self_contact=False), weak)
    model = dv.Model(mesh, energies=energies, colliders=planes)
    rest = model.rest_points
    squeezed = rest * rest.new_tensor([1.0, 0.89, 1.0]) + rest.new_tensor([0.0, 0.005 * size, 0.0])
    given = {"mu": mu, "lam": lam, "c": 0.0, "m": 0.0, "k": 0.0, "gravity": (0, 0, 0)}
    y = dv.equilibrium(model, squeezed, dv.VBD(1.0, 1), **given).x[:, 1]
    top, bottom = rest[:, 1] > size - 1e-9, rest[:, 1] < 1e-9
    stretch = float(y[top].mean() - y[bottom].mean()) / size
    wide, gap = 1.0, 0.9 * size - y[top]
    for _ in range(100):  # mu (w^2 - 1) + lam log(stretch w^2) = 0
        volume = stretch * wide**2
        wide -= (mu * (wide**2 - 1) + lam * math.log(volume)) / (2 * mu * wide + 2 * lam / wide)
    pressure = -(mu * (stretch - 1 / stretch) + lam * math.log(stretch * wide**2) / stretch)
    borne = kappa * (2 * (gap - dhat) * torch.log(gap / dhat) + (gap - dhat) ** 2 / gap)
    assert 0.88 < stretch < 0.91 and float(gap.min()) > 0
    assert float(borne[gap < dhat].sum()) == pytest.approx(size**2 * pressure, rel=0.01)
