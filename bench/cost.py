"""Cost of a backward by each route on one forward: time, memory, iterations, error; then over stiffness.

The preset scene of `python -m bench exactness` (115 vertices, four steps) at K = 20. Gradients are those to x0, v0, mu
and lam, the moduli being one number each; errors are those of x0 and v0. Conjugate gradients stop at 1e-10, as the
default does. The unrolled opponent is `dv.Unrolled()`, the same sweeps in torch, vectorised over each color.
"""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import statistics
import time
import warnings
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench import paper
from bench.common import cell, markdown_table
from bench.cpu import peak_memory, reset_peak_memory
from bench.exactness import (
    PRESET,
    Case,
    Row,
    Scene,
    Solves,
    build,
    expected_of,
    gradient_error,
    result_of,
    verify_forward,
)
from bench.gpu_measure import Card
from diffvbd import testing

SWEEPS = 20
TOLERANCE = 1e-10  # of the linear solves: the default, and about the errors in the paper's table
MODULI = (1e3, 1e4, 1e5, 5e5, 1e6, 5e6)  # [Pa], mu = lam
FULL, COMPACT, UNROLLED = "reverse sweep, full tape", "reverse sweep, compact tape", "unrolled autograd"
GLOBAL = ("global, assembled", "global, matrix-free")
PROCESSES = 5  # whose resident memory is read, one after another, for each route


def route(name: str, solves: Solves | None = None) -> Any:
    """The adjoint of a route."""
    if name in GLOBAL:
        return dv.GlobalAdjoint(assembled=name == GLOBAL[0], tolerance=TOLERANCE, on_failure="warn", report=solves)
    return {FULL: dv.ReverseSweep("full"), COMPACT: dv.ReverseSweep("compact"), UNROLLED: dv.Unrolled()}[name]


ROUTES = (FULL, COMPACT, UNROLLED, *GLOBAL)


class Task:
    """Forward and backward of a scene's rollout by one route."""

    def __init__(self, scene: Scene, name: str) -> None:
        case, like = scene.case, scene.x
        moduli = [torch.full((), m, dtype=like.dtype, device=like.device) for m in (case.mu, case.lam)]
        self.leaves = tuple(t.clone().requires_grad_() for t in (scene.x, scene.v, *moduli))
        self.options = scene.options(SWEEPS)
        self.scene, self.adjoint = scene, route(name)
        rng = testing.generator("loss")
        self.weights = [torch.from_numpy(rng.standard_normal(tuple(like.shape))).to(like) for _ in range(2)]
        self.weights[1] *= case.time_step

    def forward(self) -> tuple[Tensor, Tensor]:
        x, v, mu, lam = self.leaves
        given = {**self.options, "mu": mu, "lam": lam, "adjoint": self.adjoint}
        done = dv.rollout(self.scene.model, x, v, checkpoint_every=None, save="last", **given)
        return done.x[-1], done.v[-1]

    def backward(self, end: tuple[Tensor, Tensor]) -> Any:
        return torch.autograd.grad(end, self.leaves, self.weights)

    def both(self) -> Any:
        return self.backward(self.forward())


def seconds(card: Card, task: Task) -> tuple[float, float]:
    """Wall-clock seconds of one forward and of its backward, from idle device to idle device."""
    card.sync()
    start = time.perf_counter()
    end = task.forward()
    card.sync()
    middle = time.perf_counter()
    task.backward(end)
    card.sync()
    return middle - start, time.perf_counter() - middle


def interleaved(card: Card, tasks: dict[Any, Task], rounds: dict[Any, int]) -> dict[Any, Row]:
    """Median milliseconds of each task. Rounds visit all tasks, so that a drift of the machine hits all alike, each
    round in another order, so that what a task leaves in the caches does; a task that takes longer takes part in fewer
    rounds, spread over the whole."""
    spans: dict[Any, list[tuple[float, float]]] = {key: [] for key in tasks}
    total, order = max(rounds.values()), testing.generator("order")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a solve that fails is a column of the table
        for task in tasks.values():
            task.both()
        for n in range(total):
            gc.collect()
            gc.disable()  # a collection that falls into one task's time is not that task's
            for key in (list(tasks)[k] for k in order.permutation(len(tasks))):
                if n * rounds[key] // total != (n + 1) * rounds[key] // total:
                    spans[key].append(seconds(card, tasks[key]))
            gc.enable()
    return {
        key: {
            "forward_ms": 1e3 * statistics.median(f for f, _ in values),
            "backward_ms": 1e3 * statistics.median(b for _, b in values),
            "both_ms": 1e3 * statistics.median(f + b for f, b in values),
            "repetitions": len(values),
        }
        for key, values in spans.items()
    }


