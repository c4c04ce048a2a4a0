"""Cost of a backward by each route on one forward: time, memory, iterations, error; then over stiffness.

The preset scene of `python -m bench exactness` (115 vertices, four steps) at K = 20. Gradients are those to x0, v0, mu
and lam, the moduli being one number each; errors are those of x0 and v0. Conjugate gradients stop at 1e-10, as the
default does. The unrolled opponent is `dv.Unrolled()`, the same sweeps in torch, vectorised over each color.

What is compared: ours is compiled code, its opponents are sequences of torch operations on small tensors, as the
paper's are; how much of their time is dispatch has a table of its own. The matrix-free opponent multiplies by
hand-written products with the Hessian, where the paper's takes torch's double backward.
"""

from __future__ import annotations

import gc
import statistics
import time
import warnings
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bench import paper
from bench.common import cell, markdown_table
from bench.cost_parts import (
    COMPACT,
    FULL,
    GLOBAL,
    PARTS,
    ROUTES,
    SWEEPS,
    TOLERANCE,
    Task,
    kept_bytes,
    preset,
    resident_growth,
    route,
    split,
)
from bench.exactness import UNROLLED, Row, Scene, Solves, build, expected_of, gradient_error, result_of, verify_forward
from bench.gpu_measure import Card
from diffvbd import testing

PRESET_MODULUS = 1e4  # [Pa]
MODULI = (1e3, PRESET_MODULUS, 1e5, paper.STIFF_MODULUS, 1e6, 5e6)  # [Pa], mu = lam
SPLIT_AT = (PRESET_MODULUS, paper.STIFF_MODULUS)  # where the time of the global routes is taken apart
PROCESSES = 5  # whose resident memory is read, one after another, for each route


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
    got = result_of(scene, SWEEPS, route(name, solves))
    forward = verify_forward(scene, got, expected, name)
    return {"error": gradient_error(got, expected), "forward": forward, **solves.summary()}


def run(quick: bool, *, device: str = "cpu") -> dict[str, Any]:
    card = Card(torch.device(device), quick)
    rows, stiff = routes(card), stiffness(card)
    if card.cuda:  # last, because a capture that fails leaves torch on the stream of the capture
        unrolled = next(row for row in rows if row["route"] == UNROLLED)
        try:
            unrolled |= _captured(card, build(preset(quick), device), UNROLLED)
        except RuntimeError as error:
            unrolled["graph_failed"] = str(error).splitlines()[0][:200]
    return {"routes": rows, "stiffness": stiff, "device": card.device.type}


# --- one scene --------------------------------------------------------------------------------------------------------


def routes(card: Card) -> list[Row]:
    scene = build(preset(card.quick), str(card.device))
    expected = expected_of(scene, SWEEPS)
    errors = {name: accuracy(scene, name, expected) for name in ROUTES}
    tasks = {name: Task(scene, name) for name in ROUTES}
    many, few = (5, 1) if card.quick else (41, 7)
    rounds = {name: few if name == UNROLLED else many for name in ROUTES}
    rows = interleaved(card, tasks, rounds)
    for name, row in rows.items():
        row |= {"route": name, "mesh": scene.name, "steps": scene.case.steps, **errors[name]}
        row["kept"] = kept_bytes(tasks[name])
        if card.cuda:
            tasks[name].both()  # libraries have their workspaces
            row["memory"] = card.peak(tasks[name].both)
        else:
            processes = PROCESSES if not card.quick else int(name in (FULL, UNROLLED))
            row["memories"] = [resident_growth(name, card.quick) for _ in range(processes)]
            row["memory"] = statistics.median(row["memories"]) if processes else None
    for name in (FULL, COMPACT):  # after all peaks: a capture makes torch drop the workspaces of cuBLAS
        rows[name] |= _captured(card, scene, name)
    return list(rows.values())


def _captured(card: Card, scene: Scene, name: str) -> Row:
    """Milliseconds in a CUDA graph; its backward alone cannot be captured and is a difference. Nothing on the CPU."""
    # with leaves of its own, which no graph of another stream has seen
    task = Task(scene, name)
    ahead, both = card.graph(task.forward), card.graph(task.both)
    if ahead is None or both is None:
        return {}
    return {"graph_forward_ms": 1e3 * ahead, "graph_backward_ms": 1e3 * (both - ahead), "graph_both_ms": 1e3 * both}


# --- stiffness --------------------------------------------------------------------------------------------------------


