"""Claim: the compiled adjoint of the rigid correction of bodies that touch is that which autograd derives of it."""

import importlib
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import mesh, ops
from diffvbd.step.rigid_terms import Scenes
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import noise

rigid_contact = importlib.import_module("diffvbd.step.rigid_contact")
ELASTIC = dv.StableNeoHookean()


def pile(*energies: Any, count: int = 2, anchored: bool = False, scenes: int = 1, dtype: torch.dtype = torch.float64
         ) -> tuple[dv.Model, Tensor, Tensor]:  # fmt: skip
    """Boxes one above the other over a floor at -5 mm that the lowest touches; x and v [scenes, V, 3]."""
    box = mesh.box(2, 0.1)
    places = [[0.013 * k, 0.105 * k, 0.017 * k] for k in range(count)]
    tets = mesh.join([box.translate(p) for p in places])
    if anchored:
        spring = torch.zeros(tets.num_vertices)
        spring[:3] = 50.0
        energies = (*energies, dv.Anchor(stiffness=spring, points=torch.from_numpy(tets.points) + 0.01))
    model = dv.Model(tets, energies=(ELASTIC, *energies)).to(dtype=dtype)
    shape = (scenes, *model.rest_points.shape)
    x = model.rest_points + noise("pile", shape=shape, size=5e-4).to(dtype)
    return model, x, noise("pile", "v", shape=shape, size=0.3).to(dtype)


FLOOR = dv.FloorBarrier([-0.005, -0.3], [(0.0, 1.0, 0.0), (0.3, 1.0, 0.1)], kappa=1e3, dhat=0.01, damping=3.0)
PAIRS = dv.PairBarrier(1e3, 0.01, damping=2.0)
CASES = {
    "floor": ((FLOOR, dv.Friction(0.4)), {"count": 1}),
    "pairs": ((PAIRS, dv.Friction(0.4)), {}),
    "all": ((FLOOR, PAIRS, dv.Friction(0.4)), {"anchored": True, "count": 3}),
    "batched": ((FLOOR, PAIRS, dv.Friction(0.4)), {"scenes": 3}),
    "single": ((FLOOR, PAIRS, dv.Friction(0.4)), {"dtype": torch.float32}),
}


def derived(s: Scenes, needs: Sequence[bool], *given: Tensor) -> tuple[Tensor, ...]:
    """By autograd, as CUDA does it."""
    with torch.enable_grad():
        leaves = (t.detach().requires_grad_(need and t.is_floating_point())
                  for t, need in zip(s.fields, needs, strict=True))  # fmt: skip
        return rigid_contact._adjoints(s._replace(fields=ops.TouchingFields(*leaves)), *given, needs)


@pytest.mark.parametrize("name", CASES)
def test_compiled_adjoint_is_that_of_autograd(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    energies, options = CASES[name]
    model, x, v = pile(*energies, **options)
    compiled, seen = rigid_contact._compiled_adjoints, {}

    def both(s: Scenes, x_bar: Tensor, share: Tensor, motion: Tensor, factor: Tensor, needs: Sequence[bool]) -> Any:
        found = compiled(s, x_bar, share, motion, factor, needs)
        expected = derived(s, needs, x_bar, share, motion, factor)
        names = [field for field, need in zip(ops.TouchingFields._fields, needs, strict=True) if need]
        for field, own, other in zip(names, found, expected, strict=True):
            size = float(other.norm())
            seen[field] = max(seen.get(field, 0.0), size)
            assert own.shape == other.shape, field
            if size > 0:
                limit = tolerance("contact_adjoint" if own.dtype == torch.float64 else "contact_float32")
                assert relative_error(own, other) <= limit, field
        return found

    monkeypatch.setattr(rigid_contact, "_compiled_adjoints", both)
    leaves = {"x": x, "v": v, "density": torch.full((), 1e3, dtype=x.dtype)}
    parameters = {"floor_barrier.kappa": 1e3} if dv.FloorBarrier in map(type, energies) else {}
    parameters |= {"pair_barrier.kappa": 1e3} if dv.PairBarrier in map(type, energies) else {}
    values = {key: torch.full((), value, dtype=x.dtype).requires_grad_() for key, value in parameters.items()}
    for leaf in leaves.values():
        leaf.requires_grad_()
    end = dv.step(model, leaves["x"], leaves["v"], mu=1e5, lam=1e5, time_step=0.01, sweeps=2, density=leaves["density"],
                  parameters=values)  # fmt: skip
    sum(((t * noise(name, shape=t.shape, size=1.0).to(t)).sum() for t in end), x.new_zeros(())).backward()
    wanted = {"x", "x_prev", "y", "mass"} | ({"lag"} if "pair_barrier.kappa" in values else {"floor_lag"})
    assert all(seen[field] > 0 for field in wanted), seen
    assert all(
        float(leaf.grad.abs().max()) > 0 for leaf in (*leaves.values(), *values.values()) if leaf.grad is not None
    )
