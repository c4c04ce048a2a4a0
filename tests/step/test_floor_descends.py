"""Claim: steps on a floor converge, with and without coarse corrections: no update and no correction raises the
incremental potential, so that few sweeps rebound and press as converged ones do."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.results import evaluated
from helpers.spreads import assert_near_reference
from scipy.spatial import Delaunay

import diffvbd as dv
from diffvbd import testing
from diffvbd.reference import sweep as reference
from diffvbd.reference.sweep import incremental_potential
from diffvbd.testing import build_scene, tolerance

RADIUS, DHAT, MODULI = 0.1, 5e-3, {"young": 1e5, "poisson": 0.3}


def ball(gap: float, held: bool = False) -> dv.Model:
    """A ball of some 200 vertices above a floor at y = 0."""
    rng = np.random.default_rng(0)
    inner = rng.uniform(-RADIUS, RADIUS, (400, 3))
    inner = inner[np.linalg.norm(inner, axis=1) < 0.8 * RADIUS][:100]
    k = np.arange(100) + 0.5
    polar, turn = np.arccos(1 - k / 50), np.pi * (1 + 5**0.5) * k
    shell = RADIUS * np.stack([np.cos(turn) * np.sin(polar), np.cos(polar), np.sin(turn) * np.sin(polar)], -1)
    points = np.concatenate([inner, shell])
    tets = Delaunay(points).simplices
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    good = np.abs(np.linalg.det(edges)) > 0.01 * np.linalg.norm(edges, axis=-1).max(1) ** 3
    points[:, 1] += gap - points[:, 1].min()
    mesh = dv.mesh.TetMesh(points, tets[good], orient=True)
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=2e5, dhat=DHAT))
    return dv.Model(mesh, energies=energies, pinned=points[:, 1] > 1.6 * RADIUS if held else None)


def rebound(subspace: Any, sweeps: int) -> float:
    model, solver = ball(gap=8e-3), dv.VBD(2e-3, sweeps, subspace=subspace)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    v[:, 1] = -2.0
    end = dv.rollout(model, x, v, solver, steps=60, gravity=(0, 0, 0), save="last", **MODULI)
    return float((model.mass * end.v[-1, :, 1]).sum() / model.mass.sum()) / 2.0


def test_a_ball_rebounds_as_with_converged_steps() -> None:
    converged = rebound("rigid", 100)
    assert 0.6 < converged < 0.9
    for subspace, sweeps in (("coarse", 8), ("coarse", 20), ("rigid", 20)):
        assert rebound(subspace, sweeps) == pytest.approx(converged, rel=tolerance("few_sweeps_rebound"))


@pytest.mark.parametrize("subspace", (None, "coarse"))
def test_the_potential_never_rises(subspace: Any) -> None:
    """After one sweep, two and so on of a step in which the ball hits the floor."""
    for time_step, gap, speed in ((2e-3, 6e-3, 2.0), (5e-3, 1e-2, 3.0)):
        model = ball(gap)
        x, v = model.rest_points, torch.zeros_like(model.rest_points)
        v[:, 1] = -speed
        moduli = dict(zip(("mu", "lam"), dv.lame(**MODULI), strict=True))
        values = []
        for sweeps in range(1, 13):
            solver = dv.VBD(time_step, sweeps, subspace=subspace)
            end, _ = dv.step(model, x, v, solver, gravity=(0, 0, 0), **moduli)
            y = x + time_step * v
            values.append(float(incremental_potential(model, end, y, **moduli, time_step=time_step, x_prev=x)))
        assert (np.diff(values) <= tolerance("potential") * max(values)).all(), values
        assert values[-1] < 0.99 * values[0]


def test_a_pressed_ball_bears_what_its_cap_presses_with() -> None:
    """20 mm in five steps: the floor's force is that of 400 plain sweeps, and the reactions at the cap."""
    forces = []
    for subspace, sweeps in (("rigid", 400), ("coarse", 20), ("coarse", 8)):
        model, solver = ball(gap=DHAT, held=True), dv.VBD(0.02, sweeps, subspace=subspace)
        x, v = model.rest_points, torch.zeros_like(model.rest_points)
        down = torch.where(model.pinned[:, None], torch.tensor([0.0, -4e-3, 0.0]), 0.0).to(x.dtype)
        for _ in range(5):
            x, v = dv.step(model, x, v, solver, prescribed=x + down, gravity=(0, 0, 0), **MODULI)
        gap = x[:, 1]
        first = -2 * (gap - DHAT) * torch.log(gap / DHAT) - (gap - DHAT) ** 2 / gap
        push = -float(torch.where((gap < DHAT) & ~model.pinned, 2e5 * first, 0.0).sum())
        forces += [push, -float(dv.reactions(model, x, gravity=(0, 0, 0), **MODULI)[..., 1].sum())]
    assert forces[0] > 50
    assert np.allclose(forces, forces[0], rtol=tolerance("few_sweeps_force")), forces


def test_fractions_occur_in_the_comparison_with_autograd(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole updates, parts and none are among those whose gradients equal the twin's."""
    fractions, own = [], reference._descending
    monkeypatch.setattr(reference, "_descending", lambda *a: fractions.append(own(*a)) or fractions[-1])
    scene = build_scene("floor_filtered", testing.KINDS[0], "small")
    for tape in ("full", "compact"):
        model, inputs, solver = scene.model(), scene.inputs(), scene.solver(5, tape=tape)
        assert_near_reference(model, inputs, solver, 1, evaluated(model, inputs, solver), None)
    found = torch.cat([f.reshape(-1) for f in fractions])
    assert (found == 1).any() and ((found > 0) & (found < 1)).any(), found
