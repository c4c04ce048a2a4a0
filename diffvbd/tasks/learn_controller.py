"""Train a network to drive a soft arm, by gradients through the simulation (a task that the paper does not have).

The column has 0.4 m, the cart an acceleration of at most 6 m/s^2 along each axis. The network sees tip and cart
relative to the target, their velocities, and the time. The arm starts with a swing; targets are 0.15 to 0.35 m away,
and the tip must stay for 0.25 s, over which the loss is the mean squared distance of all scenes. The findings report
the same for 64 scenes that the training has not seen.

CMA-ES starts from the same network and runs for as many seconds as the gradient took. A generation is one batch of 21
networks in 64 scenes, without tapes; on a GPU, an iteration with the gradient is one CUDA graph, a generation is not.
This needs the package cma, and how far it gets depends on the speed of the machine, so its part of the findings does
not repeat.

Choices: 28 vertices; 1000 kg/m^3; mu = lam = 4e4 Pa, so soft that the column leans far over when the cart speeds up; h
= 1/60 s; K = 16 sweeps. Targets are as high as the column stands, or a tip would reach them lying down. The cart is the
prescribed motion of the column's foot: x and v are all the state there is. The sweeps start from the predictor, as in
the paper's tasks.
"""

import importlib.metadata
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

import diffvbd as dv
from diffvbd import results, viz
from diffvbd.tasks.problem import Problem, Row, Settings, Stage

SIZE = (0.08, 0.4, 0.08)  # [m]
DENSITY = 1000.0  # [kg/m^3]
MU = LAM = 4e4  # [Pa]
TIME_STEP, SWEEPS = 1 / 60, 16  # [s]
STEPS, STAY = 60, 15  # of a motion, and of its end, where the tip must be at the target
SCENES = 64
DISTANCE = (0.15, 0.35)  # from the tip to its target, along the ground [m]
HEIGHT = 0.39  # of the targets; the weight of the column shortens it [m]
SWING = (0.0, 0.5)  # first velocity of the tip [m/s]
ACCELERATION = 6.0  # largest of the cart along an axis [m/s^2]
HIDDEN = 32
LENGTH, SPEED = 0.2, 1.0  # [m], [m/s]; the network sees multiples of them
NEAR = 0.02  # a scene in which the tip is closer than this [m], root mean square, counts as reached
SPREAD = 0.3  # first standard deviation of CMA-ES; for seed 0 the best of 0.03, 0.1, 0.3 and 1
SHOWN = 4  # scenes in pictures

Scenes = tuple[Tensor, Tensor]  # targets [m] and first velocities of the tips [m/s] along the ground, shape [scenes, 2]
Policy = Callable[[Tensor], Tensor]  # from what is seen, shape [..., scenes, 9], to what is done, [..., scenes, 2]


def problem(settings: Settings) -> Problem:
    scenes, iterations = (8, 40) if settings.quick else (SCENES, 150)
    arm = Arm(settings.device)
    training = Training(arm, scenes, settings)
    return Problem(
        name="learn-controller",
        parameters=dict(training.network.named_parameters()),
        stages=[Stage(loss=training.loss, iterations=iterations, learning_rate=0.05, capturable=True)],
        estimates=lambda: judged(training.missed),
        units={"distance": "m"},
        protocol={"scenes": scenes, "vertices": arm.model.num_vertices, "steps": STEPS, "held": STAY,
                  "time_step": TIME_STEP, "sweeps": SWEEPS, "density": DENSITY, "mu": MU, "lam": LAM, "size": SIZE,
                  "height": HEIGHT, "distance": DISTANCE, "swing": SWING, "acceleration": ACCELERATION,
                  "hidden": HIDDEN, "near": NEAR, "spread": SPREAD},
        findings=training.findings,
        picture=training.picture,
        animation=training.animation,
    )  # fmt: skip


