"""Claim: SDIRK2 and BDF2 are of second order between contacts, exact in free fall, damp what is stiff, gain no energy
at an impact, and are differentiated as executed."""

import math
from typing import Any

import pytest
import torch
from helpers.bad_input import INF, NAN, raises
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd import colliders, results
from diffvbd.testing import generator, relative_error, tolerance

SECOND = (dv.SDIRK2(), dv.BDF2())
EVERY = (dv.ImplicitEuler(), *SECOND)
MATERIAL: dict[str, Any] = {"mu": 1e5, "lam": 2e5}
GRAVITY = torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64)


def random(*key: Any, shape: Any) -> Tensor:
    return torch.from_numpy(generator("integrators", *key).standard_normal(tuple(shape)))


def beam() -> dv.Model:
    mesh = dv.mesh.beam(7, 3, 3, (0.6, 0.15, 0.15), "kuhn")
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 0.01)


def vbd(time_step: float, sweeps: int, integrator: Any, **options: Any) -> dv.VBD:
    """The solver of a beam."""
    return dv.VBD(time_step, sweeps, **{"relaxation": 1.5, "integrator": integrator, **options})


def marched(model: dv.Model, x: Tensor, v: Tensor, solver: dv.VBD, steps: int, **inputs: Any) -> tuple[Tensor, Tensor]:
    end = dv.rollout(model, x, v, solver, steps=steps, save="last", **inputs)
    return end.x[-1], end.v[-1]


@pytest.mark.parametrize("integrator", EVERY, ids=str)
def test_order_of_a_vibration(integrator: Any) -> None:
    model = beam()
    x, v, seconds = model.rest_points, torch.zeros_like(model.rest_points), 0.08

    def end(steps: int, scheme: Any) -> Tensor:
        return marched(model, x, v, vbd(seconds / steps, 60, scheme), steps, **MATERIAL)[0]

    exact = end(640, dv.SDIRK2())
    coarse, fine = (float((end(n, integrator) - exact).norm()) for n in (40, 80))
    order = 1 if isinstance(integrator, dv.ImplicitEuler) else 2
    assert order - 0.35 < math.log2(coarse / fine) < order + 0.35
    if order == 2:
        assert coarse < 0.2 * float((end(40, dv.ImplicitEuler()) - exact).norm())


@pytest.mark.parametrize("integrator", SECOND, ids=str)
@pytest.mark.parametrize("subspace", ("rigid", None))
def test_free_fall_is_exact(device: str, integrator: Any, subspace: Any) -> None:
    model = dv.Model(dv.mesh.cube(3), device=device)
    x, v, h = model.rest_points, torch.full_like(model.rest_points, 0.7), 0.05
    end, speed = marched(model, x, v, dv.VBD(h, 2, integrator=integrator, subspace=subspace), 10, **MATERIAL)
    t = 10 * h
    g = GRAVITY.to(device)
    assert relative_error(end, x + t * v + 0.5 * t * t * g) <= tolerance("free_fall")
    assert relative_error(speed, v + t * g) <= tolerance("free_fall")


@pytest.mark.parametrize("integrator", EVERY, ids=str)
def test_momentum_and_energy_of_a_free_body(integrator: Any) -> None:
    """A stretched cube vibrates: its momentum stays, and in 1,000 steps its energy never rises above its start."""
    model = dv.Model(dv.mesh.cube(3, 0.2, "kuhn"))
    x = model.rest_points * torch.tensor([1.1, 0.95, 0.97], dtype=torch.float64)
    v = 0.1 * random("momentum", shape=x.shape)
    solver = dv.VBD(0.004, 60, subspace=None, integrator=integrator)
    end = dv.rollout(model, x, v, solver, steps=1000, gravity=(0.0, 0.0, 0.0), **MATERIAL)
    mass = model.mass[:, None]
    before, after = (mass * end.v[0]).sum(0), (mass * end.v[50]).sum(0)  # what sweeps leave adds up later
    assert relative_error(after, before) <= tolerance("momentum")
    speed = (mass * end.v.square()).sum((-1, -2))
    energy = energy_of(model, end.x, end.v, 1e5, 2e5, weight=0.0)
    gain = tolerance("energy_gain" if isinstance(integrator, dv.ImplicitEuler) else "second_order_energy")
    assert float(energy.max()) <= (1 + gain) * float(energy[0]) and float(energy[-1]) < 0.5 * float(energy[0])
    least = {dv.ImplicitEuler: 0.0, dv.SDIRK2: 0.2, dv.BDF2: 0.02}[type(integrator)]
    assert float(speed[40:50].max()) > least * float(speed.max())


