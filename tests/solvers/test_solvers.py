"""Claim: XPBD and projective dynamics are their formulas, and their gradients those of the executed sweeps.

The references are plain torch, written apart from the package and differentiated by autograd. The forward is compared
first. Networks are the edges and tets of meshes of the unit cube, bent smoothly, so that no tet inverts: the iteration
by which the reference finds the closest rotation needs that.
"""

import functools
import re
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
    expected = evaluate(repeated(reference_step(solver), steps, sweeps=sweeps), inputs, H)
    given = on_device(inputs, solver.mass.device)
    found = on_device(evaluate(repeated(solver.step, steps, sweeps=sweeps), given, H), "cpu")
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
    found, expected = (evaluate(repeated(s.step, 1, sweeps=3), i, H) for s, i in ((colored, inputs), (listed, same)))
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
    expected = evaluate(repeated(solver.step, 1, sweeps=3), inputs, H)
    inputs = {name: t.float() if isinstance(t, Tensor) else t for name, t in inputs.items()}
    found = evaluate(repeated(single.step, 1, sweeps=3), inputs, H)
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


# --- factors of projective dynamics -----------------------------------------------------------------------------------


MESH = dv.mesh.cube(3, size=0.5)


def body(device: str = "cpu") -> ProjectiveDynamics:
    """Springs and tets, held where x < 0.1 m."""
    return ProjectiveDynamics.from_mesh(MESH, pinned=MESH.points[:, 0] < 0.1, springs=True, device=device)


def constants(solver: ProjectiveDynamics) -> dict[str, Tensor]:
    """What a factor is made of, one value for each spring, tet and particle."""
    rng = generator("factor")
    sizes = {"stiffness": len(solver.edges), "tet_stiffness": MESH.num_tets}
    found = {name: 10 ** rng.uniform(3.5, 4.5, n) for name, n in sizes.items()}
    return {name: torch.from_numpy(a).to(solver.mass.device) for name, a in found.items()} | {"mass": solver.mass * 1.1}


def state(device: str = "cpu") -> dict[str, Tensor]:
    x = torch.from_numpy(MESH.points.copy()).to(device)
    return {"x": x * x.new_tensor([1.2, 0.9, 1.0]), "v": torch.sin(5 * x)}


def test_a_factor_serves_many_steps(device: str) -> None:
    solver = body(device)
    given = constants(solver)

    def run(x: Tensor, v: Tensor, time_step: float, *, once: bool, **own: Tensor) -> tuple[Tensor, Tensor]:
        options: dict[str, Any] = own | {"time_step": time_step}
        if once:
            options = {"factor": solver.factor(**options)}
            assert not options["factor"].lower.requires_grad
        for _ in range(3):
            x, v = solver.step(x, v, sweeps=2, **options)
        return x, v

    inputs = state(device) | given | {"time_step": H}
    found, expected = (evaluate(lambda once=once, **i: run(once=once, **i), inputs, H) for once in (True, False))
    assert all(torch.equal(found[n], expected[n]) for n in ("x", "v"))
    assert all(relative_error(found[n], expected[n]) <= tolerance("other_solvers") and found[n].any() for n in found)


def optimizers(leaf: Tensor) -> list[torch.optim.Optimizer]:
    kinds: list[dict[str, Any]] = [{"foreach": False}, {"foreach": True}]
    if not leaf.is_cuda:
        kinds.append({"fused": True})  # which torch does not count as a change: seen by values
    return [torch.optim.Adam([leaf], lr=0.01 * float(leaf.detach().mean()), **kind) for kind in kinds]


@pytest.mark.parametrize("shape", ["scalar", "each"])
@pytest.mark.parametrize("name", ["stiffness", "tet_stiffness", "mass"])
def test_a_factor_of_values_that_have_changed_is_refused(name: str, shape: str, device: str) -> None:
    """Forward and gradient would mix the matrix of the old values with the new ones."""
    solver = body(device)
    given = constants(solver)
    leaf = (given[name] if shape == "each" else given[name].mean()).clone().requires_grad_()
    refused = f"^{name}: expected the values that were factored.*factor again"
    ends = []
    for optimizer in optimizers(leaf):
        factor = solver.factor(time_step=H, **(given | {name: leaf}))
        for _ in range(2):  # what does not change them leaves the factor as it is
            end, _ = solver.step(**state(device), factor=factor, sweeps=2)
        optimizer.zero_grad()
        (end**2).sum().backward()
        assert leaf.grad is not None and leaf.grad.any()
        optimizer.step()
        for mode in (torch.enable_grad(), torch.no_grad(), torch.inference_mode()):
            with mode, pytest.raises(ValueError, match=refused):
                solver.step(**state(device), factor=factor, sweeps=2)
        ends.append(end.detach())
    assert all(not torch.equal(ends[0], end) for end in ends[1:])


