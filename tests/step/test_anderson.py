"""Claim: Anderson acceleration brings steps nearer to converged ones in as many sweeps, raises no potential, mixes no
bodies and scenes, leaves short steps as they are, and is refused where it is not known to be right."""

import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.adjoint.anderson import _Combine, _combined, _combined_in_torch, combinations_of, cycles_of
from diffvbd.adjoint.rise import RiseParts, rise_of_bodies, rise_parts
from diffvbd.adjoint.sweep import sweep
from diffvbd.reference.anderson import Anderson
from diffvbd.reference.energies import build_energies
from diffvbd.reference.scene import build_layout
from diffvbd.reference.scene import build_scene as reference_scene
from diffvbd.step.arguments import GRAVITY, acceleration_of, prepare
from diffvbd.step.predict import begin
from diffvbd.testing import build_scene, relative_error, tolerance

SPACE = dv.CoarseSpace(functions=8, every=2)


def contrast(ratio: float = 1e3, **options: Any) -> tuple[dv.Model, dict[str, Any]]:
    """A beam with a stiff middle, which sweeps and corrections leave behind."""
    mesh = dv.mesh.box((13, 4, 4), (1.0, 0.2, 0.2))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, **options)
    middle = model.rest_points[model.tets].mean(1)[:, 0]
    stiff = torch.where((middle > 0.3) & (middle < 0.6), ratio, 1.0).to(middle)
    return model, {"mu": 2e5 * stiff, "lam": 2e5 * stiff, "time_step": 1 / 60}


def error(sweeps: int, ratio: float, **options: Any) -> float:
    """Over five steps, of the motion."""
    model, given = contrast(ratio, **options)
    plain, _ = contrast(ratio, coarse=dv.CoarseSpace(), relaxation=1.5)
    x = model.rest_points

    def end(model: dv.Model, sweeps: int) -> Tensor:
        return dv.rollout(model, x, torch.zeros_like(x), steps=5, sweeps=sweeps, save="last", **given).x[-1]

    goal = end(plain, 200)
    return float((end(model, sweeps) - goal).abs().max() / (goal - x).abs().max())


@pytest.mark.parametrize(("sweeps", "ratio", "window", "options"),
                         [(31, 1e3, 2, {"coarse": SPACE, "relaxation": 1.5}), (60, 1.0, 5, {})])  # fmt: skip
def test_nearer_in_as_many_sweeps(sweeps: int, ratio: float, window: int, options: dict[str, Any]) -> None:
    before, after = error(sweeps, ratio, **options), error(sweeps, ratio, acceleration=dv.Anderson(window), **options)
    assert after < before / 3, (before, after)


@pytest.mark.parametrize("coarse", [None, SPACE])
def test_short_steps_are_as_without(coarse: dv.CoarseSpace | None) -> None:
    """Nothing is combined before two cycles have ended and one is left."""
    shortest = 3 if coarse is None else 6
    one, given = contrast(coarse=coarse, relaxation=1.5)
    two, _ = contrast(coarse=coarse, relaxation=1.5, acceleration=dv.Anderson(2))
    x = one.rest_points
    for sweeps in range(shortest + 5):
        ends = [dv.step(model, x, torch.zeros_like(x), sweeps=sweeps, **given)[0] for model in (one, two)]
        with dv.acceleration.record() as taken:
            dv.step(two, x, torch.zeros_like(x), sweeps=sweeps, **given)
        assert taken[0].shape == (1, combinations_of(two, sweeps), 1) and sum(cycles_of(two, sweeps)) == sweeps
        assert torch.equal(*ends) != bool(taken[0].any())
        assert (taken[0].numel() == 0) == (sweeps < shortest)
    assert taken[0].any()


@pytest.mark.parametrize("case", ("inverted", "violent", "contrast", "floor_filtered"))
@pytest.mark.parametrize("coarse", [None, SPACE])
def test_no_step_ends_above_its_start(case: str, coarse: dv.CoarseSpace | None) -> None:
    scene = build_scene(case, "structured", "small")
    inputs = scene.inputs()
    names = ("mu", "lam", "time_step", "rest_points", "density", "parameters")
    given = {name: inputs[name] for name in names if name in inputs}
    begun_of = scene.model(start="inertia", rigid=False)
    model = scene.model(start="inertia", rigid=False, coarse=coarse, acceleration=dv.Anderson(3))
    load = inputs["gravity"] + inputs["force"] / model.mass[:, None]
    h, held = inputs["time_step"], model.pinned[:, None]
    y = torch.where(held, inputs["prescribed"], inputs["x"] + h * inputs["v"] + h * h * load)
    with torch.no_grad():
        ends = [dv.step(begun_of, sweeps=0, **inputs)[0], dv.step(model, sweeps=9, **inputs)[0]]
        before, after = (reference.incremental_potential(model, at, y, x_prev=inputs["x"], **given) for at in ends)
    assert not torch.equal(*ends)
    assert float(after) <= float(before) * (1 + tolerance("energy_gain")), (before, after)


