"""Inverse problems on the public interface alone; `python -m diffvbd run NAME` runs one."""

from collections.abc import Callable
from dataclasses import dataclass

from diffvbd.tasks import beam_mu, beam_mu_lam, cover_the_spot
from diffvbd.tasks.runner import Problem, Result, Settings, solve, table


@dataclass(frozen=True)
class Task:
    """A summary in one line, the function that builds the problem, and the numbers that it takes besides Settings."""

    summary: str
    build: Callable[..., Problem]
    numbers: tuple[str, ...] = ()


TASKS = {
    "beam-mu": Task("shear modulus of a beam that is twisted by half a turn and released", beam_mu.problem),
    "beam-mu-lam": Task("both Lame parameters of a soft beam that is kicked sideways", beam_mu_lam.problem),
    "cover-the-spot": Task("throw three soft disks that cover a round target", cover_the_spot.problem, ("radius",)),
}

__all__ = ["TASKS", "Problem", "Result", "Settings", "Task", "solve", "table"]
