"""Claim: dv.refine runs a loss with smaller steps and more sweeps over the same motion, and tells what survives."""

import math
from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import results
from diffvbd.testing.tolerances import tolerance

H, K, STEPS = 1 / 50, 4, 6
LOADS: dict[str, Any] = {"mu": 2e4, "lam": 2e4, "steps": STEPS, "solver": dv.VBD(H, K)}


def beam() -> tuple[dv.Model, Tensor, Tensor]:
    mesh = dv.mesh.box((3, 2, 2), 0.1)
    model = dv.Model(mesh, pinned=torch.tensor(mesh.points[:, 0] < 1e-9))
    return model, model.rest_points, torch.zeros_like(model.rest_points)


def results_of(loss: Any) -> tuple[results.Refinement, list[Any]]:
    """What a loss that keeps its trajectories gave at (h, K), (h, 2K), (h/2, K), (h/2, 2K)."""
    seen: list[Any] = []
    found = dv.refine(lambda: loss(seen))
    return found, seen


def finer(parts: int, sweeps: int, steps: int = STEPS, **options: Any) -> dict[str, Any]:
    return LOADS | {"steps": parts * steps, "solver": dv.VBD(H / parts, sweeps * K, **options)}


FACTORS = ((1, 1), (1, 2), (2, 1), (2, 2))


@pytest.mark.parametrize("integrator", [dv.ImplicitEuler(), dv.SDIRK2(), dv.BDF2()])
def test_a_rollout_is_that_of_smaller_steps_and_more_sweeps(integrator: Any) -> None:
    def loss(seen: list[Any]) -> Tensor:
        seen.append(
            dv.rollout(
                *beam(),
                **finer(1, 1, integrator=integrator),
                observe=lambda step, x, v: x.mean() * step,
            )
        )
        return seen[-1].x[-1].square().sum()

    found, seen = results_of(loss)
    for (parts, sweeps), got in zip(FACTORS, seen, strict=True):
        want = dv.rollout(*beam(), **finer(parts, sweeps, integrator=integrator))
        assert got.steps == list(range(STEPS + 1)) and got.observations.shape == (STEPS,)
        assert torch.equal(got.x, want.x[::parts]) and torch.equal(got.v, want.v[::parts])
        assert torch.equal(got.observations[-1], got.x[-1].mean() * STEPS)
    values = (found.loss, found.more_sweeps, found.smaller_steps, found.both)
    assert len(set(values)) == 4 and values == tuple(float(t.x[-1].square().sum()) for t in seen)


def test_a_rollout_continues_another() -> None:
    model, x, v = beam()
    given = finer(1, 1, integrator=dv.BDF2())

    def loss(seen: list[Any]) -> Tensor:
        first = dv.rollout(model, x, v, **given)
        seen.append(dv.rollout(model, first.x[-1], first.v[-1], **given, history=first.history))
        return seen[-1].x.sum()

    for (parts, sweeps), got in zip(FACTORS, results_of(loss)[1], strict=True):
        whole = finer(parts, sweeps, 2 * STEPS, integrator=dv.BDF2())
        assert torch.equal(got.x[-1], dv.rollout(model, x, v, **whole).x[-1])
    outer = dv.rollout(model, x, v, **given)
    with pytest.raises(NotImplementedError, match="history of larger steps"):
        dv.refine(lambda: dv.rollout(model, outer.x[-1], outer.v[-1], **given, history=outer.history).x.sum())


def test_loads_and_materials_are_held_and_policies_asked_at_the_same_steps() -> None:
    generator = torch.Generator().manual_seed(0)
    force = torch.randn(STEPS, 3, dtype=torch.float64, generator=generator) * 1e-2
    mu = torch.linspace(1e4, 3e4, STEPS, dtype=torch.float64)
    asked: list[int] = []

    def policy(step: int, x: Tensor, v: Tensor) -> Tensor:
        asked.append(step)
        return force[step] - 0.1 * v.mean(0)

    def loss(seen: list[Any]) -> Tensor:
        asked.clear()
        given = LOADS | {"mu": dv.per_step(mu), "force": policy}
        seen.append(dv.rollout(*beam(), **given))
        assert asked == list(range(STEPS))
        return seen[-1].x.sum()

    _, seen = results_of(loss)
    model, x, v = beam()
    for k in range(STEPS):  # the finest, by hand
        now = force[k] - 0.1 * v.mean(0)
        for _ in range(2):
            x, v = dv.step(model, x, v, dv.VBD(H / 2, 2 * K), mu=float(mu[k]), lam=2e4, force=now)
    assert torch.allclose(seen[3].x[-1], x, rtol=0, atol=tolerance("sum")) and not torch.equal(
        seen[3].x[-1], seen[0].x[-1]
    )