@pytest.mark.parametrize("integrator", SECOND, ids=str)
def test_a_stiff_body_decays(integrator: Any) -> None:
    """Far above its frequencies a step leaves next to nothing of a vibration."""
    model, solver = beam(), vbd(0.5, 100, integrator, subspace="coarse")
    x = model.rest_points.clone()
    x[:, 1] += 0.05 * x[:, 0] ** 2
    end, speed = marched(model, x, torch.zeros_like(x), solver, 12, gravity=(0.0, 0.0, 0.0), mu=1e7, lam=1e7)
    assert float((end - model.rest_points).norm()) < 0.02 * float((x - model.rest_points).norm())
    assert float(speed.abs().max()) < 1e-2


def falling(count: int, kind: str, **options: Any) -> tuple[dv.Model, Tensor, Tensor]:
    """Cubes that turn and fall on a floor, a scene each; "bare": without damping and friction;
    "rubbing": with friction alone."""
    energies: list[Any] = [dv.StableNeoHookean()]
    if kind.endswith("floor"):
        energies.append(dv.FloorBarrier(height=-0.3, kappa=1e4, dhat=0.01, damping=2.0 if kind == "floor" else 0.0))
    else:
        energies.append(dv.PairBarrier(kappa=1e4, dhat=0.01, self_contact=False))
        energies += [dv.Friction(0.3)] if kind in ("plane", "rubbing plane") else []
        options["colliders"] = [colliders.Plane((0.0, -0.3, 0.0), (0.0, 1.0, 0.0))]
    model = dv.Model(dv.mesh.cube(2, size=0.2), energies=tuple(energies), **options)
    x = model.rest_points.expand(count, -1, -1).clone()
    x[..., 1] += 0.2 * random("height", shape=(count, 1)).abs().clamp(max=1)
    arm = x - x.mean(1, keepdim=True)
    v = torch.linalg.cross((6 * random("spin", shape=(count, 1, 3))).expand_as(arm), arm)
    v = v + random("speed", shape=(count, 1, 3))
    v[..., 1] -= 4
    return model, x, v


def energy_of(model: dv.Model, x: Tensor, v: Tensor, mu: float, lam: float, weight: float = 9.81) -> Tensor:
    """Kinetic, elastic and of weight [B], from deformation gradients."""
    rest, deformed = model.rest_points[model.tets], x[:, model.tets]
    edges = (rest[:, 1:] - rest[:, :1]).mT
    f = (deformed[:, :, 1:] - deformed[:, :, :1]).mT @ torch.linalg.inv(edges)
    det, above = torch.linalg.det(f), 1 + mu / lam
    density = mu / 2 * (f.square().sum((-1, -2)) - 3) + lam / 2 * ((det - above) ** 2 - (1 - above) ** 2)
    elastic = (density * torch.linalg.det(edges) / 6).sum(-1)
    mass = model.mass[:, None]
    return 0.5 * (mass * v.square()).sum((-1, -2)) + (mass[:, 0] * weight * x[..., 1]).sum(-1) + elastic


