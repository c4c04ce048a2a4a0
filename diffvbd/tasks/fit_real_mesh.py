"""Map the stiffness inside a body from where its surface was seen to move: one unknown for each tet.

A rabbit, 0.3 m high, is held at its lower tenth and pulled at eight places of its surface, one after another, each time
from rest. Given are the positions of the surface vertices at six times of each pull, simulated with the same mesh and
solver, with Gaussian noise of 0.1 % of the height. The truth has two regions, a soft one and one four times as stiff,
but neither their number nor their place is given: every tet has its own log mu, and its lam by a known Poisson's ratio.
Some tets hardly move the surface, so the total variation of log mu over inner faces is minimised along with the misfit.
The paper recovers uniform materials only (section 6.5); this is the same gradient, with respect to a field.

How much total variation: the discrepancy principle (Morozov 1966). The misfit is the mean squared residual over the
variance of the noise; the truth has 1, give or take sqrt(2 / N) for N observed numbers. The weight begins high, where
the field has few levels, and is lowered by sqrt(10) at the start of each stage if the misfit is still above 1; a stage
that finds it at most 1 goes on at the same weight. The last possible weight, 3.2, still holds the field together where
the noise happens to be larger than stated. High weights lead the way: with a low one from the start L-BFGS takes
longer.

Choices the paper leaves open, as it has no such task: the default mesh is `dv.mesh.bunny(10)`, a likeness made of
ellipsoids that needs no file. A file (option --mesh) holds tets, or a surface that `dv.mesh.tetrahedralize` fills; it
is scaled to a height of 0.3 m, y up, so that loads, stiffness and time step suit it. A plane through the middle of the
bounding box, normal to (1, 1, 0), splits the regions: the rabbit's head and ears are stiff. Places to pull at are
farthest points of the surface above the held part; a pull is a traction on the surface within 3.6 cm, away from the
middle of the base, so that thin parts are not torn off. No gravity; density 1000 kg/m^3. Steps of 5 ms and 20 sweeps
relaxed by 1.7 are on average 0.06 mm off converged ones, below the noise; ten sweeps are 1.3 mm off, and the map would
be one for that solver. Finer meshes need more sweeps, so a surface should be filled with edges of a tenth of its
diagonal (--edge-length), and larger ones more evaluations (--iterations). Total variation is smoothed below jumps of 5
% in mu. mu stays within a factor 30 of the first guess, because line searches try wild steps. The sweeps start from the
predictor, as in the paper's tasks.
"""

import math
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import viz
from diffvbd.tasks.problem import Problem, Settings, Stage
from diffvbd.tasks.progress import Row

HEIGHT = 0.3  # [m]
SOFT, STIFF, START = 5e3, 2e4, 3e4  # mu of the two regions, first guess everywhere [Pa]
RANGE = 30.0  # largest factor between mu and the first guess
POISSON = 0.3
DENSITY = 1000.0  # [kg/m^3]
PLANE = (math.sqrt(0.5), math.sqrt(0.5), 0.0)  # normal of what splits the regions
HELD, OUT_OF_REACH = 0.1, 0.2  # lower parts of the height that are held, and where nothing pulls
TRACTION, GRIP = 4e3, 0.12 * HEIGHT  # [Pa], radius [m]
NOISE = 1e-3  # standard deviation over the height
TIME_STEP, SWEEPS, RELAXATION = 5e-3, 20, 1.7  # [s]
WEIGHT, FALL = 100.0, math.sqrt(10)  # of the total variation at first, and the factor by which it is lowered
SMOOTH = 0.05  # jumps of log mu below which total variation is quadratic
SURFACES = (".obj", ".off", ".ply", ".stl")


