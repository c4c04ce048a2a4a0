"""Claim: XPBD and projective dynamics are their formulas, and their gradients those of the executed sweeps.

The references are plain torch, written apart from the package and differentiated by autograd. The forward is compared
first. Networks are the edges and tets of meshes of the unit cube, bent smoothly, so that no tet inverts: the iteration
by which the reference finds the closest rotation needs that.
"""

import functools
from typing import Any

import numpy as np
import pytest
import torch
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd import solvers, testing
from diffvbd.reference import projective_dynamics as reference_pd
from diffvbd.reference import xpbd as reference_xpbd
from diffvbd.solvers import XPBD, ProjectiveDynamics
from diffvbd.testing import evaluate, generator, on_device, relative_error, tolerance

H = 1 / 60
RUNS = [(1, 1), (5, 1), (20, 1), (1, 3), (5, 3), slow(20, 3)]  # sweeps and steps
LONGER = (("small", 20), ("medium", 5), ("medium", 20))  # slow where each constraint is an update of its own

# names of the solvers, how each is made from a mesh, and with what
KINDS = {"xpbd": {}, "springs": {"springs": True, "tets": False}, "tets": {}, "both": {"springs": True}}
MADE = {"xpbd": XPBD.from_mesh} | dict.fromkeys(("springs", "tets", "both"), ProjectiveDynamics.from_mesh)


@functools.cache
def mesh_of(size: str) -> dv.TetMesh:
    return dv.TetMesh(*testing.build_mesh("delaunay", size))


def held(mesh: dv.TetMesh) -> np.ndarray:
    return mesh.points[:, 0] < 0.2


def inputs_of(mesh: dv.TetMesh, solver: Any, batch: tuple = ()) -> dict[str, Any]:
    """A smooth deformation and velocity; stiffness, lengths and masses that differ from one to the next."""
    rng = generator("networks", mesh.num_vertices)
    waves = [rng.uniform(-1.5, 1.5, (2, 3, 3)), rng.uniform(0, 6, (2, *batch, 1, 3))]
    x, v = (np.sin(mesh.points @ waves[0][k] + waves[1][k]) for k in (0, 1))
    x, v = mesh.points + 0.1 * x, 2 * v
    arrays = {"x": x, "v": v, "prescribed": x + H * v, "force": rng.uniform(-1, 1, (mesh.num_vertices, 3))}
    arrays["mass"] = solver.mass.numpy() * rng.uniform(0.9, 1.1, mesh.num_vertices)
    if count := len(solver.edges):
        arrays["stiffness"] = 10 ** rng.uniform(3.5, 4.5, count)
        arrays["rest_length"] = solver.rest_length.numpy() * rng.uniform(0.8, 1.2, count)
    if isinstance(solver, ProjectiveDynamics) and (count := len(solver.tets.nodes)):
        arrays["tet_stiffness"] = 10 ** rng.uniform(4.5, 5.5, count)
    gravity = torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64)
    return {name: torch.from_numpy(a) for name, a in arrays.items()} | {"gravity": gravity, "time_step": H}


def repeated(step: Any, steps: int, **options: Any) -> Any:
    def run(x: Tensor, v: Tensor, **given: Any) -> tuple[Tensor, Tensor]:
        for _ in range(steps):
            x, v = step(x, v, **given, **options)
        return x, v

    return run


def reference_step(solver: Any) -> Any:
    shared = {"edges": solver.edges.cpu(), "pinned": solver.pinned.cpu()}
    if isinstance(solver, XPBD):
        return functools.partial(reference_xpbd.step, groups=[g.cpu() for g in solver.groups], **shared)
    absent: dict[str, Any] = {} if len(solver.edges) else {"stiffness": 0.0, "rest_length": 0.0}
    absent |= {} if len(solver.tets.nodes) else {"tet_stiffness": 0.0}
    rest = {"rest_points": solver.rest_points.cpu(), "tets": solver.tets.nodes.cpu()}
    return functools.partial(reference_pd.step, **shared, **rest, **absent)


def check(solver: Any, inputs: dict[str, Any], sweeps: int, steps: int = 1) -> dict[str, Tensor]:
    """Compares a solver, on its device, with its reference on the CPU."""
    expected = evaluate(repeated(reference_step(solver), steps, sweeps=sweeps), inputs)
    given = on_device(inputs, solver.mass.device)
    found = on_device(evaluate(repeated(solver.step, steps, sweeps=sweeps), given), "cpu")
    assert relative_error(found["x"], expected["x"]) <= tolerance("forward")
    # a velocity is a difference of positions over h, and so is its error
    error = (found["v"] - expected["v"]).abs().max() * H / expected["x"].abs().max()
    assert float(error) <= tolerance("forward") and found["v"].any()
    bar = tolerance("other_solvers" if steps == 1 else "other_solvers_rollout")
    for name in found:
        if name.startswith("grad_"):
            error = relative_error(found[name], expected[name])
            assert error <= bar, f"{name}: {error:.1e} > {bar:.0e}"
            assert found[name].any(), f"{name} is zero"
            assert found[name].shape == inputs[name[5:]].shape
    return found