@pytest.mark.parametrize(
    ("kind", "time_step"),
    (("floor", 0.02), ("floor", 0.005), ("plane", 0.02), slow("plane", 0.005), slow("plane", 0.001),
     ("bare floor", 0.005), slow("bare floor", 0.001), slow("bare plane", 0.001)),
)  # fmt: skip
@pytest.mark.parametrize("integrator", SECOND, ids=str)
def test_impacts_gain_no_energy(integrator: Any, kind: str, time_step: float) -> None:
    """125 impacts each, at any phase of a step; the barrier itself gives back what it took."""
    model, x, v = falling(125, kind)
    start = energy_of(model, x, v, 3e4, 3e4)
    scale = start + float(model.mass.sum()) * 9.81 * 0.3
    most, lowest = torch.zeros_like(start), torch.ones_like(start)

    def observe(step: int, x: Tensor, v: Tensor) -> None:
        nonlocal most, lowest
        lowest = torch.minimum(lowest, (x[..., 1] + 0.3).amin(-1))
        most = torch.maximum(most, (energy_of(model, x, v, 3e4, 3e4) - start) / scale)

    solver = dv.VBD(time_step, 15, integrator=integrator)
    dv.rollout(model, x, v, solver, duration=0.3, save="last", observe=observe, mu=3e4, lam=3e4)
    # after longer steps a shape may be in the air that a barrier has just pushed there
    bound = tolerance("energy_gain") if time_step < 0.005 else 0.02
    assert float(most.max()) <= bound and float(lowest.min()) > 0
    assert float(lowest.median()) < 0.01, "few have landed"


@pytest.mark.parametrize("kind", ("bare floor", slow("bare plane")))
@pytest.mark.parametrize("integrator", SECOND, ids=str)
def test_order_through_an_impact(integrator: Any, kind: str) -> None:
    """Steps that resolve the barrier are of second order while it pushes, too."""
    model, x, v = falling(1, kind)
    x, v = x[0] - torch.tensor([0.0, float(x[0, :, 1].min()) + 0.29, 0.0], dtype=x.dtype), 0.25 * v[0]

    def end(steps: int) -> Tensor:
        return marched(model, x, v, dv.VBD(0.03 / steps, 30, integrator=integrator), steps, mu=3e4, lam=3e4)[0]

    exact = end(960)
    errors = [float((end(steps) - exact).norm()) for steps in (60, 120)]
    assert errors[1] < errors[0] / 3
    assert float((v[:, 1] * 0.03).mean() - (exact - x)[:, 1].mean()) < -0.01, "it has not been thrown back"


@pytest.mark.parametrize("support", ("floor", "plane"))
@pytest.mark.parametrize("integrator", SECOND)
def test_bodies_of_which_one_may_touch_stay_apart(integrator: Any, support: str) -> None:
    """Two cubes fall on a support, one close behind the other. The lower one takes implicit Euler; if the upper one
    went ahead of it by the first solve of SDIRK2, it would be inside."""
    lower, upper = (dv.mesh.cube(2, size=0.1).translate(at) for at in ((0.0, 0.02, 0.0), (0.013, 0.13, 0.007)))
    energies: list[Any] = [dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.004, self_contact=False)]
    energies += [dv.FloorBarrier(kappa=1e4, dhat=0.004)] if support == "floor" else []
    planes = [] if support == "floor" else [dv.colliders.Plane()]
    model = dv.Model(dv.mesh.join([lower, upper]), energies=energies, colliders=planes)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    v[:, 1] = -5.0
    with dv.record("integrator") as euler:
        end = dv.rollout(model, x, v, dv.VBD(0.01, 10, integrator=integrator), steps=3, mu=1e5, lam=1e5)
    assert any(bool(e.any() and not e.all()) for e in euler)
    assert all(len(dv.contact.intersections(model, state)) == 0 for state in end.x)


@pytest.mark.parametrize("integrator", SECOND, ids=str)
def test_friction_leaves_the_vibrations_of_an_impact(integrator: Any) -> None:
    """Friction is of first order, but bodies with friction do not take implicit Euler, which damps vibrations."""
    model, x, v = falling(1, "rubbing plane")
    x, v = x[0] - torch.tensor([0.0, float(x[0, :, 1].min()) + 0.29, 0.0], dtype=x.dtype), 0.25 * v[0]

    def end(steps: int, integrator: Any) -> Tensor:
        return marched(model, x, v, dv.VBD(0.03 / steps, 30, integrator=integrator), steps, mu=3e4, lam=3e4)[0]

    exact = end(480, dv.SDIRK2())
    error, of_euler = (float((end(120, scheme) - exact).norm()) for scheme in (integrator, dv.ImplicitEuler()))
    assert error < of_euler / 3


