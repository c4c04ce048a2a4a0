"""Claim: gradient, Hessian products, blocks and the assembled matrix of the incremental potential are its derivatives.

The oracle is double backward through diffvbd.reference's potential, which is written with deformation gradients."""

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.adjoint.implicit import Assembled, conjugate_gradients
from diffvbd.adjoint.potential import IncrementalPotential
from diffvbd.model.system import system_of
from diffvbd.step.advance import begin
from diffvbd.step.arguments import acceleration_of, given_of, prepare
from diffvbd.testing import build_scene, relative_error, tolerance

CASES = ("plain", "paper", "inverted", "contrast", "no_shear", "floor_damped", "floor_corner", "anchored", "batch")


def at_a_state(device: str, case: str, kind: str) -> tuple[IncrementalPotential, Tensor, Tensor]:
    """Potential after two sweeps, and gradient and Hessian product with a random w from the reference."""
    scene = build_scene(case, kind)
    solver, inputs = scene.solver(2), scene.inputs(device=device)
    model, h = system_of(scene.model(device), solver), solver.time_step
    given = {name: inputs[name] for name in ("mu", "lam", "force", "gravity", "prescribed")}
    x, v = inputs["x"], inputs["v"]
    prepared = prepare(model, tuple(x.shape[:-2]), given_of(model, given), time_step=h, sweeps=2)
    begun = begin(model, x, v, prepared, given["force"], acceleration_of(given["gravity"], x), given["prescribed"])
    end = dv.step(model.model, x, v, solver, **given)[0].reshape(begun.y.shape)
    potential = IncrementalPotential(model, end, begun.fields(model, prepared), h)
    w = torch.randn(end.shape, dtype=end.dtype, generator=torch.Generator().manual_seed(1)).to(device) * potential.free

    leaf = end.clone().requires_grad_()
    energy = reference.incremental_potential(model, leaf, begun.y, prepared.mu, prepared.lam, h, begun.x_prev)
    (gradient,) = torch.autograd.grad(energy.sum(), leaf, create_graph=True)
    (product,) = torch.autograd.grad((gradient * w).sum(), leaf)
    assert bool(product.any())
    return potential, w, torch.stack([gradient.detach(), product])


@pytest.mark.parametrize("kind", ("delaunay", "random"))
@pytest.mark.parametrize("case", CASES)
def test_derivatives(device: str, case: str, kind: str) -> None:
    potential, w, (gradient, product) = at_a_state(device, case, kind)
    parts = potential.forces(), potential.inertia()
    # the parts of a balanced gradient cancel: the error counts against them
    error = ((parts[0] + parts[1] - gradient) * potential.free).abs().max() / max(a.abs().max() for a in parts)
    assert float(error) <= tolerance("hessian")
    assert relative_error(potential.product(w), product) <= tolerance("hessian")
    assert relative_error(Assembled(potential, potential.diagonal())(w), product * potential.free) <= tolerance(
        "hessian"
    )


@pytest.mark.parametrize("case", ("plain", "floor_corner", "batch"))
def test_diagonal_blocks_are_those_of_the_matrix(device: str, case: str) -> None:
    potential, w, _ = at_a_state(device, case, "random")
    blocks, matrix = potential.diagonal(), Assembled(potential, potential.diagonal())
    assert float(torch.linalg.eigvalsh(blocks[:, ~potential.model.pinned]).min()) > 0
    for vertex in (~potential.model.pinned).nonzero().reshape(-1)[:4].tolist():
        for c in range(3):
            unit = torch.zeros_like(w)
            unit[:, vertex, c] = 1
            column = matrix(unit)[:, vertex]
            assert relative_error(blocks[:, vertex, :, c], column) <= tolerance("hessian")


def test_the_matrix_is_symmetric_and_leaves_pinned_vertices_alone(device: str) -> None:
    potential, w, _ = at_a_state(device, "floor_corner", "delaunay")
    matrix, pinned = Assembled(potential, potential.diagonal()), potential.model.pinned
    a, b = w, potential.free * w.roll(1, 1)
    difference = float(((a * matrix(b)).sum() - (b * matrix(a)).sum()).abs())
    assert difference <= tolerance("sum") * float((a * matrix(a)).sum())
    assert not matrix(w)[:, pinned].any() and pinned.any()
    assert not matrix(torch.where(pinned[:, None], 1.0, 0.0).expand(w.shape).to(w)).any()


def test_conjugate_gradients_solve_each_scene_on_its_own(device: str) -> None:
    """A scene that needs one iteration beside one that needs many, one with b = 0, and one with negative curvature."""
    diagonal = torch.ones((4, 5, 3), dtype=torch.float64, device=device)
    diagonal[1] = torch.arange(1, 16, device=device).reshape(5, 3) ** 2
    diagonal[3, 0] = torch.tensor([-2.0, 1.0, 3.0])
    b = torch.ones_like(diagonal)
    b[2] = 0
    goal = tolerance("linear_residual")
    result = conjugate_gradients(lambda w: diagonal * w, b, lambda r: r, goal, 100)
    assert float(result.residual.max()) <= goal and result.indefinite and 10 < result.iterations < 100
    assert relative_error(result.x, b / diagonal) <= tolerance("conjugate_gradients")
    alone = conjugate_gradients(lambda w: diagonal[:1] * w, b[:1], lambda r: r, goal, 100)
    assert alone.iterations == 1 and not alone.indefinite
    assert torch.equal(alone.x[0], result.x[0])


def test_conjugate_gradients_say_when_there_is_no_solution(device: str) -> None:
    diagonal = torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64, device=device).expand(1, 2, 3)
    result = conjugate_gradients(lambda w: diagonal * w, torch.ones_like(diagonal), lambda r: r, 1e-10, 50)
    assert float(result.residual[0]) > 1e-3
