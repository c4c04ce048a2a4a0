"""Launch a million soft cubes so that each is at its place in a formation at one moment (paper, section "Scale").

Cubes of 3 mm (8 vertices and 6 tets each) lie in layers on a launch pad, let go from a squeeze by a tenth of their
height. The ring stands 1.77 m above the pad, the height of a throw whose apex is reached after 0.6 s. The shear modulus
passes a sigmoid; 240 steps of 5 ms with K = 5 sweeps, of which every fifth state is kept. The loss is the sum of Huber
losses of the distances between centers of mass and places at t = 0.6 s. The first stage has no contact; in the second,
bodies push each other away by a penalty between centers of mass (`diffvbd.contact.center_of_mass_penalty`), and the
gradient goes through every push.

Choices: density 1000 kg/m^3, lam = 1e4 Pa, mu in 1e3 .. 1e5 Pa; Huber's delta 1 m; the limit of 5 is on the gradient of
each body's velocity. Pad and ring have a place every 8 mm. Bodies and places are matched in the order of x, then z,
then y, each place mixed by a seed with its next few: mixed among all, bodies would meet everywhere on the way. Bodies
overlap below 5.2 mm, the diagonal of a cube, and are pushed with 3e-3 N/m of overlap. That is soft: bodies that fly
side by side and touch drift apart exponentially, at 0.1 N/m their gradients reach 1e6 and lead nowhere. The first guess
is 3 m/s upwards for all. After t = 0.6 s bodies fly on without contact, which does not change the loss; the paper rolls
these steps out, so it is the default (option `steps`). The center of mass of a free body does not depend on its
material, except through what K = 5 sweeps leave unsolved: the gradient of mu is that of the executed solver, and tiny
against that of the velocity; where nothing else decides, Adam moves mu all the same, and the task does not identify it.
The rigid correction is off (`subspace=None`) and the sweeps start from the predictor, as in the paper. float32, because
a million bodies fill tens of GB; the quick version uses float64.

That the bar is met says little: the paper does not say where its bodies start and end, so its errors and ours are of
different scenes, and its times and memory are those of float64, ours of float32. The bar only keeps this task from
getting worse.
"""

import math
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

import diffvbd as dv
from diffvbd import distributed, losses, viz
from diffvbd.tasks.problem import Problem, Row, Settings, Stage

BODIES, QUICK_BODIES = 1_000_000, 64
EDGE = 3e-3  # [m]
SQUEEZE = 0.9  # height at the start, of the height at rest
DENSITY = 1000.0  # [kg/m^3]
LAM, MU = 1e4, (1e3, 1e5)  # [Pa]; the range of mu
TIME_STEP, SWEEPS, STEPS = 5e-3, 5, 240  # [s]
TARGET_STEP = 120  # t = 0.6 s
CHECKPOINT_EVERY = 5
HUBER = 1.0  # delta [m]
CLIP = 5.0  # longest gradient of a body
PAD_SPACING, RING_SPACING = 8e-3, 8e-3  # of places [m]
LAYERS = 16
HEIGHT = 1.77  # of the middle of the ring [m]
RADIUS, STIFFNESS = math.sqrt(3) * EDGE, 3e-3  # [m], [N/m]
GROUP, QUICK_GROUP = 64, 16  # most bodies in a scene on the CPU
PAIRS, MOST_PAIRS = 2, 16  # room for pairs, for each body: in a CUDA graph, where room costs time; outside of one
ROOM = 1.05  # in a CUDA graph of a rank, times the most bodies that were near those of the rank
DEPTH = -1e3  # below the pad, where no body comes [m]
MIXED = 8  # bodies whose places are mixed
LAUNCH = 3.0  # first guess, upwards [m/s]
STAGES = ("without contact", "with contact")
ITERATIONS, RATES = (40, 40), (0.5, 0.005)  # of the stages


class Version(NamedTuple):
    """Numbers that options and the quick version change."""

    bodies: int = BODIES
    steps: int = STEPS
    target_step: int = TARGET_STEP
    height: float = HEIGHT  # [m]
    launch: float = LAUNCH  # [m/s]
    dtype: torch.dtype = torch.float32
    counts: tuple[int, int] = ITERATIONS
    rates: tuple[float, float] = RATES
    group: int = GROUP


# a flight of a sixth of the time
QUICK = Version(QUICK_BODIES, 24, 20, 0.05, 0.6, torch.float64, (15, 10), (0.5, 0.02), QUICK_GROUP)


