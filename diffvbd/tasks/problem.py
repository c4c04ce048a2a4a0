"""Inverse problems: parameters, stages with a loss each, and reports."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffvbd.results import Refinement

Row = dict[str, float]
OWN_KEYS = ("iteration", "stage", "loss", "gradient_norm", "seconds")  # of a row; the others are estimates


@dataclass(frozen=True)
class Settings:
    """Choices of the user about a run.

    Attributes:
        out: Directory for log.json, picture.png, animation.gif, motion.npz (which `diffvbd view` shows), parameters.pt
            (if there are more than LISTED numbers) and state.pt (which exists only while a run is unfinished).
        device: A torch device.
        seed: Seed of torch's generators.
        quick: Ask the task for a small version that runs in seconds; it leaves the animation out.
    """

    out: Path
    device: str = "cpu"
    seed: int = 0
    quick: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.out, Path):
            raise TypeError(f"out: expected a pathlib.Path, got {self.out!r}")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or not 0 <= self.seed < 2**63:
            raise ValueError(f"seed: expected an integer from 0 to 2^63 - 1, got {self.seed!r}")


@dataclass
class Stage:
    """One minimisation. A problem has one, or several that follow each other.

    Attributes:
        loss: Scalar loss at the present parameters.
        iterations: Most loss evaluations.
        learning_rate: First rate of Adam; it falls to 0 along a cosine.
        optimizer: Makes another optimiser; it keeps its rate.
        moves: Names of the parameters that it moves; default: all of the problem's.
        tolerance: The stage ends once the loss is at most this fraction of its first loss, which must not be negative
            then; 0: never.
        gradient_tolerance: It also ends once the norm of the gradient is at most this fraction of the first one; 0:
            never.
        refinable: False where the loss keeps what it finds: then a run ends without `dv.refine`, which calls it again.
        before: Called with the number of each iteration of the stage before its loss, to change tensors that it reads;
            the first number may come more than once.
        criterion: Key of the history by whose lowest value the best iteration is chosen, and by the loss among equals;
            for losses that change on the way.
        clip: Longest gradient, over all parameters together; longer ones are scaled down to it. None: no limit.
        rough: The loss has cliffs, as where bodies bounce off one another: Adam averages over more steps, and goes back
            to the lowest loss so far, at a lower rate, once a loss is more than twice as high. The loss must not be
            negative, and where it changes on the way it should not rise much at the same parameters.
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
    rough: bool = False
    capturable: bool = False
    name: str = ""
    refinable: bool = True


