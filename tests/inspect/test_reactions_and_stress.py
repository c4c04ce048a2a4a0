"""Claim: `dv.reactions` are what pins bear, and `dv.stress` what the material does, both differentiable."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.mesh import box, join
from diffvbd.testing import contact_scenes, relative_error, tolerance

GRAVITY = 9.81  # [m/s^2]
SOFT: dict[str, Any] = {"mu": 2e4, "lam": 3e4}


def hanging(device: str = "cpu", dtype: torch.dtype = torch.float64, **options: Any) -> dv.Model:
    """A cube that hangs from its upper face."""
    mesh = box(3, 0.2)
    return dv.Model(mesh, pinned=mesh.points[:, 1] > 0.19, device=device, dtype=dtype, **options)


def noise(*key: Any, shape: Any, size: float) -> Tensor:
    return contact_scenes.noise("reactions", *key, shape=shape, size=size)


def test_a_hanging_body_is_borne_by_its_pins(device: str) -> None:
    model = hanging(device)
    x, mass = model.rest_points, model.mass
    for _ in range(8):
        x = dv.solve(model, x, 0 * x, dv.VBD(1.0, 1), tolerance=1e-13, on_failure="warn", max_sweeps=3000, **SOFT).x
    force = torch.zeros_like(x)
    force[-1] = x.new_tensor([0.3, -0.2, 0.1])  # on a pinned vertex: its support bears it
    held = dv.reactions(model, x, force=force, **SOFT)
    total = x.new_tensor([0.0, GRAVITY * float(mass.sum()), 0.0]) - force.sum(0)
    assert float((held.sum(0) - total).abs().max()) <= tolerance("closed_form") * float(total[1])
    assert not held[~model.pinned].any() and (held[model.pinned, 1] > 0).all()


def test_reactions_of_a_step_are_newtons_second_law(device: str) -> None:
    """Of all bodies together: what moves them besides their weight are the supports, of pins and of colliders."""
    bodies = join([box(2, 0.2), box(2, (0.4, 0.1, 0.4)).translate((-0.1, -0.115, -0.1))])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(2e3, 0.02, self_contact=False, reach=0.2), dv.Friction(0.3, 0.05))
    model = dv.Model(bodies, density=500.0, pinned=list(range(8, 16)), energies=energies, device=device)
    x, h = model.rest_points, 0.005
    v = torch.zeros_like(x)
    v[:8, 0] = 0.2
    moved = torch.where(model.pinned[:, None], x + 1e-4, torch.nan)
    done = dv.solve(model, x, v, dv.VBD(h, 1), prescribed=moved, tolerance=1e-12, **SOFT)
    held = dv.reactions(model, done.x, dv.VBD(h, 1), previous=(x, v), **SOFT)
    mass = model.mass[:, None]
    gained = (mass * (done.v - v)).sum(0) / h + x.new_tensor([0.0, GRAVITY, 0.0]) * mass.sum()
    assert relative_error(held.sum(0), gained) <= tolerance("closed_form")
    assert held.sum(0)[0] != 0


def test_gradients_of_reactions_agree_with_differences() -> None:
    model = hanging()
    n, t = model.num_vertices, model.num_tets
    arguments = {
        "x": model.rest_points + noise("x", shape=(2, n, 3), size=5e-3),
        "before": model.rest_points + noise("before", shape=(2, n, 3), size=5e-3),
        "v": noise("v", shape=(2, n, 3), size=0.1),
        "mu": 2e4 * torch.exp(noise("mu", shape=(2, t), size=0.1)),
        "lam": 3e4 * torch.exp(noise("lam", shape=(t,), size=0.1)),
        "force": noise("force", shape=(n, 3), size=1.0),
        "gravity": noise("gravity", shape=(3,), size=1.0),
        "rest_points": model.rest_points + noise("rest", shape=(n, 3), size=5e-3),
        "density": 1000 * torch.exp(noise("density", shape=(t,), size=0.1)),
    }
    weights = noise("weights", shape=(2, n, 3), size=1.0)

    def loss(**given: Any) -> Tensor:
        previous = given.pop("before"), given.pop("v")
        return (weights * dv.reactions(model, solver=dv.VBD(0.02, 1), previous=previous, **given)).sum()

    check = dv.check_gradients(loss, arguments, verbose=False)
    assert check.ok and all(size > 0 for _, size, *_ in check.rows), str(check)


def test_stress_of_uniaxial_tension(device: str) -> None:
    """Free sides: J = 1 + (mu / lb) (1 - 1 / s), t = sqrt(J / s), P = mu (s - J / s^2); Cauchy's stress is P s / J."""
    mu, lam, s = 1e5, 1.5e5, 2.0
    det = 1 + mu / (mu + lam) * (1 - 1 / s)
    model = dv.Model(box(3, 0.2), device=device)
    stretch = model.rest_points.new_tensor([s, (det / s) ** 0.5, (det / s) ** 0.5])
    turn, _ = torch.linalg.qr(noise("turn", shape=(3, 3), size=1.0).to(device))
    found = dv.stress(model, (model.rest_points * stretch) @ turn.T, mu=mu, lam=lam)
    along = mu * (s - det / s**2) * s / det
    expected = along * torch.outer(turn[:, 0], turn[:, 0])
    assert along == pytest.approx(170000 * s / det)
    assert float((found.cauchy - expected).abs().max()) <= tolerance("geometry") * along
    assert float((found.von_mises - along).abs().max()) <= tolerance("geometry") * along
    assert found.cauchy.shape == (model.num_tets, 3, 3) and found.von_mises.shape == (model.num_tets,)