def problem(
    settings: Settings, bodies: int | None = None, steps: int | None = None, iterations: int | None = None
) -> Problem:
    """The task with so many cubes, steps of a rollout and iterations of each stage; defaults BODIES, STEPS, ITERATIONS.

    The quick version takes at most QUICK_BODIES, and has its own steps. ValueError for no bodies or iterations, too
    many bodies, or a rollout that ends before t = 0.6 s.
    """
    version = chosen(settings.quick, bodies, steps, iterations)
    cubes = Cubes(settings, version)
    return Problem(
        name="million-cubes",
        parameters={"velocity": cubes.velocity, "material": cubes.material},
        stages=[
            Stage(loss=cubes.loss, iterations=count, learning_rate=rate,
                  before=partial(cubes.begin, touching=touching), criterion="mean_error",
                  capturable=not dist.is_initialized() or dist.get_backend() == "nccl", name=name)
            for name, count, rate, touching in zip(STAGES, version.counts, version.rates, (False, True), strict=True)
        ],
        estimates=lambda: {"mean_error": cubes.error.mean().item()},
        units={"mean_error": "m"},
        protocol={"bodies": version.bodies, "vertices": version.bodies * cubes.cube.num_vertices,
                  "tets": version.bodies * cubes.cube.num_tets, "steps": version.steps,
                  "target_step": version.target_step, "iterations": version.counts, "edge": EDGE, "squeeze": SQUEEZE,
                  "density": DENSITY, "mu": MU, "lam": LAM, "time_step": TIME_STEP, "sweeps": SWEEPS,
                  "checkpoint_every": CHECKPOINT_EVERY, "radius": RADIUS, "stiffness": STIFFNESS, "huber": HUBER,
                  "clip": CLIP, "spacing": (PAD_SPACING, RING_SPACING), "height": HEIGHT,
                  "dtype": str(version.dtype)},
        findings=cubes.findings,
        picture=cubes.picture,
        animation=cubes.animation,
    )  # fmt: skip


def chosen(quick: bool, bodies: int | None, steps: int | None, iterations: int | None) -> Version:
    """The version that these options make; None: its own value."""
    version, most = (QUICK, QUICK_BODIES) if quick else (Version(), math.inf)
    if quick and steps is not None:
        raise ValueError(f"steps: expected none with --quick, which has its own, got {steps}")
    bodies = version.bodies if bodies is None else bodies
    if not 1 <= bodies <= most:
        raise ValueError(f"bodies: expected at least 1{f' and at most {most}' if quick else ''}, got {bodies}")
    steps = version.steps if steps is None else steps
    if steps < version.target_step:
        raise ValueError(f"steps: expected at least {version.target_step}, which are 0.6 s, got {steps}")
    if iterations is not None and iterations < 1:
        raise ValueError(f"iterations: expected at least 1, got {iterations}")
    counts = version.counts if iterations is None else (iterations, iterations)
    return version._replace(bodies=bodies, steps=steps, counts=counts)


