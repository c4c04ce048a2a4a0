"""Claim: every adjoint route is what it says. Unrolled equals the reverse sweep; GlobalAdjoint has the same forward, is
the derivative of a converged step in both of its forms, is wrong where the sweeps have not converged, and never fails
silently."""

import contextlib
import itertools
import subprocess
import sys
from typing import Any

import pytest
import torch
from helpers.marks import slow
from helpers.paths import ROOT
from helpers.results import saved_bytes
from helpers.spreads import beyond
from torch import Tensor

import diffvbd as dv
from diffvbd import results, testing
from diffvbd.testing import build_scene, debug_checks, evaluate, relative_error, tolerance

CONVERGED = 300  # sweeps, after which the scenes used here stand still
SCENES = [("plain", "structured"), ("paper", "delaunay"), ("soft", "random"), ("floor_damped", "delaunay"),
          ("floor_corner", "random"), ("anchored", "structured"), ("batch", "delaunay")]  # fmt: skip
TIGHT = tolerance("linear_residual")
GLOBAL = [dv.GlobalAdjoint(tolerance=TIGHT), dv.GlobalAdjoint(False, tolerance=TIGHT)]


def of_step(scene: testing.Scene, device: str, sweeps: int, adjoint: Any) -> dict[str, Tensor]:
    model, solver = scene.model(device), scene.solver(sweeps)
    run = lambda **given: dv.step(model, solver=solver, adjoint=adjoint, **given)  # noqa: E731
    return evaluate(run, scene.inputs(device=device), solver.time_step)


def gradients(result: dict[str, Tensor]) -> list[str]:
    """Names of the gradients that do not vanish."""
    names = [name for name in result if name.startswith("grad_") and bool(result[name].any())]
    assert {"grad_x", "grad_v", "grad_mu", "grad_lam", "grad_density", "grad_rest_points"} <= set(names)
    return names


def scene_on(device: str, case: str, sweeps: int, kind: str = "structured") -> tuple[dv.Model, dict[str, Any]]:
    """A Model, and the inputs and the solver of its step."""
    scene = build_scene(case, kind)
    return scene.model(device), scene.inputs(device=device) | {"solver": scene.solver(sweeps)}


@pytest.mark.parametrize("sweeps", (0, 1, slow(5)))
@pytest.mark.parametrize(("case", "kind"), SCENES)
def test_unrolled_is_the_reverse_sweep(device: str, case: str, kind: str, sweeps: int) -> None:
    scene = build_scene(case, kind)
    ours, unrolled = (of_step(scene, device, sweeps, a) for a in (dv.ReverseSweep(), dv.Unrolled()))
    # v is a difference of positions over h: it is held to their scale
    scale = max(1.0, float(ours["x"].abs().max() / ours["v"].abs().max()) / scene.case.time_step)
    errors = {n: relative_error(unrolled[n], ours[n]) / (scale if n == "v" else 1.0) for n in ours}
    sample = lambda: testing.spread(scene.model(), scene.inputs(), scene.solver(sweeps))  # noqa: E731
    failures = beyond(errors, dict.fromkeys(errors, tolerance("adjoint")), [sample])
    assert not failures, failures
    assert bool(unrolled["grad_x"].any())


@pytest.mark.parametrize(("case", "kind"), SCENES)
def test_global_adjoint_is_the_derivative_of_a_converged_step(device: str, case: str, kind: str) -> None:
    scene = build_scene(case, kind)
    expected = of_step(scene, device, CONVERGED, dv.ReverseSweep())
    assembled, free = (of_step(scene, device, CONVERGED, adjoint) for adjoint in GLOBAL)
    for name in gradients(expected):
        assert relative_error(free[name], assembled[name]) <= tolerance("global_routes"), name
        assert relative_error(assembled[name], expected[name]) <= tolerance("global_converged"), name
    for name in ("x", "v"):
        assert torch.equal(assembled[name], free[name])
        if device == "cpu":  # where the default route does not fuse the step
            assert torch.equal(assembled[name], expected[name])
        assert relative_error(assembled[name], expected[name]) <= tolerance("forward")