def test_views_of_what_has_changed_are_refused_too() -> None:
    solver = body()
    given = constants(solver)
    both = torch.stack((given["stiffness"], given["stiffness"]))
    factor = solver.factor(time_step=H, **(given | {"stiffness": both[1]}))
    both.mul_(2)
    with pytest.raises(ValueError, match="stiffness: expected the values that were factored"):
        solver.step(**state(), factor=factor, sweeps=1)
    factor = solver.factor(time_step=H, stiffness=1e3, tet_stiffness=1e4)
    solver.mass.mul_(2)  # None stands for it
    with pytest.raises(ValueError, match="mass: expected the values that were factored"):
        solver.step(**state(), factor=factor, sweeps=1)


# --- bad input --------------------------------------------------------------------------------------------------------


TETS = dv.mesh.cube(split="kuhn")  # 8 vertices, 6 tets, 19 edges
X = torch.from_numpy(TETS.points.copy())
NAN = torch.where(torch.arange(8)[:, None] == 2, torch.nan, X)
INF = float("inf")
LEAF = torch.tensor(0.01, dtype=torch.float64, requires_grad=True)
GIVEN = {"x": X, "v": torch.zeros_like(X), "stiffness": 1e3, "time_step": 0.01, "sweeps": 1}


def xpbd(**changes: Any) -> Any:
    return XPBD.from_mesh(TETS).step(**(GIVEN | changes))


def pd(**changes: Any) -> Any:
    return ProjectiveDynamics.from_mesh(TETS, springs=True).step(**(GIVEN | {"tet_stiffness": 1e4} | changes))