class Arm:
    """The column on its cart, and its motion under a policy."""

    def __init__(self, device: str) -> None:
        self.mesh = dv.mesh.box((2, 7, 2), SIZE, split="kuhn").translate((-SIZE[0] / 2, 0.0, -SIZE[2] / 2))
        height = self.mesh.points[:, 1]
        self.model = dv.Model(self.mesh, density=DENSITY, pinned=height == 0.0).to(device)
        self.like = {"dtype": self.model.dtype, "device": self.model.device}
        self.foot, self.tip = (
            torch.as_tensor(np.flatnonzero(height == y), device=self.model.device) for y in (0.0, SIZE[1])
        )
        self.pinned = self.model.pinned[:, None]
        self.ground = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], **self.like)
        self.standing = torch.tensor([0.0, HEIGHT, 0.0], **self.like)
        self.bend = self.model.rest_points[:, 1:2] / SIZE[1]  # share of the tip's velocity that a vertex starts with

    def along_ground(self, x: Tensor, part: Tensor) -> Tensor:
        """Mean x and z of some vertices, shape [..., 2]."""
        return mean(x, part) @ self.ground.T

    def driven(self, policy: Policy, targets: Tensor) -> Callable[[int, Tensor, Tensor], Tensor]:
        """Position of the foot after a step: the decision of the network, carried out by the cart."""

        def drive(step: int, x: Tensor, v: Tensor) -> Tensor:
            speed = self.along_ground(v, self.foot)
            places = [(self.along_ground(x, part) - targets) / LENGTH for part in (self.tip, self.foot)]
            clock = torch.full_like(speed[..., :1], step / STEPS)
            seen = torch.cat([*places, self.along_ground(v, self.tip) / SPEED, speed / SPEED, clock], -1)
            travel = TIME_STEP * (speed + TIME_STEP * ACCELERATION * policy(seen).tanh())
            return torch.where(self.pinned, x + (travel @ self.ground)[..., None, :], x)

        return drive

    def simulate(
        self, policy: Policy, given: Scenes, lead: tuple[int, ...] = (), save: Literal["all", "last"] = "last"
    ) -> results.Trajectory:
        """The motion of each scene, for each of the policies of shape `lead`; it observes from target to tip [m]."""
        targets, swings = given
        shape = (*lead, len(targets), self.model.num_vertices, 3)
        x, v = self.model.rest_points.expand(shape), (self.bend * (swings @ self.ground)[:, None]).expand(shape)
        return dv.rollout(self.model, x, v, dv.VBD(TIME_STEP, SWEEPS, start="predictor"), steps=STEPS, save=save,
                          observe=lambda step, x, v: mean(x, self.tip) - (targets @ self.ground + self.standing),
                          checkpoint_every=None, mu=MU, lam=LAM, prescribed=self.driven(policy, targets))  # fmt: skip

    def misses(self, policy: Policy, given: Scenes, lead: tuple[int, ...] = ()) -> Tensor:
        """Mean squared distance from tip to target while it must be there [m^2], shape [*lead, scenes]."""
        return self.simulate(policy, given, lead).observations[-STAY:].square().sum(-1).mean(0)