def stiffness(card: Card) -> list[Row]:
    """The same scene with mu = lam from soft to stiff: iterations, times and errors of the routes.

    Three groups of tasks are measured one after another: ours alone; ours among the global routes, round by round; and
    unrolled autograd, whose graph of tens of MB would empty the caches of whatever comes next.
    """
    moduli = SPLIT_AT if card.quick else MODULI
    scenes = {m: build(replace(preset(card.quick), mu=m, lam=m), str(card.device)) for m in moduli}
    alone, among, few = (5, 3, 1) if card.quick else (201, 21, 3)
    times = []
    for names, count in (((FULL,), alone), ((FULL, *GLOBAL), among), ((UNROLLED,), few)):
        tasks = {(m, name): Task(scene, name) for m, scene in scenes.items() for name in names}
        times.append(interleaved(card, tasks, dict.fromkeys(tasks, count)))
    rows = []
    for m, scene in scenes.items():
        expected = expected_of(scene, SWEEPS)
        row: Row = {"modulus": m, "time_step": scene.case.time_step, "steps": scene.case.steps,
                    "among_global": times[1][m, FULL], "routes": {}}  # fmt: skip
        for name in (FULL, UNROLLED, *GLOBAL):
            measured = next(group[m, name] for group in times if (m, name) in group)
            row["routes"][name] = {**measured, **accuracy(scene, name, expected)}
        if m in SPLIT_AT:
            for name in GLOBAL:
                row["routes"][name] |= {"split": split(card, scene, name)}
        rows.append(row)
    return rows


# --- text -------------------------------------------------------------------------------------------------------------

PEAK = {
    "cuda": (
        "allocator peak",
        "growth of `torch.cuda.max_memory_allocated` over forward and backward: the paper's own",
    ),
    "cpu": (
        "resident peak",
        "growth of the peak of resident memory (pages of 4 kB) over forward and backward in a process of its own, "
        "after a first call and after the heap's free pages have been given back (`malloc_trim`), the median of "
        f"{PROCESSES} processes. It counts all: tensors, workspace, nodes of the graph, what the allocator rounds up. "
        "The paper's is the peak of torch's CUDA allocator, which sees no nodes of the graph",
    ),
}
KEPT = (
    "stored tensors",
    "bytes of the distinct tensor storages that the graph holds between forward and backward, what it shares with the "
    "graph of another rollout left out. Workspace of a backward, as the matrix of a global route, is not in it",
)


def ratios(rows: list[Row]) -> list[tuple[str, float, float]]:
    """What the reverse sweep with its full tape saves in time, and the least that it should."""
    by_name = {row["route"]: row for row in rows}
    ours, theirs = by_name[FULL], by_name[UNROLLED]
    out = []
    for part, label in (("backward_ms", "backward"), ("both_ms", "forward + backward"),
                        ("graph_both_ms", "forward + backward, both in a CUDA graph")):  # fmt: skip
        if part in ours and part in theirs:
            out.append((f"less time than unrolled autograd, {label}", theirs[part] / ours[part],
                        paper.LESS_TIME_THAN_UNROLLED))  # fmt: skip
    for part, label in (("backward_ms", "backward"), ("both_ms", "forward + backward")):
        best = min(by_name[name][part] for name in GLOBAL)
        out.append((f"less time than the faster global route, {label}", best / ours[part], paper.LESS_TIME_THAN_GLOBAL))
    return out


def steadiness(times: list[Row], part: str) -> float:
    """How much longer a route takes at its slowest modulus than at its fastest."""
    values = [row[part] for row in times]
    return max(values) / min(values) - 1


