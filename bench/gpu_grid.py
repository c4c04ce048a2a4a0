"""Groups of the GPU benchmark over sizes: the grid of sweeps and vertices, memory, and the regimes' crossover."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from typing import Any

import torch

import diffvbd as dv
from bench.gpu_measure import (
    STEP,
    Card,
    Row,
    Scene,
    Work,
    attempt,
    forward,
    forward_reverse,
    milliseconds,
    model_of,
    scene_of,
)
from bench.gpu_scenes import GRADIENTS, timed_forward, timed_reverse

REGIMES = ("thread", "block", "grid", "color")
STEPS = 50  # of a rollout of the grid, as in the paper
SLOW = 0.1  # [s] a step of a regime that is not followed to larger batches


def rollout_reverse(scene: Scene, sweeps: int, steps: int, tape: Any, every: Any) -> Work:
    """A rollout and its gradients; only the last frame is kept."""
    ones = torch.ones_like(scene.x)
    wanted = [t for t in scene.leaves if t.requires_grad]

    def work() -> Any:
        end = dv.rollout(scene.model, scene.x, scene.v, steps=steps, mu=scene.mu, lam=scene.lam, time_step=STEP,
                         sweeps=sweeps, adjoint=dv.ReverseSweep(tape), checkpoint_every=every, save="last")  # fmt: skip
        return torch.autograd.grad((end.x[-1], end.v[-1]), wanted, (ones, ones))

    return work


def room(card: Card) -> int:
    """Bytes that a measurement may take."""
    return int(0.5 * torch.cuda.get_device_properties(card.device).total_memory) if card.cuda else 2**30


# --- sweeps x vertices ------------------------------------------------------------------------------------------------


def grid(card: Card, rate: float) -> list[Row]:
    """Refinements of one box from 560 to 204k vertices: forward, reverse, their ratio and peak memory."""
    mesh = dv.mesh.box((4, 3, 3) if card.quick else (10, 8, 7), size=(0.9, 0.7, 0.6), split="kuhn")
    rows: list[Row] = []
    for level in range(2 if card.quick else 4):
        if level:
            mesh = dv.mesh.subdivide(mesh)
        for sweeps in (5, 10) if card.quick else (5, 10, 20, 50, 100, 200):
            about = {"level": level, "vertices": mesh.num_vertices, "tets": mesh.num_tets, "sweeps": sweeps}
            attempt(card, rows, about, lambda m=mesh, k=sweeps: _grid_row(card, m, k))
    return rows


def _grid_row(card: Card, mesh: dv.TetMesh, sweeps: int) -> Row:
    before = card.allocated()
    model = model_of(mesh, card)
    scene = scene_of(model).requiring(*GRADIENTS)
    size = model.num_vertices * sweeps
    count = 10 if size < 2_000_000 else 3
    row: Row = {"steps": count, **timed_forward(card, scene_of(model), sweeps, count, budget=2.0)}
    taped, reverse = timed_reverse(card, scene, sweeps, count, budget=2.0)
    row |= {"taped_ms": taped["ms"], "reverse_ms": reverse["ms"], "reverse_eager_ms": reverse["eager_ms"]}
    if reverse["ms"] is not None:
        row["ratio"] = reverse["ms"] / taped["ms"]
    card.tidy()
    step_ms = reverse["both_ms"] or reverse["both_eager_ms"]
    if 2 * STEPS * step_ms > 15e3 or not card.cuda:
        return {**row, "note": f"peak of {STEPS} steps not measured"}
    row["rollout_peak"] = card.peak(rollout_reverse(scene, sweeps, STEPS, "auto", "auto"))
    predicted = model.memory(sweeps=sweeps, steps=STEPS, tape="full", checkpoint_every=None)
    if predicted["total"] < room(card):
        own = card.allocated() - before - scene.bytes
        peak = card.peak(rollout_reverse(scene, sweeps, STEPS, "full", None))
        if peak is not None:
            row["full_peak"] = peak + own
            row["full_peak_bytes_per_vertex_sweep_step"] = (peak + own) / (size * STEPS)
    return row


# --- memory -----------------------------------------------------------------------------------------------------------


def memory(card: Card, rate: float) -> list[Row]:
    """Peak of allocated bytes, Model included and arguments left out, against the prediction of model.memory()."""
    cases: list[tuple[int, int, int, int | None]] = (
        [(4, 5, 2, None)]
        if card.quick
        else [(5, 20, 4, None), (11, 20, 10, None), (11, 10, 1, 1024), (31, 20, 10, None), (58, 20, 1, None),
              (58, 20, 10, None)]
    )  # fmt: skip
    rows: list[Row] = []
    for n, sweeps, steps, scenes in cases:
        mesh = dv.mesh.cube(n, split="five")
        for tape in ("full", "compact", "recompute"):
            for rest in (False, True) if tape == "full" and scenes is None else (False,):
                name = f"{mesh.num_vertices} v, K = {sweeps}, {steps} steps, {scenes or 1} scenes"
                about = {"name": name, "part": f"{tape} tape" + (", rest gradients" if rest else "")}
                attempt(card, rows, about, partial(_memory, card, mesh, sweeps, steps, scenes, tape, rest))
    return rows


def _memory(card: Card, mesh: dv.TetMesh, sweeps: int, steps: int, scenes: int | None, tape: str, rest: bool) -> Row:
    card.tidy()
    before = card.allocated()
    model = model_of(mesh, card)
    scene = scene_of(model, scenes).requiring(*GRADIENTS)
    points = model.rest_points.clone().requires_grad_() if rest else None
    given = scene.bytes + (0 if points is None else points.numel() * points.element_size())
    ones = torch.ones_like(scene.x)
    wanted = [*scene.leaves] + ([] if points is None else [points])

    def work() -> Any:
        end = dv.rollout(model, scene.x, scene.v, steps=steps, mu=scene.mu, lam=scene.lam, time_step=STEP, save="last",
                         sweeps=sweeps, adjoint=dv.ReverseSweep(tape), checkpoint_every=None, rest_points=points)  # type: ignore[arg-type]  # fmt: skip
        return torch.autograd.grad((end.x[-1], end.v[-1]), wanted, (ones, ones))

    work()  # what is made at the first use and kept belongs to the Model
    own = card.allocated() - before - given - ones.numel() * ones.element_size()
    peak = card.peak(work)
    predicted = model.memory(sweeps=sweeps, steps=steps, scenes=scenes or 1, tape=tape, checkpoint_every=None,
                             rest=rest)  # fmt: skip
    allowed = predicted["model"] + predicted["total"]
    row: Row = {
        "predicted": allowed,
        "predicted_tape": predicted["tape"] * steps,
        "predicted_scratch": predicted["scratch"],
    }
    if peak is not None:
        row |= {"model": own, "peak": own + peak, "ratio": (own + peak) / allowed, "target_ratio": 1.1}
    return row


# --- regimes ----------------------------------------------------------------------------------------------------------


def regimes(card: Card, rate: float, sweeps: int = 10) -> list[Row]:
    """Each regime where it can run, sizes 8 to 195k vertices times 1 to 1e6 scenes: forward, and with reverse."""
    rows: list[Row] = []
    for n in (2, 3) if card.quick else (2, 3, 5, 7, 11, 21, 31, 58):
        mesh = dv.mesh.cube(n, split="five")
        exhausted: set[tuple[str, str]] = set()
        for scenes in (1, 8) if card.quick else (1, 8, 64, 512, 4096, 32_768, 262_144, 1_000_000):
            if mesh.num_vertices * scenes > 9_000_000:
                continue
            about = {"vertices": mesh.num_vertices, "scenes": scenes, "sweeps": sweeps}
            attempt(card, rows, about, lambda m=mesh, b=scenes, e=exhausted: _regimes_row(card, m, b, sweeps, e))
    return rows


def _regimes_row(card: Card, mesh: dv.TetMesh, scenes: int, sweeps: int, exhausted: set[tuple[str, str]]) -> Row:
    model = model_of(mesh, card, pinned=mesh.num_vertices > 8)
    plain = scene_of(model, scenes)
    wanted = plain.requiring("x", "v")
    cells: dict[str, Row] = {"forward": {}, "forward + reverse": {}}
    for name in ("auto", *REGIMES):
        for part, cell in cells.items():
            if (name, part) in exhausted:
                cell[name] = "slow"
                continue
            steps = 10 if part == "forward" else 2
            make = forward if part == "forward" else forward_reverse
            scene = plain if part == "forward" else wanted
            try:
                with nullcontext() if name == "auto" else dv.regime(name):
                    cell[name] = _cell(card, make(scene, sweeps, 1), make(scene, sweeps, steps), steps)
            except ValueError as error:
                if "regime" not in str(error):
                    raise
                cell[name] = None  # cannot run this scene
            except RuntimeError as error:
                cell[name] = f"{type(error).__name__}: {error}".splitlines()[0][:120]
            if isinstance(cell[name], float) and cell[name] > 1e3 * SLOW:
                exhausted.add((name, part))
            card.tidy()
    row: Row = dict(cells)
    for part, cell in cells.items():
        times = {k: t for k, t in cell.items() if isinstance(t, float) and k != "auto"}
        if times:
            best = min(times, key=lambda k: times[k])
            row[f"best, {part}"] = best
            if isinstance(cell["auto"], float):
                row[f"auto over best, {part}"] = cell["auto"] / times[best]
    return row


def _cell(card: Card, one: Work, several: Work, steps: int) -> float | None:
    """Milliseconds per step: of a graph, or of one eager step where a graph would take long."""
    one()
    first = card.eager(one, 1)
    if first > SLOW or not card.cuda:
        return milliseconds(first)
    return milliseconds(card.graph(several, replays=10, budget=0.2), steps)