@pytest.mark.parametrize("coarse", [None, SPACE])
def test_scenes_and_bodies_do_not_mix(coarse: dv.CoarseSpace | None) -> None:
    one = dv.mesh.box((4, 4, 4), (0.2, 0.2, 0.2))
    two = dv.mesh.join([one, dv.mesh.box((5, 3, 3), (0.4, 0.1, 0.1)).translate((3.0, 0.0, 0.0))])
    options: dict[str, Any] = {"coarse": coarse, "relaxation": 1.5, "acceleration": dv.Anderson(2)}
    given = {"mu": 1e6, "lam": 1e6, "time_step": 1 / 60, "sweeps": 9}
    model, alone = dv.Model(two, **options), dv.Model(one, **options)
    x = torch.stack([model.rest_points, model.rest_points * 1.05])
    with dv.acceleration.record() as taken:
        ends, _ = dv.step(model, x, torch.zeros_like(x), **given)
    assert taken[0].any() and taken[0].shape[0] == 2 and taken[0].shape[2] == 2
    for scene in range(2):
        single, _ = dv.step(model, x[scene], torch.zeros_like(x[scene]), **given)
        assert torch.equal(ends[scene], single)
        part = x[scene, : one.num_vertices]
        own, _ = dv.step(alone, part, torch.zeros_like(part), **given)
        assert relative_error(single[: one.num_vertices], own) <= tolerance("coarse_forward")


def test_same_bits_on_one_thread_and_on_two() -> None:
    mesh = dv.mesh.box((16, 16, 16), (1.0, 1.0, 1.0))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, coarse="auto", relaxation=1.5, acceleration=dv.Anderson(2))
    x = model.rest_points.requires_grad_()
    threads, found = torch.get_num_threads(), []
    try:
        for n in (1, 2):
            torch.set_num_threads(n)
            with dv.acceleration.record() as taken:
                x_end, v_end = dv.step(model, x, torch.zeros_like(x), mu=1e6, lam=1e6, time_step=1 / 60, sweeps=14)
            assert taken[0].any()
            (bar,) = torch.autograd.grad(x_end.square().sum() + v_end.square().sum(), x)
            found.append((x_end.detach(), bar))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(one, two) for one, two in zip(*found, strict=True)) and found[0][1].abs().max() > 0


def comparison(case: str, dtype: torch.dtype = torch.float64) -> tuple[dv.Model, Any, Tensor, Tensor, Any]:
    """A step's parts, two states of it, and the reference of its potential."""
    scene = build_scene(case, "structured", "small")
    model, inputs = scene.model(acceleration=dv.Anderson(2)).to(dtype=dtype), scene.inputs()
    inputs = {k: v.to(dtype) if isinstance(v, Tensor) else v for k, v in inputs.items()}
    names = ("mu", "lam", "rest_points", "density")
    material = {k: inputs[k] for k in names}
    prepared = prepare(model, inputs["x"].shape[:-2], time_step=inputs["time_step"], sweeps=1, parameters=None,
                       **material)  # fmt: skip
    begun = begin(model, inputs["x"], inputs["v"], prepared, inputs["force"], acceleration_of(GRAVITY, inputs["x"]),
                  inputs["prescribed"])  # fmt: skip
    fields = begun.fields(model, prepared)
    to = sweep(fields, model._packed_rest, model._plan, prepared.settings, tape_policy=0)[0]
    parts = rise_parts(model, fields, inputs["time_step"])
    twin = reference_scene(model, build_layout(model), inputs["x"], parameters=None, time_step=inputs["time_step"],
                           **material)  # fmt: skip
    return model, parts, begun.x_start, to, Anderson(twin, build_energies(twin))


