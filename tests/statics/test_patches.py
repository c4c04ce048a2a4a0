"""Claim: volumes averaged over patches unlock linear tets near incompressibility and add no soft mode; rest states,
reactions and stress are those of the averaged energy; the gradient of equilibrium is that of differences."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.adjoint.statics import StaticPotential, Statics
from diffvbd.model.patches import find_patches
from diffvbd.model.system import system_of

SOLVER = dv.VBD(1.0, 0, subspace="coarse")
AUTO = dv.StableNeoHookean(patches="auto")


def numbers(*shape: int, size: float = 1.0, seed: int = 0) -> Tensor:
    return size * torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def cantilever(law: dv.StableNeoHookean, n: int = 3) -> dv.Model:
    """5 x 1 x 1, pinned at x = 0, of the tets that lock most."""
    mesh = dv.mesh.beam(5 * n + 1, n + 1, n + 1, size=(5.0, 1.0, 1.0), split="kuhn")
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=[law])


def deflection(model: dv.Model, poisson: float) -> float:
    """Of the end under a small force, over that of Timoshenko's beam."""
    young, end = 1e6, model.rest_points[:, 0] > 5 - 1e-9
    force = torch.zeros_like(model.rest_points)
    force[end, 1] = 0.1 / end.sum()
    rest = dv.equilibrium(model, model.rest_points, SOLVER, young=young, poisson=poisson, gravity=(0, 0, 0),
                          force=force, tolerance=1e-6)  # fmt: skip
    shear = young / (2 * (1 + poisson)) * 10 * (1 + poisson) / (12 + 11 * poisson)
    return float((rest.x - model.rest_points)[end, 1].mean()) / (0.1 * (5**3 / (3 * young / 12) + 5 / shear))


def test_patches_unlock_a_cantilever() -> None:
    """Plain tets bend by a twentieth of what they should; with patches they bend as tets of nu = 0.3 do."""
    plain, averaged = cantilever(dv.StableNeoHookean()), cantilever(AUTO)
    assert deflection(plain, 0.4999) < 0.06
    assert deflection(averaged, 0.4999) > 0.95 * deflection(plain, 0.3)
    assert deflection(averaged, 0.3) > deflection(plain, 0.3)


def hessian(model: dv.Model, mu: float, lam: float) -> Tensor:
    """At rest, of all degrees of freedom [3 V, 3 V]."""
    system, one = system_of(model, SOLVER), torch.ones(1, 1, dtype=torch.float64)
    x = model.rest_points[None]
    none = x.new_zeros((1, 0, 3))
    given = Statics(
        torch.zeros_like(x),
        mu * one,
        lam * one,
        model.rest_scalars,
        x.new_zeros((1, 0)),
        none,
        one[0],
        x.new_zeros((1, 0)),
    )
    at = StaticPotential(system, x, given)
    columns = torch.eye(x.numel(), dtype=x.dtype).reshape(-1, 1, *x.shape[1:])
    return torch.stack([at.product(c).flatten() for c in columns], -1)


def test_a_free_body_has_six_modes_without_stiffness() -> None:
    mesh = dv.mesh.beam(4, 3, 3, size=(0.3, 0.2, 0.2), split="kuhn")
    model = dv.Model(mesh, energies=[AUTO])
    matrix = hessian(model, 1.0, 5e3)
    assert torch.allclose(matrix, matrix.T, atol=1e-9)
    value, least = (torch.linalg.eigvalsh(m) for m in (matrix, hessian(dv.Model(mesh), 1.0, 0.0)))
    assert value[:6].abs().max() < 1e-9 < least[6]
    assert (value[6:] >= least[6:] - 1e-9).all()  # nothing is softer than with lam = 0


def test_the_hessian_is_the_derivative_of_the_forces_and_these_that_of_the_energy() -> None:
    model = cantilever(AUTO, 1)
    system = system_of(model, SOLVER)
    mu, lam = (m * (1 + 0.3 * numbers(1, model.num_tets, seed=4).clamp(-1, 1)) for m in (1e4, 1e6))
    lam = model.patches.spread(model.patches.mean(lam, model.rest_scalars[..., 6]))
    x = model.rest_points[None] + numbers(1, model.num_vertices, 3, size=0.1)
    rest = model.rest_scalars
    given = Statics(torch.zeros_like(x), mu, lam, rest, x.new_zeros((1, 0)), x.new_zeros((1, 0, 3)), x.new_ones(1),
                    x.new_zeros((1, 0)))  # fmt: skip
    at, w = StaticPotential(system, x, given), numbers(*x.shape, seed=1)
    leaf = x.clone().requires_grad_()
    (force,) = torch.autograd.grad(energy_of(model, leaf[0], mu[0], lam[0]), leaf, create_graph=True)
    (product,) = torch.autograd.grad((force * w).sum(), leaf, retain_graph=True)
    assert (at.forces() - force).norm() <= 1e-12 * force.norm()
    assert (at.product(w) - product).norm() <= 1e-12 * product.norm()
    columns = [torch.autograd.grad(force[0, 5, c], leaf, retain_graph=True)[0][0, 5] for c in range(3)]
    assert torch.allclose(at.diagonal()[0, 5], torch.stack(columns), rtol=1e-10)