@pytest.mark.parametrize("integrator", SECOND, ids=str)
@pytest.mark.parametrize(
    "case", ("free", "pinned", "floor", "plane", "bare floor", "bare plane", "rubbing plane", "coarse")
)
def test_gradients_are_those_of_what_ran(integrator: Any, case: str) -> None:
    """Against central differences, for a state, a material and a coefficient of the contact."""
    extra: dict[str, Tensor] = {}
    bare, of_beam = case.startswith(("bare", "rubbing")), case in ("pinned", "coarse")
    if case.endswith(("floor", "plane")):
        model, x, v = falling(2, case)
        x = x * (1.3 if bare else 1.0)  # so much that the material matters in short steps
        x[0, :, 1] -= x[0, :, 1].min() + 0.3 - (0.008 if bare else 0.02)  # lands at once; the other flies on
        name, value = ("friction", 0.3) if case in ("plane", "rubbing plane") else ("floor_kappa", 1e4)
        name = "pair_kappa" if case == "bare plane" else name
        extra[name] = torch.tensor(value, dtype=torch.float64, requires_grad=True)
    else:
        model = beam() if of_beam else dv.Model(dv.mesh.cube(3, size=0.2))
        x = model.rest_points
        v = 0.3 * random("gradients", case, shape=x.shape)
    weight = random("weight", case, shape=x.shape)
    mu = torch.tensor(3e4, dtype=x.dtype, requires_grad=True)
    push = torch.zeros((), dtype=x.dtype, requires_grad=True)
    solver = dv.VBD(2e-4 if bare else 0.01, 3, integrator=integrator, relaxation=1.5 if of_beam else 1.0,
                    subspace="coarse" if case == "coarse" else "rigid")  # fmt: skip

    def loss(push: Tensor, mu: Tensor, *more: Tensor) -> Tensor:
        parameters = dict(zip(extra, more, strict=True))
        with dv.record("integrator") as euler:
            end, speed = marched(model, x + 1e-3 * push * weight, v + push * weight, solver, 4, mu=mu, lam=4e4,
                                 **parameters)  # fmt: skip
        assert not bare or not any(bool(e.any()) for e in euler), "the barrier is extrapolated"
        return (weight * end).sum() + 1e-2 * (weight * speed).sum()

    given = [push, mu, *extra.values()]
    for k, (t, grad) in enumerate(zip(given, torch.autograd.grad(loss(*given), given), strict=True)):
        size = 1e-2 if bare and k > 0 else 1e-4 if case == "rubbing plane" else 1e-6
        size = (1e-7, 1e-7, 3e-8)[k] if case == "plane" else size  # it presses hard, and little moves much
        d = size * max(1.0, abs(t.item()))
        with torch.no_grad():
            sides = [loss(*(u + s * d if i == k else u for i, u in enumerate(given))) for s in (1, -1)]
        assert grad.abs() > 0
        assert abs(float((sides[0] - sides[1]) / (2 * d) - grad)) <= tolerance("finite_difference") * abs(
            float(grad)
        ), k


@pytest.mark.parametrize("integrator", SECOND, ids=str)
def test_a_scene_is_the_same_alone_in_steps_and_in_checkpoints(integrator: Any) -> None:
    model, x, v = falling(3, "plane")
    v = v.requires_grad_()
    options: Any = {"steps": 8, "mu": 3e4, "lam": 3e4, "solver": dv.VBD(0.01, 4, integrator=integrator)}
    whole = dv.rollout(model, x, v, checkpoint_every=None, **options)
    (grad,) = torch.autograd.grad(whole.x[-1].sum(), v)
    assert grad.abs().max() > 0
    for every in (3, dv.BinomialCheckpoints(2)):
        again = dv.rollout(model, x, v, checkpoint_every=every, **options)
        assert torch.equal(again.x, whole.x)
        assert torch.equal(torch.autograd.grad(again.x[-1].sum(), v)[0], grad)
    alone = dv.rollout(model, x[1], v[1], **options)
    assert torch.equal(alone.x, whole.x[:, 1])
    first = dv.rollout(model, x, v, **options | {"steps": 5})
    rest = dv.rollout(model, first.x[-1], first.v[-1], history=first.history, **options | {"steps": 3})
    assert torch.equal(rest.x[-1], whole.x[-1])