def test_stress_is_work_conjugate_to_the_nodal_forces() -> None:
    """The power of elastic forces on any motion is that of the stress on its velocity gradient."""
    model = dv.Model(box(3, 0.2), pinned=list(range(27)))
    x = model.rest_points + noise("power", shape=(27, 3), size=1e-2)
    motion = noise("motion", shape=(27, 3), size=1.0)
    forces = dv.reactions(model, x, gravity=(0.0, 0.0, 0.0), **SOFT)  # of the pins, opposite to the material's
    corners, speed = x[model.tets], motion[model.tets]
    edges, rates = (a[:, 1:] - a[:, :1] for a in (corners, speed))
    gradient = torch.linalg.solve(edges, rates).mT  # of the velocity, [T, 3, 3]
    volume = torch.linalg.det(edges) / 6
    power = (volume * (dv.stress(model, x, **SOFT).cauchy * gradient).sum((-2, -1))).sum()
    assert float((forces * motion).sum()) == pytest.approx(float(power), rel=tolerance("cancelling"))


def test_gradients_of_stress_agree_with_differences_and_rest_has_finite_ones() -> None:
    model = dv.Model(box(2, 0.2, split="kuhn"))
    arguments = {
        "x": model.rest_points + noise("sx", shape=(2, 8, 3), size=1e-2),
        "mu": 2e4 * torch.exp(noise("smu", shape=(2, 6), size=0.1)),
        "lam": 3e4 * torch.exp(noise("slam", shape=(6,), size=0.1)),
        "rest_points": model.rest_points + noise("srest", shape=(8, 3), size=5e-3),
    }

    def loss(**given: Any) -> Tensor:
        found = dv.stress(model, **given)
        weights = noise("sweights", shape=found.cauchy.shape, size=1.0)
        return 1e-3 * ((weights * found.cauchy).sum() + found.von_mises.square().sum().sqrt())

    check = dv.check_gradients(loss, arguments, verbose=False)
    assert check.ok and all(size > 0 for _, size, *_ in check.rows), str(check)
    x = model.rest_points.requires_grad_()
    at_rest = dv.stress(model, x, **SOFT)
    assert float(at_rest.von_mises.max()) <= tolerance("geometry") * 2e4
    assert bool(torch.isfinite(torch.autograd.grad(at_rest.von_mises.sum(), x)[0]).all())


@pytest.mark.parametrize("what", ("reactions", "stress"))
def test_batches_and_float32(device: str, what: str) -> None:
    single, double = hanging(device, torch.float32), hanging(device)
    x = (double.rest_points + noise("batch", shape=(2, 3, 27, 3), size=1e-2).to(device)).float()
    mu = 2e4 * torch.arange(1, 7, device=device, dtype=torch.float32).reshape(2, 3, 1)

    def run(model: dv.Model, x: Tensor, mu: Tensor) -> Tensor:
        found = (
            dv.reactions(model, x, mu=mu, lam=3e4)
            if what == "reactions"
            else dv.stress(model, x, mu=mu, lam=3e4).cauchy
        )
        assert found.dtype == model.dtype and found.shape[: x.dim() - 2] == x.shape[:-2]
        return found

    many = run(double, x.double(), mu.double())
    assert relative_error(run(single, x, mu).double(), many) <= tolerance("float32_forward")
    assert relative_error(run(double, x[1, 2].double(), mu[1, 2].double()), many[1, 2]) <= tolerance("formula")


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda m, x: dv.reactions(m, x), "mu: expected"),
        (lambda m, x: dv.reactions(m, x[:3], **SOFT), r"x: expected shape \[..., 27, 3\]"),
        (lambda m, x: dv.reactions(m, x, previous=(x, 0 * x), **SOFT), "solver: expected"),
        (lambda m, x: dv.reactions(m, x, dv.VBD(0.1, 1), previous=(x, x / 0), **SOFT), "previous: v: expected finite"),
        (lambda m, x: dv.reactions(m, x, force=x[:3], **SOFT), "force: expected"),
        (lambda m, x: dv.reactions(m, x, gravity=(1.0, 2.0), **SOFT), "gravity: expected 3 numbers"),
        (lambda m, x: dv.reactions(m, x.float(), **SOFT), "x: expected dtype"),
        (lambda m, x: dv.reactions(m, x, mu=-1.0, lam=2.0), "mu: expected finite values >= 0 Pa, got -1"),
        (lambda m, x: dv.reactions(m, x, mu=float("nan"), lam=2.0), "mu: expected finite values"),
        (lambda m, x: dv.reactions(m, x, force=x / 0, **SOFT), "force: expected finite values"),
        (lambda m, x: dv.reactions(m, x, gravity=[float("nan")] * 3, **SOFT), "gravity: expected finite values"),
        (lambda m, x: dv.stress(m, x, mu=1e4), "lam: expected"),
        (lambda m, x: dv.stress(m, x, mu=torch.ones(5).double(), lam=1e4), "mu: expected a shape that broadcasts"),
        (lambda m, x: dv.stress(m, x, mu=1e4, lam=1e4, rest_points=x[:5]), "rest_points: expected"),
        (lambda m, x: dv.stress(m, x, mu=1e4, lam=1e4, young=1e4), "mu: expected mu and lam, or young and poisson"),
        (
            lambda m, x: dv.stress(dv.Model(m.mesh, energies=(dv.Anchor(1.0),)), x, mu=1e4, lam=1e4),
            "model: expected StableNeo",
        ),
    ],
)
def test_bad_input(run: Any, message: str) -> None:
    model = hanging()
    with pytest.raises((ValueError, TypeError), match=message):
        run(model, model.rest_points)