def problem(
    settings: Settings, mesh: Path | None = None, edge_length: float | None = None, iterations: int | None = None
) -> Problem:
    """The task; on request a body from a file of tets or, filled with tets of some edge length, of a surface, and
    another number of evaluations for each weight.

    Raises:
        FileNotFoundError, ValueError: no such file, no body in it, edge_length or iterations not positive.
        ImportError: the file holds a surface, and pytetwild is missing.
    """
    grips, steps, every, heavy, counts = 8, 48, 8, WEIGHT, (8, 40, 24, 24, 30)
    if settings.quick:
        grips, steps, every, heavy, counts = 3, 32, 8, WEIGHT / 10, (5, 30)
    if iterations is not None:
        if iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {iterations}")
        counts = (counts[0], *(iterations for _ in counts[1:]))
    if edge_length is not None and (mesh is None or mesh.suffix.lower() not in SURFACES):
        raise ValueError(
            f"edge_length: expected it beside a mesh that is a surface ({', '.join(SURFACES)}), got {mesh}"
        )
    body = scaled(read(mesh, edge_length) if mesh else dv.mesh.bunny(8 if settings.quick else 10), HEIGHT)
    pinned = body.points[:, 1] <= HELD * HEIGHT
    model = dv.Model(body, density=DENSITY, pinned=pinned, relaxation=RELAXATION, start="predictor").to(settings.device)
    like = {"dtype": model.dtype, "device": model.device}
    force = torch.as_tensor(pulls(body, grips), **like)
    x = model.rest_points.expand(grips, -1, -1)
    v = torch.zeros_like(x)
    seen = np.setdiff1d(body.surface, np.flatnonzero(pinned))
    seen = torch.as_tensor(seen, device=model.device)

    def simulate(mu: Tensor, save: int = every) -> Tensor:
        """Positions [m] of saved frames, shape [frames, grips, V, 3]."""
        lam = 2 * POISSON / (1 - 2 * POISSON) * mu
        motion = dv.rollout(model, x, v, steps=steps, mu=mu, lam=lam, time_step=TIME_STEP, sweeps=SWEEPS, force=force,
                            gravity=(0.0, 0.0, 0.0), save=save)  # fmt: skip
        return motion.x

    side = (body.points[body.tets].mean(1) - 0.5 * (body.points.min(0) + body.points.max(0))) @ np.array(PLANE)
    stiff = torch.as_tensor(side > 0, device=model.device)
    true = torch.where(stiff, torch.tensor(STIFF, **like), torch.tensor(SOFT, **like))
    with torch.no_grad():
        observed = simulate(true)[1:, :, seen]
    sigma = NOISE * HEIGHT
    random = torch.Generator().manual_seed(settings.seed)
    observed += sigma * torch.randn(observed.shape, generator=random, dtype=torch.float64).to(**like)

    first, second, area = (torch.as_tensor(a, device=model.device) for a in neighbors(body))
    share = area / area.sum()
    level = torch.zeros((), **like, requires_grad=True)
    exponents = torch.zeros(body.num_tets, **like, requires_grad=True)
    lowered = torch.zeros(len(counts), **like)  # 1 for each stage that began with a lower weight
    weight = torch.tensor(heavy, **like)

    def log_mu() -> Tensor:
        limit = math.log(RANGE)
        return math.log(START) + limit * ((level + exponents) / limit).tanh()

    def misfit(mu: Tensor) -> Tensor:
        return (simulate(mu)[1:, :, seen] - observed).square().mean() / sigma**2

    def loss() -> Tensor:
        field = log_mu()
        jumps = ((field[first] - field[second]).square() + SMOOTH**2).sqrt() - SMOOTH
        return misfit(field.exp()) + weight * (share * jumps).sum()

    @torch.no_grad()
    def lower(stage: int, iteration: int) -> None:
        if iteration == 0 and stage > 1:
            lowered[stage] = misfit(log_mu().exp()) > 1
        weight.copy_(heavy * FALL ** -lowered.sum())

    @torch.no_grad()
    def estimates() -> Row:
        mu = log_mu().exp()
        error = (mu / true - 1).abs()
        return {
            "mu_soft": mu[~stiff].mean().item(),
            "mu_stiff": mu[stiff].mean().item(),
            "field_error": error.median().item(),
            "within_10_percent": (error <= 0.1).to(error.dtype).mean().item(),
        }

    @torch.no_grad()
    def findings(history: list[Row]) -> dict[str, float]:
        found = {"misfit": misfit(log_mu().exp()), "misfit_of_truth": misfit(true), "weight": weight}
        return {name: value.item() for name, value in found.items()}

    def picture(path: Path, history: list[Row]) -> None:
        maps = {"true": true, "recovered": log_mu().exp()}
        middle = 0.5 * (body.points.min(0) + body.points.max(0))
        truth = {"mu_soft": SOFT, "mu_stiff": STIFF}
        viz.field(path, body.points, body.tets, maps, "mu [Pa]", (middle.tolist(), (0.0, 0.0, 1.0)), history, truth)

    @torch.no_grad()
    def animation(path: Path) -> None:
        # the first pull, at the highest place
        motions = {"target": simulate(true, 1)[:, 0], "recovered": simulate(log_mu().exp(), 1)[:, 0]}
        viz.animation(path, body.surface, motions, TIME_STEP)

    return Problem(
        name="fit-real-mesh",
        parameters={"level": level, "exponents": exponents},
        state={"lowered": lowered},
        stages=[
            Stage(
                loss=loss,
                iterations=count,
                optimizer=lambda p: torch.optim.LBFGS(
                    p, max_iter=5, history_size=30, tolerance_grad=0, tolerance_change=0, line_search_fn="strong_wolfe"
                ),
                moves=("exponents",) if k else ("level",),
                before=partial(lower, k),
                capturable=True,
                name=f"field, weight {k}" if k else "uniform",
            )
            for k, count in enumerate(counts)
        ],
        estimates=estimates,
        truth={"mu_soft": SOFT, "mu_stiff": STIFF},
        units={"mu_soft": "Pa", "mu_stiff": "Pa"},
        protocol={
            "mesh": str(mesh or "bunny"),
            "edge_length": edge_length,
            "vertices": body.num_vertices,
            "tets": body.num_tets,
            "observed": list(observed.shape),
            "noise": sigma,
            "iterations": counts,
            "steps": steps,
            "time_step": TIME_STEP,
            "sweeps": SWEEPS,
            "relaxation": RELAXATION,
            "density": DENSITY,
            "poisson": POISSON,
            "start_mu": START,
            "traction": TRACTION,
            "weight": heavy,
            "fall": FALL,
            "smooth": SMOOTH,
            "range": RANGE,
        },
        findings=findings,
        picture=picture,
        animation=animation,
    )


