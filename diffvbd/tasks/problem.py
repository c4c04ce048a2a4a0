"""What an inverse problem is: parameters, stages with a loss each, what to report."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffvbd.tasks.progress import Row

OWN_KEYS = ("iteration", "stage", "loss", "gradient_norm", "seconds")  # of a row; the others are estimates


@dataclass(frozen=True)
class Settings:
    """What the user chooses about a run.

    Attributes:
        out: Directory for log.json, picture.png, animation.gif, parameters.pt (if there are more than LISTED numbers)
            and state.pt (which exists only while a run is unfinished).
        device: A torch device.
        seed: Seed of torch's generators.
        quick: Ask the task for a small version that runs in seconds; it leaves the animation out.
    """

    out: Path
    device: str = "cpu"
    seed: int = 0
    quick: bool = False


@dataclass
class Stage:
    """One minimisation. A problem has one, or several that follow each other.

    Attributes:
        loss: Scalar loss at the present parameters.
        iterations: Most loss evaluations.
        learning_rate: First rate of Adam; it falls to 0 along a cosine.
        optimizer: Makes another optimiser; it keeps its rate.
        moves: Names of the parameters that it moves; default: all of the problem's.
        tolerance: The stage ends once the loss is at most this fraction of its first loss; 0: never.
        gradient_tolerance: It also ends once the norm of the gradient is at most this fraction of the first one; 0:
            never.
        before: Called with the number of each iteration of the stage before its loss, to change tensors that it reads.
        criterion: Key of the history by whose lowest value the best iteration is chosen, and by the loss among equals;
            for losses that change on the way.
        clip: Longest gradient, over all parameters together; longer ones are scaled down to it. None: no limit.
        capturable: On a CUDA device loss and gradient may be captured in one CUDA graph, which is replayed: the loss
            reads nothing but tensors that stay where they are, and never waits for the device.
        name: For the log.
    """

    loss: Callable[[], Tensor]
    iterations: int
    learning_rate: float = 0.15
    optimizer: Callable[[Iterable[Tensor]], torch.optim.Optimizer] | None = None
    moves: Sequence[str] | None = None
    tolerance: float = 0.0
    gradient_tolerance: float = 0.0
    before: Callable[[int], object] | None = None
    criterion: str = "loss"
    clip: float | None = None
    capturable: bool = False
    name: str = ""


@dataclass
class Problem:
    """An inverse problem.

    Attributes:
        name: Name of the task.
        parameters: Leaf tensors that the optimisers move; `solve` leaves the best ones in them.
        stages: What is minimised, one after another, each from the best parameters of the one before.
        estimates: The quantities to report; called after each evaluation of a loss, at the same parameters.
        truth: Known values of some estimates, for the table.
        units: Units of estimates, for tables.
        protocol: Numbers that define the problem, for the log.
        state: Tensors that `Stage.before` changes and later iterations need: saved and restored, not optimised.
        findings: Called once with the history at the end; what it returns is logged as "findings".
        picture: Draws the result, given a path and the history; needs matplotlib.
        animation: Writes the motion as a .gif, given a path; needs matplotlib.
    """

    name: str
    parameters: dict[str, Tensor]
    stages: Sequence[Stage]
    estimates: Callable[[], Row]
    truth: Row = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    protocol: dict[str, Any] = field(default_factory=dict)
    state: dict[str, Tensor] = field(default_factory=dict)
    findings: Callable[[list[Row]], dict[str, Any]] | None = None
    picture: Callable[[Path, list[Row]], object] | None = None
    animation: Callable[[Path], object] | None = None


@dataclass
class Result:
    """What `solve` found: the best row of the last stage, and every row."""

    best: Row
    history: list[Row]
    estimates: Row
    errors: Row
    converged: bool
    files: list[Path]
    findings: dict[str, Any] = field(default_factory=dict)


def estimates_of(row: Row) -> Row:
    """The quantities that a problem reports, from a row of the history."""
    return {key: value for key, value in row.items() if key not in OWN_KEYS}


def check(problem: Problem) -> None:
    """Raises ValueError or TypeError for a problem that cannot be solved, naming what is wrong."""
    name = problem.name
    if not problem.stages:
        raise ValueError(f"{name}: stages: expected at least one Stage, got none")
    for key, parameter in problem.parameters.items():
        if not (isinstance(parameter, Tensor) and parameter.is_leaf and parameter.requires_grad):
            raise TypeError(f"{name}: parameters[{key!r}]: expected a leaf tensor that requires grad")
    for k, stage in enumerate(problem.stages):
        if stage.iterations < 1:
            raise ValueError(f"{name}: stages[{k}].iterations: expected at least 1, got {stage.iterations}")
        unknown = sorted(set(stage.moves or ()) - set(problem.parameters))
        if unknown:
            raise ValueError(f"{name}: stages[{k}].moves: expected names of parameters, got {unknown}")


def check_device(device: str) -> None:
    """Raises ValueError for a device that torch does not know or see."""
    try:
        kind = torch.device(device).type
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        seen = f"cpu{', cuda' if torch.cuda.is_available() else ''}"
        raise ValueError(f"device: expected one of this machine ({seen}), got {device!r}") from error
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device: expected cpu or cuda, got {device!r}")
