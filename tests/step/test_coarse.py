"""Claim: coarse corrections bring stiff bodies near converged steps in a few sweeps, raise no potential, keep momentum,
and are refused where they are not known to be right."""

import itertools
from typing import Any

import pytest
import torch
from helpers.marks import slow
from helpers.spreads import assert_near_reference
from torch import Tensor

import diffvbd as dv
from diffvbd import reference, testing
from diffvbd.model.system import system_of
from diffvbd.testing import CASES, build_scene, evaluate, relative_error, tolerance

MODULI = {"mu": 1e7, "lam": 1e7}


def cantilever() -> dv.Model:
    mesh = dv.mesh.box((13, 4, 4), (1.0, 0.2, 0.2))
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9)


def solver_of(sweeps: int, subspace: Any = "coarse") -> dv.VBD:
    return dv.VBD(1 / 60, sweeps, relaxation=1.5, subspace=subspace)


def end(model: dv.Model, solver: dv.VBD) -> Tensor:
    x = model.rest_points
    return dv.rollout(model, x, torch.zeros_like(x), solver, steps=10, save="last", **MODULI).x[-1]


def test_a_stiff_cantilever_in_four_sweeps() -> None:
    model = cantilever()
    goal = end(model, solver_of(60))
    motion = (goal - model.rest_points).abs().max()
    x, v = goal, torch.zeros_like(goal)
    after, _ = dv.step(model, x, v, solver_of(60), **MODULI)
    solved = dv.solve(model, x, v, solver_of(0), tolerance=1e-10, **MODULI)  # which looks at the forces that are left
    assert relative_error(after - x, solved.x - x) <= tolerance("closed_form")
    swept = dv.solve(model, x, v, solver_of(0), tolerance=1e-10, adjoint=dv.ReverseSweep(), **MODULI)
    assert swept.converged
    assert relative_error(swept.x - x, solved.x - x) <= tolerance("closed_form")
    error = {k: float((end(model, solver_of(k)) - goal).abs().max() / motion) for k in (4, 10)}
    plain = float((end(model, solver_of(20, "rigid")) - goal).abs().max() / motion)
    assert error[4] < 0.01 and error[10] < error[4] / 100 and plain > 0.1, (error, plain)


@pytest.mark.parametrize("case", ("inverted", "violent", "huge_strain", "contrast", "floor_filtered"))
@pytest.mark.parametrize("sweeps", (0, 5))
def test_no_step_ends_above_its_start(case: str, sweeps: int) -> None:
    scene = build_scene(case, "structured", "small")
    model, inputs = scene.model(), scene.inputs()
    with torch.no_grad():
        begun, _ = dv.step(model, solver=scene.solver(0, start="inertia"), **inputs)
        ended, _ = dv.step(model, solver=scene.solver(sweeps, subspace="coarse"), **inputs)
        potential = [_potential(model, at, inputs, scene.case.time_step) for at in (begun, ended)]
    assert not torch.equal(begun, ended) or case == "huge_strain"
    assert potential[1] <= potential[0] * (1 + tolerance("energy_gain")), potential


def _potential(model: dv.Model, x: Tensor, inputs: dict[str, Any], h: float) -> float:
    given = {name: inputs[name] for name in ("mu", "lam", "rest_points", "density")}
    parameters = {name: value for name, value in inputs.items() if name.startswith(("floor_", "anchor_"))}
    load = inputs["gravity"] + inputs["force"] / model.mass[:, None]
    y = torch.where(model.pinned[:, None], inputs["prescribed"], inputs["x"] + h * inputs["v"] + h * h * load)
    return float(reference.incremental_potential(model, x, y, x_prev=inputs["x"], time_step=h, parameters=parameters,
                                                 **given))  # fmt: skip


def test_momentum_of_a_free_body() -> None:
    mesh = dv.mesh.box((5, 4, 4), (0.3, 0.15, 0.15))
    model = dv.Model(mesh)
    wave = torch.sin(40 * model.rest_points.flip(-1))
    x, v = model.rest_points + 0.01 * wave, torch.cos(30 * model.rest_points)
    x_end, v_end = dv.step(model, x, v, solver_of(4), mu=1e6, lam=1e6, gravity=(0.0, 0.0, 0.0))
    mass = model.mass[:, None]
    before, after = (mass * v).sum(0), (mass * v_end).sum(0)
    assert relative_error(after, before) <= tolerance("sum")
    # implicit Euler: L' - L = h sum m v' x v, to what the sweeps have left
    arm = x - (mass * x).sum(0) / mass.sum()
    spin = torch.linalg.cross(arm, mass * v).sum(0)
    arm = x_end - (mass * x_end).sum(0) / mass.sum()
    change = torch.linalg.cross(arm, mass * v_end).sum(0) - spin
    expected = torch.linalg.cross(v_end, mass * v).sum(0) / 60
    assert (change - expected).abs().max() <= tolerance("momentum") * spin.abs().max()