@pytest.mark.parametrize("kind", ["per_step", "callable", "policy", "constant"])
def test_prescribed_vertices_go_straight(kind: str) -> None:
    model, x, v = beam()
    pinned, shift = model.pinned, torch.tensor([0.0, 0.0, 0.03], dtype=torch.float64)
    shares = torch.arange(STEPS + 1, dtype=torch.float64) / STEPS
    if kind == "constant":  # there after the first step
        shares = (shares > 0).to(torch.float64)
    ways = shares[:, None, None] * shift
    ends = torch.where(pinned[:, None], x + ways[1:], math.nan)
    given = {
        "per_step": dv.per_step(ends),
        "callable": lambda k, x, v: ends[k],
        "policy": lambda k, x, v: torch.where(pinned[:, None], ends[k], x),  # elsewhere where vertices are
        "constant": ends[0],
    }[kind]
    velocities: list[Tensor] = []

    def loss(seen: list[Any]) -> Tensor:
        seen.append(dv.rollout(model, x, v, **LOADS, prescribed=given))
        velocities.append(seen[-1].v[1, pinned])
        return seen[-1].x[-1].sum()

    for got in results_of(loss)[1]:
        assert torch.allclose(
            got.x[:, pinned] - x[pinned], ways.expand(-1, int(pinned.sum()), 3), rtol=0, atol=tolerance("forward")
        )
    for found in velocities:  # the smaller steps share the way
        assert torch.allclose(found, (ways[1] / H).expand_as(found), rtol=tolerance("travel"))


def test_a_result_that_few_sweeps_invented_does_not_survive() -> None:
    """A stiff beam hardly sags in a few sweeps: a loss that wants it straight is met by the solver, not by the beam."""
    mesh = dv.mesh.box((9, 2, 2), (0.8, 0.1, 0.1))
    model = dv.Model(mesh, pinned=torch.tensor(mesh.points[:, 0] < 1e-9))
    x = model.rest_points

    def loss_with(sweeps: int, mu: float) -> Callable[[], Tensor]:
        def loss() -> Tensor:
            end = dv.rollout(model, x, torch.zeros_like(x), dv.VBD(1 / 50, sweeps), mu=mu, lam=mu, steps=40,
                             save="last")  # fmt: skip
            return (end.x[-1] - x).square().sum()

        return loss

    invented = dv.refine(loss_with(1, 1e6))
    assert invented.both > 2 * invented.loss
    assert not invented.survives and str(invented).startswith("does not survive")
    assert "no reference could be reached, 16 K leave" in str(invented)
    assert "optimise on with more sweeps" in str(invented)
    gain = dv.refine(loss_with(60, 1e7), before=0.2)
    assert gain.survives and str(gain).startswith("survives") and "began at 0.2" in str(gain)
    assert "optimise" not in str(gain) and "too coarse" not in str(gain)
    larger = results.Refinement(-0.046, -0.05, -0.078, -0.08, 0.0, 0.1)
    assert larger.survives and str(larger).endswith("too coarse to say how much it is")
    strict = tolerance("minimum")
    assert not dv.refine(loss_with(60, 1e7), before=0.2, tolerance=strict).survives


def test_the_finer_mesh_is_that_of_a_subdivided_model() -> None:
    """What belongs to vertices and to tets goes to those of the finer mesh; frames are of the vertices of the mesh."""
    model, x, v = beam()
    fine = dv.mesh.subdivide(model.mesh)
    refined = dv.Model(fine, pinned=torch.tensor(fine.points[:, 0] < 1e-9))
    mu = torch.linspace(1e4, 3e4, model.num_tets, dtype=torch.float64)
    push = torch.zeros_like(x)
    push[-1, 2] = 0.01
    lift = torch.tensor([0.0, 0.0, 0.01], dtype=torch.float64)
    ends = torch.stack([torch.where(model.pinned[:, None], x + (k + 1) * lift, math.nan) for k in range(STEPS)])
    seen: list[Any] = []

    def loss() -> Tensor:
        seen.append(dv.rollout(model, x, v, **LOADS | {"mu": mu, "force": lambda k, x, v: push + 0 * x},
                               prescribed=dv.per_step(ends), observe=lambda k, x, v: x[:, 2].max()))  # fmt: skip
        return seen[-1].x[-1].sum()

    found = dv.refine(loss, mesh=True)
    rest, pushed = refined.rest_points, torch.zeros_like(refined.rest_points)
    pushed[: len(x)] = push
    halves = torch.stack([torch.where(refined.pinned[:, None], rest + (k + 1) * lift / 2, math.nan)
                          for k in range(2 * STEPS)])  # fmt: skip
    want = dv.rollout(refined, rest, 0 * rest, dv.VBD(H / 2, found.sweeps * K), mu=mu.repeat_interleave(8), lam=2e4,
                      steps=2 * STEPS, force=pushed, prescribed=dv.per_step(halves))  # fmt: skip
    got = seen[-1]
    assert found.mesh == float(got.x[-1].sum()) and got.observations.shape == (STEPS,)
    assert torch.allclose(got.x, want.x[::2, : len(x)], rtol=0, atol=tolerance("forward"))