@pytest.mark.parametrize("case", ("plain", "floor_active", "free_anchored", "free_batch", "violent"))
def test_the_potential_of_two_states(case: str, device: str) -> None:
    """Compiled, and by the reference."""
    model, parts, x, to, twin = comparison(case)
    rows = [t.transpose(-1, -2) for t in (x, to, parts.fields.y, parts.fields.x_prev)]
    expected, size = twin.rise(*rows)
    assert (expected < 0).any()
    there = RiseParts(model.to(device), type(parts.fields)(*(t if t is None else t.to(device) for t in parts.fields)),
                      parts.material.to(device), parts.rest.to(device), parts.time_step)  # fmt: skip
    found = rise_of_bodies(there, x.to(device), to.to(device)).to(expected)
    assert found.shape == (*x.shape[:1], model._moving.number, 2)
    finite = torch.isfinite(found[..., 0])
    assert finite.any() and (found[..., 1] > 0).all()
    apart = (found[..., 0] - expected).abs()[finite]
    assert (apart <= tolerance("sum") * size[finite]).all(), apart / size[finite]
    assert parts.admits(x, to)[expected < 0].all() and not parts.admits(to, x)[expected < 0].any()


@pytest.mark.parametrize("case", ("plain", "free_batch"))
@pytest.mark.parametrize("count", [2, 4, 11])
def test_the_combination_of_iterates(case: str, count: int) -> None:
    """Compiled, in torch as CUDA has it, and least squares: the rest of the residual is as small as it can be."""
    model, parts, x, *_ = comparison(case)
    generator = torch.Generator().manual_seed(1)
    states = [x + torch.rand(x.shape, generator=generator, dtype=x.dtype) for _ in range(2 * count)]
    given = model._moving, parts.fields.mass, tuple(states), count
    found = [_combined(*given), _combined_in_torch(*given, noise=0.0)]
    for one, two in zip(*found, strict=True):
        assert relative_error(one, two) <= tolerance("sum")
    to, _, gamma = found[0]
    free = ~model.pinned
    assert torch.equal(to[:, ~free], states[-1][:, ~free]) and not torch.equal(to, states[-1])
    residuals = torch.stack([g - x for x, g in zip(states[:count], states[count:], strict=True)])[:, :, free]
    root = parts.fields.mass[:, free, None].sqrt()
    of_scene = (root * (residuals[1:] - residuals[:-1])).flatten(2).permute(1, 2, 0)
    least = torch.linalg.lstsq(of_scene, (root * residuals[-1]).flatten(1)[..., None]).solution[..., 0]
    assert model._moving.number == 1 and relative_error(gamma[:, 0], least) <= tolerance("regularized")


def test_what_is_no_number_or_below_a_floor_is_not_taken() -> None:
    _, parts, x, to, _ = comparison("floor_active")
    for bad in (torch.full_like(to, torch.nan), torch.full_like(to, torch.inf), to - 100):
        assert not parts.admits(x, bad).any()
        states = [x, to, to, to, to, bad]
        assert torch.equal(
            *[_Combine.forward(parts.fields.mass, parts, 3, *states)[0].nan_to_num(7), bad.nan_to_num(7)]
        )


def test_nothing_moves_any_more() -> None:
    """Iterates without a residual have no combination, and a gradient all the same."""
    _, parts, x, *_ = comparison("plain")
    leaves = [x.clone().requires_grad_() for _ in range(6)]
    end, taken, *_ = _Combine.apply(parts.fields.mass, parts, 3, *leaves)
    bars = torch.autograd.grad(end.sum(), leaves)
    assert torch.equal(end, x) and not taken.any() and all(torch.isfinite(b).all() for b in bars)
    assert relative_error(sum(bars), torch.ones_like(x)) <= tolerance("adjoint")


def test_float32_is_near_float64() -> None:
    model, given = contrast(coarse=SPACE, relaxation=1.5, acceleration=dv.Anderson(2))
    given, ends = given | {"mu": 2e5, "lam": 2e5}, []
    for dtype in (torch.float64, torch.float32):
        own = model.to(dtype=dtype)
        x = own.rest_points
        ends.append(dv.rollout(own, x, torch.zeros_like(x), steps=3, sweeps=11, save="last", **given).x[-1])
    assert ends[1].dtype == torch.float32 and relative_error(*ends[::-1]) <= tolerance("float32_forward")


def test_checkpoints_and_the_reference_as_a_route() -> None:
    model, given = contrast(coarse=SPACE, relaxation=1.5, acceleration=dv.Anderson(2))
    x, found = model.rest_points, []
    for options in ({"checkpoint_every": None}, {"checkpoint_every": 2}, {"adjoint": dv.Unrolled()}):
        mu = given["mu"].clone().requires_grad_()
        run = dv.rollout(model, x, torch.zeros_like(x), steps=3, sweeps=9, save="last", **(given | {"mu": mu}),
                         **options)  # fmt: skip
        found.append((run.x[-1].detach(), torch.autograd.grad(run.x[-1].square().sum(), mu)[0]))
    assert torch.equal(found[0][0], found[1][0]) and found[0][1].abs().max() > 0
    assert relative_error(found[1][1], found[0][1]) <= tolerance("schedules")
    assert relative_error(found[2][0], found[0][0]) <= tolerance("coarse_forward")
    assert relative_error(found[2][1], found[0][1]) <= tolerance("accelerated")