def markdown(results: dict[str, Any]) -> str:
    rows, stiff = results["routes"], results["stiffness"]
    by_name = {row["route"]: row for row in rows}
    text = (
        f"Forward and backward of a rollout of {rows[0]['steps']} steps at K = {SWEEPS}, {rows[0]['mesh']}, float64: "
        f"gradients to x0, v0, mu and lam. Median wall-clock milliseconds of {by_name[FULL]['repetitions']} "
        f"repetitions (unrolled: {by_name[UNROLLED]['repetitions']}), called from Python, in rounds that visit all "
        f"routes in turn. The linear solves stop at {TOLERANCE:g}; *iterations* are those of the longest of a step, "
        "and of all. Errors are relative, of x0 and v0; that of unrolled autograd, the reference's own code, is 0 or "
        "rounding. Every route's end state was compared with the reference's first; the largest difference is "
        f"{max(row['forward'] for row in rows):.1e}, relative.\n"
    )
    header = ("route", "forward [ms]", "backward [ms]", "paper [ms]", "iterations", "paper", "gradient error", "paper")
    lines = []
    for row in rows:
        theirs = paper.COST.get(row["route"], {})
        lines.append((row["route"], row["forward_ms"], row["backward_ms"], theirs.get("backward_ms"),
                      _iterations(row), theirs.get("iterations"), row["error"], theirs.get("error")))  # fmt: skip
        if "graph_both_ms" in row:
            lines.append((f"{row['route']}, CUDA graph", row["graph_forward_ms"], row["graph_backward_ms"],
                          *[None] * 5))  # fmt: skip
    text += "\n## Routes\n\n" + markdown_table(header, lines)
    text += (
        "\nThe paper's times are those of its backward on an RTX 4090 Laptop GPU, its iterations and errors those "
        f"of a scene that it does not state.{_of_graphs(by_name) if results['device'] == 'cuda' else ''}\n\n"
    )
    text += markdown_table(
        ("the reverse sweep takes", "factor", "paper"),
        [(what, value, f">= {target}") for what, value, target in ratios(rows)],
    )
    text += "\n" + _memory_text(rows, results["device"])
    return text + "\n" + _dispatch_text(stiff) + "\n" + _stiffness_text(stiff)


def _of_graphs(by_name: dict[str, Row]) -> str:
    failed = by_name[UNROLLED].get("graph_failed")
    unrolled = f"; the capture of unrolled autograd failed ({failed})" if failed else ", and so is unrolled autograd"
    return (
        f" In a CUDA graph, the reverse sweep is measured{unrolled}. The global routes cannot be captured: their solve "
        "reads on the host whether it has converged."
    )


def _memory_text(rows: list[Row], device: str) -> str:
    by_name = {row["route"]: row for row in rows}
    lines, verdicts = [], []
    for key, (label, _) in (("memory", PEAK[device]), ("kept", KEPT)):
        unrolled = by_name[UNROLLED][key]
        for name in ROUTES:
            mine = by_name[name][key]
            factor, asked, met = (unrolled / mine if mine else None), None, None
            if name in (FULL, COMPACT) and factor is not None:
                asked, met = f">= {paper.LESS_MEMORY_THAN_UNROLLED}", factor >= paper.LESS_MEMORY_THAN_UNROLLED
                verdicts.append(f"{'met' if met else 'not met'} in {label} by the {name.split(', ')[1]} ({factor:.0f})")
            lines.append((label, name, None if mine is None else mine / 1e6, factor, asked, met))
    theirs = ", ".join(f"{name} {row['memory_mb']:g}" for name, row in paper.COST.items())
    return (
        f"## Memory\n\nTwo definitions. *{PEAK[device][0].capitalize()}*: {PEAK[device][1]}. *{KEPT[0].capitalize()}*: "
        f"{KEPT[1]}. The paper's {paper.LESS_MEMORY_THAN_UNROLLED} times less than unrolled autograd: "
        f"{'; '.join(verdicts)}. The paper's MB, on its GPU: {theirs}.\n\n"
    ) + markdown_table(("memory", "route", "MB", "times less than unrolled", "paper", "met"), lines)


def _dispatch_text(rows: list[Row]) -> str:
    """Where the global routes' time goes, and what is left of the ratio with another solver."""
    rows = [row for row in rows if "split" in row["routes"][GLOBAL[0]]]
    lines, said, differences = [], [], []
    for row in rows:
        ours = row["among_global"]["backward_ms"] / row["steps"]
        parts = row["routes"][GLOBAL[0]]["split"]
        variants = {name: row["routes"][name]["split"] for name in GLOBAL}
        for key, label in (("scipy", "scipy and numpy"), ("cholesky", "dense Cholesky")):
            if other := parts[key]:
                differences.append(other["difference"])
                variants[f"{GLOBAL[0]}, solved by {label}"] = {**parts, "solve_ms": other["ms"]}
        for name, mine in variants.items():
            whole = sum(mine[part] for part in PARTS)
            lines.append((f"{row['modulus']:g}", name, *(mine[part] for part in PARTS), whole / ours,
                          mine["solve_ms"] / ours))  # fmt: skip
        if other := parts["scipy"]:
            now, then = lines[-len(variants)][-2], lines[-len(variants) + len(GLOBAL)][-2]
            said.append(
                f"at {row['modulus']:g} Pa ({other['total_iterations']} iterations in all) {then:.1f} times the "
                f"reverse sweep's backward, in place of {now:.1f}, and {other['ms'] / ours:.2f} times if all but the "
                "solves took no time"
            )
    text = (
        "## How much of that is dispatch\n\nMilliseconds per step of a global backward, in its parts; *other* is "
        "torch's own backward of predictor and velocity, the gradient of pinned positions, and checks. The same linear "
        "systems are then given to other solvers: scipy's CSR product in numpy's conjugate gradients with the same "
        "preconditioner and tolerance, on the CPU; and torch's dense Cholesky on the device of the run. Their "
        f"solutions agree within {max(differences, default=0.0):.0e}. *Factor*: the sum of the parts over the reverse "
        "sweep's backward of a step.\n\n"
    )
    header = ("mu = lam [Pa]", "route", "potential and matrix", "solve", "gradients", "other", "factor",
              "factor of the solve alone")  # fmt: skip
    text += markdown_table(header, lines)
    if said:
        text += (
            "\nWith the compiled conjugate gradients, the assembled route would take "
            f"{'; '.join(said)}. So the factors above compare a compiled reverse sweep with routes in torch. The last "
            "column bounds from below what a global route compiled throughout could reach; where it is less than 1, "
            "such a route could be the faster one.\n"
        )
    return text


