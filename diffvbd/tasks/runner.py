"""The optimiser loop that every task shares: stages, log, resume, pictures."""

import io
import json
import math
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffvbd.mesh.write import replace
from diffvbd.tasks import problem as checks
from diffvbd.tasks.folder import STATE, alone_in, is_first, prepare, put_aside, remove_results, with_own_folder
from diffvbd.tasks.optimizer import optimizer_of
from diffvbd.tasks.problem import OWN_KEYS, Problem, Result, Row, Settings, Stage, estimates_of
from diffvbd.tasks.report import Progress, summary, survival, versions

LISTED = 1000  # numbers of a parameter that log.json lists; larger ones go to parameters.pt


def solve(problem: Problem, settings: Settings, watch: Callable[[Row], object] | None = None) -> Result:
    """Minimise the losses of all stages; of each stage the parameters with the lowest criterion win.

    A stage whose optimiser has stalled ends there, and stderr says so: two steps in a row moved no parameter and saw
    the same losses, so that every further one would, too.

    After every step of an optimiser the whole state is on disk, so the same call continues an interrupted run with the
    very numbers the uninterrupted one would have had. A state of other settings, of another protocol or of a first loss
    that is no longer the same number is put aside. In a process group every rank has to call it, with the same problem
    and settings; files are those of the first rank. `watch` is called there with each row of the history, at its
    parameters, which it must not change.

    Returns:
        The result; files are in settings.out: log.json, motion.npz and, with matplotlib, picture.png and animation.gif.

    Raises:
        ArithmeticError: the loss or a gradient is not finite.
        OSError: a file cannot be written, as on a full disk; the same call continues the run.
        ValueError, TypeError: the problem is not well formed; the device is not there; the folder cannot be written to,
            holds results of another task, or another run works in it.
    """
    checks.check(problem)
    checks.check_device(settings.device)
    with alone_in(settings.out) if is_first() else nullcontext(), with_own_folder(settings) as own:
        return _solve(problem, own, watch if is_first() else None)


def _solve(problem: Problem, settings: Settings, watch: Callable[[Row], object] | None) -> Result:
    torch.manual_seed(settings.seed)
    prepare(settings.out, problem.name)
    run = _Run(problem, settings)
    run.resume()
    if run.cuda:
        torch.cuda.empty_cache()  # what others have left would count
        torch.cuda.reset_peak_memory_stats(settings.device)
    progress = Progress(problem.name, sum(stage.iterations for stage in problem.stages), len(run.history), watch)
    begun = time.perf_counter() - (run.history[-1]["seconds"] if run.history else 0.0)
    while run.at < len(problem.stages):
        _minimise(run, progress, begun)
        run.next_stage()
    progress.close()
    return run.finish()


def _minimise(run: "_Run", progress: Progress, begun: float) -> None:
    """The run's present stage, from where it stands to its end."""
    problem, stage, parameters = run.problem, run.stage, list(run.moved.values())
    gradient = _gradient(run)

    def evaluate() -> float:
        if stage.before:
            stage.before(len(run.rows))
        loss = gradient()
        norm = math.sqrt(sum(p.grad.square().sum().item() for p in parameters if p.grad is not None))
        row = {"iteration": float(len(run.history)), "loss": loss.item(), "gradient_norm": norm}
        if len(problem.stages) > 1:
            row["stage"] = float(run.at)
        estimates = problem.estimates()
        checks.check_row(problem, run.at, estimates)
        row |= estimates | {"seconds": time.perf_counter() - begun}
        if not (math.isfinite(row["loss"]) and math.isfinite(row["gradient_norm"])):
            raise ArithmeticError(f"{problem.name}: the loss or its gradient is not finite: {summary(row)}")
        if stage.clip is not None:
            torch.nn.utils.clip_grad_norm_(parameters, stage.clip)
        run.record(row)
        progress.show(row)
        if run.stage_ended:
            raise _Ended
        return row["loss"]

    try:
        while not run.stage_ended:
            # A step of an optimiser with a line search evaluates more than once.
            before, rows = [p.detach().clone() for p in parameters], len(run.history)
            run.optimizer.step(evaluate)
            if run.schedule:
                run.schedule.step()
            run.notice(before, rows)
            run.save()
    except _Ended:
        pass
    if run.stalled:
        name = f", stage {stage.name or run.at}" if len(problem.stages) > 1 else ""
        progress.say(f"{problem.name}{name}: stalled: the last two steps of the optimiser moved no parameter")


