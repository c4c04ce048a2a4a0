"""Reports of a run: progress while it goes on, a table at its end, and the versions that it depended on."""

import logging
import platform
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffvbd as dv
from diffvbd import losses, viz
from diffvbd.results import Refinement
from diffvbd.tasks.problem import Problem, Result, Row, Settings, Stage, estimates_of
from diffvbd.viz.pictures import VIEW

LOG = logging.getLogger("diffvbd")


class Progress:
    """A bar that redraws itself on a terminal, and about ten plain lines elsewhere (a log file, a pipe)."""

    def __init__(self, name: str, total: int, done: int = 0, watch: Callable[[Row], object] | None = None) -> None:
        self.name, self.total, self.done, self.before, self.watch = name, total, done, done, watch
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
        LOG.info("%s %d/%d  %s", self.name, self.done, self.total, summary(row))
        if self.watch is not None:
            self.watch(row)

    def _print(self) -> None:
        assert self.last is not None
        left = (time.perf_counter() - self.begun) / (self.done - self.before) * (self.total - self.done)
        filled = 20 * self.done // self.total
        text = f"{self.name} [{'#' * filled}{'.' * (20 - filled)}] {self.done}/{self.total}  {summary(self.last)}"
        text += f"  {left:.0f} s left"
        if self.terminal:
            text = text[: shutil.get_terminal_size().columns - 1]  # a line that wraps cannot be cleared
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
        else:
            print(text, file=sys.stderr, flush=True)

    def say(self, text: str) -> None:
        """A line of its own."""
        print(f"\n{text}" if self.terminal and self.last else text, file=sys.stderr, flush=True)

    def close(self) -> None:
        if not self.printed:
            self._print()
        if self.terminal:
            print(file=sys.stderr)


def pictures(
    surface: NDArray[np.int64],
    motions: Callable[[], dict[str, Tensor]],
    time_step: float,
    shown: list[int],
    truth: Row | None = None,
    **options: Any,
) -> dict[str, Any]:
    """`picture` and `animation` of a Problem whose motions [N, V, 3] are compared, the picture at the frames shown.

    Options are those of both functions of `viz`: scenery and view.
    """

    def picture(path: Path, history: list[Row]) -> None:
        frames = {name: motion[shown] for name, motion in motions().items()}
        times = [k * time_step for k in shown]
        viz.comparison(path, surface, frames, times, history, truth, **options)

    def animation(path: Path) -> None:
        viz.animation(path, surface, motions(), time_step, **options)

    return {"picture": picture, "animation": animation}


def fitted(
    name: str,
    unknown: str,
    simulate: Callable[[Tensor], Tensor],
    start: Tensor,
    true: Tensor,
    estimates: Callable[[Tensor], Row],
    stage: dict[str, Any],
    drawn: tuple[NDArray[np.int64], float, list[int]],
    observe: Callable[[Tensor], Tensor] = lambda x: x,
    weight: float = 1.0,
    target_name: str = "",
    findings: Callable[[Tensor], dict[str, Any]] | None = None,
    truth: Row | None = None,
    view: tuple[float, float] = VIEW,
    **fields: Any,
) -> Problem:
    """Problem of one stage of Adam: the values whose motion looks like that of the true ones.

    Args:
        name: Of the task.
        unknown: Name of the parameter; "log_..." is the logarithm of the values.
        simulate: Positions [m] of all frames [N, V, 3] from the values.
        start, true: First guess and true values, of one shape.
        estimates: Quantities to report, from the present values.
        stage: `iterations`, `learning_rate` and other fields of the Stage.
        drawn: Surface, time between frames [s] and frames shown, see `pictures`.
        observe: Points [..., c] [m] that are seen of a motion; the loss is their mean squared distance.
        weight: Of the loss.
        target_name: Entry of the protocol for what is seen of the true motion, where that is one number.
        findings: As in Problem, from the present values.
        fields: Protocol and units of the Problem.
    """
    is_log = unknown.startswith("log_")
    parameter = (start.log() if is_log else start.clone()).requires_grad_()

    def now() -> Tensor:
        return parameter.exp() if is_log else parameter

    with torch.no_grad():
        target_motion = simulate(true)
        target = observe(target_motion)
    if target_name:
        fields["protocol"][target_name] = target.item()

    @torch.no_grad()
    def motions() -> dict[str, Tensor]:
        return {"initial": simulate(start), "target": target_motion, "recovered": simulate(now())}

    def loss() -> Tensor:
        return weight * losses.vertex_distance(observe(simulate(now())), target)

    return Problem(
        name=name,
        parameters={unknown: parameter},
        stages=[Stage(loss=loss, capturable=True, **stage)],
        estimates=lambda: estimates(now()),
        truth=truth or {},
        findings=None if findings is None else lambda history: findings(now()),
        **fields,
        **pictures(*drawn[:1], motions, *drawn[1:], truth, view=view),
    )


def table_of(start: Mapping[str, float], estimates: Row, truth: Row, errors: Row, units: Mapping[str, str]) -> str:
    """Start, true and recovered values as aligned text."""
    rows = [("parameter", "start", "true", "recovered", "relative error")]
    for name, value in estimates.items():
        true = f"{truth[name]:.6g}" if name in truth else "-"
        error = f"{100 * errors[name]:.2g} %" if name in errors else "-"
        label = f"{name} [{units[name]}]" if name in units else name
        rows.append((label, f"{start[name]:.6g}", true, f"{value:.6g}", error))
    widths = [max(len(row[k]) for row in rows) for k in range(5)]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def versions(device: str = "cpu") -> dict[str, str]:
    """Versions of what can change a result, and the machine."""
    return {
        "diffvbd": dv.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "threads": str(torch.get_num_threads()),
        "device": torch.cuda.get_device_name(device) if torch.device(device).type == "cuda" else platform.machine(),
    }


def summary(row: Row) -> str:
    """A row of the history in one line."""
    short = {"loss": "loss", "gradient_norm": "|grad|"}
    return "  ".join(f"{short.get(k, k)} {v:.4g}" for k, v in row.items() if k not in ("iteration", "seconds"))


def survival(problem: Problem, settings: Settings, first: float) -> Refinement | str:
    """Refinement of the result by more sweeps and smaller steps, or the reason why it is not known."""
    stage = problem.stages[-1]
    if settings.quick:
        return "not refined: a quick run"
    if not stage.refinable:
        return "not refined: its loss keeps what it finds"
    if stage.before or len(problem.stages) > 1:
        return "not refined: what its loss reads changes during the run"
    state = {name: value.clone() for name, value in problem.state.items()}
    try:
        return dv.refine(stage.loss, before=first)
    except Exception as error:  # more memory or pairs than there is room for: that costs no result
        return f"not refined: {error or type(error).__name__}"
    finally:
        with torch.no_grad():
            for name, value in state.items():
                problem.state[name].copy_(value)


def table(problem: Problem, result: Result) -> str:
    """Start, true and recovered values as aligned text, and how the run ended."""
    seconds, first = result.history[-1]["seconds"], result.history[0]["loss"]
    how = "converged" if result.converged else "stalled" if result.stalled else "stopped"
    start = estimates_of(result.history[0])
    return table_of(start, result.estimates, problem.truth, result.errors, problem.units) + (
        f"\n{how} after {len(result.history)} evaluations in {seconds:.0f} s; "
        f"loss {first:.3g} -> {result.best['loss']:.3g} (lowest at evaluation {result.best['iteration'] + 1:.0f})"
        + (f"\n{result.refined}" if result.refined else "")
    )
