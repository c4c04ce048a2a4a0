"""Claim: what rests on another body keeps its gap, for any number of sweeps and detections.

docs/method.md, section 12: no gap of a pair falls below min(first gap, dhat / 16, d*(F) / 10), with d*(F) the gap where
the barrier bears the largest force F that presses a corner on it. These tests take the whole weight of what rests.
"""

import pytest
import torch
from conftest import DEVICES
from helpers.bearing import bearing_gap
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd.testing.tolerances import tolerance

KAPPA, DHAT, DENSITY, SIZE, GRAVITY = 1e3, 1e-2, 3000.0, 0.2, 9.81


def tower(first_gap: float, bodies: int, detections: int) -> dv.Model:
    """Boxes, each turned a little on the one below it; the lowest one is pinned."""
    boxes, top = [], 0.0
    for k in range(bodies):
        box = dv.mesh.box(3, SIZE)
        boxes.append(box.translate((0.013 * k, top, -0.009 * k)))
        top += SIZE + first_gap
    mesh = dv.mesh.join(boxes)
    barrier = dv.PairBarrier(kappa=KAPPA, dhat=DHAT, detections=detections, self_contact=False)
    return dv.Model(mesh, density=DENSITY, energies=(dv.StableNeoHookean(), barrier), pinned=mesh.body == 0)


RUNS = ((0, 1), (0, 2), (1, 1), (1, 2), (2, 1), (5, 2))  # sweeps and detections
QUICK = (4, 2, 4, 2, 2, 2)  # bodies of the quick tower of each


@pytest.mark.parametrize(
    ("sweeps", "detections", "bodies"),
    [(*run, n) if n == quick else slow(*run, n) for run, quick in zip(RUNS, QUICK, strict=True) for n in (2, 4)],
)
def test_a_tower_keeps_its_gaps(sweeps: int, detections: int, bodies: int) -> None:
    first = 0.5 * DHAT
    model = tower(first, bodies, detections)
    weight = (bodies - 1) * DENSITY * SIZE**3 * GRAVITY
    least = min(first, DHAT / 16, 0.1 * bearing_gap(weight, KAPPA, DHAT))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    smallest = []
    for _ in range(120):
        x, v = dv.step(model, x, v, dv.VBD(0.01, sweeps), mu=2e5, lam=4e5)
        smallest.append(dv.contact.status(model).smallest_gap[0])
    assert min(smallest) >= least * (1 - 1e-9), (min(smallest), least)
    assert min(smallest) < first and bool(torch.isfinite(v).all())
    if sweeps:  # which keep each body from passing through itself, too
        assert len(dv.contact.intersections(model, x)) == 0


# --- on bodies that are held ------------------------------------------------------------------------------------------


FRICTION, SPEED, WEIGHT, H = 0.3, 0.7, 9.81, 0.01


def cube_on_table(device: str) -> tuple[dv.Model, Tensor]:
    """A cube above a soft table whose bottom is pinned, and which vertices are the cube's."""
    table = dv.mesh.beam(7, 3, 4, size=(0.6, 0.1, 0.3))
    table = table.translate(tuple(-table.points.min(0)))
    mesh = dv.mesh.join([dv.mesh.cube(3, size=0.1).translate((0.081, 0.1088, 0.117)), table])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=5e3, dhat=0.01, self_contact=False), dv.Friction(FRICTION))
    pinned = (mesh.body == 1) & (mesh.points[:, 1] < 1e-9)
    return dv.Model(mesh, density=500.0, pinned=pinned, energies=energies, device=device), torch.tensor(mesh.body == 0)


@pytest.mark.parametrize("modulus", (1e5, 1e6))
@pytest.mark.parametrize("device", DEVICES)
def test_a_cube_weighs_on_it_what_it_weighs_and_slides_as_far_as_it_should(device: str, modulus: float) -> None:
    model, cube = cube_on_table(device)
    material = {"mu": modulus, "lam": modulus, "save": "last", "solver": dv.VBD(H, 5)}
    x = model.rest_points
    for _ in range(6):  # until it rests
        x = dv.rollout(model, x, torch.zeros_like(x), steps=20, **material).x[-1]
    weight = WEIGHT * float(model.mass[cube.to(device)].sum())
    borne = float(dv.contact.forces(model, x).between.normal[0, 1])
    assert borne == pytest.approx(weight, rel=tolerance("borne_by_held"))
    v = torch.zeros_like(x)
    v[cube.to(device), 0] = SPEED
    end = dv.rollout(model, x, v, steps=40, **material).x[-1]
    expected = SPEED**2 / (2 * FRICTION * WEIGHT) - SPEED * H / 2  # of implicit Euler
    assert float((end - x)[cube.to(device), 0].mean()) == pytest.approx(expected, rel=tolerance("slide_on_held"))


@pytest.mark.parametrize("device", DEVICES)
def test_one_that_falls_begins_with_its_fall(device: str) -> None:
    """A sheet that hangs by one side, from level; once it hangs, it rests."""
    sheet = dv.mesh.sheet(5, 3, (0.4, 0.2), 0.02)
    model = dv.Model(sheet, density=500.0, pinned=sheet.points[:, 0] < 1e-9, device=device,
                     energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa=1e3, dhat=0.005)))  # fmt: skip
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    given = {"mu": 1e4, "lam": 1e4}
    with dv.record("contact") as found:
        dv.step(model, x, v, dv.VBD(H, 5), **given)
    assert not bool(found[0].resting.any())
    speed = v
    for _ in range(150):  # it swings, and slower and slower
        x, speed = dv.step(model, x, 0.8 * speed, dv.VBD(H, 20), **given)
    with dv.record("contact") as found:
        x1, _ = dv.step(model, x, v, dv.VBD(H, 1), **given)
    assert found[0].resting[0, ~model.pinned].all()
    assert float((x1 - x).norm(dim=-1).max()) < 0.1 * H**2 * WEIGHT
