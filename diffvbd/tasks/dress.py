"""Identify both Lame parameters of a dress that falls onto a mannequin (paper, section 6.5).

The tasks dress-mu-lam, which observes vertices, and dress-silhouette, which observes an outline. The early window ends
when the hem has landed, the settled one is the drape. Stage A alone meets the bars of both tasks. Stage B alone, from
the same start, is run at the end for comparison (findings of a run). It finds the material from vertices, and from
outlines it comes within a per cent in its five rounds. The paper's ends at a fixed point that is no solution. That is a
matter of the scene: each window here sees both parameters, since without friction the dress still swings and turns
about its axis at the end.

Choices: a gown 0.8 m tall whose hem starts 5 cm above the floor, of the mesh's default thickness, and of 100 kg/m^3, so
that it stretches by a tenth or two at 1500 Pa; a mannequin of 13 cm, 2.5 cm less than the waist's inner layer; 80 steps
of 1/60 s. No friction, as in the paper's other task with contact, and no self-contact. K = 20 sweeps for target and fit
alike: with 10 the alternation on outlines no longer contracts at the solution. One search for pairs a step, up to 10
cm. Both objectives are mean squared distances [m^2], added as they are. Newton's steps are damped by a limit, and a
solve makes two of them. The sweeps start from the predictor, as in the paper.

Choices of dress-silhouette: heights from the floor to the neck, 4.25 cm apart; Gaussian windows of 3 cm, half the
distance of rings; the weight of a vertex grows by a factor e per cm of its distance from the axis.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import losses, viz
from diffvbd.tasks.cloth import few_sweeps, ring_of_vertices
from diffvbd.tasks.optimizer import Newton
from diffvbd.tasks.problem import Problem, Row, Settings, Stage
from diffvbd.tasks.report import pictures
from diffvbd.tasks.runner import solve

TRUTH = {"mu": 1500.0, "lam": 800.0}  # [Pa]
START = (5000.0, 3000.0)
TIME_STEP, SWEEPS = 1 / 60, 20  # [s]
NECK, HEM = 0.85, 0.05  # heights of the openings [m]
THICKNESS, DENSITY = 0.01, 100.0  # [m], [kg/m^3]
FOOT, HEAD, RADIUS = (0.0, 0.0, 0.0), (0.0, 0.67, 0.0), 0.13  # of the mannequin [m]
KAPPA, DHAT, DAMPING = 400.0, 0.02, 2.0  # of floor and mannequin [N/m], [m], [N s/m]
REACH = 0.1  # [m]
LEARNING_RATE = 0.15
ROUNDS, NEWTON_STEPS = 5, 2  # of stage B, of each of its solves
PROBE, LIMIT = 1e-3, 0.5  # distance of the second gradient, longest step, in log mu or log lam
HEIGHTS = 21  # of a profile
WINDOW = 0.03  # standard deviation [m]
SOFTNESS = 0.01  # [m]


class Version(NamedTuple):
    """Numbers that the quick version changes."""

    segments: int
    rings: int
    steps: int
    early: int  # frames that the early objective sees
    settled: int  # frames that the settled one averages
    iterations: int  # of stage A
    rounds: int  # of stage B


FULL, QUICK = Version(20, 15, 80, 16, 32, 150, ROUNDS), Version(8, 6, 24, 8, 12, 25, 4)


def problem(name: str, settings: Settings, observe: Callable[[Tensor], Tensor], alone: bool = False) -> Problem:
    """The task of this name.

    Args:
        name: Of the task.
        settings: As for every task.
        observe: What is seen of frames [N, V, 3] [m]: lengths [N, ..., c] [m], compared as points of c coordinates.
        alone: Leave stage A out.
    """
    version = QUICK if settings.quick else FULL
    drape = Drape(settings, observe, version)
    first = Stage(drape.both, version.iterations, LEARNING_RATE, capturable=True, name="both objectives")
    stages = [] if alone else [first]
    for k in range(1, version.rounds + 1):
        stages += [newton(drape.settled_loss, "log_mu", f"mu {k}"), newton(drape.early_loss, "log_lam", f"lam {k}")]

    def findings(history: list[Row]) -> dict[str, Any]:
        other = problem(name, settings, observe, alone=True)
        other.name += ", alternation alone"
        other.picture = other.animation = None
        return {"alternation_alone": solve(other, replace(settings, out=settings.out / "alternation_alone")).estimates}

    return Problem(name=name, parameters={"log_mu": drape.log_mu, "log_lam": drape.log_lam}, stages=stages,
                   estimates=drape.estimates, truth=TRUTH, units={"mu": "Pa", "lam": "Pa"},
                   protocol={"vertices": drape.model.num_vertices, "tets": drape.model.num_tets, "thickness": THICKNESS,
                             "steps": version.steps, "early": version.early, "settled": version.settled,
                             "time_step": TIME_STEP, "sweeps": SWEEPS, "density": DENSITY,
                             "mannequin": [FOOT, HEAD, RADIUS], "kappa": KAPPA, "dhat": DHAT, "damping": DAMPING,
                             "reach": REACH, "detections": 1, "start": START, "stages": len(stages)},
                   findings=None if alone or settings.quick else findings,
                   **pictures(drape.mesh.surface, drape.motions, TIME_STEP, [0, version.early, version.steps], TRUTH,
                              scenery=scenery()))  # fmt: skip


class Drape:
    """A dress, what is seen of its fall, and the material that is looked for."""

    def __init__(self, settings: Settings, observe: Callable[[Tensor], Tensor], version: Version) -> None:
        self.observe, self.version = observe, version
        self.mesh = dv.mesh.dress(version.segments, version.rings, THICKNESS, NECK, HEM)
        neck = ring_of_vertices(self.mesh, version.segments, version.rings) == 0
        energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=KAPPA, dhat=DHAT, damping=DAMPING),
                    dv.PairBarrier(KAPPA, DHAT, self_contact=False, damping=DAMPING, detections=1, reach=REACH)
                    )  # fmt: skip
        mannequin = dv.colliders.Capsule(FOOT, HEAD, RADIUS)
        model = dv.Model(self.mesh, density=DENSITY, pinned=neck, energies=energies, colliders=[mannequin])
        self.model = model.to(settings.device)
        self.still = torch.zeros_like(self.model.rest_points)
        self.start, truth = (self.still.new_tensor(values) for values in (START, list(TRUTH.values())))
        with torch.no_grad():
            self.target = self.fall(truth[0], truth[1])
            self.target_early, self.target_settled = self.first_frames(self.target), self.settled_drape(self.target)
        self.log_mu, self.log_lam = (value.log().requires_grad_() for value in self.start)

    @few_sweeps()
    def fall(self, mu: Tensor, lam: Tensor, steps: int | None = None) -> Tensor:
        """Positions [m] of all frames, shape [steps + 1, V, 3]."""
        solver = dv.VBD(TIME_STEP, SWEEPS, start="predictor")
        return dv.rollout(self.model, self.model.rest_points, self.still, solver, steps=steps or self.version.steps,
                          mu=mu, lam=lam).x  # fmt: skip

    def recovered(self, steps: int | None = None) -> Tensor:
        return self.fall(self.log_mu.exp(), self.log_lam.exp(), steps)

    def first_frames(self, x: Tensor) -> Tensor:
        return self.observe(x[1 : self.version.early + 1])

    def settled_drape(self, x: Tensor) -> Tensor:
        return self.observe(x[-self.version.settled :]).mean(0)

    def early_loss(self, x: Tensor | None = None) -> Tensor:
        x = self.recovered(self.version.early) if x is None else x
        return losses.vertex_distance(self.first_frames(x), self.target_early)

    def settled_loss(self, x: Tensor | None = None) -> Tensor:
        x = self.recovered() if x is None else x
        return losses.vertex_distance(self.settled_drape(x), self.target_settled)

    def both(self) -> Tensor:
        x = self.recovered()
        return self.early_loss(x) + self.settled_loss(x)

    def estimates(self) -> Row:
        return {"mu": self.log_mu.exp().item(), "lam": self.log_lam.exp().item()}

    @torch.no_grad()
    def motions(self) -> dict[str, Tensor]:
        return {
            "initial": self.fall(self.start[0], self.start[1]),
            "target": self.target,
            "recovered": self.recovered(),
        }


def newton(loss: Callable[[], Tensor], moved: str, name: str) -> Stage:
    """One solve of stage B: Newton's method for one of the two numbers."""
    return Stage(
        loss=loss,
        iterations=2 * NEWTON_STEPS + 1,  # two gradients a step, and the result's
        optimizer=lambda parameters: Newton(parameters, PROBE, LIMIT),
        moves=(moved,),
        capturable=True,
        name=name,
    )