@pytest.mark.parametrize("adjoint", GLOBAL, ids=("assembled", "matrix-free"))
def test_global_adjoint_is_wrong_before_and_right_after_convergence(device: str, adjoint: dv.GlobalAdjoint) -> None:
    scene, errors = build_scene("plain", "delaunay"), []
    for sweeps in (1, 3, 10, 30):
        ours, theirs = (of_step(scene, device, sweeps, a) for a in (dv.ReverseSweep(), adjoint))
        errors.append(max(relative_error(theirs[k], ours[k]) for k in ("grad_x", "grad_v")))
    assert errors[0] > 0.1
    assert all(later < earlier for earlier, later in itertools.pairwise(errors))
    assert errors[-1] < tolerance("thirty_sweeps")


def test_both_forms_agree_where_nothing_has_converged(device: str) -> None:
    """They solve one system, wherever the sweeps have ended."""
    scene = build_scene("floor_corner", "delaunay")
    assembled, free = (of_step(scene, device, 1, adjoint) for adjoint in GLOBAL)
    for name in gradients(assembled):
        assert relative_error(free[name], assembled[name]) <= tolerance("global_routes"), name


def test_what_a_step_keeps_does_not_grow_with_the_sweeps(device: str) -> None:
    kept = []
    for sweeps in (1, 50):
        model, given = scene_on(device, "plain", sweeps, "delaunay")
        given["mu"].requires_grad_()
        kept.append(saved_bytes(lambda model=model, given=given: dv.step(model, adjoint=dv.GlobalAdjoint(), **given)))
    assert kept[0] == kept[1] > 0


