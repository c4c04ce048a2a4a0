"""Map the stiffness inside a body from where its surface was seen to move: one unknown for each tet.

A rabbit, 0.3 m high, is held at its lower tenth and pulled, each time from rest. Its surface is seen at six times of
each pull, with Gaussian noise of 0.1 % of the height. The stiff region is four times as stiff. Every tet has its own
log mu, and its lam by a known Poisson's ratio. Some tets hardly move the surface: hence the total variation over inner
faces. The paper recovers uniform materials only (section 6.5); this is the same gradient, with respect to a field.

How much total variation: the discrepancy principle (Morozov 1966). The misfit is the mean squared residual over the
variance of the noise; the truth has 1, give or take sqrt(2 / N) for N observed numbers. The weight begins high, where
the field has few levels, and is lowered by sqrt(10) at the start of each stage if the misfit is still above 1; a stage
that finds it at most 1 goes on at the same weight. The last possible weight, 3.2, still holds the field together where
the noise happens to be larger than stated. High weights lead the way: with a low one from the start L-BFGS takes
longer.

Choices: the default mesh is `dv.mesh.bunny(10)`, a likeness made of ellipsoids that needs no file. A file (option
--mesh) holds tets, or a surface that `dv.mesh.tetrahedralize` fills; it is scaled to a height of 0.3 m, y up, so that
loads, stiffness and time step suit it. A plane through the middle of the bounding box, normal to (1, 1, 0), splits the
regions: the rabbit's head and ears are stiff. Places to pull at are farthest points of the surface above the held part;
a pull is a traction on the surface within 3.6 cm, away from the middle of the base, so that thin parts are not torn
off. No gravity; density 1000 kg/m^3. Steps of 5 ms and 20 sweeps relaxed by 1.7 are on average 0.06 mm off converged
ones, below the noise; ten sweeps are 1.3 mm off, and the map would be one for that solver. Finer meshes need more
sweeps, so a surface should be filled with edges of a tenth of its diagonal (--edge-length), and larger ones more
evaluations (--iterations). Total variation is smoothed below jumps of 5 % in mu. mu stays within a factor 30 of the
first guess, because line searches try wild steps. The sweeps start from the predictor, as in the paper's tasks.
"""

import math
import warnings
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import viz
from diffvbd.mesh.tet_mesh import TET_FACES, inner_faces
from diffvbd.tasks.optimizer import lbfgs
from diffvbd.tasks.problem import Problem, Row, Settings, Stage

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


class Version(NamedTuple):
    """Numbers that the quick version changes."""

    grips: int
    steps: int
    every: int  # steps from one observed shape to the next
    weight: float  # of the total variation at first
    counts: tuple[int, ...]  # evaluations of each stage
    bunny: int


FULL, QUICK = Version(8, 48, 8, WEIGHT, (8, 40, 24, 24, 30), 10), Version(3, 32, 8, WEIGHT / 10, (5, 30), 8)