def _stiffness_text(rows: list[Row]) -> str:
    alone, among = [row["routes"][FULL] for row in rows], [row["among_global"] for row in rows]
    spans = [
        f"{100 * steadiness(times, 'backward_ms'):.1f} % (forward + backward: "
        f"{100 * steadiness(times, 'both_ms'):.1f} %) over the moduli where {where}, medians of "
        f"{times[0]['repetitions']} rounds"
        for times, where in (
            (alone, "rounds visit no other route"),
            (among, "both global routes take part in every round"),
        )
    ]
    text = (
        f"## Stiffness: mu = lam, h = {rows[0]['time_step']:g} s\n\n"
        f"The reverse sweep solves nothing whose difficulty tracks the material. Its backward varies, slowest over "
        f"fastest, by {spans[0]}; and by {spans[1]}. The times of the global routes are those of that second group. "
        f"Unrolled autograd is measured in a group of its own ({rows[0]['routes'][UNROLLED]['repetitions']} rounds): "
        "its graph of tens of MB empties the caches, and whatever ran next would pay for that. Where "
        f"{SWEEPS} sweeps do not converge any more, the global routes differentiate another function, however well "
        "they solve.\n\nMilliseconds of the backward.\n\n"
    )
    header = ["mu = lam [Pa]", "reverse sweep, alone [ms]", "among global [ms]", "error", "unrolled [ms]", "error"]
    for name in GLOBAL:
        header += [f"{name} [ms]", "iterations", "error"]
    lines = []
    for row, mine, other in zip(rows, alone, among, strict=True):
        unrolled = row["routes"][UNROLLED]
        line = [f"{row['modulus']:g}", mine["backward_ms"], other["backward_ms"], mine["error"],
                unrolled["backward_ms"], unrolled["error"]]  # fmt: skip
        for name in GLOBAL:
            theirs = row["routes"][name]
            line += [theirs["backward_ms"], _iterations(theirs), theirs["error"]]
        lines.append(line)
    return text + markdown_table(header, lines) + "\n" + _stiff_figures(rows)


def _stiff_figures(rows: list[Row]) -> str:
    """What the paper says of stiff material, beside ours."""
    both = [next(row for row in rows if row["modulus"] == paper.STIFF_MODULUS)["routes"][name] for name in GLOBAL]
    low, high = paper.STIFF_MS
    header = (f"at mu = lam = {paper.STIFF_MODULUS:g} Pa", *GLOBAL, "paper")
    text = markdown_table(header, [
        ("backward [ms]", *(row["backward_ms"] for row in both), f"{low} to {high}"),
        ("iterations of the longest solve", *(row["iterations"] for row in both), None),
        ("iterations of all steps", *(row["total_iterations"] for row in both), None),
        ("iterations, of what it does not say", None, None, paper.STIFF_ITERATIONS),
    ])  # fmt: skip
    soft = rows[0]["routes"][GLOBAL[0]]
    return text + (
        f"\nThe paper counts about {paper.SOFT_ITERATIONS} iterations for soft material; ours are {_iterations(soft)} "
        f"at {rows[0]['modulus']:g} Pa. It states neither material nor motion of its scene, and not whether its counts "
        "are of one solve or of several.\n"
    )


def _iterations(row: Row) -> str:
    if "iterations" not in row:
        return cell(None)
    return f"{row['iterations']}, in all {row['total_iterations']}{'' if row['converged'] else ', not converged'}"
