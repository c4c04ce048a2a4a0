"""Claim: motion in contact is that of converged steps, at few sweeps: sliding, spinning, falling, resting, standing.

The scenes are those of `python -m bench contact_gates`, which says where their references come from.
"""

from __future__ import annotations

import pytest
import torch

import diffvbd as dv
from bench import contact_gates
from diffvbd.mesh import box, join
from diffvbd.testing import relative_error, tolerance


@pytest.mark.parametrize("surface", ["Plane", "FloorBarrier"])
def test_a_block_at_ten_meters_a_second_stops_where_coulombs_law_says(surface: str) -> None:
    row = contact_gates.slide(surface=surface, sweeps=5)
    assert row["value"] == pytest.approx(row["reference"], rel=tolerance("contact_motion"))


def test_the_derivative_of_a_travel_survives_sliding() -> None:
    """That of the way in 0.1 s toward the speed is 0.1 s, and Newton's method finds the speed of a way, from 0.7 of
    it."""
    speed, friction, h, steps = 3.0, 0.1, 1 / 60, 6
    model, rest = contact_gates.block("Plane", friction, "cpu")
    x, weight = rest["x"], model.mass / model.mass.sum()

    def travel(v0: float) -> tuple[float, float]:
        leaf = torch.tensor(v0, dtype=x.dtype, requires_grad=True)
        v = leaf * x.new_tensor([1.0, 0.0, 0.0]).expand_as(x)
        end = dv.rollout(model, x, v, dv.VBD(h, 20), steps=steps, save="last", mu=1e5, lam=2e5)
        way = weight @ (end.x[-1] - x)[:, 0]
        return float(way.detach()), float(torch.autograd.grad(way, leaf)[0])

    assert travel(speed)[1] == pytest.approx(steps * h, rel=tolerance("contact_motion"))
    # backward Euler's own sum
    goal = speed * steps * h - 0.5 * friction * contact_gates.GRAVITY * h * h * steps * (steps + 1)
    guess, taken = 0.7 * speed, 1
    at, change = travel(guess)
    while abs(at / goal - 1) >= 1e-3 and taken < 8:
        guess, taken = guess - (at - goal) / change, taken + 1
        at, change = travel(guess)
    assert at == pytest.approx(goal, rel=1e-3)


def test_a_body_spins_next_to_another_as_alone() -> None:
    row = contact_gates.spin()
    assert row["value"] == pytest.approx(row["reference"], rel=tolerance("contact_motion"))


def test_a_body_that_flies_and_spins_beside_others_lists_no_pairs_of_its_own() -> None:
    """With self-contact, 3 cm above a slab: it goes as far as without contact."""
    tets = join([box(4, 0.2), box(2, (4.0, 0.1, 4.0)).translate((-1.0, -0.13, -1.0))])
    ends = []
    for energies in ((dv.StableNeoHookean(), dv.PairBarrier(1e3, 5e-3)), (dv.StableNeoHookean(),)):
        model = dv.Model(tets, energies=energies, pinned=range(64, 72))
        x = model.rest_points
        arm = x - x[:64].mean(0)
        turning = torch.linalg.cross(arm.new_tensor([0.0, 10.0, 0.0]).expand_as(arm), arm)
        v = torch.where(model.pinned[:, None], 0.0, turning + arm.new_tensor([5.0, 0.0, 0.0]))
        for _ in range(3):
            with dv.record("contact") as found:
                x, v = dv.step(model, x, v, dv.VBD(0.01, 40), mu=1e5, lam=1e5)
            for detection in found:
                bodies = model.body[detection.listed.pairs[:, :4].long()]
                assert len(bodies) > 0 and (bodies[:, 0] != bodies[:, 3]).all()
                assert dv.contact.status(model).truncated == [0] and bool((detection.fractions == 1.0).all())
        ends.append(x)
    assert relative_error(ends[0] - model.rest_points, ends[1] - model.rest_points) <= tolerance("contact_motion")


def test_a_soft_body_that_stands_does_not_creep() -> None:
    """In long steps, each begun at rest: its weight bends it as far as without contact, and no farther in time."""
    body = box((3, 4, 3), (0.2, 0.3, 0.2))
    ends = []
    for barrier in ((dv.PairBarrier(1e4, 0.01, self_contact=False),), (dv.PairBarrier(1e4, 0.01),), ()):
        model = dv.Model(body, pinned=torch.from_numpy(body.points[:, 1] < 1e-9),
                         energies=(dv.StableNeoHookean(), *barrier))  # fmt: skip
        x = model.rest_points
        for _ in range(20):
            x, _ = dv.step(model, x, 0 * x, dv.VBD(0.05, 300), mu=2e4, lam=4e4)
        ends.append(x - model.rest_points)
    for end in ends[:2]:
        assert relative_error(end, ends[2]) <= tolerance("contact_motion")
    assert 0.005 < float(-ends[0].min()) < 0.05


def test_a_block_on_a_soft_block_does_not_sink() -> None:
    """Which long steps let fall a part of every step's fall, where sweeps had too little room to take it back."""
    row = contact_gates.rest("box", sweeps=5)
    assert row["note"] == ""  # nothing crossed and nothing was stopped
    assert abs(row["value"] - row["reference"]) <= tolerance("dented_rest")


@pytest.mark.parametrize(("speed", "time_step"), [(5.0, 0.01), (5.0, 1 / 60), (7.0, 0.01)])
def test_an_impact_of_more_than_an_edge_a_step_keeps_its_momentum(speed: float, time_step: float) -> None:
    """The rigid correction after the sweeps goes as far as the whole part may. With what the sweeps had left of their
    rooms these lost 9, 27 and 34 % of it."""
    large, small = dv.mesh.cube(4, size=0.2), dv.mesh.cube(4, size=0.12).translate((0.225, 0.08, 0.06))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.01, detections=1))
    model = dv.Model(dv.mesh.join([large, small]), energies=energies)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    v[64:, 0] = -speed
    mu, lam = dv.lame(2e4, 0.3)
    start, cut = (model.mass[:, None] * v).sum(0), 0
    for _ in range(8):
        x, v = dv.step(model, x, v, dv.VBD(time_step, 10), mu=mu, lam=lam, gravity=(0.0, 0.0, 0.0))
        cut += sum(dv.contact.status(model).truncated)
    end = (model.mass[:, None] * v).sum(0)
    assert float((end - start).norm()) <= tolerance("closed_form") * float(start.norm())
    assert cut > 0 and v[:64].abs().max() > 0.1  # they have met, and pairs held some vertices up