def test_same_bits_on_one_thread_and_on_two() -> None:
    mesh = dv.mesh.box((16, 16, 16), (1.0, 1.0, 1.0))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9)
    x = model.rest_points.requires_grad_()
    threads, found = torch.get_num_threads(), []
    try:
        for n in (1, 2):
            torch.set_num_threads(n)
            x_end, v_end = dv.step(model, x, torch.zeros_like(x), solver_of(8), mu=1e6, lam=1e6)
            (bar,) = torch.autograd.grad(x_end.square().sum() + v_end.square().sum(), x)
            found.append((x_end.detach(), bar))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(one, two) for one, two in zip(*found, strict=True)) and found[0][1].abs().max() > 0


def test_scenes_and_bodies_do_not_mix() -> None:
    """A batch is its scenes one by one, and two bodies far apart are what each is alone."""
    one = dv.mesh.box((4, 4, 4), (0.2, 0.2, 0.2))
    two = dv.mesh.join([one, dv.mesh.box((5, 3, 3), (0.4, 0.1, 0.1)).translate((3.0, 0.0, 0.0))])
    given: dict[str, Any] = {"mu": 1e6, "lam": 1e6, "solver": solver_of(5, dv.CoarseSpace(functions=10))}
    model, alone = dv.Model(two), dv.Model(one)
    x = torch.stack([model.rest_points, model.rest_points * 1.05])
    ends, _ = dv.step(model, x, torch.zeros_like(x), **given)
    for scene in range(2):
        single, _ = dv.step(model, x[scene], torch.zeros_like(x[scene]), **given)
        assert torch.equal(ends[scene], single)
        part = x[scene, : one.num_vertices]
        own, _ = dv.step(alone, part, torch.zeros_like(part), **given)
        assert relative_error(single[: one.num_vertices], own) <= tolerance("coarse_forward")


def test_float32_is_near_float64() -> None:
    model = cantilever()
    single = end(model.to(dtype=torch.float32), solver_of(5))
    assert single.dtype == torch.float32
    assert relative_error(single, end(model, solver_of(5))) <= tolerance("float32_forward")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"subspace": "yes"}, 'subspace: expected "rigid", "coarse", a diffvbd.CoarseSpace or None'),
        ({"saturation": 0.1}, "subspace: expected no coarse space with saturation"),
        ({"block": "paper"}, 'subspace: expected no coarse space with block="paper"'),
    ],
)
def test_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        dv.VBD(**{"time_step": 0.01, "sweeps": 1, "subspace": "coarse", **options})


def test_refused_without_an_elastic_law() -> None:
    model = dv.Model(dv.mesh.cube(3), energies=())
    with pytest.raises(ValueError, match="subspace: expected no coarse space without StableNeoHookean"):
        dv.step(model, model.rest_points, 0 * model.rest_points, solver_of(1))


@pytest.mark.parametrize("options", [{"functions": 0}, {"degree": 4}, {"every": 0}, {"groups": "many"}])
def test_bad_spaces(options: dict[str, Any]) -> None:
    (name,) = options
    with pytest.raises((ValueError, TypeError), match=f"{name}: expected"):
        dv.CoarseSpace(**options)


def test_transforms_are_refused() -> None:
    model = cantilever()
    x = model.rest_points
    with pytest.raises(NotImplementedError, match="coarse corrections"):
        torch.func.vmap(lambda y: dv.step(model, y, 0 * y, solver_of(2), **MODULI)[0])(torch.stack([x, x]))


def test_no_more_functions_than_asked_for() -> None:
    thin, thick = dv.mesh.box((6, 6, 2), (1.0, 1.0, 0.01)), dv.mesh.box((5, 5, 5), (1.0, 1.0, 1.0))
    for mesh in (thin, thick):
        for functions in (1, 5, 10, 40):
            for degree in (1, 2, 3):
                solver = solver_of(1, dv.CoarseSpace(functions=functions, degree=degree))
                geometry = system_of(dv.Model(mesh), solver).coarse_geometry
                assert 0 < int((~geometry.filling).sum()) <= functions