def problem(
    settings: Settings, mesh: Path | None = None, edge_length: float | None = None, iterations: int | None = None
) -> Problem:
    """The task; on request a body from a file of tets or, filled with tets of some edge length, of a surface, and
    another number of evaluations for each weight.

    Raises:
        FileNotFoundError, ValueError: no such file, no body in it, edge_length or iterations not positive.
        ImportError: the file holds a surface, and pytetwild is missing.
    """
    version = QUICK if settings.quick else FULL
    if iterations is not None and iterations < 1:
        raise ValueError(f"iterations: expected at least 1, got {iterations}")
    if iterations is not None:
        version = version._replace(counts=(version.counts[0], *(iterations for _ in version.counts[1:])))
    if edge_length is not None and (mesh is None or mesh.suffix.lower() not in SURFACES):
        raise ValueError(f"edge_length: expected it with a mesh that is a surface ({', '.join(SURFACES)}), got {mesh}")
    body = scaled(read(mesh, edge_length) if mesh else dv.mesh.bunny(version.bunny), HEIGHT)
    pulled = Pulled(body, settings, version)
    fit = Fit(pulled, version)
    return Problem(
        name="fit-real-mesh",
        parameters={"level": fit.level, "exponents": fit.exponents},
        state={"lowered": fit.lowered},
        # L-BFGS on one number for all tets (stage 0), or on one for each
        stages=[Stage(loss=fit.loss, iterations=count, optimizer=lambda p: lbfgs(p, history=30),
                      moves=("exponents",) if k else ("level",), before=partial(fit.lower, k), capturable=True,
                      name=f"field, weight {k}" if k else "uniform") for k, count in enumerate(version.counts)],
        estimates=fit.estimates,
        truth={"mu_soft": SOFT, "mu_stiff": STIFF},
        units={"mu_soft": "Pa", "mu_stiff": "Pa"},
        protocol={"mesh": str(mesh or "bunny"), "edge_length": edge_length, "vertices": body.num_vertices,
                  "tets": body.num_tets, "observed": list(pulled.observed.shape), "noise": pulled.sigma,
                  "iterations": version.counts, "steps": version.steps, "time_step": TIME_STEP, "sweeps": SWEEPS,
                  "relaxation": RELAXATION, "density": DENSITY, "poisson": POISSON, "start_mu": START,
                  "traction": TRACTION, "weight": version.weight, "fall": FALL, "smooth": SMOOTH, "range": RANGE},
        findings=fit.findings,
        picture=fit.picture,
        animation=fit.animation,
    )  # fmt: skip


class Pulled:
    """The body, its true material, and the shapes that were seen of each pull."""

    def __init__(self, body: dv.TetMesh, settings: Settings, version: Version) -> None:
        self.body, self.version = body, version
        pinned = body.points[:, 1] <= HELD * HEIGHT
        model = dv.Model(body, density=DENSITY, pinned=pinned)
        self.model = model.to(settings.device)
        self.solver = dv.VBD(TIME_STEP, SWEEPS, relaxation=RELAXATION, start="predictor")
        self.like = {"dtype": self.model.dtype, "device": self.model.device}
        self.force = torch.as_tensor(pulls(body, version.grips), **self.like)
        self.x = self.model.rest_points.expand(version.grips, -1, -1)
        self.v = torch.zeros_like(self.x)
        seen = np.setdiff1d(body.surface, np.flatnonzero(pinned))
        self.seen = torch.as_tensor(seen, device=self.model.device)

        side = (body.points[body.tets].mean(1) - 0.5 * (body.points.min(0) + body.points.max(0))) @ np.array(PLANE)
        self.stiff = torch.as_tensor(side > 0, device=self.model.device)
        self.true = torch.where(self.stiff, torch.tensor(STIFF, **self.like), torch.tensor(SOFT, **self.like))
        with torch.no_grad():
            self.observed = self.simulate(self.true)[1:, :, self.seen]
        self.sigma = NOISE * HEIGHT
        random = torch.Generator().manual_seed(settings.seed)
        noise = torch.randn(self.observed.shape, generator=random, dtype=torch.float64)
        self.observed += self.sigma * noise.to(**self.like)

    def simulate(self, mu: Tensor, save: int | None = None) -> Tensor:
        """Positions [m] of saved frames, shape [frames, grips, V, 3]."""
        lam = 2 * POISSON / (1 - 2 * POISSON) * mu
        save = self.version.every if save is None else save
        return dv.rollout(self.model, self.x, self.v, self.solver, steps=self.version.steps, save=save, mu=mu, lam=lam,
                          force=self.force, gravity=(0.0, 0.0, 0.0)).x  # fmt: skip

    def misfit(self, mu: Tensor) -> Tensor:
        """Mean squared residual over the variance of the noise."""
        return (self.simulate(mu)[1:, :, self.seen] - self.observed).square().mean() / self.sigma**2