def test_solve_and_the_equation() -> None:
    model, given = contrast(coarse=SPACE, relaxation=1.5, acceleration=dv.Anderson(2))
    x, found = model.rest_points, []
    for adjoint in (dv.GlobalAdjoint(), dv.ReverseSweep()):
        mu = given["mu"].clone().requires_grad_()
        solved = dv.solve(model, x, torch.zeros_like(x), tolerance=1e-10, adjoint=adjoint, **(given | {"mu": mu}))
        assert solved.converged
        found.append((solved.x.detach(), torch.autograd.grad(solved.x.square().sum(), mu)[0]))
    assert relative_error(found[1][0] - x, found[0][0] - x) <= tolerance("thirty_sweeps")
    assert relative_error(found[1][1], found[0][1]) <= tolerance("thirty_sweeps") and found[0][1].abs().max() > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"acceleration": "anderson"}, "acceleration: expected a diffvbd.Anderson or None"),
        ({"saturation": 0.1}, "acceleration: expected None with saturation"),
        ({"energies": dv.StableNeoHookean("paper")}, "the exact block"),
    ],
)
def test_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        dv.Model(dv.mesh.cube(3), **({"acceleration": dv.Anderson()} | options))


@pytest.mark.parametrize("window", [0, 11, 2.5, True])
def test_bad_windows(window: Any) -> None:
    with pytest.raises((ValueError, TypeError), match="window: expected"):
        dv.Anderson(window)


def test_transforms_are_refused_and_the_repr_says_what_there_is() -> None:
    model, given = contrast(acceleration=dv.Anderson(5))
    x = model.rest_points
    with pytest.raises(NotImplementedError, match="Anderson acceleration"):
        torch.func.vmap(lambda y: dv.step(model, y, torch.zeros_like(y), sweeps=4, **given)[0])(torch.stack([x, x]))
    assert "acceleration=Anderson(window=5)" in repr(model)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_combinations_end_where_differences_are_rounding(dtype: torch.dtype) -> None:
    """Long after it has converged a step has the gradient that it had when it did."""
    mesh = dv.mesh.beam(7, 3, 3, size=(1.0, 0.25, 0.25))
    pinned = mesh.points[:, 0] < 1e-9
    model = dv.Model(mesh, pinned=pinned, dtype=dtype, acceleration=dv.Anderson(5))
    weight = torch.randn(mesh.num_vertices, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    grads, taken = [], []
    for sweeps in (14, 60):
        x = model.rest_points.clone().requires_grad_()
        with dv.acceleration.record() as bits:
            end, _ = dv.step(model, x, torch.zeros_like(x), mu=1e3, lam=1e3, time_step=0.01, sweeps=sweeps)
        grads += torch.autograd.grad((end * weight.to(dtype)).sum(), x)
        taken.append(int(bits[0].sum()))
    assert taken[1] < 20 and (taken[0] > 0 or dtype == torch.float32)
    bar = "float32_gradient" if dtype == torch.float32 else "global_converged"
    assert relative_error(grads[1], grads[0]) <= tolerance(bar)


@pytest.mark.parametrize(
    ("options", "sweeps", "wanted", "warns"),
    [
        ({"acceleration": dv.Anderson(5)}, 20, True, True),
        ({"acceleration": dv.Anderson(5)}, 20, False, False),
        ({"acceleration": dv.Anderson(5)}, 4, True, False),
        ({"acceleration": dv.Anderson(2), "coarse": "auto"}, 20, True, False),
        ({}, 20, True, False),
    ],
)
def test_gradients_through_accelerated_plain_sweeps_warn_once(
    options: dict[str, Any], sweeps: int, wanted: bool, warns: bool
) -> None:
    model, given = contrast(**options)
    x = model.rest_points.clone().requires_grad_(wanted)
    said: list[bool] = []
    for _ in range(2):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            dv.step(model, x, torch.zeros_like(x), sweeps=sweeps, **given)
        said.append(any("acceleration: gradients" in str(w.message) for w in found))
    assert said == [warns, False]
