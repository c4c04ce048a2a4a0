"""The optimiser loop that every task shares: progress, log, resume, and a table at the end."""

import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv

Row = dict[str, float]


@dataclass(frozen=True)
class Settings:
    """What the user chooses about a run.

    Attributes:
        out: Directory for log.json, picture.png and state.pt (which exists only while a run is unfinished).
        device: A torch device.
        seed: Seed of torch's generators.
        quick: Ask the task for a small version that runs in seconds.
    """

    out: Path
    device: str = "cpu"
    seed: int = 0
    quick: bool = False


@dataclass
class Problem:
    """An inverse problem.

    Attributes:
        name: Name of the task.
        parameters: Leaf tensors that the optimiser moves; `solve` leaves the best ones in them.
        loss: Scalar loss at the present parameters.
        estimates: The quantities to report, from the present parameters.
        iterations: Most loss evaluations.
        learning_rate: First rate of Adam; it falls to 0 along a cosine.
        optimizer: Makes another optimiser; it keeps its rate.
        tolerance: The run ends once the loss is at most this fraction of the first loss.
        gradient_tolerance: It also ends once the norm of the gradient is at most this fraction of the first one.
        truth: Known values of some estimates, for the table.
        protocol: Numbers that define the problem, for the log.
        picture: Draws the result, given a path and the history; needs matplotlib.
        before: Called with the number of each iteration before its loss, to change tensors that the loss reads.
        criterion: Key of the history by whose lowest value the best iteration is chosen, and by the loss among equals;
            for losses that change on the way.
        capturable: On a CUDA device loss and gradient may be captured in one CUDA graph, which is replayed: the loss
            reads nothing but tensors that stay where they are, and never waits for the device.
    """

    name: str
    parameters: dict[str, Tensor]
    loss: Callable[[], Tensor]
    estimates: Callable[[], Row]
    iterations: int
    learning_rate: float = 0.15
    optimizer: Callable[[Iterable[Tensor]], torch.optim.Optimizer] | None = None
    tolerance: float = 0.0
    gradient_tolerance: float = 0.0
    truth: Row = field(default_factory=dict)
    protocol: dict[str, Any] = field(default_factory=dict)
    picture: Callable[[Path, list[Row]], object] | None = None
    before: Callable[[int], object] | None = None
    criterion: str = "loss"
    capturable: bool = False


@dataclass
class Result:
    """What `solve` found: the best row of the history, and every row."""

    best: Row
    history: list[Row]
    estimates: Row
    errors: Row
    converged: bool
    files: list[Path]


def solve(problem: Problem, settings: Settings) -> Result:
    """Minimise the loss; the parameters with the lowest criterion, by default the loss, win.

    After every step of the optimiser the whole state is on disk, so the same call continues an interrupted run with the
    very numbers the uninterrupted one would have had. A state of other settings or of another protocol is ignored.

    Returns:
        The result; log.json and picture.png (where matplotlib is installed) are in settings.out.

    Raises:
        ArithmeticError: the loss or a gradient is not finite.
    """
    torch.manual_seed(settings.seed)
    settings.out.mkdir(parents=True, exist_ok=True)
    parameters = list(problem.parameters.values())
    if problem.optimizer:
        optimizer, schedule = problem.optimizer(parameters), None
    else:
        # A few parameters and gradients without noise need no long average, and overshoot less without it. Losses in
        # m^2 can be tiny: the default eps would exceed their gradients.
        optimizer = torch.optim.Adam(parameters, problem.learning_rate, betas=(0.7, 0.9), eps=1e-20)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, problem.iterations)
    run = _Run(problem, settings, optimizer, schedule)
    run.resume()
    progress = Progress(problem.name, problem.iterations, done=len(run.history))
    begun = time.perf_counter() - (run.history[-1]["seconds"] if run.history else 0.0)

    def gradient() -> Tensor:
        optimizer.zero_grad()
        loss = problem.loss()
        loss.backward()
        return loss.detach()

    if problem.capturable and torch.device(settings.device).type == "cuda":
        if problem.before:
            problem.before(len(run.history))
        gradient = _captured(gradient)

    def evaluate() -> float:
        if problem.before:
            problem.before(len(run.history))
        loss = gradient()
        row = {"iteration": float(len(run.history)), "loss": loss.item(), "gradient_norm": _norm(parameters)}
        row |= problem.estimates() | {"seconds": time.perf_counter() - begun}
        if not (math.isfinite(row["loss"]) and math.isfinite(row["gradient_norm"])):
            raise ArithmeticError(f"{problem.name}: the loss or its gradient is not finite: {_summary(row)}")
        run.record(row)
        progress.show(row)
        if run.ended:
            raise _Ended
        return row["loss"]

    try:
        while not run.ended:
            # A step of an optimiser with a line search evaluates more than once.
            optimizer.step(evaluate)
            if schedule:
                schedule.step()
            run.save()
    except _Ended:
        pass
    progress.close()
    return run.finish()