def read(path: Path, edge_length: float | None = None) -> dv.TetMesh:
    """Tets of a file, or those that fill the surface in it; edge_length as in `dv.mesh.tetrahedralize`."""
    surface = path.suffix.lower() in SURFACES
    return dv.mesh.tetrahedralize(path, edge_length) if surface else dv.mesh.load(path)


def scaled(mesh: dv.TetMesh, height: float) -> dv.TetMesh:
    """The mesh with another height [m] along y, standing on y = 0."""
    low, high = mesh.points.min(0), mesh.points.max(0)
    return mesh.translate([0.0, -low[1], 0.0]).transform(height / (high[1] - low[1]) * np.eye(3))


def neighbors(mesh: dv.TetMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both tets of each inner face and its area [m^2], shape [F] each."""
    faces = np.sort(mesh.tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = np.flatnonzero((faces[order[1:]] == faces[order[:-1]]).all(1))
    a, b, c = mesh.points[faces[order[same]]].transpose(1, 0, 2)
    return order[same] // 4, order[same + 1] // 4, 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def pulls(mesh: dv.TetMesh, count: int) -> np.ndarray:
    """Forces [N] of each pull, shape [count, V, 3], for a mesh of HEIGHT that stands on y = 0."""
    p, surface = mesh.points, mesh.surface
    a, b, c = p[surface].transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    area = np.bincount(surface.ravel(), np.repeat(areas / 3, 3), len(p))
    reach = np.flatnonzero((area > 0) & (p[:, 1] > OUT_OF_REACH * HEIGHT))
    base = 0.5 * (p.min(0) + p.max(0)) * [1.0, 0.0, 1.0]
    distance = -p[reach, 1]
    force = np.zeros((count, len(p), 3))
    for k in range(count):
        # the first place is the highest, every other the one farthest from those before
        place = p[reach[np.argmin(distance) if k == 0 else np.argmax(distance)]]
        away = np.linalg.norm(p[reach] - place, axis=1)
        distance = away if k == 0 else np.minimum(distance, away)
        near = reach[away <= GRIP]
        force[k, near] = TRACTION * area[near, None] * (place - base) / np.linalg.norm(place - base)
    return force
