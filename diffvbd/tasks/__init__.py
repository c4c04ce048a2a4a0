"""Inverse problems on the public interface alone; `python -m diffvbd run NAME` runs one."""

from collections.abc import Callable
from dataclasses import dataclass

from diffvbd.tasks import beam_mu, beam_mu_lam
from diffvbd.tasks.runner import Problem, Result, Settings, solve, table


@dataclass(frozen=True)
class Task:
    """A summary in one line, and the function that builds the problem."""

    summary: str
    build: Callable[[Settings], Problem]


TASKS = {
    "beam-mu": Task("shear modulus of a beam that is twisted by half a turn and released", beam_mu.problem),
    "beam-mu-lam": Task("both Lame parameters of a soft beam that is kicked sideways", beam_mu_lam.problem),
}

__all__ = ["TASKS", "Problem", "Result", "Settings", "Task", "solve", "table"]
