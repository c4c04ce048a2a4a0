"""Claim: VBD written as composed block updates is the step of the package, forward and backward."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers.spreads import beyond
from torch import Tensor

import diffvbd as dv
from diffvbd import testing
from diffvbd.solvers import VertexBlock, vertex_block_descent
from diffvbd.testing import build_scene, evaluate, relative_error, tolerance

CASES = ("plain", "paper", "saturated", "relaxed", "stiff", "inverted", "inverted_paper", "no_shear")


def composed(model: Any, solver: dv.VBD, update: type[VertexBlock] = VertexBlock) -> Any:
    """A whole step around the composed sweep, masses from density."""

    def run(x: Tensor, v: Tensor, **given: Any) -> tuple[Tensor, Tensor]:
        h, pinned = solver.time_step, model.pinned[:, None]
        corners = model.rest_points[model.tets]
        volume = torch.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
        quarter = (given["density"] * volume / 4).repeat_interleave(4)
        mass = torch.zeros_like(model.mass).index_add(0, model.tets.reshape(-1), quarter)
        y = x + h * v + h**2 * (given["gravity"] + torch.where(pinned, 0.0, given["force"]) / mass[:, None])
        y = torch.where(pinned, given["prescribed"], y)
        descent = vertex_block_descent(model, solver, update)
        (end,) = descent((y,), (y, given["mu"], given["lam"], mass), sweeps=solver.sweeps)
        return end, (end - x) / h

    return run


def solver_of(scene: Any, sweeps: int) -> dv.VBD:
    """Its sweeps start where composed() starts them."""
    return scene.solver(sweeps, start="predictor")


def inputs_of(scene: Any, device: str = "cpu") -> dict[str, Any]:
    inputs = scene.inputs(device=device)
    del inputs["rest_points"]  # a constant of VertexBlock
    return inputs


def assert_agree(found: dict[str, Tensor], expected: dict[str, Tensor], spread: Callable[[], dict[str, float]]) -> None:
    errors = {name: relative_error(found[name], expected[name]) for name in found if name != "v"}
    floors = {name: tolerance("forward" if name == "x" else "adjoint") for name in errors}
    failures = beyond(errors, floors, [spread])
    assert not failures, failures
    assert all(found[name].any() for name in found if name.startswith("grad_"))


@pytest.mark.parametrize("sweeps", [1, 5, 20])
@pytest.mark.parametrize("case", CASES)
def test_equals_the_reference(case: str, sweeps: int, device: str) -> None:
    scene = build_scene(case, "delaunay")
    model, solver, inputs = scene.model(), solver_of(scene, sweeps), inputs_of(scene)
    expected = testing.reference_result(model, inputs, solver)
    found = evaluate(composed(scene.model(device), solver), inputs_of(scene, device), solver.time_step)
    assert_agree(found, expected, lambda: testing.spread(model, inputs, solver, expected=expected))


@pytest.mark.parametrize("case", ["plain", "paper"])
def test_equals_the_step_of_the_package(case: str, device: str) -> None:
    scene = build_scene(case, "delaunay", "medium")
    model, solver, inputs = scene.model(device), solver_of(scene, 3), inputs_of(scene, device)
    expected = evaluate(lambda x, v, **given: dv.step(model, x, v, solver, **given), inputs, solver.time_step)
    found = evaluate(composed(model, solver), inputs, solver.time_step)
    assert_agree(found, expected, lambda: testing.spread(scene.model(), inputs_of(scene), solver))


def test_scenes_of_a_batch_do_not_mix() -> None:
    scene = build_scene("paper", "delaunay")
    inputs = inputs_of(scene)
    model, x = scene.model(), inputs["x"]
    descent = vertex_block_descent(model, solver_of(scene, 2))
    scale = torch.tensor([1.0, 1.1, 0.9], dtype=x.dtype)[:, None, None]
    results = []
    for batch in (scale, *scale.split(1)):
        leaves = [(batch * x).requires_grad_(), inputs["mu"].clone().requires_grad_()]
        (end,) = descent((leaves[0],), (leaves[0], leaves[1], inputs["lam"], model.mass), sweeps=2)
        results.append((end.detach(), *torch.autograd.grad((end**2).sum(), leaves)))
    together, *each = results
    for k in (0, 1):
        assert relative_error(together[k], torch.cat([one[k] for one in each])) <= tolerance("forward")
    total = torch.stack([one[2] for one in each]).sum(0)
    assert together[2].shape == inputs["mu"].shape and total.any()
    assert relative_error(together[2], total) <= tolerance("adjoint")


@pytest.mark.parametrize("part", ["saturation_vjp", "hessian_tangent", "gradient_tangent"])
def test_each_part_of_the_adjoint_is_seen(part: str) -> None:
    """The comparison above fails, after one sweep, for an adjoint that lacks a part; the forward does not change."""

    class Without(VertexBlock):
        def saturation_vjp(self, z: Tensor, raw: Tensor) -> Tensor:
            return z if part == "saturation_vjp" else super().saturation_vjp(z, raw)

        def hessian_tangent(self, b: Any, p: Tensor, raw: Tensor) -> Any:
            return super().hessian_tangent(b, 0 * p if part == "hessian_tangent" else p, raw)

        def gradient_tangent(self, b: Any, p: Tensor) -> Any:
            return super().gradient_tangent(b, 0 * p if part == "gradient_tangent" else p)

    scene = build_scene("inverted_paper", "delaunay")
    model, solver, inputs = scene.model(), solver_of(scene, 1), inputs_of(scene)
    full, without = (
        evaluate(composed(model, solver, kind), inputs, solver.time_step) for kind in (VertexBlock, Without)
    )
    assert torch.equal(full["x"], without["x"])
    assert relative_error(without["grad_x"], full["grad_x"]) > 1e-3


def test_float32() -> None:
    scene = build_scene("plain", "delaunay")
    model, solver = scene.model().to(dtype=torch.float32), solver_of(scene, 2)
    single = {name: t.float() if isinstance(t, Tensor) else t for name, t in inputs_of(scene).items()}
    found = evaluate(composed(model, solver), single, solver.time_step)
    expected = evaluate(composed(scene.model(), solver), inputs_of(scene), solver.time_step)
    assert found["grad_x"].dtype == torch.float32 and found["grad_x"].any()
    assert relative_error(found["x"], expected["x"]) <= tolerance("float32_forward")
    assert relative_error(found["grad_x"], expected["grad_x"]) <= tolerance("float32_gradient")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": torch.zeros(7, 3).double()}, r"x: expected shape \[..., 8, 3\], got shape \[7, 3\]"),
        ({"x": torch.zeros(8, 3)}, "x: expected dtype torch.float64 .the Model's., got torch.float32"),
        ({"y": torch.zeros(1, 3).double()}, r"y: expected shape \[..., 8, 3\], got shape \[1, 3\]"),
        ({"y": torch.zeros(2, 8, 3).double()}, r"y: expected a shape that broadcasts to \[8, 3\]"),
        ({"mu": torch.ones(5).double()}, r"mu: expected a shape that broadcasts to \[6\], got shape \[5\]"),
        ({"lam": torch.ones(2, 6).double()}, r"lam: expected a shape that broadcasts to \[6\]"),
        ({"mass": torch.ones(6).double()}, r"mass: expected a shape that broadcasts to \[8\]"),
        ({"x": torch.full((8, 3), torch.nan).double()}, "x: expected finite values, got nan"),
        ({"y": torch.full((8, 3), torch.inf).double()}, "y: expected finite values, got inf"),
        ({"mu": torch.tensor(-1.0).double()}, "mu: expected finite numbers >= 0 Pa, got -1"),
        ({"mu": torch.tensor(torch.inf).double()}, "mu: expected finite numbers >= 0 Pa, got inf"),
        ({"lam": torch.tensor(torch.nan).double()}, "lam: expected finite values, got nan"),
        ({"lam": torch.full((6,), -9e2).double()}, r"lam: expected mu \+ lam >= 0 Pa, got -100 at \[0\]"),
        ({"mass": torch.zeros(8).double()}, r"mass: expected finite numbers > 0 kg where not pinned, got 0 at \[1\]"),
    ],
)
def test_bad_arguments_of_the_composed_sweep_are_named(changes: dict[str, Tensor], message: str) -> None:
    mesh = dv.mesh.cube(split="kuhn")
    model = dv.Model(mesh, pinned=[0])
    x = torch.from_numpy(mesh.points.copy())
    given = {"x": x, "y": x - 0.01, "mu": torch.tensor(8e2).double(), "lam": torch.tensor(-4e2).double()}
    given |= {"mass": model.mass}

    def run(x: Tensor, *parameters: Tensor) -> Tensor:
        return vertex_block_descent(model, dv.VBD(0.01, 1))(x, parameters, sweeps=1)

    assert not torch.equal(run(*given.values()), x)
    with pytest.raises((ValueError, TypeError), match=message):
        run(*(given | changes).values())