@pytest.mark.parametrize(("integrator", "tau"), [(i, tau) for i in SECOND for tau in (0.0, 1e-3)], ids=str)
def test_a_scene_that_touches_is_the_same_beside_one_that_does_not(integrator: Any, tau: float) -> None:
    """All of it takes implicit Euler: alone in one solve, beside others as a part of theirs, with the same chord."""
    cube, pairs = dv.mesh.cube(2, size=0.1), dv.PairBarrier(kappa=1e3, dhat=0.04, self_contact=False, detections=1)
    mesh = dv.mesh.join([cube, cube.translate((0.01, 0.115, 0.005))])
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), pairs))
    x, v = model.rest_points.repeat(2, 1, 1), torch.from_numpy(generator("beside").normal(0, 0.3, (2, 16, 3)))
    x[1, 8:, 1], v[:, 8:, 1] = x[1, 8:, 1] + 1, v[:, 8:, 1] - 1
    found, solver = [], dv.VBD(0.01, 5, integrator=integrator, regularization=tau)
    for scenes in (2, 1):
        own, mu = v[:scenes].clone().requires_grad_(), torch.tensor(1e5, dtype=x.dtype, requires_grad=True)
        end = marched(model, x[:scenes], own, solver, 3, mu=mu, lam=1e5)[0][0]
        grads = torch.autograd.grad(end.square().sum(), (own, mu))
        found.append((end.detach(), grads[0][0], grads[1]))
    for beside, alone in zip(*found, strict=True):
        assert alone.abs().max() > 0 and relative_error(beside, alone) <= tolerance("solves_of_a_part")


@pytest.mark.parametrize("integrator", EVERY, ids=str)
def test_what_is_held_moves_evenly(integrator: Any) -> None:
    model = beam()
    x, pinned = model.rest_points, model.pinned
    speed = torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64)
    v, steps, h = torch.where(pinned[:, None], speed, 0.0), 5, 0.02
    where = torch.stack([x + (n + 1) * h * v for n in range(steps)])
    solver = vbd(h, 5, integrator)
    end, after = marched(model, x, v, solver, steps, prescribed=dv.per_step(where), **MATERIAL)
    assert torch.equal(end[pinned], where[-1][pinned])
    assert relative_error(after[pinned], v[pinned]) <= tolerance("travel")
    if isinstance(integrator, dv.SDIRK2):
        share = 1 - 1 / math.sqrt(2)
        even = dv.step(model, x, v, solver, prescribed=where[0], **MATERIAL)
        halves = (x + share * (where[0] - x), where[0])
        given = dv.step(model, x, v, solver, prescribed=halves, **MATERIAL)
        assert all(torch.equal(a, b) for a, b in zip(even, given, strict=True))


@pytest.mark.parametrize("integrator", (dv.ImplicitEuler(), dv.SDIRK2()), ids=str)
def test_a_converged_step(integrator: Any) -> None:
    model = beam()
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    mu = torch.tensor(1e5, dtype=x.dtype, requires_grad=True)
    solved = dv.solve(model, x, v, vbd(0.02, 0, integrator), mu=mu, lam=2e5)
    swept, _ = marched(model, x, v, vbd(0.02, 600, integrator), 1, mu=1e5, lam=2e5)
    assert solved.converged and relative_error(solved.x, swept) <= tolerance("global_converged")
    (grad,) = torch.autograd.grad(solved.x.square().sum(), mu)
    assert grad.abs() > 0


