"""Claim: where sweeps let vibrations of a body grow from step to step, every step and rollout says so, by a measurement
on its own mesh, and what it says to take does not grow."""

import re
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd import results
from diffvbd.step import stability

MEASURES_GROWTH = True  # see conftest.py

STILL, GROWN = 5.0, 1e3  # speeds [m/s] of a bar that sags under its weight, and of one that grows from that
BODY = dv.mesh.beam(7, 2, 2, size=(0.6, 0.1, 0.1), split="kuhn")


def end(integrator: Any, sweeps: int, relaxation: float, modulus: float = 1e8, ratio: float = 1.0,
        subspace: Any = "rigid", pinned: bool = True) -> tuple[float, list[str]]:  # fmt: skip
    """The largest speed [m/s] after three seconds, and what was said. ratio: lam / mu."""
    model = dv.Model(BODY, pinned=torch.tensor(BODY.points[:, 0] < 1e-9) if pinned else None)
    solver = dv.VBD(0.01, sweeps, integrator=integrator, relaxation=relaxation, subspace=subspace)
    x = model.rest_points.clone()
    v = torch.zeros_like(x)
    if not pinned:
        v[:, 1] = 0.3 * torch.sin(7 * x[:, 0])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            out = dv.rollout(model, x, v, solver, steps=300, save="last", checks=dv.Checks(energy=False), mu=modulus,
                             lam=ratio * modulus, gravity=(0.0, -9.81 if pinned else 0.0, 0.0))  # fmt: skip
            speed = float(out.v[-1].norm(dim=-1).max())
        except ValueError:  # positions that are not finite
            speed = float("inf")
    return speed, [str(w.message) for w in said if "not finite" not in str(w.message)]


EULER, BDF2, SDIRK2 = dv.ImplicitEuler(), dv.BDF2(), dv.SDIRK2()
FEW = dv.VBD(0.01, 2, integrator=BDF2, relaxation=1.5)


@pytest.mark.parametrize(
    ("integrator", "sweeps", "relaxation", "options"),
    [
        (EULER, 1, 1.5, {}),
        (EULER, 2, 1.7, {"ratio": 4.0}),
        (BDF2, 4, 1.7, {}),
        (BDF2, 1, 1.0, {"ratio": 9.0}),
        (BDF2, 4, 1.5, {"ratio": 9.0}),
        (BDF2, 5, 1.5, {"subspace": "coarse", "ratio": 9.0}),
        (BDF2, 3, 1.7, {"pinned": False}),
        (SDIRK2, 4, 1.0, {"ratio": 9.0}),
        (SDIRK2, 3, 1.5, {"pinned": False}),
        (SDIRK2, 3, 1.5, {"subspace": "coarse"}),
    ],
)
def test_what_grows_is_said_and_what_is_said_helps(integrator: Any, sweeps: int, relaxation: float,
                                                   options: dict[str, Any]) -> None:  # fmt: skip
    speed, (said,) = end(integrator, sweeps, relaxation, **options)
    assert speed > GROWN
    assert said.startswith(f"sweeps: {sweeps} with {type(integrator).__name__}(), relaxation={relaxation:g}")
    found = re.search(r"take (\d+) sweeps", said)
    assert found is not None
    speed, said_then = end(integrator, int(found[1]), relaxation, **options)
    assert speed < STILL and not said_then
    if less := re.search(r", relaxation=([\d.]+)", said[found.end() :]):
        speed, said_then = end(integrator, sweeps, float(less[1]), **options)
        assert speed < GROWN and not said_then
    if 'subspace="coarse"' in said:
        speed, said_then = end(integrator, sweeps, relaxation, **options | {"subspace": "coarse"})
        assert speed < STILL and not said_then


def test_the_stiffest_tets_and_scenes_count() -> None:
    model = dv.Model(BODY, pinned=torch.tensor(BODY.points[:, 0] < 1e-9))
    x = model.rest_points
    soft, stiff = 3e2, 1e8
    few_tets = torch.full((model.num_tets,), soft, dtype=x.dtype)
    few_tets[::3] = stiff
    one_scene = torch.tensor([[soft], [soft], [stiff]], dtype=x.dtype)
    for mu, start in ((few_tets, x), (one_scene, x.expand(3, -1, -1)), (stiff, x)):
        other = model.replace()
        with pytest.warns(UserWarning, match=r"sweeps: 2 with BDF2\(\)"):
            dv.rollout(other, start, 0 * start, FEW, steps=1, mu=mu, lam=mu)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dv.rollout(model, x, 0 * x, FEW, steps=1, mu=soft, lam=soft)


def test_a_measurement_is_made_once_for_alike_moduli(monkeypatch: pytest.MonkeyPatch) -> None:
    measured, measure = [], stability.growth
    monkeypatch.setattr(stability, "growth", lambda *a, **k: measured.append(1) or measure(*a, **k))
    model = dv.Model(BODY, pinned=BODY.points[:, 0] < 1e-9)
    x = model.rest_points
    for modulus in np.linspace(0.99e6, 1e6, 5):
        dv.step(model, x, 0 * x, dv.VBD(0.01, 8), mu=modulus, lam=modulus)
    assert len(measured) == 1
    dv.step(model, x, 0 * x, dv.VBD(0.01, 8), mu=2e6, lam=1e6)
    assert len(measured) == 2


def test_nothing_is_said_of_soft_bodies_plain_sweeps_and_enough_of_them() -> None:
    for sweeps, relaxation, options in ((2, 1.5, {"modulus": 3e3}), (2, 1.0, {}), (10, 1.5, {}),
                                        (1, 1.5, {"subspace": "coarse"})):  # fmt: skip
        speed, said = end(BDF2, sweeps, relaxation, **options)
        assert not said and 0 < speed < 10


def test_settings_of_pilot_runs_are_not_doubted() -> None:
    model = dv.Model(BODY, pinned=torch.tensor(BODY.points[:, 0] < 1e-9))
    x = model.rest_points
    stiff: dict[str, Any] = {"mu": 1e8, "lam": 1e8}
    told = results.Prediction(0.01, 0.01, 1.0, 0.03, True, "", (), 1.0, 1)
    proven = replace(FEW, relaxation=1.4, prediction=told)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dv.rollout(model, x, 0 * x, proven, duration=0.03, **stiff)
    missed = replace(proven, prediction=replace(told, reached=False))
    with pytest.warns(UserWarning, match=r"sweeps: 2 with BDF2\(\)"):
        dv.rollout(model, x, 0 * x, missed, duration=0.03, **stiff)
    with pytest.warns(UserWarning, match=r"sweeps: 2 with BDF2\(\)"):
        dv.rollout(model, x, 0 * x, FEW, duration=0.03, **stiff)
