"""Claim: with the rigid correction a body on planes rests, slides and bounces as it should, at any number of sweeps."""

import itertools
import math
from typing import Any

import pytest
import torch
from helpers.marks import slow

import diffvbd as dv
from diffvbd.model.system import system_of
from diffvbd.testing.tolerances import tolerance

H, DENSITY, KAPPA, DHAT, EDGE = 0.01, 3000.0, 1e3, 1e-2, 0.2
NORMALS = {"y": (0.0, 1.0, 0.0), "x": (1.0, 0.0, 0.0), "oblique": (0.48, 0.6, 0.64)}


def turned_cube(normal: tuple[float, ...], lift: float) -> dv.TetMesh:
    """A cube of 27 vertices whose lower face lies ``lift`` above the plane through the origin."""
    n = torch.tensor(normal, dtype=torch.float64)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    axis, cosine = torch.linalg.cross(up, n), float(up @ n)
    k = torch.zeros(3, 3, dtype=torch.float64)
    k[0, 1], k[0, 2], k[1, 0], k[1, 2], k[2, 0], k[2, 1] = -axis[2], axis[1], axis[2], -axis[0], -axis[1], axis[0]
    rotation = torch.eye(3, dtype=torch.float64) + k + k @ k / (1 + cosine)
    mesh = dv.mesh.cube(3, size=EDGE).translate((0.0, lift, 0.0))
    return mesh.transform(rotation.numpy())


def resting(device: str, normal: str = "y", lift: float = 0.012) -> dv.Model:
    floor = dv.FloorBarrier(height=0.0, normal=NORMALS[normal], kappa=KAPPA, dhat=DHAT)
    return dv.Model(turned_cube(NORMALS[normal], lift), density=DENSITY, energies=(dv.StableNeoHookean(), floor),
                    device=device)  # fmt: skip


def equilibrium_gap(force: float) -> float:
    """The gap at which the barrier of one vertex pushes with ``force`` [N], by bisection."""

    def push(d: float) -> float:
        return KAPPA * (2 * (d - DHAT) * math.log(d / DHAT) + (d - DHAT) ** 2 / d)

    low, high = 1e-12, DHAT
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if push(middle) > force else (low, middle)
    return low


def gaps(model: dv.Model, x: torch.Tensor) -> torch.Tensor:
    floor = model.floor
    assert floor is not None
    return x @ torch.tensor(floor.normal[0], dtype=x.dtype, device=x.device)


@torch.no_grad()
def run(model: dv.Model, x: torch.Tensor, v: torch.Tensor, steps: int, solver: dv.VBD, gravity: Any, mu: Any = 2e5
        ) -> tuple[torch.Tensor, torch.Tensor, float]:  # fmt: skip
    lowest = math.inf
    for _ in range(steps):
        x, v = dv.step(model, x, v, solver, mu=mu, lam=2 * mu, gravity=gravity)
        lowest = min(lowest, float(gaps(model, x).min()))
    return x, v, lowest


ON_PLANES = ((0.5, 0), (1.0, 1), (1.6, 2))  # relaxation and sweeps of what rests on all planes
QUICK = (*ON_PLANES, (0.5, 3), (1.6, 5))
EVERY = itertools.product((0.5, 1.0, 1.6), (0, 1, 2, 3, 5))


@pytest.mark.parametrize(("relaxation", "sweeps"), [a if a in QUICK else slow(*a) for a in EVERY])
def test_a_body_rests(device: str, relaxation: float, sweeps: int) -> None:
    """The gap is above a tenth of the equilibrium gap at all times, in the end at it; nothing moves or drifts.
    Materials are scenes: from jelly to rubber."""
    mu = torch.tensor([[2e4], [2e5], [2e7]], dtype=torch.float64, device=device)
    weight = DENSITY * EDGE**3 * 9.81
    # all of the weight on nine vertices alike, or on the corner that bears least of it
    least = equilibrium_gap(weight / 4)
    for normal in NORMALS if (relaxation, sweeps) in ON_PLANES else ("y",):
        model, solver = resting(device, normal), dv.VBD(H, sweeps, relaxation=relaxation)
        assert system_of(model, solver).corrects
        n = torch.tensor(NORMALS[normal], dtype=torch.float64, device=device)
        x = model.rest_points.expand(3, -1, -1).clone()
        x, v, lowest = run(model, x, torch.zeros_like(x), 500, solver, tuple((-9.81 * n).tolist()), mu)
        assert lowest >= 0.1 * least
        assert float(v.norm(dim=-1).max()) <= tolerance("rest_speed")
        moved = (x - model.rest_points).mean(-2)
        assert float((moved - (moved @ n)[:, None] * n).norm(dim=-1).max()) <= tolerance("rest_drift")
        assert float(gaps(model, x).min()) >= 0.5 * least


def energy(model: dv.Model, x: torch.Tensor, v: torch.Tensor, mu: float) -> torch.Tensor:
    """Kinetic, gravitational, elastic and barrier energy of each scene [J]."""
    tets = x[:, model.tets]
    rest = model.rest_points[model.tets]
    edges, dm = (torch.stack([a[..., i, :] - a[..., 0, :] for i in (1, 2, 3)], -1) for a in (tets, rest))
    f = edges @ torch.linalg.inv(dm)
    volume, j = torch.linalg.det(dm) / 6, torch.linalg.det(f)
    lam = 2 * mu
    elastic = (volume * (mu / 2 * (f.square().sum((-2, -1)) - 3) - mu * (j - 1) + (mu + lam) / 2 * (j - 1) ** 2)).sum(
        -1
    )
    d = gaps(model, x)
    barrier = torch.where(d < DHAT, -KAPPA * (d - DHAT) ** 2 * torch.log(d / DHAT), 0.0).sum(-1)
    kinetic = 0.5 * (model.mass[:, None] * v.square()).sum((-2, -1))
    return kinetic + 9.81 * (model.mass * x[..., 1]).sum(-1) + elastic + barrier