# --- against the references -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sweeps", "steps"), RUNS)
@pytest.mark.parametrize("size", ["small", "medium"])
def test_xpbd(size: str, sweeps: int, steps: int, device: str) -> None:
    mesh = mesh_of(size)
    solver = XPBD.from_mesh(mesh, pinned=held(mesh), device=device)
    check(solver, inputs_of(mesh, XPBD.from_mesh(mesh)), sweeps, steps)


@pytest.mark.parametrize(("size", "sweeps"), [("small", 1), ("small", 5), ("medium", 1), *(slow(*m) for m in LONGER)])
def test_xpbd_one_constraint_after_another(size: str, sweeps: int, device: str) -> None:
    mesh = mesh_of(size)
    solver = XPBD.from_mesh(mesh, pinned=held(mesh), order="sequential", device=device)
    assert all(group.numel() == 1 for group in solver.groups)
    check(solver, inputs_of(mesh, XPBD.from_mesh(mesh)), sweeps)


@pytest.mark.parametrize(("sweeps", "steps"), RUNS)
@pytest.mark.parametrize("size", ["small", "medium"])
@pytest.mark.parametrize("kind", ["springs", "tets", "both"])
def test_projective_dynamics(kind: str, size: str, sweeps: int, steps: int, device: str) -> None:
    mesh = mesh_of(size)
    solver = MADE[kind](mesh, pinned=held(mesh), **KINDS[kind], device=device)
    inputs = inputs_of(mesh, MADE[kind](mesh, **KINDS[kind]))
    check(solver, inputs, sweeps, steps)


def test_colors_are_the_sequential_sweep_in_their_order() -> None:
    mesh = mesh_of("small")
    colored = XPBD.from_mesh(mesh, pinned=held(mesh))
    order = torch.cat(colored.groups)
    listed = XPBD(mesh.points, colored.edges[order], colored.mass, held(mesh), "sequential")
    for group in colored.groups:
        assert colored.edges[group].unique().numel() == 2 * group.numel()
    inputs = inputs_of(mesh, colored)
    same = inputs | {name: inputs[name][order] for name in ("stiffness", "rest_length")}
    found, expected = (evaluate(repeated(s.step, 1, sweeps=3), i) for s, i in ((colored, inputs), (listed, same)))
    for name in expected:
        value = found[name][order] if name in ("grad_stiffness", "grad_rest_length") else found[name]
        assert (
            relative_error(value, expected[name])
            <= (tolerance("other_solvers") if name != "x" else tolerance("forward"))
            and value.any()
        )


@pytest.mark.parametrize("kind", ["xpbd", "both"])
def test_batches(kind: str, device: str) -> None:
    mesh = mesh_of("small")
    solver = MADE[kind](mesh, pinned=held(mesh), device=device, **KINDS[kind])
    inputs = inputs_of(mesh, MADE[kind](mesh, **KINDS[kind]), batch=(2, 2))
    assert inputs["x"].shape == (2, 2, mesh.num_vertices, 3)
    check(solver, inputs, 3)
    own = torch.tensor([[1.0], [1.5]]).double()[:, None]  # a value per first index, shared by the second
    inputs |= {name: inputs[name] * own for name in ("stiffness", "tet_stiffness", "mass") if name in inputs}
    found = check(solver, inputs | {"rest_length": inputs["rest_length"] * own}, 3)
    assert found["grad_stiffness"].shape == (2, 1, len(solver.edges))


@pytest.mark.parametrize("kind", ["xpbd", "both"])
def test_float32(kind: str) -> None:
    mesh = mesh_of("small")
    solver, single = (MADE[kind](mesh, dtype=t, **KINDS[kind]) for t in (torch.float64, torch.float32))
    inputs = inputs_of(mesh, solver)
    expected = evaluate(repeated(solver.step, 1, sweeps=3), inputs)
    inputs = {name: t.float() if isinstance(t, Tensor) else t for name, t in inputs.items()}
    found = evaluate(repeated(single.step, 1, sweeps=3), inputs)
    assert found["grad_x"].dtype == torch.float32 and found["grad_x"].any()
    assert relative_error(found["x"], expected["x"]) <= tolerance("float32_forward")
    assert relative_error(found["grad_x"], expected["grad_x"]) <= tolerance("float32_gradient")


# --- pins, degenerate places ------------------------------------------------------------------------------------------