def _gradient(run: "_Run") -> Callable[[], Tensor]:
    """Loss of the present stage, whose gradient it leaves in the parameters."""
    stage = run.stage

    def gradient() -> Tensor:
        for parameter in run.problem.parameters.values():
            parameter.grad = None
        loss = stage.loss()
        checks.check_loss(run.problem.name, run.at, loss)
        loss.backward(inputs=list(run.moved.values()))
        checks.check_gradients(run.problem, run.at, list(run.moved))
        return loss.detach()

    if not (stage.capturable and run.cuda):
        return gradient
    if stage.before:
        stage.before(len(run.rows))
    with torch.cuda.device(run.settings.device):
        return captured(gradient)


class _Ended(Exception):
    """Leaves an optimiser's step at the last evaluation."""


class _Run:
    """The stage that a run has reached, its optimiser, history and best parameters, and their files."""

    def __init__(self, problem: Problem, settings: Settings) -> None:
        self.problem, self.settings = problem, settings
        self.history: list[Row] = []
        self.state = settings.out / STATE
        choices = {key: value for key, value in asdict(settings).items() if key != "out"}
        self.identity = {"task": problem.name, "settings": choices, "protocol": problem.protocol}
        self.cuda = torch.device(settings.device).type == "cuda"
        self.fingerprint = self._fingerprint()
        self._enter(0)

    def _enter(self, stage: int) -> None:
        self.at, self.first, self.best = stage, len(self.history), len(self.history)
        self.best_parameters: dict[str, Tensor] = {}
        self.stalled = False
        self.still: list[float] = []  # losses of the last step, if it moved no parameter
        if stage >= len(self.problem.stages):
            return
        self.optimizer, self.schedule = optimizer_of(self.stage, list(self.moved.values()))

    @property
    def stage(self) -> Stage:
        return self.problem.stages[self.at]

    @property
    def moved(self) -> dict[str, Tensor]:
        """Parameters that the present stage moves, by name."""
        return _moved(self.problem, self.stage)

    @property
    def rows(self) -> list[Row]:
        """Of the present stage."""
        return self.history[self.first :]

    @property
    def converged(self) -> bool:
        if not self.rows:
            return False
        first, last, stage = self.rows[0], self.rows[-1], self.stage
        limits = {"loss": stage.tolerance, "gradient_norm": stage.gradient_tolerance}
        return any(limit > 0 and last[key] <= limit * first[key] for key, limit in limits.items())

    @property
    def stage_ended(self) -> bool:
        return self.converged or self.stalled or len(self.rows) >= self.stage.iterations

    def record(self, row: Row) -> None:
        self.history.append(row)
        if not self.best_parameters or self._merit(row) < self._merit(self.history[self.best]):
            self.best = len(self.history) - 1
            self.best_parameters = {name: p.detach().clone() for name, p in self.problem.parameters.items()}

    def notice(self, before: list[Tensor], rows: int) -> None:
        """Record of whether the optimiser stalls, after its step from `before` and as many rows of the history."""
        moved = any(not torch.equal(p, old) for p, old in zip(self.moved.values(), before, strict=True))
        losses = [row["loss"] for row in self.history[rows:]]
        self.stalled = not self.converged and not moved and losses == self.still
        self.still = [] if moved else losses

    def _merit(self, row: Row) -> tuple[float, float]:
        return row[self.stage.criterion], row["loss"]

    def next_stage(self) -> None:
        _assign(self.problem.parameters, self.best_parameters)
        self.last_best, self.last_converged, self.last_stalled = self.best, self.converged, self.stalled
        self._enter(self.at + 1)
        if self.at < len(self.problem.stages):
            self.save()

    def save(self) -> None:
        if not is_first():
            return
        state = {"fingerprint": self.fingerprint, "history": self.history, "stage": (self.at, self.first, self.best),
                 "stalls": (self.stalled, self.still), "best_parameters": self.best_parameters,
                 "parameters": {name: p.detach() for name, p in self.problem.parameters.items()},
                 "state": self.problem.state, "optimizer": self.optimizer.state_dict(),
                 "schedule": self.schedule.state_dict() if self.schedule else None,
                 "random": torch.get_rng_state()}  # fmt: skip
        replace(self.state, partial(_save, state))
        self.write_log()

    def resume(self) -> None:
        """Continue where the file says, if it is of the same problem."""
        if not self.state.exists():
            remove_results(self.settings.out)  # of a run before, which this one's would be mixed with
            return
        tensors = (self.problem.parameters, self.problem.state)
        begun = [{name: t.detach().clone() for name, t in each.items()} for each in tensors]
        first = self._first_loss()
        try:
            state = torch.load(self.state, map_location=self.settings.device)
            same = state["fingerprint"] == self.fingerprint and state["history"][0]["loss"] == first
            if same:
                self._restore(state)
        except Exception as error:  # torch.load raises errors of many kinds, and a damaged state others
            same = False
            print(f"{self.state} cannot be read ({type(error).__name__}: {error})", file=sys.stderr)
        if same:
            print(f"continuing after {len(self.history)} iterations", file=sys.stderr)
            return
        for each, values in zip(tensors, begun, strict=True):
            _assign(each, values)
        torch.manual_seed(self.settings.seed)
        self.history = []
        self._enter(0)
        aside = put_aside(self.state)
        print(f"{self.state} does not belong to this run, and is {aside.name} now; starting anew", file=sys.stderr)

    def _restore(self, state: dict[str, Any]) -> None:
        stage, first, best = state["stage"]
        if not 0 <= stage < len(self.problem.stages):
            raise ValueError(f"there is no stage {stage}")
        self.history = state["history"]
        self._enter(stage)
        self.first, self.best = first, best
        self.stalled, self.still = state["stalls"]
        self.best_parameters = state["best_parameters"]
        for each in (state["parameters"], self.best_parameters):
            if not all(value.isfinite().all() for value in each.values()):
                raise ValueError("a parameter is not finite")
        _assign(self.problem.parameters, state["parameters"])
        _assign(self.problem.state, state["state"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self.schedule:
            self.schedule.load_state_dict(state["schedule"])
        torch.set_rng_state(state["random"].cpu())
        keys = set(OWN_KEYS) - {"stage"}
        if not (all(keys <= row.keys() for row in self.history) and 0 <= first <= best <= len(self.history)):
            raise ValueError("its history is not whole")

    def _fingerprint(self) -> str:
        """Text that must be the same for a run to be continued, besides the first loss."""
        kept = ("name", "iterations", "moves", "tolerance", "gradient_tolerance", "criterion", "clip", "rough")
        stages = []
        for stage in self.problem.stages:
            optimizer, _ = optimizer_of(stage, list(_moved(self.problem, stage).values()))
            groups = [{k: v for k, v in group.items() if k != "params"} for group in optimizer.param_groups]
            stages.append([[getattr(stage, key) for key in kept], type(optimizer).__name__, groups])
        tensors = {name: [str(p.dtype), *p.shape] for name, p in self.problem.parameters.items()}
        known = versions(self.settings.device)
        libraries = {key: known[key] for key in ("diffvbd", "torch", "device")}
        content = {"stages": stages, "tensors": tensors, "versions": libraries}
        return json.dumps(self.identity | content, default=str)

    def _first_loss(self) -> float:
        """Of a run that begins now, which it leaves as it would have begun."""
        stage, kept = self.problem.stages[0], {name: t.clone() for name, t in self.problem.state.items()}
        if stage.before:
            stage.before(0)
        loss = stage.loss().item()
        _assign(self.problem.state, kept)
        torch.manual_seed(self.settings.seed)
        return loss

    def write_log(self, **result: Any) -> Path:
        stages = [stage.name for stage in self.problem.stages]
        content = self.identity | {"stages": stages, "versions": versions(self.settings.device), **result}
        log = self.settings.out / "log.json"
        text = json.dumps(content | {"history": self.history}, indent=1, default=_plain)
        replace(log, lambda path: path.write_text(text + "\n"))
        return log

    def finish(self) -> Result:
        problem, best = self.problem, self.history[self.last_best]
        estimates = estimates_of(best)
        errors = {name: abs(estimates[name] / true - 1) for name, true in problem.truth.items()}
        memory = {}  # that the run has reserved of a CUDA device, before findings, which may run other things
        if self.cuda:
            memory = {"peak_memory_gb": torch.cuda.max_memory_reserved(self.settings.device) / 1e9}
        findings = problem.findings(self.history) if problem.findings else {}
        refined = survival(problem, self.settings, self.history[0]["loss"])
        listed = {name: p.tolist() for name, p in problem.parameters.items() if p.numel() <= LISTED}
        log = self.write_log(converged=self.last_converged, stalled=self.last_stalled, best=best, parameters=listed,
                             estimates=estimates, truth=problem.truth, units=problem.units, relative_error=errors,
                             findings=findings, refined=str(refined),
                             variables=sum(p.numel() for p in problem.parameters.values()), **memory)  # fmt: skip
        result = Result(best, self.history, estimates, errors, self.last_converged, self.last_stalled, [log], findings,
                        refined)  # fmt: skip
        if listed.keys() != problem.parameters.keys():
            path = self.settings.out / "parameters.pt"
            replace(path, partial(_save, {name: p.detach().cpu() for name, p in problem.parameters.items()}))
            result.files.append(path)
        self._draw(result)
        self.state.unlink(missing_ok=True)
        return result

    def _draw(self, result: Result) -> None:
        """Pictures come last, and what goes wrong with them costs no result."""
        draw: dict[str, Callable[[Path], object]] = {}
        if picture := self.problem.picture:
            draw["picture.png"] = lambda path: picture(path, self.history)
        if animation := self.problem.animation:
            draw |= {"motion.npz": animation} | ({} if self.settings.quick else {"animation.gif": animation})
        for name, function in draw.items():
            try:
                replace(self.settings.out / name, function)
                result.files.append(self.settings.out / name)
            except Exception as error:
                if isinstance(error, OSError) and error.errno:  # a full disk: the run continues here once there is room
                    raise
                print(f"no {name}: {error or type(error).__name__}", file=sys.stderr)


def _save(state: dict[str, Any], path: Path) -> None:
    content = io.BytesIO()  # torch.save into a file turns the system's errors into others
    torch.save(state, content)
    path.write_bytes(content.getbuffer())


@torch.no_grad()
def _assign(parameters: dict[str, Tensor], values: dict[str, Tensor]) -> None:
    for name, value in values.items():
        parameters[name].copy_(value)


def _plain(value: Any) -> Any:
    """Arrays and tensors as numbers; of anything else, such as paths, its name."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _moved(problem: Problem, stage: Stage) -> dict[str, Tensor]:
    return {name: p for name, p in problem.parameters.items() if stage.moves is None or name in stage.moves}


def captured(run: Callable[[], Tensor], warm: int = 2) -> Callable[[], Tensor]:
    """`run` as a CUDA graph: the same work on the same memory, results and gradients included. The optimiser stays
    outside: its few launches cost nothing against a rollout, and so any optimiser will do.

    A graph cannot make its lists of pairs longer: a step with more pairs than when it was captured returns NaN. Then
    `run` works once outside of it, where lists grow or the step says what is wrong, and is captured anew.
    """
    graph, result = _graph(run, warm)

    def replay() -> Tensor:
        nonlocal graph, result
        graph.replay()
        if not bool(torch.isfinite(result).all()):
            del graph  # its memory goes to the next
            graph, result = _graph(run, 1)
            graph.replay()
        return result

    return replay


def _graph(run: Callable[[], Tensor], warm: int) -> tuple[torch.cuda.CUDAGraph, Tensor]:
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(warm):  # libraries load, autograd makes its buffers
            run()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = run()
    return graph, result