def accuracy(scene: Scene, name: str, expected: dict[str, Tensor]) -> Row:
    """Gradient error of a route, its forward verified first, and what its linear solves took."""
    solves = Solves()
    if name == UNROLLED:
        return {"error": None}
    got = result_of(scene, SWEEPS, route(name, solves))
    forward = verify_forward(scene, got, expected, name)
    return {"error": gradient_error(got, expected), "forward": forward, **solves.summary()}


def run(quick: bool, *, device: str = "cpu") -> dict[str, Any]:
    card = Card(torch.device(device), quick)
    return {"routes": routes(card), "stiffness": stiffness(card), "device": card.device.type}


# --- one scene --------------------------------------------------------------------------------------------------------


def _preset(quick: bool) -> Case:
    return replace(PRESET, size="small", steps=2) if quick else PRESET


def routes(card: Card) -> list[Row]:
    scene = build(_preset(card.quick), str(card.device))
    expected = expected_of(scene, SWEEPS)
    errors = {name: accuracy(scene, name, expected) for name in ROUTES}
    tasks = {name: Task(scene, name) for name in ROUTES}
    many, few = (5, 1) if card.quick else (41, 7)
    rounds = {name: few if name == UNROLLED else many for name in ROUTES}
    rows = interleaved(card, tasks, rounds)
    for name, row in rows.items():
        row |= {"route": name, "mesh": scene.name, "steps": scene.case.steps, **errors[name]}
        if card.cuda:
            row["memory"] = card.peak(tasks[name].both)
        else:
            processes = PROCESSES if not card.quick else int(name in (FULL, UNROLLED))
            row["memories"] = [_resident_growth(name, card.quick) for _ in range(processes)]
            row["memory"] = statistics.median(row["memories"]) if processes else None
        if name in (FULL, COMPACT):
            row |= _captured(card, tasks[name])
    return list(rows.values())


def _captured(card: Card, task: Task) -> Row:
    """Milliseconds in a CUDA graph; its backward alone cannot be captured and is a difference. Nothing on the CPU."""
    ahead, both = card.graph(task.forward), card.graph(task.both)
    if ahead is None or both is None:
        return {}
    return {"graph_forward_ms": 1e3 * ahead, "graph_backward_ms": 1e3 * (both - ahead), "graph_both_ms": 1e3 * both}