@pytest.mark.parametrize(
    ("adjoint", "schedule"), [(dv.Unrolled(), 2), (GLOBAL[0], dv.BinomialCheckpoints(1)), (GLOBAL[1], None)]
)
def test_a_rollout_is_its_steps_under_every_schedule(device: str, adjoint: Any, schedule: Any) -> None:
    model, inputs = scene_on(device, "batch", 4)

    def by_steps(x: Tensor, v: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
        for _ in range(3):
            x, v = dv.step(model, x, v, adjoint=adjoint, **options)
        return x, v

    def by_rollout(**options: Any) -> tuple[Tensor, Tensor]:
        end = dv.rollout(model, steps=3, adjoint=adjoint, checkpoint_every=schedule, save="last", **options)
        return end.x[-1], end.v[-1]

    steps, rollout = (evaluate(run, inputs, inputs["solver"].time_step) for run in (by_steps, by_rollout))
    assert bool(steps["grad_mu"].any())
    for name in steps:
        assert relative_error(rollout[name], steps[name]) <= tolerance("property_subset"), name


# --- what GlobalAdjoint reports ---------------------------------------------------------------------------------------


def test_report_tells_of_each_backward_step(device: str) -> None:
    model, inputs = scene_on(device, "batch", 4)
    solves: list[results.LinearSolve] = []
    goal = 1e-9
    adjoint = dv.GlobalAdjoint(tolerance=goal, report=solves.append)
    x = inputs.pop("x").requires_grad_()
    end = dv.rollout(model, x, steps=3, adjoint=adjoint, save="last", **inputs)
    assert not solves
    end.x.sum().backward()
    assert len(solves) == 3
    for solve in solves:
        assert solve.converged and 0 < solve.residual <= 2 * goal and 1 < solve.iterations < 200


def test_the_first_solve_of_a_process_is_silent() -> None:
    """Of which torch says that its block-sparse matrices are new."""
    script = """
import diffvbd as dv, warnings
warnings.resetwarnings()
warnings.simplefilter("error")
model = dv.Model(dv.mesh.cube(2, size=0.1), pinned=[0])
x = model.rest_points.requires_grad_()
dv.step(model, x, 0 * x, dv.VBD(0.01, 30), mu=1e4, lam=1e4, adjoint=dv.GlobalAdjoint())[0].sum().backward()
assert x.grad.any()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("assembled", (True, False))
def test_a_solve_that_fails_is_never_silent(device: str, assembled: bool) -> None:
    scene = build_scene("batch")
    solves: list[results.LinearSolve] = []
    options: dict[str, Any] = {"max_iterations": 2, "report": solves.append}
    message = r"relative residual of 1e-10, got .* in scene \d after 2 iterations"
    with pytest.raises(RuntimeError, match=message):
        of_step(scene, device, 3, dv.GlobalAdjoint(assembled, **options))
    with pytest.warns(RuntimeWarning, match=message):
        result = of_step(scene, device, 3, dv.GlobalAdjoint(assembled, on_failure="warn", **options))
    assert not solves[-1].converged and solves[-1].residual > 1e-10 and bool(result["grad_x"].any())


def test_a_nan_in_the_adjoint_fails_too(device: str) -> None:
    model, inputs = scene_on(device, "plain", 2)
    inputs["x"].requires_grad_()
    x, _ = dv.step(model, adjoint=dv.GlobalAdjoint(max_iterations=5), **inputs)
    with pytest.raises(RuntimeError, match="expected finite adjoints of the positions, got nan in scene 0"):
        torch.autograd.grad(x.sum(), inputs["x"], torch.tensor(torch.nan, dtype=x.dtype, device=device))


def loose_cube(dtype: torch.dtype, device: str) -> tuple[dv.Model, Tensor]:
    """Without pins: the rigid motions see the mass alone, the rest a stiffness far above it."""
    model = dv.Model(dv.mesh.cube(3, size=0.2), density=100.0, dtype=dtype, device=device)
    return model, model.rest_points * torch.tensor([1.02, 0.99, 1.01], dtype=dtype, device=device)


@pytest.mark.parametrize("assembled", (True, False))
def test_the_residual_that_counts_is_the_true_one(device: str, assembled: bool) -> None:
    """In float32 the recurrence of conjugate gradients believes in a residual that rounding has not kept."""
    results = {}
    for dtype in (torch.float64, torch.float32):
        model, x = loose_cube(dtype, device)
        mu = torch.tensor(1e6, dtype=dtype, device=device, requires_grad=True)
        end, _ = dv.step(model, x, 0 * x, dv.VBD(0.1, 200), mu=mu, lam=1e6, gravity=(0.0, 0.0, 0.0),
                         adjoint=dv.GlobalAdjoint(assembled))  # fmt: skip
        if dtype == torch.float32:
            with pytest.raises(RuntimeError, match="relative residual of 1e-05, got"):
                end[:, 0].square().sum().backward()
        else:
            (results["expected"],) = torch.autograd.grad(end[:, 0].square().sum(), mu)
    assert bool(results["expected"].any())


# --- unsupported ------------------------------------------------------------------------------------------------------


def test_function_transforms_raise(device: str) -> None:
    model, inputs = scene_on(device, "plain", 2)
    x = inputs.pop("x")

    def end(x: torch.Tensor) -> torch.Tensor:
        return dv.step(model, x, adjoint=dv.GlobalAdjoint(), **inputs)[0]

    for run in (torch.func.grad(lambda x: end(x).sum()), lambda x: torch.func.vmap(end)(x[None])):
        with pytest.raises(NotImplementedError, match=r"^adjoint: expected ReverseSweep inside torch\.func transforms"):
            run(x)
    out = end(x.requires_grad_())
    with pytest.raises(NotImplementedError, match="^adjoint: expected ReverseSweep for batched gradients"):
        torch.autograd.grad(out, x, out.detach().expand(2, *out.shape), is_grads_batched=True)


BAD = [
    ({"assembled": "yes"}, TypeError, "assembled: expected a bool, got str"),
    ({"tolerance": 0}, ValueError, "tolerance: expected a finite number > 0"),
    ({"tolerance": 1.0}, ValueError, r"tolerance: expected a number in \(0, 1\), got 1.0"),
    ({"tolerance": float("nan")}, ValueError, "tolerance: expected a finite number > 0, got nan"),
    ({"max_iterations": 0}, ValueError, "max_iterations: expected an integer >= 1, got 0"),
    ({"max_iterations": 2.5}, TypeError, "max_iterations: expected an integer, got float"),
    ({"on_failure": "ignore"}, ValueError, 'on_failure: expected "raise" or "warn", got \'ignore\''),
    ({"report": 3}, TypeError, "report: expected a function of a LinearSolve, got int"),
]


@pytest.mark.parametrize(("options", "error", "message"), BAD)
def test_bad_options_are_named(options: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        dv.GlobalAdjoint(**options)


@pytest.mark.usefixtures("value_checks")
@pytest.mark.parametrize("adjoint", [dv.Unrolled(), dv.GlobalAdjoint()], ids=("unrolled", "global"))
def test_bad_values_are_named(device: str, adjoint: Any) -> None:
    model, inputs = scene_on(device, "plain", 2)
    for name, value in (("mu", -1e4), ("lam", float("nan")), ("density", -1.0)):
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            dv.step(model, adjoint=adjoint, **inputs | {name: value})


@pytest.mark.parametrize("adjoint", [dv.Unrolled(), dv.GlobalAdjoint()], ids=("unrolled", "global"))
def test_debug_checks_reach_every_route(device: str, adjoint: Any) -> None:
    model, inputs = scene_on(device, "plain", 2)
    inputs["x"][-1, 0] = torch.nan
    with debug_checks(), pytest.raises((RuntimeError, ValueError), match="^x: expected finite values|step 0, sweep"):
        dv.step(model, adjoint=adjoint, **inputs)


@pytest.mark.parametrize("adjoint", [dv.Unrolled(), *GLOBAL], ids=("unrolled", "assembled", "matrix-free"))
def test_scenes_without_anything_to_solve(device: str, adjoint: Any) -> None:
    """All vertices pinned, or no scene at all: the gradients of the identity, and of nothing."""
    mesh = dv.mesh.cube(2)
    model = dv.Model(mesh, pinned=range(mesh.num_vertices), device=device)
    x = model.rest_points.clone().requires_grad_()
    end, _ = dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 2), mu=1e4, lam=1e4, adjoint=adjoint)
    assert torch.equal(torch.autograd.grad(end.sum(), x)[0], torch.ones_like(x))
    model = dv.Model(mesh, pinned=[0], device=device)
    x = torch.zeros((0, mesh.num_vertices, 3), dtype=torch.float64, device=device, requires_grad=True)
    end, _ = dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 2), mu=1e4, lam=1e4, adjoint=adjoint)
    assert end.shape == x.shape and torch.autograd.grad(end.sum(), x)[0].shape == x.shape


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [dv.Unrolled(), dv.GlobalAdjoint(tolerance=1e-6)], ids=("unrolled", "global"))
def test_float32(device: str, adjoint: Any) -> None:
    scene = build_scene("anchored", "delaunay")
    model, solver = scene.model(device, dtype=torch.float32), scene.solver(60)
    double = of_step(scene, "cpu", 60, dv.ReverseSweep())
    single = evaluate(lambda **given: dv.step(model, solver=solver, adjoint=adjoint, **given),
                      scene.inputs(torch.float32, device), solver.time_step)  # fmt: skip
    assert single["x"].dtype == torch.float32
    for name in ("grad_x", "grad_mu", "grad_rest_points", "grad_floor_kappa"):
        assert relative_error(single[name], double[name]) <= tolerance("float32_gradient"), name


@pytest.mark.cuda
def test_a_capture_is_told_to_take_another_route() -> None:
    model, inputs = scene_on("cuda", "plain", 2)
    inputs["x"].requires_grad_()

    def work() -> None:
        x, _ = dv.step(model, adjoint=dv.GlobalAdjoint(), **inputs)
        torch.autograd.grad(x.sum(), inputs["x"])

    work()
    torch.cuda.synchronize()
    with pytest.raises(RuntimeError, match="expected ReverseSweep while a CUDA graph"):
        with contextlib.suppress(AttributeError), torch.cuda.graph(torch.cuda.CUDAGraph()):
            work()