def test_closest_rotation() -> None:
    """Through SVD, which autograd can do where no two squares of singular values meet; det F > 0 and < 0."""
    rng = generator("rotation")
    points, corners = testing.structured((1, 1, 1))
    tets = solvers.ProjectiveDynamics(points, 1.0, tets=corners).tets
    f, bar = (torch.from_numpy(rng.standard_normal((40, 3, 3))) for _ in range(2))
    leaf = f.clone().requires_grad_()
    u, _, vt = torch.linalg.svd(leaf)
    flip = torch.diag_embed(
        torch.stack((*[torch.ones(40).double()] * 2, torch.linalg.det(u @ vt).detach().round()), -1)
    )
    rotation = u @ flip @ vt
    (expected,) = torch.autograd.grad((bar * rotation).sum(), leaf)
    assert (torch.linalg.det(f) < 0).any() and (torch.linalg.det(f) > 0).any()
    assert relative_error(tets.project(f), rotation) <= tolerance("forward")
    assert torch.allclose(torch.linalg.det(tets.project(f)), torch.ones(40).double())
    found = tets.project_vjp(f, bar)
    assert relative_error(found, expected) <= tolerance("adjoint") and found.any()


def degenerate() -> tuple:
    points, corners = testing.structured((1, 1, 1))
    return points, 1.0, None, corners


# --- physics ----------------------------------------------------------------------------------------------------------


def test_xpbd_without_compliance_keeps_lengths() -> None:
    """A chain that swings from its first particle: the more sweeps, the less it stretches."""
    points = torch.zeros(6, 3, dtype=torch.float64)
    points[:, 0] = torch.linspace(0, 1, 6)
    chain = XPBD(points, [[k, k + 1] for k in range(5)], 0.1, pinned=[0])
    assert chain.rest_length is not None and len(chain.groups) == 2
    stretched = []
    for sweeps in (2, 20, 200, 1000):
        x, v = points, torch.zeros_like(points)
        for _ in range(3):
            x, v = chain.step(x, v, stiffness=float("inf"), time_step=H, sweeps=sweeps)
        stretched.append(float(((x[1:] - x[:-1]).norm(dim=-1) / chain.rest_length - 1).abs().max()))
    assert (
        stretched == sorted(stretched, reverse=True)
        and stretched[0] > 1e-3
        and stretched[-1] < tolerance("rigid_links")
    )


@pytest.mark.slow
def test_projective_dynamics_converges_to_the_minimum_of_its_energy() -> None:
    mesh = mesh_of("small")
    solver = ProjectiveDynamics.from_mesh(mesh, pinned=held(mesh), springs=True)
    given = inputs_of(mesh, solver)
    found, _ = solver.step(**given, sweeps=300)
    free, mass = ~solver.pinned, given["mass"]
    y = given["x"] + H * given["v"] + H**2 * (given["gravity"] + given["force"] / mass[:, None])
    affine = torch.cat((torch.ones(mesh.num_tets, 4, 1).double(), torch.from_numpy(mesh.points[mesh.tets])), -1)
    gradient = torch.linalg.inv(affine)[:, 1:]
    unknown = given["x"][free].clone().requires_grad_()

    def energy() -> Tensor:
        """1/2 m |x - y|^2 + h^2 (sum k/2 (|d| - L)^2 + sum w/2 |F - R|^2), |F - R|^2 = sum (s - 1)^2."""
        x = given["prescribed"].index_put((free.nonzero()[:, 0],), unknown)
        d = (x[solver.edges[:, 0]] - x[solver.edges[:, 1]]).norm(dim=-1)
        s = torch.linalg.svdvals((gradient @ x[torch.from_numpy(mesh.tets.copy())]).transpose(-1, -2))
        springs = (given["stiffness"] / 2 * (d - given["rest_length"]) ** 2).sum()
        tets = (given["tet_stiffness"] * torch.from_numpy(mesh.volume.copy()) / 2 * ((s - 1) ** 2).sum(-1)).sum()
        return (mass[free, None] / 2 * (unknown - y[free]) ** 2).sum() + H**2 * (springs + tets)

    stop = {"max_iter": 500, "tolerance_grad": 1e-11, "tolerance_change": 0}
    search = torch.optim.LBFGS([unknown], **stop, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        search.zero_grad()
        value = energy()
        value.backward()
        return value

    search.step(closure)
    assert float((unknown - given["x"][free]).detach().abs().max()) > 1e-2
    assert relative_error(found[free], unknown) <= tolerance("minimum")
    with torch.no_grad():
        inertia = mass[free, None] * (found - y)[free]
        unknown.copy_(found[free])
    (left,) = torch.autograd.grad(energy(), unknown)
    assert float(left.abs().max()) <= tolerance("block_residual") * float(inertia.abs().max())