def _captured(run: Callable[[], Tensor], warm: int = 2) -> Callable[[], Tensor]:
    """`run` as a CUDA graph: the same work on the same memory, results and gradients included. The optimiser stays
    outside: its few launches cost nothing beside a rollout, and so any optimiser will do."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(warm):  # libraries load, autograd makes its buffers
            run()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = run()

    def replay() -> Tensor:
        graph.replay()
        return result

    return replay


class _Ended(Exception):
    """Leaves an optimiser's step at the last evaluation."""


class _Run:
    """History, best parameters and their files."""

    def __init__(
        self,
        problem: Problem,
        settings: Settings,
        optimizer: torch.optim.Optimizer,
        schedule: torch.optim.lr_scheduler.LRScheduler | None,
    ) -> None:
        self.problem, self.settings, self.optimizer, self.schedule = problem, settings, optimizer, schedule
        self.history: list[Row] = []
        self.best = 0
        self.best_parameters: dict[str, Tensor] = {}
        self.state = settings.out / "state.pt"
        choices = {key: value for key, value in asdict(settings).items() if key != "out"}
        self.identity = {"task": problem.name, "settings": choices, "protocol": problem.protocol}

    @property
    def converged(self) -> bool:
        if not self.history:
            return False
        first, last, problem = self.history[0], self.history[-1], self.problem
        return (
            last["loss"] <= problem.tolerance * first["loss"]
            or last["gradient_norm"] <= problem.gradient_tolerance * first["gradient_norm"]
        )

    @property
    def ended(self) -> bool:
        return self.converged or len(self.history) >= self.problem.iterations

    def record(self, row: Row) -> None:
        self.history.append(row)
        if not self.best_parameters or self._merit(row) < self._merit(self.history[self.best]):
            self.best = len(self.history) - 1
            self.best_parameters = {name: p.detach().clone() for name, p in self.problem.parameters.items()}

    def _merit(self, row: Row) -> tuple[float, float]:
        return row[self.problem.criterion], row["loss"]

    def save(self) -> None:
        state = {
            "identity": json.dumps(self.identity),
            "history": self.history,
            "best": self.best,
            "best_parameters": self.best_parameters,
            "parameters": {name: p.detach() for name, p in self.problem.parameters.items()},
            "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict() if self.schedule else None,
            "random": torch.get_rng_state(),
        }
        _replace(self.state, lambda path: torch.save(state, path))
        self.write_log()

    def resume(self) -> None:
        if not self.state.exists():
            return
        state = torch.load(self.state, map_location=self.settings.device)
        if state["identity"] != json.dumps(self.identity):
            print(f"{self.state} belongs to other settings; starting anew", file=sys.stderr)
            return
        self.history, self.best, self.best_parameters = state["history"], state["best"], state["best_parameters"]
        _assign(self.problem.parameters, state["parameters"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self.schedule:
            self.schedule.load_state_dict(state["schedule"])
        torch.set_rng_state(state["random"].cpu())
        print(f"continuing after {len(self.history)} iterations", file=sys.stderr)

    def write_log(self, **result: Any) -> Path:
        content = self.identity | {"versions": versions(), **result, "history": self.history}
        log = self.settings.out / "log.json"
        _replace(log, lambda path: path.write_text(json.dumps(content, indent=1) + "\n"))
        return log

    def finish(self) -> Result:
        problem = self.problem
        _assign(problem.parameters, self.best_parameters)
        estimates = problem.estimates()
        errors = {name: abs(estimates[name] / true - 1) for name, true in problem.truth.items()}
        best = self.history[self.best]
        log = self.write_log(
            converged=self.converged,
            best=best,
            parameters={name: p.tolist() for name, p in problem.parameters.items()},
            estimates=estimates,
            truth=problem.truth,
            relative_error=errors,
        )
        result = Result(best, self.history, estimates, errors, self.converged, [log])
        if problem.picture:
            picture = self.settings.out / "picture.png"
            try:
                problem.picture(picture, self.history)
                result.files.append(picture)
            except ImportError as missing:
                print(f"no picture: {missing}", file=sys.stderr)
        self.state.unlink(missing_ok=True)
        return result


class Progress:
    """A bar that redraws itself on a terminal, and about ten plain lines elsewhere (a log file, a pipe)."""

    def __init__(self, name: str, total: int, done: int = 0) -> None:
        self.name, self.total, self.done, self.before = name, total, done, done
        self.terminal = sys.stderr.isatty()
        self.begun = time.perf_counter()
        self.last: Row | None = None
        self.printed = True

    def show(self, row: Row) -> None:
        self.done += 1
        self.last = row
        self.printed = self.terminal or self.done == 1 or self.done % max(1, self.total // 10) == 0
        if self.printed:
            self._print()

    def _print(self) -> None:
        assert self.last is not None
        left = (time.perf_counter() - self.begun) / (self.done - self.before) * (self.total - self.done)
        filled = 20 * self.done // self.total
        text = f"{self.name} [{'#' * filled}{'.' * (20 - filled)}] {self.done}/{self.total}  {_summary(self.last)}"
        text += f"  {left:.0f} s left"
        if self.terminal:
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
        else:
            print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        if not self.printed:
            self._print()
        if self.terminal:
            print(file=sys.stderr)


def table(problem: Problem, start: Mapping[str, float], result: Result) -> str:
    """Start, true and recovered values as aligned text."""
    rows = [("parameter", "start", "true", "recovered", "relative error")]
    for name, value in result.estimates.items():
        true = f"{problem.truth[name]:.6g}" if name in problem.truth else "-"
        error = f"{100 * result.errors[name]:.2g} %" if name in result.errors else "-"
        rows.append((name, f"{start[name]:.6g}", true, f"{value:.6g}", error))
    widths = [max(len(row[k]) for row in rows) for k in range(5)]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    lines.insert(1, "  ".join("-" * width for width in widths))
    seconds, first = result.history[-1]["seconds"], result.history[0]["loss"]
    how = "converged" if result.converged else "stopped"
    lines.append(
        f"{how} after {len(result.history)} iterations in {seconds:.0f} s; "
        f"loss {first:.3g} -> {result.best['loss']:.3g} (lowest at iteration {result.best['iteration']:.0f})"
    )
    return "\n".join(lines)


def versions() -> dict[str, str]:
    """Versions of what can change a result."""
    return {
        "diffvbd": dv.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "threads": str(torch.get_num_threads()),
    }


def _summary(row: Row) -> str:
    short = {"loss": "loss", "gradient_norm": "|grad|"}
    return "  ".join(f"{short.get(k, k)} {v:.4g}" for k, v in row.items() if k not in ("iteration", "seconds"))


def _norm(parameters: list[Tensor]) -> float:
    return math.sqrt(sum(p.grad.square().sum().item() for p in parameters if p.grad is not None))


@torch.no_grad()
def _assign(parameters: dict[str, Tensor], values: dict[str, Tensor]) -> None:
    for name, value in values.items():
        parameters[name].copy_(value)


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    # An interruption in the middle of a write must not destroy the previous file.
    unfinished = path.with_name(path.name + ".part")
    write(unfinished)
    os.replace(unfinished, path)