def _resident_growth(name: str, quick: bool) -> int:
    """Bytes by which forward and backward raise the peak of resident memory of a process of their own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_growth_here, (name, quick))


def _growth_here(name: str, quick: bool) -> int:
    task = Task(build(_preset(quick)), name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        task.both()  # libraries and thread pool are up
        gc.collect()
        try:  # what the first call has left free in the heap would hide what the second needs
            ctypes.CDLL("libc.so.6").malloc_trim(0)
        except OSError:
            pass  # another C library
        before = reset_peak_memory()
        task.both()
    return peak_memory() - before


# --- stiffness --------------------------------------------------------------------------------------------------------


def stiffness(card: Card) -> list[Row]:
    """The same scene with mu = lam from soft to stiff: iterations, times and errors of the routes."""
    names = (FULL, UNROLLED, *GLOBAL)
    moduli = MODULI[::5] if card.quick else MODULI
    scenes = {m: build(replace(_preset(card.quick), mu=m, lam=m), str(card.device)) for m in moduli}
    often, seldom, rarely = (5, 1, 1) if card.quick else (201, 5, 3)
    rounds = {FULL: often, UNROLLED: rarely} | dict.fromkeys(GLOBAL, seldom)
    times: dict[Any, Row] = {}
    for group in ((FULL,), names[1:]):  # ours alone: differences of per cents drown beside a graph of 80 MB
        tasks = {(m, name): Task(scene, name) for m, scene in scenes.items() for name in group}
        times |= interleaved(card, tasks, {key: rounds[key[1]] for key in tasks})
    rows = []
    for m, scene in scenes.items():
        expected = expected_of(scene, SWEEPS)
        row: Row = {"modulus": m, "time_step": scene.case.time_step, "routes": {}}
        for name in names:
            row["routes"][name] = {**times[m, name], **accuracy(scene, name, expected)}
        rows.append(row)
    return rows


# --- text -------------------------------------------------------------------------------------------------------------

MEMORY = {
    "cuda": "Memory is the growth of `torch.cuda.max_memory_allocated` over what stood before.",
    "cpu": "Memory is the growth of the peak of resident memory (pages of 4 kB) over forward and backward in a process "
    "of its own, after a first call and after the heap's free pages have been given back (`malloc_trim`): the median "
    f"of {PROCESSES} processes. torch does not count what compiled code allocates, so this counts all: tensors, "
    "workspace, nodes of the graph, and what the allocator rounds up.",
}


def ratios(rows: list[Row]) -> list[tuple[str, float | None, float]]:
    """What the reverse sweep with its full tape saves, and the least that it should."""
    by_name = {row["route"]: row for row in rows}
    ours, theirs = by_name[FULL], by_name[UNROLLED]
    out: list[tuple[str, float | None, float]] = []
    for part, label in (("backward_ms", "backward"), ("both_ms", "forward + backward")):
        out.append((f"less time than unrolled autograd, {label}", theirs[part] / ours[part],
                    paper.LESS_TIME_THAN_UNROLLED))  # fmt: skip
    for name in (FULL, COMPACT):
        mine = by_name[name]["memory"]
        saved = theirs["memory"] / mine if mine and mine > 0 else None
        out.append(
            (f"less memory than unrolled autograd, {name.split(', ')[1]}", saved, paper.LESS_MEMORY_THAN_UNROLLED)
        )
    for part, label in (("backward_ms", "backward"), ("both_ms", "forward + backward")):
        best = min(by_name[name][part] for name in GLOBAL)
        out.append((f"less time than the faster global route, {label}", best / ours[part], paper.LESS_TIME_THAN_GLOBAL))
    return out


def steadiness(rows: list[Row], part: str) -> float:
    """How much longer the reverse sweep takes at its slowest modulus than at its fastest."""
    times = [row["routes"][FULL][part] for row in rows]
    return max(times) / min(times) - 1


def markdown(results: dict[str, Any]) -> str:
    rows = results["routes"]
    by_name = {row["route"]: row for row in rows}
    text = (
        f"Forward and backward of a rollout of {rows[0]['steps']} steps at K = {SWEEPS}, {rows[0]['mesh']}, float64: "
        f"gradients to x0, v0, mu and lam. Median wall-clock milliseconds of {by_name[FULL]['repetitions']} "
        f"repetitions (unrolled: {by_name[UNROLLED]['repetitions']}), called from Python, in rounds that visit all "
        f"routes in turn. The linear solves stop at {TOLERANCE:g}; *iterations* are those of the longest of a step, "
        f"and of all. Errors are relative, of x0 and v0. {MEMORY[results['device']]}\n"
    )
    header = ("route", "forward [ms]", "backward [ms]", "paper [ms]", "peak memory [MB]", "paper [MB]", "iterations",
              "paper", "gradient error", "paper")  # fmt: skip
    lines = []
    for row in rows:
        theirs = paper.COST.get(row["route"], {})
        lines.append((row["route"], row["forward_ms"], row["backward_ms"], theirs.get("backward_ms"),
                      None if row["memory"] is None else row["memory"] / 1e6, theirs.get("memory_mb"),
                      _iterations(row), theirs.get("iterations"), row["error"], theirs.get("error")))  # fmt: skip
        if "graph_both_ms" in row:
            lines.append((f"{row['route']}, CUDA graph", row["graph_forward_ms"], row["graph_backward_ms"],
                          *[None] * 7))  # fmt: skip
    text += "\n## Routes\n\n" + markdown_table(header, lines)
    text += (
        "\nThe paper's times are those of its backward on an RTX 4090 Laptop GPU, its iterations and errors those "
        "of a scene that it does not state.\n\n"
    )
    text += markdown_table(
        ("the reverse sweep takes", "factor", "paper"),
        [(what, value, f">= {target}") for what, value, target in ratios(rows)],
    )
    return text + "\n" + _stiffness_text(results["stiffness"])


def _stiffness_text(rows: list[Row]) -> str:
    ours = [row["routes"][FULL] for row in rows]
    text = (
        f"## Stiffness: mu = lam, h = {rows[0]['time_step']:g} s\n\n"
        f"The reverse sweep's backward varies by {100 * steadiness(rows, 'backward_ms'):.1f} % over the moduli "
        f"(slowest over fastest, medians of {ours[0]['repetitions']} interleaved repetitions; forward + backward: "
        f"{100 * steadiness(rows, 'both_ms'):.1f} %): it solves nothing whose difficulty tracks the material. The "
        f"paper counts about {paper.SOFT_ITERATIONS} iterations for soft material and {paper.STIFF_ITERATIONS} at "
        f"{paper.STIFF_MODULUS:g} Pa, in a scene that it does not state. Where {SWEEPS} sweeps do not converge any "
        "more, the global routes differentiate another function, however well they solve.\n\n"
    )
    header = ["mu = lam [Pa]", "reverse sweep [ms]", "error", "unrolled [ms]"]
    for name in GLOBAL:
        header += [f"{name} [ms]", "iterations", "error"]
    lines = []
    for row in rows:
        ours = row["routes"][FULL]
        line = [f"{row['modulus']:g}", ours["backward_ms"], ours["error"], row["routes"][UNROLLED]["backward_ms"]]
        for name in GLOBAL:
            theirs = row["routes"][name]
            line += [theirs["backward_ms"], _iterations(theirs), theirs["error"]]
        lines.append(line)
    return text + "Milliseconds of the backward.\n\n" + markdown_table(header, lines)


def _iterations(row: Row) -> str:
    if "iterations" not in row:
        return cell(None)
    return f"{row['iterations']}, in all {row['total_iterations']}{'' if row['converged'] else ', not converged'}"
