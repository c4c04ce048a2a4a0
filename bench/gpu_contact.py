"""Small scenes with contact on a GPU: a step of the task cover-the-spot, and grippers by the thousand."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench.common import cell, markdown_table
from bench.gpu_measure import Card, Row, Work, attempt, milliseconds
from bench.tradeoff_scenes import gripper
from diffvbd.tasks import cover_the_spot
from diffvbd.tasks.problem import Settings

# Of grippers. With this reach a scene has about 1,000 pairs, and a vertex may go 1 mm in each of two parts of a step:
# they lift by 1.5 mm a step.
TIME_STEP, SWEEPS, DETECTIONS, REACH = 0.005, 10, 2, 4e-3
CLOSING, STEPS = 32, 5  # steps until they hold and lift evenly; steps timed
SPARE = 1.25  # of the pairs that there are then, what lists have room for


def small_contact(card: Card, rate: float) -> list[Row]:
    """Milliseconds of a step of one scene, and how many steps of scenes a second many at once take."""
    rows: list[Row] = []
    attempt(card, rows, {"name": "cover-the-spot"}, lambda: _cover(card))
    for scenes in (2,) if card.quick else (1, 64, 1024):
        name = "gripper" if scenes == 1 else f"{scenes} grippers"
        attempt(card, rows, {"name": name}, lambda scenes=scenes: _grippers(card, scenes))
    return rows


def _cover(card: Card) -> list[Row]:
    settings = Settings(Path("unused"), str(card.device), 0, card.quick)
    fall = cover_the_spot.Fall(settings, cover_the_spot.RADIUS,
                               cover_the_spot.QUICK if card.quick else cover_the_spot.FULL)  # fmt: skip

    def forward() -> Tensor:
        with torch.no_grad():
            return fall.simulate()

    def both() -> tuple[Tensor, ...]:
        return torch.autograd.grad(fall.simulate().sum(), (fall.velocity, fall.offset))

    about = {"vertices": fall.model.num_vertices, "scenes": 1, "sweeps": fall.version.sweeps}
    return _timed(card, about, fall.version.steps, forward, both, (0.25, 0.6))


def landed_step(card: Card) -> Work:
    """A step and its gradients where disks lie on the floor and on one another."""
    fall = cover_the_spot.Fall(Settings(Path("unused"), str(card.device)), cover_the_spot.RADIUS, cover_the_spot.FULL)
    given: dict[str, Any] = {"mu": cover_the_spot.MU, "lam": cover_the_spot.LAM, "time_step": cover_the_spot.TIME_STEP,
                             "sweeps": cover_the_spot.SWEEPS}  # fmt: skip
    x, v = fall.model.rest_points, fall.velocity[:, None].expand(-1, fall.disk.num_vertices, -1).flatten(0, 1)
    with torch.no_grad():
        end = dv.rollout(fall.model, x, v, steps=fall.version.steps, save="last", **given)
    leaves = tuple(t[-1].detach().requires_grad_() for t in (end.x, end.v))
    return lambda: torch.autograd.grad(sum(t.sum() for t in dv.step(fall.model, *leaves, **given)), leaves)


def _grippers(card: Card, scenes: int) -> list[Row]:
    about, forward, both = grippers(card, scenes, STEPS)
    many = scenes >= 1024
    rows = _timed(card, about, STEPS, forward, both, (None, None))
    for row, target in zip(rows, (1e5, 3.5e4), strict=True):
        row["scene_steps_per_s"] = 1e3 * scenes / (row["ms"] or row["eager_ms"])
        row["target_rate"] = target if many else None
    return rows


def grippers(card: Card, scenes: int, steps: int) -> tuple[Row, Work, Work]:
    """Scenes in which clamps hold a bar: what they are, some steps of them, and these with their gradients."""
    scene = gripper(5, (3, 5, 5), detections=DETECTIONS, reach=REACH)
    model, clamps = scene.model.to(card.device), scene.given["prescribed"]
    rest = model.rest_points
    shares = torch.ones((scenes, 1, 3)).to(rest)  # they close differently, and lift alike
    shares[..., 0] += 0.5 * torch.rand((scenes, 1), generator=torch.Generator().manual_seed(0)).to(rest)
    x, v = rest.expand(scenes, -1, -1).clone(), rest.new_zeros((scenes, *rest.shape))

    def ends(step: int) -> Tensor:
        end = clamps(step * TIME_STEP).to(rest)
        return rest + shares * (end - rest)

    def step(at: Tensor, speed: Tensor, k: int) -> tuple[Tensor, Tensor]:
        return dv.step(model, at, speed, mu=1e5, lam=2e5, time_step=TIME_STEP, sweeps=SWEEPS, prescribed=ends_of[k])

    ends_of = [ends(k + 1) for k in range(CLOSING + steps)]
    with torch.no_grad():
        for k in range(CLOSING):
            x, v = step(x, v, k)
    leaves = tuple(t.requires_grad_() for t in (x, v))

    def moved() -> Tensor:
        at, speed = leaves
        for k in range(CLOSING, CLOSING + steps):
            at, speed = step(at, speed, k)
        return at

    def forward() -> Tensor:
        with torch.no_grad():
            return moved()

    def both() -> tuple[Tensor, ...]:
        return torch.autograd.grad(moved().sum(), leaves)

    forward()
    status = dv.contact.status(model)
    pairs = status.pairs / scenes
    dv.contact.reserve(model, math.ceil(SPARE * pairs))
    held_up = sum(status.cut) / (scenes * model.num_active)
    about: dict[str, Any] = {"vertices": model.num_vertices, "scenes": scenes, "sweeps": SWEEPS,
                             "pairs_per_scene": pairs, "held_up": held_up}  # fmt: skip
    return about, forward, both


def _timed(card: Card, about: dict[str, Any], steps: int, forward: Any, both: Any,
           targets: tuple[float | None, float | None]) -> list[Row]:  # fmt: skip
    """A row of the forward and one of forward and reverse, in milliseconds a step."""
    rows: list[Row] = []
    for part, work, target in zip(("forward", "forward + reverse"), (forward, both), targets, strict=True):
        eager = milliseconds(card.eager(work, 3), steps)
        ms = milliseconds(card.graph(work, 5, 3.0), steps)
        rows.append(about | {"part": part, "ms": ms, "eager_ms": eager, "target_ms": target})
        card.tidy()
    return rows


def table(rows: list[Row]) -> str:
    header = ("scene with contact", "part", "vertices", "K", "pairs a scene", "vertices held up", "graph [ms a step]",
              "target", "eager [ms a step]", "scene-steps/s", "target")  # fmt: skip
    return markdown_table(header, [
        (r["name"], r["part"], r["vertices"], r["sweeps"], cell(r.get("pairs_per_scene")), cell(r.get("held_up")),
         r["ms"], r["target_ms"], r["eager_ms"], cell(r.get("scene_steps_per_s")),
         cell(r.get("target_rate"))) for r in rows])  # fmt: skip