class Training:
    """The network, the scenes that it learns from and those that it is judged by, and what CMA-ES makes of it."""

    def __init__(self, arm: Arm, scenes: int, settings: Settings) -> None:
        self.arm, self.settings = arm, settings
        random = torch.Generator().manual_seed(settings.seed)
        self.train, self.test = (
            (around(scenes, DISTANCE, random).to(**arm.like), around(scenes, SWING, random).to(**arm.like))
            for _ in range(2)
        )
        torch.manual_seed(settings.seed)
        self.network = nn.Sequential(nn.Linear(9, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, 2)).to(**arm.like)
        self.first = vector(self.network)
        self.missed = torch.zeros(scenes, **arm.like)  # of each scene, by the latest loss
        self.course: list[tuple[float, float]] = []  # of CMA-ES: seconds, lowest loss so far
        self.stands = 0.9 * torch.tensor([[k // 2, 0.0, k % 2] for k in range(SHOWN)], **arm.like)
        self.surface = np.concatenate([arm.mesh.surface + k * arm.mesh.num_vertices for k in range(SHOWN)])

    def loss(self) -> Tensor:
        each = self.arm.misses(self.network, self.train)
        self.missed.copy_(each.detach())
        return each.mean()

    @torch.no_grad()
    def findings(self, history: list[Row]) -> dict[str, Any]:
        found: dict[str, Any] = {"test": judged(self.arm.misses(self.network, self.test))}
        if self.settings.quick:
            return found
        try:
            return found | self.comparison(history)
        except ImportError as missing:  # which costs the comparison, but not what was learned
            print(missing, file=sys.stderr)
            return found

    def comparison(self, history: list[Row]) -> dict[str, Any]:
        """CMA-ES for as long as the gradient took; ImportError as of `cma_es`."""
        network, like, seconds = self.network, self.arm.like, history[-1]["seconds"]

        def losses(candidates: Tensor) -> Tensor:
            each = policies(network, candidates.to(**like))
            return self.arm.misses(each, self.train, candidates.shape[:1]).mean(-1)

        best, self.course, networks = cma_es(losses, self.first, seconds, self.settings.seed)
        lowest = self.course[-1][1]
        return {
            "seconds": seconds,
            "gradient_was_there_after": next((row["seconds"] for row in history if row["loss"] <= lowest), None),
            "cma_es": {"version": importlib.metadata.version("cma"), "networks": networks,
                       "train": {"distance": lowest**0.5},
                       "test": judged(self.arm.misses(policies(network, best.to(**like)), self.test)),
                       "course": self.course},
        }  # fmt: skip

    @torch.no_grad()
    def shown(self, policy: Policy) -> Tensor:
        """Motion of a few scenes side by side, shape [frames, SHOWN V, 3]."""
        targets, swings = self.test
        motion = self.arm.simulate(policy, (targets[:SHOWN], swings[:SHOWN]), save="all").x
        return (motion + self.stands[:, None]).flatten(1, 2)

    def goals(self) -> list[viz.Scenery]:
        points = (self.test[0][:SHOWN] @ self.arm.ground + self.stands + self.arm.standing).cpu().numpy()
        return [viz.capsule(point, point, 0.03, viz.COLORS["target"]) for point in points]

    def picture(self, path: Path, history: list[Row]) -> None:
        motions = {"untrained": self.shown(policies(self.network, self.first)), "trained": self.shown(self.network)}
        at = [0, STEPS // 4, STEPS // 2, STEPS]
        curves = {"gradient": [(row["seconds"], row["loss"]) for row in history], "CMA-ES": self.course}
        viz.learning(path, self.surface, {name: motion[at] for name, motion in motions.items()},
                     [k * TIME_STEP for k in at], {name: curve for name, curve in curves.items() if curve},
                     self.goals())  # fmt: skip

    def animation(self, path: Path) -> None:
        viz.animation(path, self.surface, {"trained": self.shown(self.network)}, TIME_STEP, self.goals())


def mean(x: Tensor, part: Tensor) -> Tensor:
    """Mean position of some vertices, shape [..., 3]."""
    return x.index_select(-2, part).mean(-2)


def around(count: int, radii: tuple[float, float], random: torch.Generator) -> Tensor:
    """Vectors [count, 2] of random direction whose lengths are even in an interval."""
    length, turn = torch.rand((2, count), generator=random, dtype=torch.float64)
    length, turn = radii[0] + (radii[1] - radii[0]) * length, 2 * torch.pi * turn
    return length[:, None] * torch.stack([turn.cos(), turn.sin()], 1)


def judged(misses: Tensor) -> Row:
    """Of scenes: root mean square of the distance [m], and share that is reached."""
    return {"distance": misses.mean().sqrt().item(), "reached": (misses < NEAR**2).double().mean().item()}


def vector(network: nn.Module) -> Tensor:
    """All numbers of a network, detached, shape [n]."""
    return nn.utils.parameters_to_vector(network.parameters()).detach()


def policies(network: nn.Module, vectors: Tensor) -> Policy:
    """The network with other numbers, shape [*lead, n]; it takes and returns tensors whose shape begins with lead."""
    named = dict(network.named_parameters())
    parts = vectors.split([p.numel() for p in named.values()], -1)
    numbers = {name: part.unflatten(-1, p.shape) for (name, p), part in zip(named.items(), parts, strict=True)}

    def act(numbers: dict[str, Tensor], seen: Tensor) -> Tensor:
        return torch.func.functional_call(network, numbers, (seen,))

    for _ in vectors.shape[:-1]:
        act = torch.func.vmap(act)
    return lambda seen: act(numbers, seen)


def cma_es(
    losses: Callable[[Tensor], Tensor], start: Tensor, seconds: float, seed: int
) -> tuple[Tensor, list[tuple[float, float]], int]:
    """Lower a loss, of rows [n, N] on the CPU, without its gradient for some seconds, at least one generation.

    Returns the best row, (seconds, lowest loss so far) after each generation, and how many losses that took. Raises
    ImportError where the package cma is not installed.
    """
    try:
        import cma
    except ImportError:
        raise ImportError("no comparison with CMA-ES: it needs cma: pip install 'diffvbd[tasks]'") from None
    begun = time.perf_counter()
    options = {"seed": seed % (2**32 - 1) + 1, "verbose": -9}  # seed 0 is the clock
    search = cma.CMAEvolutionStrategy(start.tolist(), SPREAD, options)
    course: list[tuple[float, float]] = []
    count = 0
    while not course or course[-1][0] < seconds:
        rows = search.ask()
        found = losses(torch.tensor(np.array(rows)))
        search.tell(rows, found.tolist())
        count += len(rows)
        course.append((time.perf_counter() - begun, search.best.f))
    return torch.tensor(search.best.x), course, count