def scenery() -> list[viz.Scenery]:
    """Floor and mannequin."""
    # pieces: a picture sorts triangles by depth, and the long ones of a whole mannequin would shine through the dress
    cuts = np.linspace(FOOT, HEAD, 13)
    mannequin = [viz.capsule(a, b, RADIUS) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
    return [viz.floor((-0.5, -0.5), (0.5, 0.5)), *mannequin]


def dress_mu_lam(settings: Settings) -> Problem:
    """The task dress-mu-lam."""
    return problem("dress-mu-lam", settings, observe=lambda frames: frames)


def dress_silhouette(settings: Settings) -> Problem:
    """The task dress-silhouette."""
    heights = torch.linspace(0.0, NECK, HEIGHTS, dtype=torch.float64, device=settings.device)
    return problem("dress-silhouette", settings, observe=lambda frames: profile(frames, heights)[..., None])


def profile(x: Tensor, heights: Tensor) -> Tensor:
    """Radius [m] of the outline of positions x [..., V, 3] [m] around the y axis at each height [H] [m], [..., H]."""
    radius = x[..., ::2].norm(dim=-1)[..., None, :]
    below = (x[..., None, :, 1] - heights[:, None]) / WINDOW
    return ((radius / SOFTNESS - 0.5 * below.square()).softmax(-1) * radius).sum(-1)
