"""Claim: the compiled adjoint of the rigid correction of bodies that touch is that of central differences."""

import importlib
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import mesh
from diffvbd.ops.fields import MOST_COUPLED
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import noise

rigid_contact = importlib.import_module("diffvbd.step.contact_rigid")
ELASTIC = dv.StableNeoHookean()


def pile(*energies: Any, heights: Sequence[int] = (2,), anchored: bool = False, scenes: int = 1, closing: float = 0.0,
         dtype: torch.dtype = torch.float64) -> tuple[dv.Model, Tensor, Tensor]:  # fmt: skip
    """Boxes one above the other over a floor at -5 mm that the lowest touch; x and v [scenes, V, 3]. closing: At which
    the first and the third come toward the second [m/s]."""
    box = mesh.box(2, 0.1)
    places = [[0.5 * n + 0.013 * (k % 4), 0.105 * k, 0.017 * (k % 4)] for n, high in enumerate(heights)
              for k in range(high)]  # fmt: skip
    tets = mesh.join([box.translate(p) for p in places])
    if anchored:
        spring = torch.zeros(tets.num_vertices)
        spring[:3] = 50.0
        energies = (*energies, dv.Anchor(stiffness=spring, points=torch.from_numpy(tets.points) + 0.01))
    model = dv.Model(tets, energies=(ELASTIC, *energies)).to(dtype=dtype)
    shape = (scenes, *model.rest_points.shape)
    x = model.rest_points + noise("pile", shape=shape, size=5e-4).to(dtype)
    v = noise("pile", "v", shape=shape, size=0.3).to(dtype)
    v[..., 1] += closing * (1 - model.body.to(dtype))
    return model, x, v


FLOOR = dv.FloorBarrier([-0.005, -0.3], [(0.0, 1.0, 0.0), (0.3, 1.0, 0.1)], kappa=1e3, dhat=0.01, damping=3.0)
PAIRS = dv.PairBarrier(1e3, 0.01, damping=2.0)
CASES = {
    "floor": ((FLOOR, dv.Friction(0.4)), {"heights": (1,)}),
    "pairs": ((PAIRS, dv.Friction(0.4)), {}),
    "all": ((FLOOR, PAIRS, dv.Friction(0.4)), {"anchored": True, "heights": (3,)}),
    "batched": ((FLOOR, PAIRS, dv.Friction(0.4)), {"scenes": 3}),
    # more than sixty-four: groups of three and two, and a stack that is too high for one
    "many": ((PAIRS, dv.Friction(0.4, 0.05)), {"heights": (3, MOST_COUPLED + 1, 2, 1), "scenes": 2}),
    "single": ((FLOOR, PAIRS, dv.Friction(0.4)), {"dtype": torch.float32}),
    "held": ((PAIRS, dv.Friction(0.4)), {"heights": (3,), "closing": 6.0}),
    "held over a floor": ((FLOOR, PAIRS, dv.Friction(0.4)), {"heights": (3,), "closing": 6.0}),
    "held, single": ((PAIRS, dv.Friction(0.4)), {"heights": (3,), "closing": 6.0, "dtype": torch.float32}),
}
SHARE = {"pairs", "many", "held", "held, single"}  # of no other does nothing else act on an island


def leaves_of(model: dv.Model, x: Tensor, v: Tensor) -> dict[str, Tensor]:
    kinds = set(map(type, model.energies))
    kappas = {"floor_kappa": dv.FloorBarrier, "pair_kappa": dv.PairBarrier}
    density = torch.linspace(800.0, 1200.0, model.num_tets, dtype=x.dtype, device=x.device)
    return {"x": x, "v": v, "density": density, "friction": x.new_full((), 0.4),
            **{name: x.new_full((), 1e3) for name, kind in kappas.items() if kind in kinds}}  # fmt: skip


def objective(model: dv.Model, leaves: dict[str, Tensor]) -> Tensor:
    x, v, *_ = given = list(leaves.values())
    others = dict(list(leaves.items())[2:])
    ends = dv.step(model, x, v, dv.VBD(0.01, 2), mu=1e5, lam=1e5, **others)
    weights = [noise(name, shape=t.shape, size=1.0).to(given[0]) for name, t in zip(("x'", "v'"), ends, strict=True)]
    return (weights[0] * ends[0]).sum() + 0.01 * (weights[1] * ends[1]).sum()


@pytest.mark.parametrize("name", CASES)
def test_adjoint_is_that_of_central_differences(name: str, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    energies, options = CASES[name]
    model, x, v = (t.to(device) for t in pile(*energies, **options))
    leaves, taken = leaves_of(model, x, v), []
    original = rigid_contact.rigid_reverse

    def reverse(fields: Any, given: Tensor, *rest: Any) -> Any:
        taken.append(given)
        return original(fields, given, *rest)

    monkeypatch.setattr(rigid_contact, "rigid_reverse", reverse)
    for leaf in leaves.values():
        leaf.requires_grad_()
    found = torch.autograd.grad(objective(model, leaves), list(leaves.values()))
    assert any(bool((t[..., 1] >= 0).any()) for t in taken) == (name in SHARE), name
    if name.startswith("held"):
        assert any(bool(((t[..., 0] > 0) & (t[..., 0] < 1)).any()) for t in taken), name
    if x.dtype == torch.float32:
        double = model.to(dtype=torch.float64)
        with torch.enable_grad():
            wide = {key: leaf.detach().double().requires_grad_() for key, leaf in leaves.items()}
            expected = torch.autograd.grad(objective(double, wide), list(wide.values()))
        for key, own, other in zip(leaves, found, expected, strict=True):
            assert float(other.abs().max()) > 0, key
            assert relative_error(own.double(), other) <= tolerance("contact_float32"), key
        return
    for key, own in zip(leaves, found, strict=True):
        direction = noise("toward", key, shape=own.shape, size=1.0).to(x)
        slope = float((own * direction).sum())
        size = 1e-7 if key in ("x", "v") else 1e-5 * float(leaves[key].detach().abs().max())

        def along(step: float, key: str = key, direction: Tensor = direction) -> float:
            with torch.no_grad():
                return float(objective(model, leaves | {key: leaves[key] + step * direction}))

        by_size = [(along(s) - along(-s)) / (2 * s) for s in (size, size / 2)]
        expected = (4 * by_size[1] - by_size[0]) / 3
        assert abs(slope) > 0, key
        assert abs(slope - expected) <= tolerance("contact_finite_difference") * abs(expected), (key, slope, by_size)
