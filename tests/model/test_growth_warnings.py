"""Claim: where few over-relaxed sweeps let vibrations of a stiff body grow, the first step says so, and what it says to
take does not grow."""

import dataclasses
import json
import re
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

import diffvbd as dv
from diffvbd.model.growth import ALL, BUT_LAST, COARSE, FREE, MANY, least_sweeps

STILL, GROWN = 5.0, 1e3  # speeds [m/s] of a bar that sags under its weight, and of one that grows from that
BODY = dv.mesh.beam(7, 2, 2, size=(0.6, 0.1, 0.1), split="kuhn")


def end(integrator: Any, sweeps: int, relaxation: float, modulus: float = 1e8, ratio: float = 1.0,
        coarse: Any = None, pinned: bool = True) -> tuple[float, list[str]]:  # fmt: skip
    """The largest speed [m/s] after three seconds, and what was said. ratio: lam / mu."""
    model = dv.Model(BODY, pinned=torch.tensor(BODY.points[:, 0] < 1e-9) if pinned else None, relaxation=relaxation,
                     coarse=coarse)  # fmt: skip
    x = model.rest_points.clone()
    v = torch.zeros_like(x)
    if not pinned:
        v[:, 1] = 0.3 * torch.sin(7 * x[:, 0])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            out = dv.rollout(model, x, v, steps=300, mu=modulus, lam=ratio * modulus, time_step=0.01, sweeps=sweeps,
                             integrator=integrator, save="last", check_energy=False,
                             gravity=(0.0, -9.81 if pinned else 0.0, 0.0))  # fmt: skip
            speed = float(out.v[-1].norm(dim=-1).max())
        except ValueError:  # positions that are not finite
            speed = float("inf")
    return speed, [str(w.message) for w in said if "not finite" not in str(w.message)]


EULER, BDF2, SDIRK2 = dv.ImplicitEuler(), dv.BDF2(), dv.SDIRK2()