def pushed(shape: Callable[[Tensor], Tensor], start: float) -> Any:
    """A loss of a parameter that a cube is pushed by, and the parameter."""
    model = dv.Model(dv.mesh.cube(2, size=0.1))
    x, p = model.rest_points, torch.tensor([start], dtype=torch.float64, requires_grad=True)

    def loss() -> Tensor:
        v = torch.cat([p, 0 * p, 0 * p]).expand_as(x)
        end = dv.rollout(model, x, v, dv.VBD(H, K), mu=1e4, lam=1e4, steps=5, gravity=(0, 0, 0)).x[-1]
        return shape(10 * (end - x)[:, 0].mean())  # the parameter again

    return loss, p


@pytest.mark.parametrize(
    ("shape", "start", "survives", "differences"),
    [
        (lambda y: y.square(), 1.0, True, (0, 0)),
        (lambda y: (y - 1).square(), 1.0, True, (0, 0)),  # at the minimum, where the gradient is rounding
        (lambda y: (y - 1).abs(), 1.005, False, (0.4, 0.9)),  # a kink within 1 %
        (lambda y: (y - 1).abs(), 1.05, False, (0, 0.4)),  # and one within 10 %
        (lambda y: y + 0.02 * (80 * (y - 1)).sin(), 1.0, False, (0, 0.4)),  # ripples on a trend
        (lambda y: y + (y.detach() > 1.001).double(), 1.0, False, (0.4, 0)),  # a jump
        (lambda y: y + 1, 0.0, True, ()),  # no size to take a share of
        (lambda y: y.detach().square() + 0 * y, 1.0, False, (0.9, 0.9)),  # a derivative that is lost
    ],
)
def test_differences_show_what_a_derivative_does_not_follow(
    shape: Any, start: float, survives: bool, differences: tuple[float, ...]
) -> None:
    loss, p = pushed(shape, start)
    found = dv.refine(loss, before=10.0, gradient=p)
    (check,) = found.gradients
    assert found.survives == survives and p.item() == start and p.grad is None
    assert list(check.finer) == ["2 K", "h/2", "both"] and len(check.differences) == len(differences)
    for got, least in zip(check.differences.values(), differences, strict=True):
        assert got >= least if least else got <= 0.1
    if not survives:
        assert str(found).endswith("the loss has kinks or jumps here") and "gradient: not stable" in found.tested
        assert dv.refine(loss, before=10.0).survives  # the loss alone does not tell


def loss_of(**given: Any) -> Any:
    return lambda: dv.rollout(*beam(), **LOADS | given).x.sum()


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: dv.refine(cast(Any, 1.0)), TypeError, "loss: expected a function"),
        (lambda: dv.refine(lambda: 1.0), ValueError, "loss: expected a function that runs dv.rollout"),
        (lambda: dv.refine(lambda: dv.rollout(*beam(), **LOADS).x), ValueError, r"loss: expected a scalar, got shape"),
        (lambda: dv.refine(cast(Any, lambda: dv.rollout(*beam(), **LOADS))), TypeError, "loss: expected a scalar"),
        (lambda: dv.refine(loss_of(), tolerance=1.5), ValueError, "tolerance: expected a share"),
        (lambda: dv.refine(loss_of(), tolerance=0), ValueError, "tolerance: expected"),
        (lambda: dv.refine(loss_of(), before=-1e9), ValueError, "before: expected a loss above"),
        (lambda: dv.refine(loss_of(), before=float("inf")), ValueError, "before: expected a finite"),
        (lambda: dv.refine(loss_of(), before=torch.tensor(float("inf"))), ValueError, "before: expected a finite"),
        (lambda: dv.refine(loss_of(), mesh=cast(Any, 1)), TypeError, "mesh: expected a bool, got int"),
        (lambda: dv.refine(loss_of(), gradient=torch.zeros(1)), TypeError, r"gradient\[0\]: expected a leaf tensor"),
        (lambda: dv.refine(loss_of(), gradient=cast(Any, 3)), TypeError, "gradient: expected a tensor or a list"),
        (lambda: dv.refine(loss_of(), gradient=torch.zeros(1, requires_grad=True)), ValueError,
         "loss: expected a scalar with a graph"),
        (lambda: dv.refine(pushed(torch.square, 1.0)[0], gradient=[torch.zeros(1, requires_grad=True)]), ValueError,
         r"gradient\[0\]: expected a parameter of the loss"),
        (lambda: dv.refine(loss_of(checks=dv.Checks(errors=True))), NotImplementedError, "errors"),
        (lambda: dv.refine(loss_of(steps=-1)), ValueError, "steps: expected"),
        (lambda: dv.refine(loss_of(save=0)), ValueError, "save: expected"),
        (lambda: dv.refine(loss_of(force=dv.per_step(torch.zeros(5, 3)))), ValueError, "force: expected 6 steps"),
        (lambda: dv.refine(lambda: dv.step(*beam(), solver=dv.VBD(H, 1), mu=1e4, lam=1e4)[0].sum()),
         NotImplementedError, "dv.step"),
        (lambda: dv.refine(lambda: dv.solve(*beam(), solver=dv.VBD(H, 1), mu=1e4, lam=1e4).x.sum()),
         NotImplementedError, "dv.solve"),
    ],
)  # fmt: skip
def test_bad_input(call: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call()
