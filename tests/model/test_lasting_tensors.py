"""A Model's tensors are its own: neither what is done to the ones it hands out nor the mode of torch that it is made in
reaches them."""

import copy
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv

NAMES = ("rest_points", "density", "mass", "pinned", "tets", "surface", "color_ptr", "color_vertices", "body",
         "collider_points", "plane_points", "collider_radius")  # fmt: skip
GIVEN: dict[str, Any] = {"lam": 1e4, "solver": dv.VBD(0.01, 3)}


def two_cubes() -> dv.TetMesh:
    cube = dv.mesh.cube(3, size=0.2)
    return dv.mesh.join([cube, cube.translate((0.0, 0.23, 0.0))])


def build(device: str, contact: bool = True) -> dv.Model:
    energies: tuple[Any, ...] = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.05), dv.Anchor(1.0, vertices=[2, 5]))
    options: dict[str, Any] = {}
    if contact:
        energies += (dv.PairBarrier(dhat=0.05), dv.Friction())
        options["colliders"] = [dv.colliders.Sphere((0.1, -0.4, 0.1), 0.3), dv.colliders.Plane((0.0, -0.3, 0.0))]
    return dv.Model(two_cubes(), pinned=[0, 1], energies=energies, device=device, **options)


def motion(model: dv.Model) -> list[Tensor]:
    """Two steps, differentiated; everything that a Model's tensors could change."""
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:, 1] = -1.0
    mu = torch.full((), 1e4, dtype=model.dtype, device=model.device, requires_grad=True)
    density = (1.1 * model.density).requires_grad_()
    x, v = dv.step(model, x, v, mu=mu, density=density, **GIVEN)
    x, v = dv.step(model, x, v, mu=mu, density=density, **GIVEN)
    return [x.detach(), v.detach(), *torch.autograd.grad((x * x).sum() + (v * v).sum(), (mu, density))]


def same(a: list[Tensor], b: list[Tensor]) -> bool:
    return all(torch.equal(one, other) for one, other in zip(a, b, strict=True)) and bool(a[2] != 0)


@pytest.mark.parametrize("contact", [False, True])
def test_changing_a_tensor_of_a_model_in_place_changes_no_model(device: str, contact: bool) -> None:
    model = build(device, contact)
    expected, before = motion(model), {name: getattr(model, name) for name in NAMES}
    for name in NAMES:
        handed = getattr(model, name)
        if handed.numel() == 0:
            assert not contact and name in ("collider_points", "plane_points", "collider_radius")
            continue
        handed.logical_not_() if handed.dtype == torch.bool else handed.add_(1)
        assert torch.equal(getattr(model, name), before[name]), name
    assert same(motion(model), expected)
    for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model)), model.to(model.device)):
        assert same(motion(twin), expected)


@pytest.mark.parametrize("name", NAMES)
def test_a_tensor_of_a_model_cannot_be_replaced(name: str) -> None:
    model = build("cpu")
    with pytest.raises(AttributeError):
        setattr(model, name, getattr(model, name))


# --- modes of torch ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("contact", [False, True])
def test_a_model_made_without_gradients_can_be_differentiated(device: str, contact: bool) -> None:
    expected = motion(build(device, contact))
    for mode in (torch.inference_mode, torch.no_grad):
        with mode():
            model = build(device, contact)
            moved = model.to(dtype=torch.float32).to(dtype=torch.float64)
            again, copied = pickle.loads(pickle.dumps(model)), copy.deepcopy(model)
            density = torch.full((model.num_tets,), 1e3, dtype=torch.float64, device=device)
            mask = torch.arange(model.num_vertices, device=device) < 2
            x = model.rest_points
            dv.step(model, x, torch.zeros_like(x), mu=1e4, **GIVEN)  # may make what later steps use
        with torch.inference_mode(False):
            for made in (model, moved, again, copied):
                assert not any(t.is_inference() for t in vars(made).values() if isinstance(t, Tensor))
                assert same(motion(made), expected)
            assert motion(dv.Model(two_cubes(), density, mask, device=device))[2] != 0
