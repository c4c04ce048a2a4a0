"""Environments: steps per second of batches, forward and with gradient, and training by SHAC and by PPO.

*Forward* is `step` without gradient, captured in a CUDA graph where there is one, with actions drawn at random.
*Gradient* is a horizon of differentiable steps and the gradient of the sum of their rewards by the actions, called from
Python. Both count steps of single scenes. Training is `examples/train_env.py` from its own start: the mean return of
episodes that it does not see, of the policy's mean actions, at the start, at the end and on the way. PPO is that of
stable-baselines3 on the same environment.
"""

from __future__ import annotations

import importlib.util
import runpy
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import torch

from bench.common import ROOT
from bench.measure import Card, Row, attempt
from bench.tables import Table
from diffvbd import envs

KINDS: dict[str, type[envs.Environment]] = {"lift": envs.SoftLift, "crawler": envs.Crawler, "push": envs.TactilePush}
SCENES, SCENES_CPU = (128, 1024, 8192), (8, 32)
STEPS, HORIZON = 20, 8  # that are timed without gradient; that a gradient goes through
SECONDS = 10.0  # of each training
TRAINED, TRAINED_CPU = 512, 8  # scenes
ANYWHERE = True
TABLES = (
    Table("Steps of environments", "steps", {
        "environment": "environment", "scenes": "scenes", "forward [steps/s]": "forward",
        "with gradient [steps/s]": "gradient", "peak memory of the gradient [GiB]": "gradient_gib",
    }),
    Table("Training", "training", {
        "environment": "environment", "method": "method", "scenes": "scenes", "return before": "before",
        "return after": "after", "best": "best", "samples": "samples", "seconds": "seconds",
    }),
)  # fmt: skip


def timed(card: Card, work: Callable[[], Any], calls: int = 1) -> float:
    """Least seconds of a call, of three measurements of so many calls, after one that does not count."""
    work()
    spans = []
    for _ in range(3):
        card.sync()
        start = time.perf_counter()
        for _ in range(calls):
            work()
        card.sync()
        spans.append((time.perf_counter() - start) / calls)
    return min(spans)


def measured(card: Card, kind: type[envs.Environment], scenes: int) -> Row:
    """Steps of scenes per second, forward and with gradient."""
    env = kind(scenes, device=card.device)
    env.reset(seed=0)
    like, random = env.model.rest_points, torch.Generator(card.device).manual_seed(0)
    size = (16, scenes, env.actions)
    actions = 2 * torch.rand(size, generator=random, dtype=like.dtype, device=like.device) - 1
    count = iter(range(10**9))
    calls = 2 if card.quick else STEPS
    forward = timed(card, lambda: env.step(actions[next(count) % len(actions)]), calls)
    del env
    card.tidy()
    env = kind(scenes, differentiable=True, device=card.device)
    leaf = actions[:HORIZON].clone().requires_grad_()

    def gradient() -> None:
        env.reset(seed=0)
        rewards = [env.step(action)[1].sum() for action in leaf.unbind()]
        torch.autograd.grad(torch.stack(rewards).sum(), leaf)

    try:
        span, peak = timed(card, gradient), card.peak(gradient)
    except torch.OutOfMemoryError as error:
        return {"forward": scenes / forward, "gradient": None, "gradient_gib": None, "why": str(error).split(".")[0]}
    return {"forward": scenes / forward, "gradient": HORIZON * scenes / span,
            "gradient_gib": None if peak is None else peak / 2**30}  # fmt: skip


def steps(card: Card) -> list[Row]:
    """Each environment, in batches."""
    rows: list[Row] = []
    for name, kind in KINDS.items():
        for scenes in (2,) if card.quick else SCENES if card.cuda else SCENES_CPU:
            about = {"environment": name, "scenes": scenes, "horizon": HORIZON}
            attempt(card, rows, about, lambda kind=kind, scenes=scenes: measured(card, kind, scenes))
    return rows


def trained(card: Card, name: str, method: str, scenes: int) -> Row:
    """The course of a training."""
    train = runpy.run_path(str(ROOT / "examples" / "train_env.py"))["train"]
    course = train(name, method, 0.2 if card.quick else SECONDS, scenes, str(card.device))
    returns = [row["return"] for row in course]
    return {"before": returns[0], "after": returns[-1], "best": max(returns), "samples": course[-1]["samples"],
            "seconds": course[-1]["seconds"], "course": course}  # fmt: skip


def training(card: Card) -> list[Row]:
    """SHAC, and PPO where stable-baselines3 is installed."""
    rows: list[Row] = []
    others = importlib.util.find_spec("stable_baselines3") is not None
    scenes = 2 if card.quick else TRAINED if card.cuda else TRAINED_CPU
    for name in list(KINDS)[:1] if card.quick else KINDS:
        for method in ("shac", "ppo") if others else ("shac",):
            library = {"stable-baselines3": version("stable-baselines3")} if method == "ppo" else {}
            about = {"environment": name, "method": method, "scenes": scenes, **library}
            attempt(card, rows, about, lambda name=name, method=method: trained(card, name, method, scenes))
    return rows


GROUPS: dict[str, Callable[[Card], list[Row]]] = {"steps": steps, "training": training}
