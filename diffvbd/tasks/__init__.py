"""Inverse problems on the public interface alone; `python -m diffvbd run NAME` runs one."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from diffvbd.tasks import beam_mu, beam_mu_lam, cover_the_spot
from diffvbd.tasks.runner import Problem, Result, Settings, Stage, solve, table


@dataclass(frozen=True)
class Option:
    """What a task takes besides Settings: `--name VALUE` on the command line, a keyword of its `problem`."""

    kind: Callable[[str], Any]
    help: str


@dataclass(frozen=True)
class Task:
    """A summary in one line, the function that builds the problem, and its options by name."""

    summary: str
    build: Callable[..., Problem]
    options: dict[str, Option] = field(default_factory=dict)


TASKS = {
    "beam-mu": Task("shear modulus of a beam that is twisted by half a turn and released", beam_mu.problem),
    "beam-mu-lam": Task("both Lame parameters of a soft beam that is kicked sideways", beam_mu_lam.problem),
    "cover-the-spot": Task(
        "throw three soft disks that cover a round target",
        cover_the_spot.problem,
        {"radius": Option(float, "radius of the disks [m] (default 0.42)")},
    ),
}

__all__ = ["TASKS", "Option", "Problem", "Result", "Settings", "Stage", "Task", "solve", "table"]
