"""A Model's tensors are its own: neither what is done to the ones it hands out nor the mode of torch that it is made in
reaches them."""

import copy
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv

NAMES = ("rest_points", "density", "mass", "pinned", "tets", "surface", "color_ptr", "color_vertices", "body",
         "collider_points", "plane_points", "collider_radius")  # fmt: skip
GIVEN: dict[str, Any] = {"lam": 1e4, "time_step": 0.01, "sweeps": 3}


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


def test_masks_and_densities_of_the_user_are_not_kept(device: str) -> None:
    mesh = two_cubes()
    pinned, density = torch.zeros(mesh.num_vertices, dtype=torch.bool), torch.full((mesh.num_tets,), 1e3).double()
    anchored = pinned.clone()
    pinned[0], anchored[5] = True, True
    energies = (dv.StableNeoHookean(), dv.Anchor(10.0, vertices=anchored))
    model = dv.Model(mesh, density=density, pinned=pinned, energies=energies, device=device)
    expected = motion(model)
    pinned.fill_(True)
    anchored.fill_(True)
    density.fill_(1.0)
    assert same(motion(model), expected)


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


def test_a_penalty_made_without_gradients_can_be_differentiated() -> None:
    mesh = two_cubes()
    with torch.inference_mode():
        bodies = dv.contact.Bodies(torch.from_numpy(mesh.body.copy()), torch.ones(mesh.num_vertices).double())
    x = torch.from_numpy(mesh.points.copy()).requires_grad_()
    (slope,) = torch.autograd.grad(dv.contact.center_of_mass_penalty(x, bodies, 0.3, 10.0)[0].sum(), x)
    assert slope.any()


@pytest.fixture
def defaults() -> Iterator[None]:
    kept = torch.get_default_dtype()
    yield
    torch.set_default_device(None)
    torch.set_default_dtype(kept)


ROUTES: list[Callable[[dv.Model, Tensor, Tensor, dict[str, Any]], Any]] = [
    lambda m, x, v, o: dv.step(m, x, v, force=torch.zeros_like(x), rest_points=x, **o)[0],
    lambda m, x, v, o: dv.rollout(m, x, v, steps=3, checkpoint_every=2, **o).x,
    lambda m, x, v, o: dv.step(m, x, v, adjoint=dv.GlobalAdjoint(), **o)[0],
    lambda m, x, v, o: dv.step(m, x, v, adjoint=dv.GlobalAdjoint(assembled=False), **o)[0],
    lambda m, x, v, o: dv.step(m, x, v, adjoint=dv.Unrolled(), **o)[0],
    lambda m, x, v, o: dv.solve(m, x, v, tolerance=1e-3, **{k: o[k] for k in ("mu", "lam", "time_step")}).x,
]


@pytest.mark.usefixtures("defaults")
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("default", ["meta", torch.float16, torch.float64])
def test_defaults_of_torch_change_nothing(default: Any, dtype: torch.dtype) -> None:
    def run() -> list[Tensor]:
        """Building included; the tensors that a user makes say where they live."""
        out = []
        for contact in (False, True):
            model = build("cpu", contact).to(dtype=dtype)
            x = model.rest_points
            mu = torch.full((), 1e4, dtype=dtype, device="cpu", requires_grad=True)
            for route in ROUTES[: 2 if contact else None]:
                end = route(model, x, torch.zeros_like(x), {"mu": mu, **GIVEN})
                out += [end.detach(), *torch.autograd.grad(end.square().sum(), mu)]
            found = dv.diagnose(model, x, mu=mu, lam=1e4, time_step=0.01, warn=False)
            out.append(torch.full((), found.largest_strain, dtype=dtype, device="cpu"))
            out.append(dv.contact.center_of_mass_penalty(x, model, 0.3, 10.0))
        return out

    expected = run()
    torch.set_default_device(default) if default == "meta" else torch.set_default_dtype(default)
    found = run()
    torch.set_default_device(None)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