def energy_of(model: dv.Model, x: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """By deformation gradients and patches one by one [J]; lam alike within each."""
    rest, now = ((p[model.tets][:, 1:] - p[model.tets][:, :1]).mT for p in (model.rest_points, x))
    f, volume = now @ torch.linalg.inv(rest), torch.linalg.det(rest) / 6
    ratio = torch.linalg.det(f)
    psi = mu / 2 * (f.square().sum((1, 2)) - 3) - mu * (ratio - 1) + mu / 2 * (ratio - 1) ** 2
    total = (volume * psi).sum()
    for patch in range(int(model.patches.label.max()) + 1):
        own = model.patches.label == patch
        mean = (volume[own] * ratio[own]).sum() / volume[own].sum()
        total = total + (volume[own] * lam[own]).sum() / 2 * (mean - 1) ** 2
    return total


def test_gradients_are_those_of_differences() -> None:
    """Every input, in two scenes, of a beam at nu about 0.45; no gradient may be zero."""
    mesh = dv.mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1), split="kuhn")
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=[AUTO])
    x, tets = model.rest_points, model.num_tets
    arguments = {
        "x": torch.stack([x, x + 0.001]),
        "mu": 3e4 * (1 + 0.2 * numbers(2, tets).clamp(-1, 1)),
        "lam": 3e5 * (1 + 0.2 * numbers(tets).clamp(-1, 1)),
        "force": numbers(2, model.num_vertices, 3, size=0.05),
        "gravity": torch.tensor([0.3, -9.0, 0.5], dtype=torch.float64),
        "rest_points": x + numbers(model.num_vertices, 3, size=1e-3),
        "density": 1000 * (1 + 0.1 * numbers(tets).clamp(-1, 1)),
        "stress_free": torch.eye(3, dtype=torch.float64) + numbers(tets, 3, 3, size=0.02),
    }
    weights = numbers(model.num_vertices, 3, seed=3)

    def loss(**inputs: Any) -> Tensor:
        done = dv.equilibrium(model, inputs.pop("x"), SOLVER, tolerance=1e-12,
                              adjoint=dv.GlobalAdjoint(tolerance=1e-12), **inputs)  # fmt: skip
        return (weights * done.x).sum() + done.x.square().sum()

    check = dv.check_gradients(loss, arguments, relative_steps=(1e-4,), verbose=False)
    assert check.ok and all(size > 0 for _, size, *_ in check.rows), str(check)


def test_large_deflections_reactions_and_stress() -> None:
    """Newton's method converges, by stages of lam; supports carry the weight; a state that is affine is as ever."""
    model, values = cantilever(AUTO, 2), {"young": 1e6, "poisson": 0.4999}
    rest = dv.equilibrium(model, model.rest_points, SOLVER, **values)
    assert rest.converged and float((model.rest_points - rest.x)[:, 1].max()) > 0.5 and rest.iterations < 60
    assert dv.equilibrium(model, rest.x, SOLVER, **values).iterations == 0
    weight = 9.81 * model.mass.sum()
    held = dv.reactions(model, rest.x.detach(), **values)
    assert abs(held[:, 1].sum() / weight - 1) < 1e-6
    bent = torch.eye(3, dtype=torch.float64) + numbers(3, 3, size=0.1)
    affine = model.rest_points @ bent.T
    one, two = (dv.stress(m, affine, **values).cauchy for m in (model, cantilever(dv.StableNeoHookean(), 2)))
    assert torch.allclose(one, two, rtol=1e-9)
    # the work of stress is the change of energy
    mu, lam = (torch.full((model.num_tets,), m, dtype=torch.float64) for m in dv.lame(**values))
    x = (rest.x + 0.01 * numbers(*rest.x.shape, seed=2)).requires_grad_()
    (force,) = torch.autograd.grad(energy_of(model, x, mu, lam), x)
    corners = x.detach()[model.tets]
    edges = corners[:, 1:] - corners[:, :1]
    slopes = torch.linalg.inv(edges).mT
    slopes = torch.cat([-slopes.sum(1, keepdim=True), slopes], 1)  # of the shape functions, at x
    stress = dv.stress(model, x.detach(), **values).cauchy * (torch.linalg.det(edges) / 6)[:, None, None]
    total = torch.zeros_like(force).index_add(0, model.tets.flatten(), (slopes @ stress).flatten(0, 1))
    assert (total - force).norm() <= 1e-10 * force.norm()