@pytest.mark.parametrize(("sweeps", "relaxation"), ((1, 0.5), (1, 1.0), (1, 1.6), (2, 1.6), (5, 1.0)))
def test_no_drop_gains_energy(device: str, sweeps: int, relaxation: float) -> None:
    """A hundred drops, tilted and spinning, at 0 to 5 m/s: no step ends with more energy than the run began with."""
    model, solver = resting(device, lift=0.25), dv.VBD(H, sweeps, relaxation=relaxation)
    generator = torch.Generator().manual_seed(5)
    center = model.rest_points.mean(0)
    axes = torch.nn.functional.normalize(torch.randn(100, 3, generator=generator, dtype=torch.float64), dim=-1)
    angle = 3 * torch.rand(100, 1, generator=generator, dtype=torch.float64)
    rotation = torch.linalg.matrix_exp(
        torch.linalg.cross(
            (angle * axes)[:, None].expand(-1, 3, -1), torch.eye(3, dtype=torch.float64).expand(100, 3, 3)
        )
    ).to(device)
    x = (model.rest_points - center) @ rotation + center
    fast = 4.0 if sweeps * relaxation >= 1 else 1.0  # [rad/s]: half a sweep does not hold a faster body together
    spin = fast * torch.randn(100, 1, 3, generator=generator, dtype=torch.float64).to(device)
    v = torch.linalg.cross(spin.expand_as(x), x - center)
    v[..., 1] -= 5 * torch.rand(100, 1, generator=generator, dtype=torch.float64).to(device)
    mu = 2e5
    start = energy(model, x, v, mu)
    touched = torch.zeros(100, dtype=torch.bool, device=device)
    with torch.no_grad():
        for _ in range(60):
            x, v = dv.step(model, x, v, solver, mu=mu, lam=2 * mu)
            now = energy(model, x, v, mu)
            assert bool(torch.isfinite(now).all())
            assert bool((now <= start + tolerance("energy_gain") * start.abs()).all())
            touched |= gaps(model, x).amin(-1) < DHAT
    assert int(touched.sum()) >= 90


def test_a_body_slides_without_friction(device: str) -> None:
    """Pushed along a floor it keeps its velocity."""
    model = resting(device)
    x = model.rest_points.clone()
    x, v, _ = run(model, x, torch.zeros_like(x), 60, dv.VBD(H, 5), (0.0, -9.81, 0.0))
    v = v + torch.tensor([1.0, 0.0, 0.0], dtype=v.dtype, device=device)
    mean = x.mean(0)
    x, v, _ = run(model, x, v, 100, dv.VBD(H, 5), (0.0, -9.81, 0.0))
    traveled = x.mean(0) - mean
    assert abs(float(traveled[0]) - 1.0) <= tolerance("rest_drift") and abs(float(traveled[2])) <= tolerance(
        "rest_drift"
    )


@pytest.mark.parametrize("mu", (1e5, 1e7))
@pytest.mark.parametrize("sweeps", (0, 1, 3))
def test_the_gradient_of_a_body_at_rest(device: str, sweeps: int, mu: float) -> None:
    """Without friction a push makes it slide: its center of mass moves n h as fast, and by h^2 n (n + 1) / 2 over its
    mass for a force; what raising the floor does differences tell. At rest a correction has nothing else to do."""
    model, n = resting(device), 20
    start, gravity = model.rest_points, (0.0, -9.81, 0.0)
    rest, still, _ = run(model, start, torch.zeros_like(start), 600, dv.VBD(H, max(sweeps, 1)), gravity, mu)
    share = model.mass / model.mass.sum()

    def center(v: torch.Tensor, force: torch.Tensor, height: torch.Tensor, steps: int) -> torch.Tensor:
        end = dv.rollout(model, rest, v, dv.VBD(H, sweeps), steps=steps, save="last", mu=mu, lam=2 * mu, force=force,
                         floor_height=height)  # fmt: skip
        return share @ end.x[-1]

    v, force = still.clone().requires_grad_(), torch.zeros_like(rest).requires_grad_()
    height = torch.zeros(1, dtype=rest.dtype, device=device, requires_grad=True)
    by_v, by_force = torch.autograd.grad(center(v, force, height, n)[0], (v, force))
    assert abs(float(by_v[:, 0].sum()) / (n * H) - 1) <= tolerance("finite_difference")
    # the same force on each vertex, so the sum of them accelerates
    expected = len(rest) * H**2 * n * (n + 1) / 2 / float(model.mass.sum())
    assert abs(float(by_force[:, 0].sum()) / expected - 1) <= tolerance("finite_difference")
    # one step: later ones coast or not, as the floor has gone down or up
    (by_height,) = torch.autograd.grad(center(v, force, height, 1)[1], height)
    with torch.no_grad():
        ahead, behind = (center(v, force, height + step, 1)[1] for step in (1e-6, -1e-6))
    difference = float(ahead - behind) / 2e-6
    assert difference > 0.1 and abs(float(by_height) - difference) <= tolerance("kinked_difference") * difference
