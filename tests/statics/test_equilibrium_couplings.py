"""Claim: dv.equilibrium takes springs, tendons and pressure: rest states, their gradients, and closed forms."""

from typing import Any

import pytest
import torch
from helpers.coupled import coupled, inputs_of
from helpers.marks import quick_and_slow, slow
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import tolerance
from diffvbd.testing.dense_statics import coupling_energy, newton, potential, residual, weight
from diffvbd.testing.soft_scenes import STILL, Linked, icosphere, pressed_sphere

SOLVER = dv.VBD(1.0, 0, subspace="coarse")


SCENES: dict[str, tuple[dict[str, Any], dict[str, float]]] = {
    "all three": ({}, {}),
    "gas, places": ({"gas": True, "places": True}, {}),
    "cables": ({"tension_only": True}, {"spring_rest_length": 0.9}),  # some of which are slack
    "soft": ({}, {"mu": 0.2, "lam": 0.2}),
}


@pytest.mark.parametrize("name", quick_and_slow(["cables", "soft"], SCENES))
def test_rest_states(name: str) -> None:
    options, factors = SCENES[name]
    model = coupled(**options)
    inputs = inputs_of(model)
    for key in ("x", "v", "rest_points", "density"):
        del inputs[key]
    for key, factor in factors.items():
        inputs[key] = factor * inputs[key]
    x = model.rest_points
    done = dv.equilibrium(model, x, SOLVER, tolerance=1e-11, **inputs)
    moved = float((done.x - x).abs().max())
    load = weight(model) + inputs["force"]
    energy = potential(model, load, inputs["mu"], inputs["lam"], lambda at: coupling_energy(model, at, inputs))
    assert done.converged and moved > 5e-3
    assert residual(model, energy, load, done.x) < 1e-8
    assert float((done.x - newton(model, energy, x)).abs().max()) < 1e-6 * moved


def rests(model: dv.Model, **inputs: Any) -> Tensor:
    return dv.equilibrium(model, model.rest_points, SOLVER, **{"gravity": STILL, **inputs}).x


@pytest.mark.parametrize(("levels", "thickness"), [(2, 0.05), pytest.param(3, 0.02, marks=pytest.mark.slow)])
def test_a_sphere_under_pressure_grows_as_the_closed_form_says(levels: int, thickness: float) -> None:
    young, nu, p = 1e5, 0.3, 200 * thickness
    model = dv.Model(dv.mesh.shell(*icosphere(levels), thickness), energies=(dv.StableNeoHookean(), dv.Pressure()))
    growth = (rests(model, young=young, poisson=nu, pressure=p).norm(dim=1) - model.rest_points.norm(dim=1)).mean()
    assert float(growth) == pytest.approx(pressed_sphere(young, nu, p, thickness), rel=tolerance("pressed_sphere"))
    if thickness <= 0.02:
        thin = p * (1 - nu) / (2 * young * thickness)
        assert float(growth) == pytest.approx(thin, rel=tolerance("pressed_sphere"))


def test_a_balloon_reaches_a_volume() -> None:
    """By Newton's method on its pressure; gas that has this pressure there rests in the same state."""
    mesh, soft = dv.mesh.shell(*icosphere(1), 0.1), {"young": 1e5, "poisson": 0.4}
    wall = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.Pressure(), dv.Anchor(1.0)))
    target = 1.3 * cavity(wall, wall.rest_points)
    pressure = torch.tensor(1000.0, dtype=torch.float64, requires_grad=True)
    for _ in range(6):
        x = rests(wall, pressure=pressure, **soft)
        volume = cavity(wall, x)
        (slope,) = torch.autograd.grad(volume, pressure)
        with torch.no_grad():
            pressure += (target - volume) / slope
    assert volume.item() == pytest.approx(float(target), rel=1e-6) and pressure.item() > 2000
    ambient = 1e4
    gas = wall.replace(energies=(dv.StableNeoHookean(), dv.Pressure(gas=True, ambient=ambient), dv.Anchor(1.0)))
    start = (pressure.detach() + ambient) * 1.3 - ambient  # at the volume at rest
    assert float((rests(gas, pressure=start, **soft) - x).abs().max()) < 1e-5


def cavity(model: dv.Model, x: Tensor) -> Tensor:
    volume = dv.coupling_forces(model, x).volume
    assert volume is not None
    return volume.sum()


def test_a_stiff_beam_between_springs() -> None:
    """Each end sinks by its share of the weight over the stiffness of its springs."""
    mesh = dv.mesh.beam(7, 3, 3, size=(0.6, 0.1, 0.1))
    ends = dv.Embedding.of_points(mesh, [[x, 0.05, z] for x in (0.0, 0.6) for z in (0.0, 0.1)])
    places = ends.at(torch.from_numpy(mesh.points.copy()))
    k = torch.tensor([400.0, 400.0, 900.0, 900.0], dtype=torch.float64)
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.Springs(ends, places, k)))
    x = rests(model, young=1e10, poisson=0.3, gravity=(0.0, -1.0, 0.0))  # from springs without length or force
    assert dv.equilibrium(model, model.rest_points, SOLVER, young=1e5, poisson=0.3).iterations < 15
    sinks = (places - ends.at(x))[:, 1]
    assert sinks.tolist() == pytest.approx((float(model.mass.sum()) / 4 / k).tolist(), rel=1e-3)
    total = dv.coupling_forces(model, x).vertices.sum(0)
    assert total.tolist() == pytest.approx([0.0, float(model.mass.sum()), 0.0], abs=1e-6)


