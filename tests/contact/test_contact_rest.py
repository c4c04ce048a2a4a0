"""Claim: what rests on another body keeps its gap, for any number of sweeps and detections.

docs/method.md, section 12: no gap of a pair falls below min(first gap, dhat / 16, d*(F) / 10), with d*(F) the gap where
the barrier bears the largest force F that presses a corner on it. These tests take the whole weight of what rests.
"""

import pytest
import torch
from helpers.bearing import bearing_gap
from helpers.marks import slow

import diffvbd as dv

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
        x, v = dv.step(model, x, v, mu=2e5, lam=4e5, time_step=0.01, sweeps=sweeps)
        smallest.append(dv.contact.status(model).smallest_gap[0])
    assert min(smallest) >= least * (1 - 1e-9), (min(smallest), least)
    assert min(smallest) < first and bool(torch.isfinite(v).all())
    if sweeps:  # which keep each body from passing through itself, too
        assert len(dv.contact.intersections(model, x)) == 0