class Fit:
    """The unknowns, and the loss with its total variation, whose weight falls from stage to stage."""

    def __init__(self, pulled: Pulled, version: Version) -> None:
        self.pulled, self.body, self.start_weight = pulled, pulled.body, version.weight
        device, like = pulled.model.device, pulled.like
        self.first, self.second, area = (torch.as_tensor(a, device=device) for a in neighbors(pulled.body))
        self.share = area / area.sum()
        self.level = torch.zeros((), **like, requires_grad=True)
        self.exponents = torch.zeros(pulled.body.num_tets, **like, requires_grad=True)
        self.lowered = torch.zeros(len(version.counts), **like)  # 1 for each stage that began with a lower weight
        self.weight = torch.tensor(version.weight, **like)

    def log_mu(self) -> Tensor:
        limit = math.log(RANGE)
        return math.log(START) + limit * ((self.level + self.exponents) / limit).tanh()

    def loss(self) -> Tensor:
        field = self.log_mu()
        jumps = ((field[self.first] - field[self.second]).square() + SMOOTH**2).sqrt() - SMOOTH
        return self.pulled.misfit(field.exp()) + self.weight * (self.share * jumps).sum()

    @torch.no_grad()
    def lower(self, stage: int, iteration: int) -> None:
        """Before an iteration of a stage: its weight."""
        if iteration == 0 and stage > 1:
            self.lowered[stage] = self.pulled.misfit(self.log_mu().exp()) > 1
        self.weight.copy_(self.start_weight * FALL ** -self.lowered.sum())

    @torch.no_grad()
    def estimates(self) -> Row:
        mu, stiff = self.log_mu().exp(), self.pulled.stiff
        error = (mu / self.pulled.true - 1).abs()
        return {"mu_soft": mu[~stiff].mean().item(), "mu_stiff": mu[stiff].mean().item(),
                "field_error": error.median().item(),
                "within_10_percent": (error <= 0.1).to(error.dtype).mean().item()}  # fmt: skip

    @torch.no_grad()
    def findings(self, history: list[Row]) -> dict[str, float]:
        misfit, true = self.pulled.misfit, self.pulled.true
        found = {"misfit": misfit(self.log_mu().exp()), "misfit_of_truth": misfit(true), "weight": self.weight}
        return {name: value.item() for name, value in found.items()}

    def picture(self, path: Path, history: list[Row]) -> None:
        body, maps = self.body, {"true": self.pulled.true, "recovered": self.log_mu().exp()}
        middle = 0.5 * (body.points.min(0) + body.points.max(0))
        truth = {"mu_soft": SOFT, "mu_stiff": STIFF}
        viz.field(path, body.points, body.tets, maps, "mu [Pa]", (middle.tolist(), (0.0, 0.0, 1.0)), history, truth)

    @torch.no_grad()
    def animation(self, path: Path) -> None:
        # the first pull, at the highest place
        materials = {"target": self.pulled.true, "recovered": self.log_mu().exp()}
        motions = {name: self.pulled.simulate(mu, 1)[:, 0] for name, mu in materials.items()}
        viz.animation(path, self.body.surface, motions, TIME_STEP)


def read(path: Path, edge_length: float | None = None) -> dv.TetMesh:
    """Tets of a file, or those that fill the surface in it; edge_length as in `dv.mesh.tetrahedralize`."""
    if path.suffix.lower() not in SURFACES:
        return dv.mesh.load(path)
    with warnings.catch_warnings():  # the unit of the file does not matter: the body is scaled
        warnings.filterwarnings("ignore", message="surface: its largest extent")
        return dv.mesh.tetrahedralize(path, edge_length)


def scaled(mesh: dv.TetMesh, height: float) -> dv.TetMesh:
    """The mesh with another height [m] along y, standing on y = 0."""
    low, high = mesh.points.min(0), mesh.points.max(0)
    return mesh.translate([0.0, -low[1], 0.0]).transform(height / (high[1] - low[1]) * np.eye(3))


def neighbors(mesh: dv.TetMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both tets of each inner face and its area [m^2], shape [F] each."""
    one, two = inner_faces(mesh.tets)
    faces = np.sort(mesh.tets[:, TET_FACES].reshape(-1, 3)[one], axis=1)
    a, b, c = mesh.points[faces].transpose(1, 0, 2)
    return one // 4, two // 4, 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


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