@pytest.mark.parametrize("integrator", SECOND, ids=str)
def test_single_precision(integrator: Any) -> None:
    """Far from the origin it is as near to double precision as implicit Euler is."""
    model = beam()
    single = model.to(dtype=torch.float32)
    x = model.rest_points + 20
    ends = [marched(m, x.to(m.dtype), torch.zeros_like(x).to(m.dtype), vbd(0.01, 10, integrator), 10,
                    **MATERIAL)[0].double() for m in (model, single)]  # fmt: skip
    assert relative_error(ends[1] - x, ends[0] - x) <= tolerance("float32_gradient")


def test_a_history_is_of_one_time_step() -> None:
    model = beam()
    x = model.rest_points
    history = dv.rollout(model, x, 0 * x, vbd(0.01, 1, dv.BDF2()), steps=1, **MATERIAL).history
    with pytest.raises(ValueError, match=r"history: expected one of a step of time_step 0.02 s .* got 0.01 s"):
        dv.rollout(model, x, 0 * x, vbd(0.02, 1, dv.BDF2()), history=history, steps=1, **MATERIAL)


def test_a_history_is_differentiable() -> None:
    model, solver = beam(), vbd(0.01, 3, dv.BDF2())
    x = model.rest_points
    first = dv.rollout(model, x, 0 * x, solver, steps=1, **MATERIAL)
    assert first.history is not None
    leaves = [t.clone().requires_grad_() for t in (first.history.moved, first.history.v)]
    history = first.history._replace(moved=leaves[0], v=leaves[1])
    end = dv.rollout(model, first.x[-1], first.v[-1], solver, steps=1, history=history, **MATERIAL)
    assert all(bool(bar.any()) for bar in torch.autograd.grad(end.x[-1].sum(), leaves))


def test_a_step_has_no_history() -> None:
    model = beam()
    for run in (dv.step, dv.solve):
        with pytest.raises(ValueError, match=r"^solver: expected ImplicitEuler\(\) or SDIRK2\(\) in a step: BDF2"):
            run(model, model.rest_points, 0 * model.rest_points, vbd(0.01, 1, dv.BDF2()), **MATERIAL)


def test_bad_integrators() -> None:
    for integrator, match in (("sdirk2", "integrator: expected .* got str"),
                              (dv.BDF2, "integrator: expected an object, BDF2")):  # fmt: skip
        with pytest.raises((TypeError, ValueError), match=match):
            vbd(0.01, 1, integrator)


@pytest.mark.parametrize(
    ("integrator", "options", "match"),
    [
        (dv.SDIRK2(), {"history": (1, 2)}, "history: expected None with SDIRK2"),
        (dv.BDF2(), {"history": (1, 2)}, "history: expected what a step with BDF2"),
        (dv.BDF2(), {"history": results.History(*[torch.zeros(1)] * 3, 0.01)}, "history.moved: expected shape"),
        (dv.ImplicitEuler(), {"prescribed": (torch.zeros(3), torch.zeros(3))}, "prescribed: expected"),
    ],
)
def test_bad_input(integrator: Any, options: dict[str, Any], match: str) -> None:
    model = beam()
    x = model.rest_points
    with pytest.raises((TypeError, ValueError), match=match):
        dv.rollout(model, x, torch.zeros_like(x), vbd(0.01, 1, integrator), steps=1, **MATERIAL, **options)


# --- bad input --------------------------------------------------------------------------------------------------------


CUBE = dv.mesh.cube(2, size=0.2)


def held(**options: Any) -> tuple[dv.Model, Tensor, Tensor]:
    model = dv.Model(CUBE, pinned=[0, 1], **options)
    return model, model.rest_points, torch.zeros_like(model.rest_points)


def taken(model: dv.Model, x: Tensor, v: Tensor, integrator: Any, way: str = "rollout", **options: Any) -> Tensor:
    """The end of a step, by dv.step or by a rollout."""
    solver = dv.VBD(0.01, 3, integrator=integrator)
    if way == "step":
        return dv.step(model, x, v, solver, mu=1e4, lam=1e4, **options)[0]
    return dv.rollout(model, x, v, solver, steps=1, mu=1e4, lam=1e4, **options).x[-1]