def test_a_refused_correction_leaves_no_trace() -> None:
    """In float32 the matrix of a stiff free body may have no factor: its corrections are refused, the other body's are
    not, and nothing becomes NaN."""
    one = dv.mesh.box((5, 4, 4), (0.2, 0.2, 0.2))
    two = dv.mesh.join([one, one.translate((3.0, 0.0, 0.0))])
    model = dv.Model(two, dtype=torch.float32)
    wave = 0.01 * torch.sin(30 * model.rest_points.flip(-1))
    stiff = torch.arange(model.num_tets) < one.num_tets
    mu = torch.where(stiff, 1e13, 1e5).requires_grad_()
    x = (model.rest_points + wave).requires_grad_()
    with dv.record("subspace") as lengths:
        solver = dv.VBD(1 / 60, 4, subspace=dv.CoarseSpace(functions=20))
        x_end, v_end = dv.step(model, x, torch.zeros_like(x), solver, mu=mu, lam=mu.detach())
    assert (lengths[0][..., 0] == 0).any() and (lengths[0][..., 1] > 0).all(), lengths
    bars = torch.autograd.grad(x_end.sum() + v_end.square().sum(), (x, mu))
    assert all(torch.isfinite(t).all() for t in (x_end, v_end, *bars)) and bars[0].abs().max() > 0


# --- exactness --------------------------------------------------------------------------------------------------------


EXACT = [name for name, case in CASES.items() if case.block == "exact" and case.saturation is None]
SPACES = (dv.CoarseSpace(functions=10, groups=3), dv.CoarseSpace(functions=4, groups=1, every=2), dv.CoarseSpace())
SWEEPS = (0, 1, 3, 5, 20)


def compiled(model: Any, inputs: dict, solver: dv.VBD, steps: int) -> tuple[dict[str, Tensor], list[Tensor]]:
    lengths = []

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        nonlocal lengths
        with dv.record("subspace") as lengths:
            end = dv.rollout(model, solver=solver, steps=steps, save="last", **options)
        return end.x[-1], end.v[-1]

    return evaluate(run, inputs, solver.time_step), lengths


def recorded(model: Any, inputs: dict, lengths: list[Tensor]) -> list[Tensor]:
    """[corrections, ..., bodies] of each step, as the reference takes them."""
    lead = inputs["x"].shape[:-2]
    return [t.transpose(0, 1).reshape(t.shape[1], *lead, t.shape[2]) for t in lengths]


def check(device: str, case: str, kind: str, space: dv.CoarseSpace, sweeps: int, steps: int, tape: str
          ) -> list[Tensor]:  # fmt: skip
    scene = build_scene(case, kind, "small")
    model, inputs = scene.model(device), scene.inputs(device=device)
    solver = scene.solver(sweeps, subspace=space, tape=tape)
    result, lengths = compiled(model, inputs, solver, steps)
    assert len(lengths) == steps and all(t.shape[1] == space.corrections(sweeps) for t in lengths)
    given = recorded(model, inputs, lengths)
    expected = assert_near_reference(model, inputs, solver, steps, result, given)
    for name, value in expected.items():
        if name in ("grad_x", "grad_v") or (name in ("grad_mu", "grad_density") and (sweeps or lengths[0].any())):
            assert value.abs().max() > 0, name
    return lengths


def rows() -> list[Any]:
    """Each case once, with space, sweeps, mesh and tape in turn; the others are slow."""
    out = []
    for i, (case, (j, sweeps)) in enumerate(itertools.product(EXACT, enumerate(SWEEPS))):
        at = (case, testing.KINDS[(i + j) % 3], (i + j) % len(SPACES), sweeps, (1, 2)[i % 2],
              ("full", "compact", "recompute")[(i // 2) % 3])  # fmt: skip
        quick = j == EXACT.index(case) % len(SWEEPS) or case in ("plain", "free")
        out.append(at if quick else slow(*at))
    return out


@pytest.mark.parametrize(("case", "kind", "space", "sweeps", "steps", "tape"), rows())
def test_step_and_rollout(device: str, case: str, kind: str, space: int, sweeps: int, steps: int, tape: str) -> None:
    check(device, case, kind, SPACES[space], sweeps, steps, tape)


def test_lengths_below_one_and_zero_occur(device: str) -> None:
    """What the comparison above is worth: shortened and refused corrections are among its steps."""
    found = torch.cat([lengths.reshape(-1)
                       for case in ("inverted", "violent", "floor_filtered", "huge_strain")
                       for lengths in check(device, case, "structured", SPACES[0], 8, 2, "full")])  # fmt: skip
    assert (found == 1).any() and ((found > 0) & (found < 1)).any() and (found == 0).any(), found