@dataclass
class Problem:
    """An inverse problem.

    Attributes:
        name: Name of the task.
        parameters: Leaf tensors that the optimisers move; `solve` leaves the best ones in them.
        stages: What is minimised, one after another, each from the best parameters of the one before.
        estimates: The quantities to report; called after each evaluation of a loss, at the same parameters.
        truth: Known values of some estimates, not 0, for the table.
        units: Units of estimates, for tables.
        protocol: Numbers that define the problem, for the log.
        state: Tensors that `Stage.before` changes and later iterations need: saved and restored, not optimised.
        findings: Called once with the history at the end; what it returns is logged as "findings".
        picture: Draws the result, given a path and the history; needs matplotlib.
        animation: Writes the motion, given a path: as a .gif, which needs matplotlib, or as an .npz for the viewer.
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
    """Result of `solve`: the best row of the last stage, and every row; their "iteration" counts from 0.

    `converged` and `stalled` are about the last stage: it met a tolerance; its optimiser moved no parameter any more.
    `refined`: what dv.refine says of the result, or why it was not asked.
    """

    best: Row
    history: list[Row]
    estimates: Row
    errors: Row
    converged: bool
    stalled: bool
    files: list[Path]
    findings: dict[str, Any] = field(default_factory=dict)
    refined: Refinement | str = ""


def estimates_of(row: Row) -> Row:
    """The quantities that a problem reports, from a row of the history."""
    return {key: value for key, value in row.items() if key not in OWN_KEYS}


def check(problem: Problem) -> None:
    """Raises ValueError or TypeError for a problem that cannot be solved, naming what is wrong."""
    name, parameters = problem.name, problem.parameters
    if not isinstance(parameters, dict) or not parameters:
        raise TypeError(f"{name}: parameters: expected tensors by name, got {parameters!r}")
    for key, parameter in parameters.items():
        if not (isinstance(parameter, Tensor) and parameter.is_leaf and parameter.requires_grad):
            got = type(parameter).__name__
            if isinstance(parameter, Tensor):
                got = f"{'a leaf' if parameter.is_leaf else 'a result'} with requires_grad = {parameter.requires_grad}"
            raise TypeError(f"{name}: parameters[{key!r}]: expected a leaf tensor that requires grad, got {got}")
    if not isinstance(problem.stages, Sequence) or not problem.stages:
        raise ValueError(f"{name}: stages: expected at least one Stage in a list, got {problem.stages!r}")
    for k, stage in enumerate(problem.stages):
        _check_stage(f"{name}: stages[{k}]", stage, parameters)
    if not isinstance(problem.truth, dict):
        raise TypeError(f"{name}: truth: expected numbers by name, got {problem.truth!r}")
    for key, value in problem.truth.items():
        if not _is_number(value) or value == 0:
            expected = "a number that an error can be relative to"
            raise ValueError(f"{name}: truth[{key!r}]: expected {expected}, got {value!r}")


def _check_stage(where: str, stage: Any, parameters: dict[str, Tensor]) -> None:
    if not isinstance(stage, Stage):
        raise TypeError(f"{where}: expected a Stage, got {type(stage).__name__}")
    for key, error, expected, fits in _RULES:
        value = getattr(stage, key)
        if not (fits(value) or (value is None and key in ("optimizer", "before", "clip"))):
            raise error(f"{where}.{key}: expected {expected}, got {value!r}")
    if stage.rough and stage.optimizer is not None:
        raise ValueError(f"{where}.rough: expected False with an optimizer of its own, got {stage.rough!r}")
    moves = stage.moves
    if moves is not None and (isinstance(moves, str) or not moves or not set(moves) <= set(parameters)):
        raise ValueError(f"{where}.moves: expected a list of names among {list(parameters)}, got {moves!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


_RULES: tuple[tuple[str, type[Exception], str, Callable[[Any], bool]], ...] = (  # of the fields of a Stage
    ("iterations", ValueError, "an integer of at least 1", lambda n: isinstance(n, int) and n is not True and n >= 1),
    *((key, TypeError, "a function", callable) for key in ("loss", "optimizer", "before")),
    ("rough", TypeError, "a bool", lambda rough: isinstance(rough, bool)),
    *((key, ValueError, "a number above 0", lambda rate: _is_number(rate) and rate > 0)
      for key in ("learning_rate", "clip")),
    *((key, ValueError, "a number of at least 0", lambda least: _is_number(least) and least >= 0)
      for key in ("tolerance", "gradient_tolerance")),
)  # fmt: skip


def check_row(problem: Problem, stage: int, estimates: Row) -> None:
    """Raises ValueError for estimates that cannot stand in the history, or that lack what is said about them."""
    name = problem.name
    if not isinstance(estimates, dict):
        raise TypeError(f"{name}: estimates: expected a dict of numbers, got {type(estimates).__name__}")
    if taken := sorted(estimates.keys() & set(OWN_KEYS)):
        raise ValueError(f"{name}: estimates: expected other names than {', '.join(OWN_KEYS)}, got {taken}")
    for key, value in estimates.items():
        if not isinstance(value, (int, float)):
            raise TypeError(f"{name}: estimates: expected numbers, got {type(value).__name__} for {key!r}")
        if key == problem.stages[stage].criterion and math.isnan(value):
            raise ArithmeticError(f"{name}: estimates: expected a number to judge by, got NaN for {key!r}")
    if missing := sorted(problem.truth.keys() - estimates.keys()):
        raise ValueError(f"{name}: truth: expected names of estimates, got {missing}")
    criterion = problem.stages[stage].criterion
    if criterion not in {"loss", "gradient_norm", *estimates}:
        raise ValueError(f"{name}: stages[{stage}].criterion: expected a key of the history, got {criterion!r}")


def check_gradients(problem: Problem, stage: int, names: Sequence[str]) -> None:
    """Raises ValueError for parameters that the loss does not depend on."""
    lost = [name for name in names if problem.parameters[name].grad is None]
    if lost:
        raise ValueError(f"{problem.name}: stages[{stage}].loss: expected one that depends on {lost}; see Stage.moves")


def check_loss(name: str, stage: int, loss: Tensor) -> None:
    """Raises ValueError for what is not a scalar that depends on parameters."""
    where = f"{name}: stages[{stage}].loss: expected"
    if not isinstance(loss, Tensor):
        raise TypeError(f"{where} a tensor, got {type(loss).__name__}")
    if loss.dim() != 0:
        raise ValueError(f"{where} a scalar, got shape {list(loss.shape)}")
    if not loss.requires_grad:
        raise ValueError(f"{where} a tensor that depends on the parameters, got one without a gradient")


def check_device(device: str) -> None:
    """Raises ValueError for a device that torch does not know or see."""
    try:
        kind = torch.device(device).type
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:
        seen = f"cpu{', cuda' if torch.cuda.is_available() else ''}"
        raise ValueError(f"device: expected one of this machine ({seen}), got {device!r}") from error
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device: expected cpu or cuda, got {device!r}")