class Cubes:
    """The bodies, their places, and the four numbers of each that are looked for.

    Under torchrun each rank moves its share of the bodies and finds the pushes on them. What is small is whole on every
    rank: parameters, their gradients and optimiser, centers of mass.
    """

    def __init__(self, settings: Settings, version: Version) -> None:
        self.version, bodies = version, version.bodies
        place = matched(ring(bodies, version.height), np.random.default_rng(settings.seed))
        self.cube = cube = dv.mesh.cube(2, EDGE, split="kuhn").translate((-EDGE / 2,) * 3)
        # a GPU has one thread sweep a whole cube; a CPU sweeps eight vertices of a color at once, and wants more cubes
        self.group = 1 if torch.device(settings.device).type == "cuda" else math.gcd(bodies, version.group)
        self.scenes = bodies // self.group
        part = distributed.share(self.scenes)  # of this rank
        mine = slice(part.start * self.group, part.stop * self.group)
        self.bodies = mine.stop - mine.start
        self.shape = (part.stop - part.start, self.group * cube.num_vertices, 3)
        model = dv.Model(dv.mesh.replicate(cube, np.zeros((self.group, 3))), density=DENSITY,
                         dtype=version.dtype)  # fmt: skip
        self.model = model.to(settings.device)
        device = self.model.device
        like = {"dtype": version.dtype, "device": device}
        self.target, pad = torch.as_tensor(place, **like), torch.as_tensor(launch_pad(bodies)[mine], **like)
        corners, self.mass = (each[: cube.num_vertices] for each in (self.model.rest_points, self.model.mass))
        self.x = (pad[:, None] + torch.tensor([1.0, SQUEEZE, 1.0], **like) * corners).reshape(self.shape)
        labels = torch.arange(self.bodies, device=device).repeat_interleave(cube.num_vertices)
        self.mine = dv.contact.Bodies(labels, self.mass.repeat(self.bodies))
        self.contact = False
        # In a CUDA graph there is room for more bodies near those of this rank than steps outside of it have found, and
        # for PAIRS of each, or a multiple after a graph that had too little.
        self.room, self.multiple, self.captured = 0, 1, False

        self.velocity = torch.tensor([0.0, version.launch, 0.0], **like).repeat(bodies, 1).requires_grad_()
        self.material = torch.zeros(bodies, **like, requires_grad=True)
        # distances of centers of mass from their places [m], by the latest loss
        self.error = torch.full((bodies,), torch.nan, **like)
        # a body that bounces off many others has a huge gradient, which a limit for all would make all others pay
        self.velocity.register_hook(lambda g: g * (CLIP / g.norm(dim=1, keepdim=True)).clamp(max=1.0))

    def push(self, step: int, x: Tensor, v: Tensor) -> Tensor | None:
        if step >= self.version.target_step:
            return None
        centers = self.mine.centers(x.reshape(1, -1, 3))[0]
        captures = x.is_cuda and torch.cuda.is_current_stream_capturing()
        if self.captured and not captures:  # a graph is made anew: it had too little room, or a number was not finite
            self.multiple *= 2
        self.captured = captures
        force = self.penalty(centers) if self.bodies == self.version.bodies else self.penalty_by_all(centers)
        return self.mine.forces(force[None]).view_as(x)

    def penalty(self, centers: Tensor) -> Tensor:
        """Forces between some bodies [N]. All see each other: they are one scene."""
        each = min(MOST_PAIRS, self.multiple * PAIRS) if self.captured else MOST_PAIRS
        return dv.contact.center_of_mass_penalty(centers, None, RADIUS, STIFFNESS, max_pairs=each * len(centers) + 256)

    def penalty_by_all(self, mine: Tensor) -> Tensor:
        """Forces on the bodies of this rank by those of all ranks [N], with the bits of one rank.

        The penalty is that of the bodies of this rank and of those of others that are near them. All pairs of a body of
        this rank are among them, in the order that they have among all bodies, so its sums are the same.
        """
        centers = self.all_of(mine)
        near = is_near(mine.detach(), centers.detach())
        if self.captured:
            rows, force = self.penalty_in_graph(centers, near)
        else:
            rows = near.nonzero()[:, 0]
            self.room = min(len(centers), max(self.room, int(ROOM * len(rows)) + 256))
            force = self.penalty(centers.index_select(0, rows))
        # Forces on bodies of other ranks lack pairs here, and nobody reads them. But these forces depend on the bodies
        # of this rank, too: the backward of `own` brings the gradient of each, and the penalty's goes on from there.
        return self.own(force.new_zeros((len(centers) + 1, 3)).index_copy(0, rows, force)[:-1])

    def penalty_in_graph(self, centers: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
        """Rows of all bodies [room], and the forces on them; NaN where more are near than there is room for.

        Unused rows are beyond the last body, and their points far from all.
        """
        bodies = len(centers)
        rows = torch.nonzero_static(near, size=self.room, fill_value=bodies)[:, 0]
        place = torch.arange(self.room, device=rows.device)
        far = (2 * RADIUS * place).to(centers.dtype)  # each twice RADIUS from the next
        far = torch.stack([far, torch.full_like(far, DEPTH), torch.zeros_like(far)], 1)
        there = rows < bodies
        points = centers.index_select(0, torch.where(there, rows, place))
        force = self.penalty(torch.where(there[:, None], points, far))
        return rows, force * torch.where(near.sum() > self.room, torch.nan, 1.0).to(force.dtype)

    def own(self, values: Tensor) -> Tensor:
        """Of all bodies [N, ...] -> of those of this rank."""
        return distributed.own(values.unflatten(0, (self.scenes, self.group))).flatten(0, 1)

    def all_of(self, values: Tensor) -> Tensor:
        """Of the bodies of this rank [n, ...] -> of all."""
        return distributed.gathered(values.unflatten(0, (-1, self.group)), self.scenes).flatten(0, 1)

    def simulate(self, save: int) -> Tensor:
        """Centers of mass [m] of every n-th frame, shape [frames, bodies, 3]."""
        cube, mu = self.cube, MU[0] + (MU[1] - MU[0]) * self.own(self.material).sigmoid()
        v = self.own(self.velocity)[:, None].expand(-1, cube.num_vertices, -1).reshape(self.shape)
        mu = mu.view(-1, self.group, 1).expand(-1, -1, cube.num_tets).flatten(1)
        solver = dv.VBD(TIME_STEP, SWEEPS, subspace=None, start="predictor")
        motion = dv.rollout(self.model, self.x, v, solver, steps=self.version.steps, save=save,
                            checkpoint_every=CHECKPOINT_EVERY, mu=mu, lam=LAM,
                            force=self.push if self.contact else None)  # fmt: skip
        centers = losses.center_of_mass(motion.x.view(-1, self.bodies, cube.num_vertices, 3), self.mass)
        return self.all_of(centers.transpose(0, 1)).transpose(0, 1)

    def begin(self, iteration: int, touching: bool) -> None:
        self.contact = touching

    def loss(self) -> Tensor:
        arrived = self.simulate(save=self.version.target_step)[1]
        self.error.copy_((arrived - self.target).detach().norm(dim=1))
        return self.version.bodies * losses.huber(arrived, self.target, HUBER)

    def findings(self, history: list[Row]) -> dict[str, float]:
        found = {
            f"mean_error_{name}": min(row["mean_error"] for row in history if row["stage"] == stage)
            for stage, name in enumerate(("without_contact", "with_contact"))
        }
        times = np.diff([row["seconds"] for row in history])
        found["seconds_per_iteration"] = float(np.median(times[-self.version.counts[1] // 2 :]))  # with contact
        return found

    @torch.no_grad()
    def picture(self, path: Path, history: list[Row]) -> None:
        every, count = self.version.target_step // 4, 6 if self.version.steps > self.version.target_step else 5
        viz.cloud(path, self.simulate(save=every)[:count], every * TIME_STEP, history, "mean_error")

    @torch.no_grad()
    def animation(self, path: Path) -> None:
        viz.cloud_animation(path, self.simulate(save=4), 4 * TIME_STEP)


def is_near(points: Tensor, others: Tensor) -> Tensor:
    """Mask [M] of others [M, 3] that may be closer to one of the points than RADIUS.

    All, where a number is not finite: then the search for pairs raises on every rank, as it does on one.
    """
    low, high = points.aminmax(dim=0)
    apart = (others - others.clamp(low, high)).abs().amax(1)  # from the box around the points
    far = (apart > 1.01 * RADIUS) & others.isfinite().all()  # by more than what rounding can move
    return ~far


def launch_pad(bodies: int) -> np.ndarray:
    """Places [m] in layers on a square about the y axis, in the order of x, then z, then y, shape [bodies, 3]."""
    layers = min(LAYERS, bodies)
    side = math.ceil(math.sqrt(bodies / layers))
    x, z, y = np.meshgrid(np.arange(side), np.arange(side), np.arange(layers), indexing="ij")
    places = np.stack([x - 0.5 * (side - 1), y, z - 0.5 * (side - 1)], -1).reshape(-1, 3)
    return PAD_SPACING * places[:bodies]


def ring(bodies: int, height: float) -> np.ndarray:
    """Lattice places [m] in a torus that stands upright at a height, in the order of x, then z, then y."""
    # the torus of the volume of so many cells whose outer radius is three times that of its tube
    tube = (bodies / (4 * math.pi**2)) ** (1 / 3)
    reach = math.ceil(3 * tube) + 2
    axis, deep = np.arange(-reach, reach + 1), np.arange(-math.ceil(tube) - 2, math.ceil(tube) + 3)
    x, z, y = (a.ravel() for a in np.meshgrid(axis, deep, axis, indexing="ij"))
    inside = np.hypot(np.hypot(x, y) - 2 * tube, z)
    chosen = np.sort(np.argsort(inside, kind="stable")[:bodies])
    return RING_SPACING * np.stack([x, y, z], -1)[chosen] + [0.0, height, 0.0]


def matched(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """The places in another order: each has moved by about MIXED ranks."""
    return places[np.argsort(np.arange(len(places)) + random.uniform(0, MIXED, len(places)), kind="stable")]
