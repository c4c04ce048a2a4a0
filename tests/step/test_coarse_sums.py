"""Claim: stiffness and mass in coarse functions are W' K W and W' M W, written out; the compiled loops and the products
of torch give the same, forward and backward, and the loops the same bits on any number of threads."""

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.model.material import shape_gradients
from diffvbd.model.system import System, system_of
from diffvbd.step.coarse import coarse_mass, coarse_stiffness
from diffvbd.testing import generator, relative_error, tolerance

SCENES = 2


@pytest.fixture(scope="module")
def model() -> System:
    """Bodies of one group and of several, with blocks that are not full."""
    sizes = ((4, 4, 3), (2, 2, 2), (9, 3, 3), (6, 6, 2))
    boxes = [dv.mesh.box(n, 0.1).translate((float(k), 0.0, 0.0)) for k, n in enumerate(sizes)]
    mesh = dv.mesh.join(boxes)
    solver = dv.VBD(0.01, 1, subspace=dv.CoarseSpace(functions=20))
    return system_of(dv.Model(mesh, pinned=mesh.points[:, 1] < 0.01), solver)


def inputs(model: System, scenes: tuple[int, ...] = (SCENES,) * 4, shared: bool = False) -> list[Tensor]:
    """mu, lam, gradients, volume; with ``shared`` one mu for all tets."""
    rng, count = generator("coarse sums"), model.num_tets
    corners = model.rest_points[model.tets] + 1e-3 * torch.as_tensor(rng.standard_normal((scenes[2], count, 4, 3)))
    mu = torch.as_tensor(rng.uniform(1, 2, (scenes[0], 1 if shared else count)))
    lam = torch.as_tensor(rng.uniform(1, 2, (scenes[1], count)))
    return [t.detach().requires_grad_() for t in (mu, lam, *shape_gradients(corners))]


def written_out(model: System, mu: Tensor, lam: Tensor, gradients: Tensor, volume: Tensor) -> Tensor:
    g = model.coarse_geometry
    whole = torch.zeros((model.num_vertices, g.functions + 1), dtype=mu.dtype)
    whole[g.vertex, g.function] = torch.as_tensor(g.weight)
    out = []
    for group, functions in enumerate(torch.as_tensor(g.group_functions)):
        tets = torch.as_tensor(g.tet_group == group).nonzero()[:, 0]
        weights = whole[model.tets[tets]][..., functions]  # -1: the column of nothing
        slopes = torch.einsum("btac,taf->btfc", gradients[:, tets], weights)
        shear, bulk = (((t if t.shape[1] > 1 else t.expand(-1, model.num_tets)) * volume)[:, tets] for t in (mu, lam))
        turned = torch.einsum("bt,btjp,btiq->bpqij", shear, slopes, slopes)
        one = torch.eye(3, dtype=mu.dtype)
        out.append(turned + torch.einsum("bt,btic,btjc,pq->bpqij", shear, slopes, slopes, one)
                   + torch.einsum("bt,btip,btjq->bpqij", bulk, slopes, slopes))  # fmt: skip
    return torch.stack(out, 1)


@pytest.mark.parametrize("shared", [False, True])
def test_stiffness_written_out(model: System, shared: bool) -> None:
    given = inputs(model, shared=shared)
    found, expected = coarse_stiffness(model._coarse_plan, *given), written_out(model, *given)
    assert relative_error(found, expected) <= tolerance("formula") and expected.abs().max() > 0
    bar = torch.as_tensor(generator("bar").standard_normal(tuple(expected.shape)))
    bars = (torch.autograd.grad((bar * t).sum(), given) for t in (found, expected))
    for ours, theirs in zip(*bars, strict=True):
        assert relative_error(ours, theirs) <= tolerance("formula") and theirs.abs().max() > 0


def test_mass_written_out(model: System) -> None:
    g, mass = model.coarse_geometry, torch.as_tensor(generator("mass").uniform(1, 2, (SCENES, model.num_vertices)))
    mass.requires_grad_()
    whole = torch.zeros((model.num_vertices, g.functions), dtype=mass.dtype)
    whole[g.vertex, g.function] = torch.as_tensor(g.weight)
    dense = torch.einsum("vi,bv,vj->bij", whole, mass, whole) + torch.diag(torch.as_tensor(g.filling).double())
    ptr = g.function_ptr.tolist()
    blocks = [dense[:, a:b, a:b].flatten(1) for a, b in zip(ptr[:-1], ptr[1:], strict=True)]
    found, expected = coarse_mass(model._coarse_plan, mass), torch.cat(blocks, 1)
    assert relative_error(found, expected) <= tolerance("formula")
    assert relative_error(model._coarse_plan.mass, coarse_mass(model._coarse_plan, model.mass[None])) == 0
    bar = torch.as_tensor(generator("bar").standard_normal(tuple(expected.shape)))
    ours, theirs = (torch.autograd.grad((bar * t).sum(), mass)[0] for t in (found, expected))
    assert relative_error(ours, theirs) <= tolerance("formula") and theirs.abs().max() > 0


def test_same_bits_on_any_number_of_threads(model: System) -> None:
    plan, given = model._coarse_plan, inputs(model)
    mass = torch.linspace(1, 2, model.num_vertices, dtype=torch.float64)[None].requires_grad_()
    threads, results = torch.get_num_threads(), []
    try:
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            out = (coarse_stiffness(plan, *given), coarse_mass(plan, mass))
            results.append((*out, *torch.autograd.grad(out[0].square().sum() + out[1].square().sum(), (*given, mass))))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
