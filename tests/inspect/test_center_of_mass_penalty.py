"""Claim: the penalty between bodies is the all-pairs sum, conserves momentum, has exact gradients, acts as a spring.

Force and gradients against plain torch, contact time of two bodies against the closed form pi sqrt(m_eff / k).
"""

import math
from typing import Any

import pytest
import torch
from helpers.regimes import captured
from torch import Tensor

import diffvbd as dv
from diffvbd.inspect.penalty import Bodies, center_of_mass_penalty
from diffvbd.testing import relative_error, tolerance

RADIUS = 0.35
LAYOUTS = ("copies", "scattered", "one vertex each")


def scene(layout: str, device: str = "cpu", dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
    """Positions of two scenes [2, V, 3], labels and masses of their bodies, each about 0.2 wide."""
    generator = torch.Generator().manual_seed(1)
    bodies = 25
    labels = {
        "copies": torch.arange(bodies).repeat_interleave(4),
        "scattered": torch.cat([torch.arange(bodies), torch.randint(bodies, (61,), generator=generator)]) * 7 - 50,
        "one vertex each": torch.arange(bodies),
    }[layout]
    centers = torch.rand(2, bodies, 3, generator=generator, dtype=torch.float64)
    order = labels.unique(return_inverse=True)[1]
    offsets = 0.2 * torch.rand(2, len(labels), 3, generator=generator, dtype=torch.float64)
    x = centers[:, order] + offsets
    mass = 0.5 + torch.rand(len(labels), generator=generator, dtype=torch.float64)
    return x.to(device, dtype), labels.to(device), mass.to(device, dtype)


def all_pairs(x: Tensor, labels: Tensor, mass: Tensor, stiffness: Tensor | float, sharpness: float | None) -> Tensor:
    """The penalty by plain torch, every body with every other."""
    members = [(labels == label).nonzero()[:, 0] for label in labels.unique()]
    share = [mass[m] / mass[m].sum() for m in members]
    centers = [(s[:, None] * x[..., m, :]).sum(-2) for s, m in zip(share, members, strict=True)]
    force = torch.zeros_like(x)
    for i, a in enumerate(centers):
        total = torch.zeros_like(a)
        for b in (b for j, b in enumerate(centers) if j != i):
            distance = (a - b).norm(dim=-1, keepdim=True)
            overlap = RADIUS - distance
            if sharpness is None:
                size = overlap.clamp(min=0)
            else:
                size = torch.logaddexp(sharpness * overlap, torch.zeros_like(overlap)) / sharpness
            total = total + stiffness * size * (a - b) / distance
        force = force.index_add(-2, members[i], share[i][:, None] * total[..., None, :])
    return force


# --- force and gradients ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sharpness", [None, 25.0, 200.0])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_force_and_gradients_are_those_of_all_pairs(layout: str, sharpness: float | None, device: str) -> None:
    x, labels, mass = scene(layout, device)
    stiffness = torch.tensor(3.0, dtype=x.dtype, device=device)
    weights = torch.linspace(-1, 1, x.numel(), dtype=x.dtype, device=device).cos().reshape(x.shape)
    results = []
    for compute in (
        lambda a, k: center_of_mass_penalty(a, (labels, mass), RADIUS, k, sharpness, max_pairs=700),
        lambda a, k: all_pairs(a, labels, mass, k, sharpness),
    ):
        leaves = [x.clone().requires_grad_(), stiffness.clone().requires_grad_()]
        force = compute(*leaves)
        results.append([force.detach(), *torch.autograd.grad((weights * force).sum(), leaves)])
    for actual, expected in zip(*results, strict=True):
        assert expected.abs().max() > 1e-2
        assert relative_error(actual, expected) <= tolerance("sum")


@pytest.mark.parametrize("sharpness", [None, 15.0])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_first_and_second_derivatives_by_differences(layout: str, sharpness: float | None, device: str) -> None:
    x, labels, mass = scene(layout, device)
    keep = labels.unique()[:6]
    member = (labels[:, None] == keep).any(-1)
    bodies = Bodies(labels[member], mass[member])
    # brought close to one another, so that every pair counts
    x = (0.3 * x[:, member]).contiguous().requires_grad_()
    stiffness = torch.tensor(2.0, dtype=x.dtype, device=device, requires_grad=True)

    def force(a: Tensor, k: Tensor) -> Tensor:
        return center_of_mass_penalty(a, bodies, RADIUS, k, sharpness)

    assert force(x, stiffness).abs().max() > 1e-2
    assert torch.autograd.gradcheck(force, (x, stiffness), fast_mode=True)
    assert torch.autograd.gradgradcheck(force, (x, stiffness), fast_mode=True)


@pytest.mark.parametrize("sharpness", [None, 30.0])
def test_it_is_the_force_of_its_energy(sharpness: float | None, device: str) -> None:
    x, labels, mass = scene("one vertex each", device)
    x = x[0].requires_grad_()
    i, j = torch.triu_indices(len(x), len(x), 1, device=device)
    overlap = RADIUS - (x[i] - x[j]).norm(dim=-1)
    if sharpness is None:
        (gradient,) = torch.autograd.grad(overlap.clamp(min=0).square().sum(), x)
    else:  # whose integral is a dilogarithm: take the force as the weight of each pair's gradient
        size = torch.logaddexp(sharpness * overlap, torch.zeros_like(overlap)) / sharpness
        (gradient,) = torch.autograd.grad((2 * size.detach() * overlap).sum(), x)
    actual = center_of_mass_penalty(x, (labels, mass), RADIUS, 5.0, sharpness, max_pairs=700)
    assert relative_error(actual, -2.5 * gradient) <= tolerance("sum")


# --- what mechanics asks for ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sharpness", [None, 25.0])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_momentum_is_conserved(layout: str, sharpness: float | None, device: str) -> None:
    x, labels, mass = scene(layout, device)
    bodies = Bodies(labels, mass)
    force = center_of_mass_penalty(x, bodies, RADIUS, 7.0, sharpness, max_pairs=700)
    size = force.norm(dim=-1).sum(-1)
    assert size.min() > 1 and (force.sum(-2).norm(dim=-1) <= tolerance("cancelling") * size).all()
    # central forces: on the bodies, which they act on at their centers, there is no torque either
    centers, total = bodies.centers(x), bodies._sum(force)
    torque = torch.linalg.cross(centers, total)
    assert (torque.sum(-2).norm(dim=-1) <= tolerance("cancelling") * torque.norm(dim=-1).sum(-1)).all()
    # one acceleration per body
    assert relative_error(force / bodies._share[:, None], bodies._spread(total)) <= tolerance("sum")


def test_scenes_do_not_see_each_other(device: str) -> None:
    x, labels, mass = scene("scattered", device)
    bodies = Bodies(labels, mass)
    both = center_of_mass_penalty(x[:, None], bodies, RADIUS, 1.0)
    assert both.shape == (2, 1, *x.shape[1:])
    for k in range(2):
        assert torch.equal(both[k, 0], center_of_mass_penalty(x[k], bodies, RADIUS, 1.0))
    none = center_of_mass_penalty(x[:0], bodies, RADIUS, 1.0)
    assert none.shape == (0, *x.shape[1:])


def test_contact_time_of_a_linear_spring(device: str) -> None:
    """Two cubes of different mass collide head-on: pi sqrt(m_eff / k) as h -> 0, with second order; momentum stays."""
    stiffness, speed, gap = 40.0, 0.3, 0.5
    mesh = dv.mesh.replicate(dv.mesh.cube(2, 0.2), [[0, 0, 0], [gap, 0, 0]])
    density = torch.where(torch.arange(mesh.num_tets) < mesh.num_tets // 2, 500.0, 2000.0).double()
    model = dv.Model(mesh, density=density, device=device)
    first = torch.arange(mesh.num_vertices, device=device) < mesh.num_vertices // 2
    m1, m2 = float(model.mass[first].sum()), float(model.mass[~first].sum())
    assert m2 == pytest.approx(4 * m1)
    exact = math.pi * math.sqrt(m1 * m2 / (m1 + m2) / stiffness)
    direction = torch.tensor([speed, 0, 0], dtype=torch.float64, device=device)

    def contact_time(steps: int) -> float:
        """Steps of exact / steps from the first touch; where the overlap is back at zero by linear interpolation."""
        h, x = exact / steps, model.rest_points
        v = torch.where(first[:, None], direction, 0.0)
        overlaps = [0.0]
        for _ in range(2 * steps):
            force = center_of_mass_penalty(x, model, gap, stiffness)
            x, v = dv.step(model, x, v, dv.VBD(h, 2), mu=1e5, lam=1e5, gravity=(0.0, 0.0, 0.0), force=force)
            apart = (x[~first] - x[first]).mean(0)
            overlaps.append(gap - float(apart.norm()))
            if overlaps[-1] < 0:
                break
        momentum = (model.mass[:, None] * v).sum(0)
        assert relative_error(momentum, m1 * direction) <= tolerance("momentum_of_a_run")
        n = len(overlaps) - 2
        return h * (n + overlaps[n] / (overlaps[n] - overlaps[n + 1]))

    errors = [abs(contact_time(steps) / exact - 1) for steps in (10, 20, 40, 80)]
    assert errors[-1] < tolerance("contact_time")
    orders = [math.log2(a / b) for a, b in zip(errors, errors[1:], strict=False)]
    assert all(1.7 < order < 2.3 for order in orders), orders


def test_centers_are_bodies_without_a_mass(device: str) -> None:
    x, labels, mass = scene("one vertex each", device)
    leaves = [x.clone().requires_grad_() for _ in range(2)]
    forces = [center_of_mass_penalty(leaves[0], None, RADIUS, 2.0, max_pairs=700),
              center_of_mass_penalty(leaves[1], (labels, mass), RADIUS, 2.0, max_pairs=700)]  # fmt: skip
    gradients = [torch.autograd.grad(f.square().sum(), a)[0] for f, a in zip(forces, leaves, strict=True)]
    assert torch.equal(*forces) and torch.equal(*gradients)
    assert forces[0].abs().max() > 0.01 and gradients[0].abs().max() > 0.01
    assert center_of_mass_penalty(x[:0], None, RADIUS, 1.0).shape == (0, 25, 3)
    assert center_of_mass_penalty(x[:, :0], None, RADIUS, 1.0).shape == (2, 0, 3)


# --- bad input --------------------------------------------------------------------------------------------------------

X, LABELS, MASS = torch.zeros(4, 3), torch.tensor([0, 0, 1, 1]), torch.ones(4)
GIVEN: dict[str, Any] = {"x": X, "model_or_bodies": (LABELS, MASS), "radius": 1.0, "stiffness": 1.0}


@pytest.mark.parametrize(
    "changes, error, message",
    [
        ({"x": [[0.0]]}, TypeError, r"x: expected a tensor of shape \[..., 4, 3\], got list"),
        ({"x": X.double()}, TypeError, "x: expected dtype torch.float32 .*, got torch.float64"),
        ({"x": X[:3]}, ValueError, r"x: expected shape \[..., 4, 3\], got shape \[3, 3\]"),
        ({"x": X[0]}, ValueError, r"x: expected shape \[..., 4, 3\], got shape \[3\]"),
        (
            {"x": X.clone().fill_(math.nan)},
            ValueError,
            r"x \(centers of mass\): expected finite values, got nan at \[0, 0, 0\]",
        ),
        (
            {"model_or_bodies": None, "x": LABELS},
            TypeError,
            r"x: expected a float64 or float32 tensor of shape \[..., N, 3\], got dtype torch.int64",
        ),
        ({"model_or_bodies": None, "x": X[0]}, ValueError, r"x: expected shape \[..., N, 3\], got shape \[3\]"),
        ({"model_or_bodies": MASS}, TypeError, "model_or_bodies: expected a Model, Bodies or .* got Tensor"),
        ({"model_or_bodies": (LABELS, MASS, MASS)}, TypeError, "model_or_bodies: .* got tuple"),
        ({"model_or_bodies": (MASS, MASS)}, TypeError, "body: expected a tensor of integers, got dtype torch.float32"),
        ({"model_or_bodies": (LABELS[:3], MASS)}, ValueError, r"body: expected a label for each mass, .* \[3\]"),
        ({"model_or_bodies": (LABELS, LABELS)}, TypeError, "mass: expected a float64 or float32 tensor, got .*int64"),
        ({"model_or_bodies": (LABELS, MASS[None])}, ValueError, r"mass: expected shape \[V\], got shape \[1, 4\]"),
        ({"model_or_bodies": (LABELS, -MASS)}, ValueError, "mass: expected finite numbers >= 0 kg, got -1 at vertex 0"),
        ({"model_or_bodies": (LABELS, MASS * LABELS)}, ValueError, "mass: expected every body .* label 0"),
        ({"radius": 0.0}, ValueError, "radius: expected a finite number > 0 m, got 0"),
        ({"radius": 1e30}, ValueError, "radius: expected a number in"),
        ({"radius": torch.ones((), requires_grad=True)}, TypeError, "radius: .* it is not differentiable"),
        ({"stiffness": -1.0}, ValueError, "stiffness: expected a finite number >= 0 N/m, got -1"),
        ({"stiffness": "stiff"}, TypeError, "stiffness: expected a number or a tensor with one element, got str"),
        ({"stiffness": torch.ones(2)}, ValueError, r"stiffness: expected .* got shape \[2\]"),
        ({"stiffness": torch.ones(1).double()}, TypeError, "stiffness: expected dtype torch.float32"),
        ({"sharpness": 0.0}, ValueError, "sharpness: expected a finite number > 0 1/m, got 0"),
        ({"sharpness": torch.ones((), requires_grad=True)}, TypeError, "sharpness: .* it is not differentiable"),
        ({"max_pairs": 0}, ValueError, "max_pairs: expected room for 1 pairs within 1 m, got 0"),
        ({"max_pairs": 1.5}, TypeError, "max_pairs: expected an integer"),
    ],
)
def test_bad_input(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        center_of_mass_penalty(**{**GIVEN, **changes})


# --- inside torch -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_compile(device: str) -> None:
    """In one graph; without a look at the number of pairs, too little room turns every force into NaN."""
    torch._dynamo.reset()
    x, labels, mass = scene("scattered", device)
    bodies = Bodies(labels, mass)

    def loss(a: Tensor, k: Tensor, room: int) -> Tensor:
        return center_of_mass_penalty(a, bodies, RADIUS, k, 25.0, max_pairs=room).square().sum()

    results = []
    for run in (loss, torch.compile(loss, fullgraph=True, backend="aot_eager")):
        leaves = [x.clone().requires_grad_(), torch.ones((), dtype=x.dtype, device=device, requires_grad=True)]
        results.append(torch.autograd.grad(run(*leaves, 700), leaves))
    for actual, expected in zip(*results, strict=True):
        assert expected.abs().max() > 1e-2 and relative_error(actual, expected) <= tolerance("formula")
    leaf = x.clone().requires_grad_()
    value = torch.compile(loss, fullgraph=True, backend="aot_eager")(leaf, torch.ones_like(x[0, 0, 0]), 7)
    assert value.isnan() and torch.autograd.grad(value, leaf)[0].isnan().all()


@pytest.mark.cuda
def test_cuda_graph() -> None:
    """Captured once, replayed for other positions: equal to the eager force to the bit; NaN where room lacks."""
    x, labels, mass = scene("scattered", "cuda")
    bodies, room = Bodies(labels, mass), 400
    leaf = x.clone().requires_grad_()
    force, gradient = torch.zeros_like(x), torch.zeros_like(x)

    def run() -> None:
        result = center_of_mass_penalty(leaf, bodies, RADIUS, 2.0, max_pairs=room)
        force.copy_(result.detach())
        gradient.copy_(torch.autograd.grad(result.square().sum(), leaf)[0])

    graph = captured(run)
    for scale in (1.0, 1.3, 0.9):
        with torch.no_grad():
            leaf.copy_(scale * x)
        graph.replay()
        replayed = force.clone(), gradient.clone()
        run()
        assert force.abs().max() > 1e-2
        assert torch.equal(replayed[0], force) and torch.equal(replayed[1], gradient)
    for bad in (0.1 * x, x.clone().index_fill_(1, torch.tensor([3], device="cuda"), math.nan)):
        with torch.no_grad():
            leaf.copy_(bad)
        graph.replay()
        assert force.isnan().all() and gradient.isnan().all()