FACTOR = ProjectiveDynamics.from_mesh(TETS).factor(time_step=0.01, tet_stiffness=1.0)
BAD: list[tuple[Any, str]] = [
    *[(lambda s=s: s(x=X[:5]), r"x: expected shape \[..., 8, 3\], got shape \[5, 3\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(x=X.float()), "x: expected dtype .*64 .the solver's., got torch.float32") for s in (xpbd, pd)],
    *[(lambda s=s: s(v=X[None]), r"v: expected x's shape \[8, 3\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(time_step=0.0), "time_step: expected a finite number > 0 s, got 0") for s in (xpbd, pd)],
    *[(lambda s=s: s(sweeps=1.5), "sweeps: expected an integer, got float 1.5") for s in (xpbd, pd)],
    *[(lambda s=s: s(force=X[:, :2]), r"force: expected a shape that broadcasts to \[8, 3\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(gravity=9.81), "gravity: expected 3 numbers or a tensor, got 9.81") for s in (xpbd, pd)],
    *[(lambda s=s: s(prescribed=[0.0]), "prescribed: expected a number or a tensor, got list") for s in (xpbd, pd)],
    *[(lambda s=s: s(mass=0.0), "mass: expected finite numbers > 0 kg where not pinned, got 0.0") for s in (xpbd, pd)],
    *[(lambda s=s: s(stiffness=X), r"stiffness: expected a shape that broadcasts to \[.*19\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(rest_length=-1.0), "rest_length: expected finite numbers >= 0, got -1.0") for s in (xpbd, pd)],
    *[(lambda s=s, n=n: s(**{n: NAN}), rf"{n}: expected finite values, got nan at \[2, 0\]")
      for s in (xpbd, pd) for n in ("x", "v", "force", "gravity")],
    *[(lambda k=k, o=o: k.from_mesh(TETS, pinned=[2]).step(**(GIVEN | o), prescribed=NAN), "prescribed: .*finite")
      for k, o in ((XPBD, {}), (ProjectiveDynamics, {"stiffness": None, "tet_stiffness": 1e4}))],
    *[(lambda s=s: s(gravity=(0.0, INF, 0.0)), r"gravity: expected finite .* inf at \[0, 1\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(v=X + 1e307, time_step=1e3, force=X), "x, v, force, mass, time_step: expected a finite predictor")
      for s in (xpbd, pd)],
    *[(lambda s=s: s(rest_length=INF), "rest_length: expected finite numbers >= 0, got inf") for s in (xpbd, pd)],
    *[(lambda s=s: s(stiffness=float("nan")), "stiffness: expected .*numbers >.* got nan") for s in (xpbd, pd)],
    *[(lambda s=s: s(time_step=LEAF), "time_step: expected a number, got a tensor that requires") for s in (xpbd, pd)],
    *[(lambda s=s, h=h: s(time_step=h), f"time_step: .* whose square lies between .*, got {h}".replace("+", r"\+"))
      for s in (xpbd, pd) for h in (1e-170, 1e170)],
    (lambda: xpbd(stiffness=1e-305, time_step=1e-3), "stiffness: expected numbers for which the compliance .* finite"),
    (lambda: pd(stiffness=INF), "stiffness: expected finite numbers >= 0, got inf"),
    (lambda: pd(tet_stiffness=INF), "tet_stiffness: expected finite numbers >= 0, got inf"),
    (lambda: ProjectiveDynamics(X, 1e-9, [[0, 1]]).factor(time_step=0.01, stiffness=1e25),
     "stiffness, mass, time_step: expected masses of the scale .*torch.float64., got 1e.25, 1e-09, 0.01"),
    (lambda: pd(stiffness=1e308, time_step=1e3), "stiffness, tet_stiffness, mass, time_step: expected masses"),
    *[(lambda k=k: k.from_mesh(TETS, device="tpu"), 'device: expected "cpu" or "cuda", got \'tpu\'')
      for k in (XPBD, ProjectiveDynamics)],
    (lambda: XPBD.from_mesh(TETS, device="meta"), 'device: expected "cpu" or "cuda", got \'meta\''),
    (lambda: xpbd(stiffness=0.0), "stiffness: expected numbers > 0, got 0.0"),
    (lambda: pd(stiffness=-1.0), "stiffness: expected finite numbers >= 0, got -1.0"),
    (lambda: pd(tet_stiffness=None), r"tet_stiffness: expected a value \(the solver has such constraints\), got None"),
    (lambda: pd(time_step=None), "time_step: expected a number of seconds, or a factor, got None"),
    (lambda: pd(factor=FACTOR), "time_step: expected None, because factor has it, got 0.01"),
    (lambda: pd(factor=3), "factor: expected what ProjectiveDynamics.factor returns, got int"),
    (lambda: ProjectiveDynamics.from_mesh(TETS).step(X, X, sweeps=1, time_step=0.1, stiffness=1.0, tet_stiffness=1.0),
     r"stiffness: expected None \(the solver has no such constraints\), got 1.0"),
    (lambda: XPBD(8, [[0, 1]], 1.0).step(**GIVEN), "rest_length: expected a value, because .* without rest positions"),
    (lambda: XPBD(X, [[0, 0]], 1.0), r"edges: expected two different indices from 0 to 7, got \[0, 0\]"),
    (lambda: XPBD(X, [[0, 8]], 1.0), r"edges: expected two different indices from 0 to 7, got \[0, 8\]"),
    (lambda: XPBD(X, [[0, 1, 2]], 1.0), r"edges: expected shape \[C, 2\], got shape \[1, 3\]"),
    (lambda: XPBD(X, [[0.0, 1.0]], 1.0), "edges: expected integers, got torch.float32"),
    (lambda: XPBD(X, [[0, 1]], -1.0), "mass: expected finite numbers > 0 kg"),
    (lambda: XPBD(X, [[0, 1]], [1.0]), r"mass: expected a number or shape \[8\], got shape \[1\]"),
    (lambda: XPBD(X, [[0, 1]], 1.0, order="random"), "order: expected \"sequential\" or \"colored\", got 'random'"),
    (lambda: XPBD(X[:, :2], [[0, 1]], 1.0), r"points: expected shape \[V, 3\]"),
    (lambda: XPBD(X, [[0, 1]], 1.0, pinned=[9]), "pinned"),
    (lambda: XPBD.from_mesh(X), "mesh: expected a diffvbd.TetMesh, got Tensor"),
    (lambda: XPBD.from_mesh(TETS, density=0.0), "density: expected a finite number > 0"),
    (lambda: XPBD.from_mesh(TETS, dtype=torch.float16), "dtype: expected torch.float64 or torch.float32"),
    (lambda: ProjectiveDynamics(8, 1.0, tets=[[0, 1, 2, 3]]), "points: expected rest positions, because"),
    (lambda: ProjectiveDynamics(5000, 1.0, [[0, 1]]), r"points: expected at most 4096 free particles .*, got 5000"),
]  # fmt: skip


@pytest.mark.parametrize(("run", "message"), BAD, ids=[b[1][:40] for b in BAD])
def test_bad_input(run: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError)) as error:
        run()
    assert re.match(message, str(error.value)), error.value


def test_what_is_not_used_may_be_anything() -> None:
    """A free particle's prescribed position, a pinned one's force; and infinite stiffness is no bad value."""
    solver = XPBD.from_mesh(TETS, pinned=[2])
    given = GIVEN | {"stiffness": INF}
    found = solver.step(**given, force=NAN, prescribed=torch.where(solver.pinned[:, None], X, torch.nan))
    expected = solver.step(**given, force=X)
    assert all(torch.equal(*pair) and pair[0].any() for pair in zip(found, expected, strict=True))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_where_there_is_none() -> None:
    for kind in (XPBD, ProjectiveDynamics):
        with pytest.raises(RuntimeError, match="^diffvbd: .*CUDA"):
            kind.from_mesh(TETS, device="cuda")