def test_parallel_springs_at_rest_let_a_beam_down() -> None:
    """They resist no motion across them at first, so the first step of Newton's method goes far."""
    held = dv.mesh.beam(4, 3, 3, size=(0.03, 0.02, 0.02))
    mesh = dv.mesh.join([held, dv.mesh.beam(13, 3, 3, size=(0.1, 0.02, 0.02)).translate((0.031, 0.0, 0.0))])
    places = [[y, z] for y in (0.002, 0.018) for z in (0.002, 0.018)]
    ends = (dv.Embedding.of_points(mesh, [[x, *place] for place in places]) for x in (0.03, 0.031))
    springs = dv.Springs(*ends, stiffness=600.0, rest_length=0.001)
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=(dv.StableNeoHookean(), springs))
    found = []
    for lower in (0.0, 1e-3):  # where the springs resist already
        x = model.rest_points.clone()
        x[len(held.points) :, 1] -= lower
        end = dv.equilibrium(model, x, dv.VBD(1.0, 0, subspace="coarse"), young=3e5, poisson=0.35)
        found.append(end.x)
    assert float((found[0] - found[1]).abs().max()) < 1e-9 and float((found[0] - model.rest_points).abs().max()) > 0.01


def test_what_only_couplings_hold() -> None:
    """Springs between free bodies hold none of them, nor does pressure; gas needs a volume."""
    cube = dv.mesh.cube(2, 0.05)
    mesh = dv.mesh.join([cube, cube.translate((0.1, 0, 0))])
    ends = [dv.Embedding.of_points(mesh, [[x, 0.02, 0.03]]) for x in (0.05, 0.1)]
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.Springs(*ends, 1e3, 0.03)))
    with pytest.raises(RuntimeError, match=r"got body 0 of scene 0, which nothing holds .* 2.45 N"):
        dv.equilibrium(model, model.rest_points, SOLVER, young=1e5, poisson=0.3)
    assert dv.coupling_forces(model, rests(model, young=1e5, poisson=0.3)).vertices.abs().max() < 1e-3
    shell = dv.mesh.shell(*icosphere(0), 0.1)
    balloon = dv.Model(shell, energies=(dv.StableNeoHookean(), dv.Pressure(gas=True)))
    with pytest.raises(RuntimeError, match="got body 0 of scene 0, which nothing holds"):
        dv.equilibrium(balloon, balloon.rest_points, SOLVER, young=1e5, poisson=0.3, pressure=100.0)
    with pytest.raises(ValueError, match="x: expected cavities of positive volume"):
        dv.equilibrium(balloon, -balloon.rest_points, SOLVER, young=1e5, poisson=0.3, pressure=100.0)


def test_float32_rests_where_float64_does(device: str) -> None:
    double, single = (coupled(device=device).to(dtype=d) for d in (torch.float64, torch.float32))
    ends = [dv.equilibrium(m, m.rest_points, SOLVER, mu=4e4, lam=4e4, on_failure="warn").x for m in (double, single)]
    assert ends[1].dtype == torch.float32
    assert float((ends[0] - ends[1]).abs().max()) < 1e-4 < float((ends[0] - double.rest_points).abs().max())


@pytest.mark.parametrize("short", (2e-3, slow(1e-2)))
def test_hinges_between_stiff_links_bend_until_moments_balance(short: float) -> None:
    finger = Linked.of(8)
    inputs = {"tendon_rest_length": 0.14 - short, "tendon_stiffness": 10.0}
    x = rests(finger.model, young=finger.young, poisson=0.0, **inputs)
    tension = dv.coupling_forces(finger.model, x, **inputs).tendons
    assert tension is not None
    assert finger.angle(x) == pytest.approx(finger.balanced(float(tension)), rel=tolerance("beam_of_tets"))


@pytest.mark.slow
def test_each_scene_of_a_batch_rests_as_it_does_alone(device: str) -> None:
    model = coupled(gas=True, device=device)
    x, pressure = model.rest_points, torch.tensor([[0.0], [2000.0]], dtype=torch.float64, device=device)
    both = dv.equilibrium(model, x.expand(2, -1, -1), SOLVER, mu=4e4, lam=4e4, pressure=pressure, tolerance=1e-11).x
    for scene in range(2):
        alone = dv.equilibrium(model, x, SOLVER, mu=4e4, lam=4e4, pressure=pressure[scene], tolerance=1e-11).x
        assert float((both[scene] - alone).abs().max()) < 1e-8
    assert float((both[1] - both[0]).abs().max()) > 1e-4