@pytest.mark.parametrize(
    ("name", "change", "got"),
    [
        ("history.moved", lambda h: {"moved": h.moved.float()}, "torch.float32"),
        ("history.v", lambda h: {"v": h.v.float()}, "torch.float32"),
        ("history.smooth", lambda h: {"smooth": h.smooth.double()}, "torch.float64"),
        ("history.smooth", lambda h: {"smooth": h.smooth.long()}, "torch.int64"),
        ("history.moved", lambda h: {"moved": h.moved.to("meta")}, "meta"),
        ("history.smooth", lambda h: {"smooth": h.smooth.to("meta")}, "meta"),
        ("history.moved", lambda h: {"moved": h.moved.to_sparse()}, "sparse"),
        ("history.moved", lambda h: {"moved": NAN * h.moved}, "nan"),
        ("history.v", lambda h: {"v": INF + h.v}, "inf"),
        ("history", lambda h: {"time_step": None}, "None"),
        ("history", lambda h: {"time_step": 0.0101}, "0.0101"),
    ],
)
def test_a_history_is_checked_like_a_state(name: str, change: Any, got: str) -> None:
    model, x, v = held()
    end = dv.rollout(model, x, v, dv.VBD(0.01, 3, integrator=dv.BDF2()), steps=1, mu=1e4, lam=1e4)
    assert end.history is not None and type(end.history.time_step) is float
    wrong = end.history._replace(**change(end.history))
    raises(lambda: taken(model, end.x[-1], end.v[-1], dv.BDF2(), history=wrong), name, got)


@pytest.mark.parametrize("integrator", (dv.ImplicitEuler(), dv.SDIRK2()), ids=str)
def test_colliders_that_are_not_finite_are_named(integrator: Any) -> None:
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e3, dhat=0.01))
    plane = colliders.Plane((0.0, -0.1, 0.0), (0.0, 1.0, 0.0))
    model, x, v = held(energies=energies, colliders=[plane])
    given = {"colliders": model.collider_points, "colliders_before": model.collider_points}
    for name in given:
        wrong = given | {name: NAN * model.collider_points}
        raises(lambda g=wrong: taken(model, x, v, integrator, "step", **g), name, "nan")


@pytest.mark.parametrize(("integrator", "way"), [(dv.SDIRK2(), "step"), *((i, "rollout") for i in SECOND)], ids=str)
def test_a_solve_that_is_lost_is_no_wrong_argument(integrator: Any, way: str) -> None:
    model, x, v = held(dtype=torch.float32)
    raises(lambda: taken(model, 1e20 * x, v, integrator, way), "x, v", "first solve")


@pytest.mark.parametrize("given", [tuple, lambda both: lambda step, x, v: both], ids=["constant", "function"])
def test_a_rollout_takes_prescribed_positions_of_two_solves(given: Any) -> None:
    model, x, v = held()
    ends = (x.clone(), x.clone())
    ends[0][:2, 1] += 0.001
    ends[1][:2, 1] += 0.002
    wanted = taken(model, x, v, dv.SDIRK2(), "step", prescribed=ends)
    assert torch.equal(taken(model, x, v, dv.SDIRK2(), prescribed=given(ends)), wanted)
    raises(lambda: taken(model, x, v, dv.ImplicitEuler(), prescribed=given(ends)), "prescribed", "2 with ImplicitEuler")
    for which in (0, 1):
        free = [end.clone() for end in ends]
        free[which][7] += 1
        raises(lambda p=tuple(free): taken(model, x, v, dv.SDIRK2(), prescribed=given(p)), "prescribed", "vertex 7")


def test_prescribed_positions_of_two_solves_are_watched() -> None:
    model, x, v = held()
    ends = (x.clone(), x.clone())
    mu = torch.tensor(1e4, dtype=x.dtype, requires_grad=True)
    solver = dv.VBD(0.01, 3, integrator=dv.SDIRK2())
    end = dv.rollout(model, x, v, solver, steps=4, checkpoint_every=2, prescribed=ends, mu=mu, lam=1e4)
    ends[0].add_(1)
    with pytest.raises(RuntimeError, match="prescribed: changed in place"):
        end.x.sum().backward()
