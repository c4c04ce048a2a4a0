"""What is legal and seldom meant is warned of (UserWarning), each time, and nothing else is."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import diffvbd as dv

MEASURES_GROWTH = True  # see conftest.py

STEP: dict[str, Any] = {"mu": 1e5, "lam": 1e5, "solver": dv.VBD(1 / 60, 20)}
FLOOR = (dv.StableNeoHookean(), dv.FloorBarrier(height=-1.0), dv.Friction(0.5))


def scaled(size: float, bodies: int = 1) -> dv.TetMesh:
    return dv.mesh.replicate(
        dv.mesh.cube(2, size=size, split="kuhn"), np.arange(bodies)[:, None] * [10.0 * size, 0.0, 0.0]
    )


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: dv.Model(scaled(200.0)),
            r"mesh: a body is 200 m long; points are in metres: one in mm needs .*--scale 0\.001",
        ),
        (lambda: dv.Model(scaled(101.0, 3)), "mesh: a body is 101 m long"),
        (lambda: dv.Model(scaled(5e-5)), "mesh: the largest body is 5e-05 m long"),
        (lambda: dv.Model(scaled(5e-5, 3)), "mesh: the largest body is 5e-05 m long"),
        (lambda: dv.Model(scaled(1.0), pinned=np.zeros(8, bool)), "pinned: none of 8 vertices is pinned"),
        (lambda: dv.Model(scaled(1.0), pinned=np.ones(8, bool)), "pinned: all 8 vertices are pinned"),
    ],
)
def test_a_model_warns_where_it_is_made(build: Callable[[], Any], message: str) -> None:
    with pytest.warns(UserWarning, match=message) as found:
        build()
    assert len(found) == 1 and found[0].filename == __file__


@pytest.mark.parametrize(
    "build",
    [
        lambda: dv.Model(scaled(99.0)),
        lambda: dv.Model(scaled(50.0, 3)),  # 1 km of bodies
        lambda: dv.Model(scaled(2e-4, 3)),
        lambda: dv.Model(scaled(1.0), energies=FLOOR),
        lambda: dv.Model(scaled(1.0)).replace(),
        lambda: dv.Model(dv.TetMesh(np.zeros((0, 3)), np.zeros((0, 4), dtype=int))),
    ],
)
def test_sound_models_do_not_warn(build: Callable[[], Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        build()


@pytest.mark.parametrize(
    ("solver", "energies", "message"),
    [
        (dv.VBD(0.01, 5, relaxation=1.5), FLOOR, "relaxation: 1.5 with Friction"),
        (dv.VBD(0.01, 5, relaxation=1.7), FLOOR[:1], None),
        (dv.VBD(0.01, 5), FLOOR, None),
    ],
)
def test_a_solver_warns_in_each_step(solver: dv.VBD, energies: Any, message: str | None) -> None:
    model = dv.Model(scaled(1.0), energies=energies)
    x = model.rest_points
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        for _ in range(2):
            dv.step(model, x, 0 * x, solver, mu=1e3, lam=1e3)
    assert [w.filename for w in found] == [__file__] * (2 if message else 0)
    assert all(message in str(w.message) for w in found if message)


def sheet(thickness: float) -> dv.Model:
    mesh = dv.mesh.sheet(8, 8, (0.14, 0.14), thickness)
    return dv.Model(mesh, density=200.0, pinned=mesh.points[:, 0] == 0)


RUNS: list[Callable[..., Any]] = [
    lambda model, x, **options: dv.step(model, x, 0 * x, **options),
    lambda model, x, **options: dv.rollout(model, x, 0 * x, steps=2, **options),
]


@pytest.mark.parametrize("run", RUNS)
def test_thin_tets_and_few_sweeps_are_named_each_time(run: Callable[..., Any]) -> None:
    model = sheet(1e-3)
    x = model.rest_points
    with pytest.warns(
        UserWarning, match="sweeps: 20 at time_step = 0.0167 s are too few for tets .* times as wide"
    ) as found:
        run(model, x, **STEP)
        run(model, x, **STEP)
    thin = [w for w in found if "thin" in str(w.message) or "thick" in str(w.message)]
    assert len(thin) == 2 and {w.filename for w in found} == {__file__}


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize(
    ("thickness", "changes"),
    [
        (0.01, {}),  # twice as wide as thick
        (1e-3, {"solver": dv.VBD(1 / 60, 2000)}),
        (1e-3, {"solver": dv.VBD(1 / 60, 0)}),
        (1e-3, {"solver": dv.VBD(1e-5, 20)}),  # a wave crosses less than an element
        (1e-3, {"mu": 6.0, "lam": 0.0}),
        (0.01, {"mu": 0.0, "lam": 0.0}),
        (0.01, {"solver": dv.VBD(0.9, 20)}),
    ],
)
def test_sound_steps_do_not_warn(run: Callable[..., Any], thickness: float, changes: dict[str, Any]) -> None:
    model = sheet(thickness)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(model, model.rest_points, **(STEP | changes))


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mu": 2.0, "lam": 1.0}, "mu: Young's modulus is at most 4.667 Pa"),
        ({"mu": None, "lam": None, "young": 9.0, "poisson": 0.3}, "mu: Young's modulus is at most 9 Pa"),
        ({"solver": dv.VBD(1.0, 20)}, "time_step: 1 s is long for a step"),
    ],
)
def test_what_looks_like_other_units_is_named_in_each_call(
    run: Callable[..., Any], changes: dict[str, Any], message: str
) -> None:
    model = sheet(0.01)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        for _ in range(2):
            run(model, model.rest_points, **(STEP | changes))
    assert [message in str(each.message) for each in found] == [True, True]
    assert found[0].filename == __file__


def test_the_warning_is_right() -> None:
    """Where it is given a step is far from converged; with a shorter step or more sweeps of a relaxed one it is not."""
    errors = {}
    for name, thickness, h in (("thin", 1e-3, 1 / 60), ("thick", 0.02, 1 / 240)):
        model = sheet(thickness)
        x = model.rest_points
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            few, _ = dv.step(model, x, 0 * x, dv.VBD(h, 20), mu=1e4, lam=1e4)
        converged, _ = dv.step(model, x, 0 * x, dv.VBD(h, 20_000, relaxation=1.7), mu=1e4, lam=1e4)
        errors[name] = float((few - converged).norm() / (converged - x).norm())
        assert bool(found) == (name == "thin")
    assert errors["thin"] > 10 * errors["thick"]


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize(("relaxation", "poisson", "warned"), [(1.5, 0.495, 2), (1.0, 0.495, 0), (1.5, 0.49, 0)])
def test_over_relaxation_of_nearly_incompressible_material(
    run: Callable[..., Any], relaxation: float, poisson: float, warned: int
) -> None:
    model, solver = dv.Model(dv.mesh.box(3, 0.1, split="kuhn")), dv.VBD(1e-3, 50, relaxation=relaxation)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        for _ in range(2):
            run(model, model.rest_points, solver=solver, young=1e5, poisson=poisson)
    assert len(found) == warned
    if warned:
        assert "take relaxation=1" in str(found[0].message) and found[0].filename == __file__


def bent() -> tuple[dv.Model, torch.Tensor, dict[str, Any]]:
    """A stiff bar whose velocities bend it, and how it gains energy."""
    model = dv.Model(dv.mesh.box((5, 2, 2), (0.4, 0.1, 0.1), split="kuhn"))
    v = torch.zeros_like(model.rest_points)
    v[:, 1] = 20 * model.rest_points[:, 0].square()
    return model, v, {"mu": 1e9, "lam": 1e9}


def gains_with_settings() -> None:
    model, v, material = bent()
    dv.rollout(model, model.rest_points, v, dv.VBD(0.01, 2, relaxation=1.2), steps=10, **material)


def gains_above() -> None:
    model, v, material = bent()
    dv.rollout(model, model.rest_points, v, dv.VBD(0.01, 2, relaxation=1.8), steps=1, **material)


def gains_inside_refine() -> None:
    model, v, material = bent()
    x = model.rest_points
    dv.refine(lambda: dv.rollout(model, x, v, dv.VBD(0.01, 2), steps=10, **material).x.square().sum())


def does_not_converge() -> None:
    model, v, material = bent()
    dv.solve(model, model.rest_points, v, dv.VBD(0.01, 1), max_sweeps=1, on_failure="warn", **material)


def has_no_derivative() -> None:
    model, v, material = bent()
    given = {"adjoint": dv.GlobalAdjoint(max_iterations=1, on_failure="warn"), "solver": dv.VBD(0.01, 1)}
    x, _ = dv.step(model, model.rest_points, v.requires_grad_(), **given, **material)
    x.sum().backward()


def is_thin_in_step_forward() -> None:
    model = sheet(1e-3)
    dv.step_forward(model, model.rest_points, 0 * model.rest_points, **STEP)


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (gains_with_settings, "has gained"),
        (gains_inside_refine, "has gained"),
        (does_not_converge, "solve: expected a residual"),
        (has_no_derivative, "GlobalAdjoint: expected conjugate gradients"),
        (is_thin_in_step_forward, "too few for tets"),
        (gains_above, "seen to gain energy above 1.7"),
        (lambda: dv.diagnose(bent()[0], 1e3 * bent()[0].rest_points, mu=1e5, lam=1e5), "Green strain"),
    ],
)
def test_a_warning_points_at_the_line_that_called_the_package(run: Callable[[], Any], message: str) -> None:
    with pytest.warns(match=message) as found:
        run()
    assert {w.filename for w in found if message in str(w.message)} == {__file__}
