"""Inverse problems on the public interface alone; `python -m diffvbd run NAME` runs one.

docs/tasks.md describes them. The docstring of a task states what else was chosen, above all what the paper leaves open.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diffvbd.tasks import (
    beam,
    bounce,
    cloth,
    cover_the_spot,
    dress,
    fit_real_mesh,
    learn_controller,
    lift,
    million_cubes,
    throw,
)
from diffvbd.tasks.problem import Problem, Result, Settings, Stage
from diffvbd.tasks.report import table
from diffvbd.tasks.runner import solve


@dataclass(frozen=True)
class Option:
    """Option of a task besides Settings: `--name VALUE` on the command line, a keyword of its `problem`."""

    kind: Callable[[str], Any]
    help: str


@dataclass(frozen=True)
class Task:
    """A summary in one line, the function that builds the problem, its options by name, and whether ranks share it."""

    summary: str
    build: Callable[..., Problem]
    options: dict[str, Option] = field(default_factory=dict)
    splits: bool = False

    def chosen(self, texts: dict[str, str]) -> dict[str, Any]:
        """Keywords of `build` from options as they are written on a command line.

        Raises:
            ValueError: an option that the task has not, or a value that is not of its kind.
        """
        if unknown := sorted(texts.keys() - self.options.keys()):
            known = ", ".join(self.options) or "none"
            raise ValueError(f"--{unknown[0]}: expected one of the task's options ({known}), got {texts[unknown[0]]!r}")
        found = {}
        for name, text in texts.items():
            try:
                found[name.replace("-", "_")] = self.options[name].kind(text)
            except ValueError:
                kind = getattr(self.options[name].kind, "__name__", "value")
                raise ValueError(f"--{name}: expected {kind}, got {text!r}") from None
        return found


TASKS = {
    "beam-mu": Task("shear modulus of a beam that is twisted by half a turn and released", beam.beam_mu),
    "beam-mu-lam": Task("both Lame parameters of a soft beam that is kicked sideways", beam.beam_mu_lam),
    "bunny-bounce": Task("throw a bunny that meets a target after its bounce", bounce.bunny_bounce),
    "cape-mu": Task("shear modulus of a cloth from how far its center sags", cloth.cape_mu),
    "cape-wind": Task("constant wind that a cape hung in, from its final shape", cloth.cape_wind),
    "cover-the-spot": Task(
        "throw three soft disks that cover a round target",
        cover_the_spot.problem,
        {"radius": Option(float, "radius of the disks [m] (default 0.42)")},
    ),
    "cube-bounce": Task(
        "throw a cube that meets a target after its bounce",
        bounce.cube_bounce,
        {"sweeps": Option(int, "sweeps per step (default 20)")},
    ),
    "dress-mu-lam": Task("both Lame parameters of a dress that drapes over a mannequin", dress.dress_mu_lam),
    "dress-silhouette": Task("both Lame parameters of the dress from its outline alone", dress.dress_silhouette),
    "dress-size": Task("size of a dress from the height of its hem", cloth.dress_size),
    "fit-real-mesh": Task(
        "map the stiffness inside a body from pulls at its surface",
        fit_real_mesh.problem,
        {
            "mesh": Option(Path, "file of tets, or a surface to fill with tets (default: a rabbit)"),
            "edge-length": Option(float, "of tets that fill a surface, in its unit (default 1/20 of its diagonal)"),
            "iterations": Option(int, "evaluations for each smoothing weight (default 40, 24, 24, 30; quick 30)"),
        },
    ),
    "flag-wind": Task("wind in eight windows that moves a flag as observed", cloth.flag_wind),
    "learn-controller": Task("train a network that drives a soft arm to where it must be", learn_controller.problem),
    "lift": Task("lift a soft beam with two fingers of a robot that press no more than they must", lift.problem),
    "million-cubes": Task(
        "launch a million small cubes that meet in a ring at one moment",
        million_cubes.problem,
        {
            "bodies": Option(int, "number of cubes (default 1000000; quick: at most 64, and so by default)"),
            "steps": Option(int, "steps of a rollout, at least 120 (default 240; not with --quick)"),
            "iterations": Option(int, "of each of the two stages (default 40)"),
        },
        splits=True,
    ),
    "throw": Task("throw a soft ball into a box with a stretched sheet", throw.problem),
}

__all__ = ["TASKS", "Option", "Problem", "Result", "Settings", "Stage", "Task", "solve", "table"]