@pytest.mark.parametrize(
    ("integrator", "sweeps", "relaxation", "options"),
    [
        (EULER, 1, 1.5, {}),
        (EULER, 2, 1.7, {}),
        (EULER, 2, 1.7, {"ratio": 4.0}),
        (BDF2, 2, 1.5, {}),
        (BDF2, 4, 1.7, {}),
        (BDF2, 1, 1.0, {"ratio": 9.0}),
        (BDF2, 4, 1.5, {"ratio": 9.0}),
        (BDF2, 2, 1.5, {"coarse": "auto"}),
        (BDF2, 5, 1.5, {"coarse": "auto", "ratio": 9.0}),
        (BDF2, 3, 1.7, {"pinned": False}),
        (SDIRK2, 1, 1.0, {}),
        (SDIRK2, 4, 1.0, {"ratio": 9.0}),
        (SDIRK2, 1, 1.0, {"coarse": "auto"}),
        (SDIRK2, 3, 1.5, {"pinned": False}),
        (SDIRK2, 5, 1.5, {}),
        (SDIRK2, 3, 1.5, {"coarse": "auto"}),
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
    if 'coarse="auto"' in said:
        speed, said_then = end(integrator, sweeps, relaxation, **options | {"coarse": "auto"})
        assert speed < STILL and not said_then


def test_the_stiffest_tets_and_scenes_count() -> None:
    model = dv.Model(BODY, pinned=torch.tensor(BODY.points[:, 0] < 1e-9), relaxation=1.5)
    x = model.rest_points
    soft, stiff = 3e2, 1e8
    few_tets = torch.full((model.num_tets,), soft, dtype=x.dtype)
    few_tets[::3] = stiff
    one_scene = torch.tensor([[soft], [soft], [stiff]], dtype=x.dtype)
    for mu, start in ((few_tets, x), (one_scene, x.expand(3, -1, -1)), (stiff, x)):
        other = model.replace(relaxation=1.5)
        with pytest.warns(UserWarning, match=r"sweeps: 2 with BDF2\(\)"):
            dv.step(other, start, 0 * start, mu=mu, lam=mu, time_step=0.01, sweeps=2, integrator=BDF2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dv.step(model, x, 0 * x, mu=soft, lam=soft, time_step=0.01, sweeps=2, integrator=BDF2)


def test_each_integrator_is_told_of_once() -> None:
    model = dv.Model(BODY, pinned=torch.tensor(BODY.points[:, 0] < 1e-9), relaxation=1.5)
    x, given = model.rest_points, {"mu": 1e8, "lam": 1e8, "time_step": 0.01, "sweeps": 2}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for integrator in (BDF2, BDF2, SDIRK2, SDIRK2):
            for _ in range(8):
                dv.step(model, x, 0 * x, integrator=integrator, **given)
    assert [re.findall(r"with (\w+)\(\)", str(w.message)) for w in said] == [["BDF2"], ["SDIRK2"]]


def test_the_tables_are_those_that_were_measured() -> None:
    least = json.loads((Path(__file__).parents[2] / "bench/results/stability.json").read_text())["results"]["least"]
    for kind, table in (("all", ALL), ("but_last", BUT_LAST), ("free", FREE), ("coarse", COARSE)):
        assert {scheme: [list(row) for row in rows] for scheme, rows in table.items()} == least[kind]


def test_the_table_of_the_page_is_that_of_the_code() -> None:
    text = (Path(__file__).parents[2] / "docs/numerics.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (0\.\d+) \| (1|1\.5) \| (.*) \|$", text.split("**Few sweeps of stiff bodies**")[1], re.M)
    assert len(rows) == 8
    schemes = ("ImplicitEuler", "BDF2", "SDIRK2")
    for poisson, relaxation, cells in rows:
        ratio = 2 * float(poisson) / (1 - 2 * float(poisson))

        def least(*tables: Any, name: str, omega: float = float(relaxation), ratio: float = ratio) -> list[str]:
            found = (least_sweeps((table,), name, omega, min(ratio, 20.0)) for table in tables)
            return [str(n) if n < MANY else f"over {MANY - 1}" for n in found]

        expected = [", ".join(least(ALL, FREE, name=name)) for name in schemes]
        expected.append(", ".join(least(COARSE, name=name)[0] for name in schemes))
        assert cells.split(" | ") == expected


def test_a_computed_ratio_is_that_of_the_table() -> None:
    mu, lam = dv.lame(1e5, 0.45)
    assert [least_sweeps((ALL,), "BDF2", 1.5, ratio) for ratio in (9.0, lam / mu, 9.1)] == [8, 8, 15]


def test_nothing_is_said_of_soft_bodies_plain_sweeps_and_enough_of_them() -> None:
    for options in ({"sweeps": 2, "relaxation": 1.5, "modulus": 3e3}, {"sweeps": 2, "relaxation": 1.0},
                    {"sweeps": 10, "relaxation": 1.5}, {"sweeps": 1, "relaxation": 1.5, "coarse": "auto"}):  # fmt: skip
        speed, said = end(BDF2, **options)  # type: ignore[arg-type]
        assert not said and 0 < speed < 10


def test_settings_of_pilot_runs_are_not_doubted() -> None:
    model = dv.Model(BODY, pinned=torch.tensor(BODY.points[:, 0] < 1e-9))
    x, stiff = model.rest_points, {"mu": 1e8, "lam": 1e8}
    few = dv.Settings(0.01, 2, BDF2, relaxation=1.5)
    told = dv.Prediction(0.01, 0.01, 1.0, 0.03, True, "", (), 1.0, 1)
    proven = dv.Settings(0.01, 2, BDF2, relaxation=1.4, predicted=told)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dv.rollout(model, x, 0 * x, duration=0.03, settings=proven, **stiff)
    missed = dataclasses.replace(proven, predicted=dataclasses.replace(told, reached=False))
    with pytest.warns(UserWarning, match=r"sweeps: 2 with BDF2\(\)"):
        dv.rollout(model, x, 0 * x, duration=0.03, settings=missed, **stiff)
    with pytest.warns(UserWarning, match=r"sweeps: 2 with BDF2\(\)"):
        dv.rollout(model, x, 0 * x, duration=0.03, settings=few, **stiff)