def test_scenes_that_need_stages_leave_others_alone() -> None:
    model = cantilever(AUTO, 1)
    alone = [dv.equilibrium(model, model.rest_points, SOLVER, young=young, poisson=0.499) for young in (5e5, 1e8)]
    young = torch.tensor([[5e5], [1e8]], dtype=torch.float64)
    both = dv.equilibrium(model, model.rest_points.expand(2, -1, -1), SOLVER, young=young, poisson=0 * young + 0.499)
    assert both.converged and alone[0].iterations > 12 > alone[1].iterations
    assert all(torch.allclose(x, own.x, atol=1e-6) for x, own in zip(both.x, alone, strict=True))


def test_pairs_press_averaged_bodies() -> None:
    low, high = dv.mesh.cube(3, 0.2, "kuhn"), dv.mesh.cube(2, 0.16, "kuhn").translate([0.013, 0.21, 0.009])
    mesh = dv.mesh.join([low, high])
    y = torch.as_tensor(mesh.points[:, 1])
    top = y > float(y.max()) - 1e-9
    model = dv.Model(mesh, pinned=top | (y < 1e-9), energies=(AUTO, dv.PairBarrier(1e4, dhat=0.02)))
    down = torch.where(top[:, None], model.rest_points - 0.03 * torch.tensor([0, 1, 0]), model.rest_points)
    rest = dv.equilibrium(model, model.rest_points, SOLVER, prescribed=down, young=3e4, poisson=0.48)
    assert rest.converged


@pytest.mark.parametrize("split", ["kuhn", "five"])
def test_patches_of_a_mesh(split: Any) -> None:
    mesh = dv.mesh.join([dv.mesh.beam(7, 4, 4, split=split), dv.mesh.cube(2).translate([3, 0, 0])])
    label = find_patches(mesh.tets)
    size = np.bincount(label)
    assert len(label) == mesh.num_tets and size.min() >= 4 and size.max() <= 12
    assert mesh.num_tets / 8 < len(size) < mesh.num_tets / 5
    for patch in range(len(size)):  # connected by faces
        own = mesh.tets[label == patch]
        joined = {0}
        for _ in own:
            joined |= {i for i in range(len(own)) for j in joined if len(set(own[i]) & set(own[j])) >= 3}
        assert len(joined) == len(own)
    assert np.array_equal(label, find_patches(mesh.tets))


def test_models_keep_their_patches() -> None:
    model = cantilever(dv.StableNeoHookean(patches=torch.arange(30 * 1) // 6), 1)
    for other in (pickle.loads(pickle.dumps(model)), model.to(dtype=torch.float32), model.replace(density=10.0)):
        assert torch.equal(other.patches.label, model.patches.label)
    assert "<30 labels>" in repr(model) and "'auto'" in repr(cantilever(AUTO, 1))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dv.StableNeoHookean(patches="cells"), "patches: expected None, \"auto\" or integers"),
        (lambda: dv.StableNeoHookean(patches=0.5), "patches: expected None, \"auto\" or integers"),
        (lambda: dv.StableNeoHookean(patches=torch.ones(3)), "patches: .*float32"),
        (lambda: dv.Model(dv.mesh.cube(), energies=[dv.StableNeoHookean(patches=[0, 0])]), r"patches: expected shape"),
        (lambda: dv.Model(dv.mesh.join([dv.mesh.cube(), dv.mesh.cube().translate([2, 0, 0])]),
                          energies=[dv.StableNeoHookean(patches=[0] * 6 + [1] * 4)]), "one connected body"),
        (lambda: dv.step(cantilever(AUTO, 1), *[cantilever(AUTO, 1).rest_points] * 2, dv.VBD(0.01, 1, block="paper"),
                         young=1e4, poisson=0.4), 'solver: expected block="exact" with patches'),
        (lambda: dv.solvers.vertex_block_descent(cantilever(AUTO, 1), dv.VBD(0.01, 1)), "model: .*without patches"),
    ],
)  # fmt: skip
def test_what_is_refused(make: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        make()
