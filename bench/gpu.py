"""Speed and memory of the CUDA backend: steps, batches, the grid of sweeps and vertices, regimes, contact.

Times are milliseconds a step of the public interface, predictor and velocity included, in float64 unless said: *graph*
is the median of 20 replays, by CUDA events, of one CUDA graph of 10 steps (or as many as a row says), *eager* the same
steps called from Python. A backward cannot be captured alone, so *reverse* is the time of a graph of forward and
reverse less that of a graph of the forward with its tape; state and material gradients are asked for. Regimes are the
median of up to 10 replays of graphs of 10 steps (2 with reverse). With tape="auto" a tape is compact where a full one
would be large.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench.measure import (
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
from bench.tables import Table, times
from bench.tradeoff import gripper
from diffvbd.tasks import cover_the_spot
from diffvbd.tasks.problem import Settings
from diffvbd.testing import regime

GRADIENTS = ("x", "v", "material")


def steps_of(card: Card) -> int:
    """Steps of one graph."""
    return 2 if card.quick else 10


def label(model: dv.Model, sweeps: int) -> str:
    return f"{model.num_vertices} v / {model.num_tets} t, K = {sweeps}, {str(model.dtype)[6:]}"


def spans(card: Card, work: Work, steps: int, budget: float | None = None, calls: int = 5, replays: int = 20) -> Row:
    """Graph and eager milliseconds a step."""
    eager = card.eager(work, calls)
    return {"ms": milliseconds(card.graph(work, replays, budget), steps), "eager_ms": milliseconds(eager, steps)}


def timed_reverse(card: Card, scene: Scene, sweeps: int, steps: int, tape: Any = "auto", budget: float | None = None
                  ) -> tuple[Row, Row]:  # fmt: skip
    """Times per step of the forward with tape, and of the reverse: forward with reverse, less the former."""
    taped, both = (spans(card, make(scene, sweeps, steps, tape), steps, budget) for make in (forward, forward_reverse))
    reverse = {key: None if both[key] is None else both[key] - taped[key] for key in both}
    return taped, reverse | {f"both_{key}": value for key, value in both.items()}


# --- one mesh, many scenes --------------------------------------------------------------------------------------------


def timed_parts(card: Card, rows: list[Row], about: Row, scene: Scene, sweeps: int, steps: int, tapes: tuple[str, ...],
                targets: tuple[float | None, float | None] = (None, None),
                wrt: tuple[str, ...] = GRADIENTS) -> None:  # fmt: skip
    """Rows of a forward without tape, and of a forward with each tape and its reverse."""
    about = {"name": label(scene.model, sweeps), "steps": steps, **about}
    attempt(card, rows, {**about, "part": "forward", "target_ms": targets[0]},
            lambda: spans(card, forward(scene, sweeps, steps), steps))  # fmt: skip
    for tape in tapes:

        def both(tape: str = tape) -> list[Row]:
            taped, reverse = timed_reverse(card, scene.requiring(*wrt), sweeps, steps, tape)
            whole = {"ms": reverse["both_ms"], "eager_ms": reverse["both_eager_ms"]}
            return [{"part": f"forward with {tape} tape", "target_ms": None, **taped},
                    {"part": f"reverse, {tape} tape", "target_ms": targets[1], **reverse},
                    {"part": "forward + reverse", "target_ms": None, **whole}]  # fmt: skip

        attempt(card, rows, {**about, "part": f"reverse, {tape} tape"}, both)


def steps(card: Card) -> list[Row]:
    """Forward and reverse of a step of cubes from 125 to 200k vertices, moduli as one number and per tet."""
    large, rows = (3.0, 6.0), []  # targets [ms]
    cases = [(5, (0.2, 0.25)), (11, (0.35, None)), (31, (0.6, None)), (58, large)]
    for n, targets in [(4, (None, None))] if card.quick else cases:
        model = model_of(dv.mesh.cube(n, split="five"), card)
        for material in ("scalar", "per tet"):
            scene = scene_of(model, material=material)
            timed_parts(card, rows, {"material": material}, scene, 20, steps_of(card), ("full", "compact"), targets)
    single = scene_of(model_of(dv.mesh.cube(4 if card.quick else 58, split="five"), card, torch.float32))
    timed_parts(card, rows, {"material": "scalar"}, single, 20, steps_of(card), (), (1.8, None))
    return rows


def bunny(card: Card) -> list[Row]:
    """40 steps of the rabbit in one graph, against the paper's 3 and 5 ms per step for 339 vertices."""
    scene, count, rows = scene_of(model_of(dv.mesh.bunny(), card, pinned=False)), 2 if card.quick else 40, []
    timed_parts(card, rows, {"material": "scalar"}, scene, 20, count, ("full",), (3.0, 5.0))
    return rows


def cubes(card: Card) -> list[Row]:
    """A million scenes of one cube of eight vertices, mu of each scene; forward without tape, and with reverse. By
    sweeps alone, too: to choose a start and to correct rigid motion is work around them."""
    scenes, rows = (100 if card.quick else 1_000_000), []
    model = model_of(dv.mesh.cube(size=0.003, split="kuhn"), card, pinned=False)
    scene = scene_of(model, scenes, "per scene", noise=1e-5)
    for note, plain in (("", False), (", sweeps alone", True)):
        about = {"name": f"{scenes} scenes of {label(model, 5)}{note}", "material": "per scene"}
        timed_parts(card, rows, about, replace(scene, plain=plain), 5, steps_of(card), ("recompute",), (1.2, None),
                    ("x", "v", "mu"))  # fmt: skip
    return rows


def batches(card: Card, sweeps: int = 10) -> list[Row]:
    """Scenes of 1,331 vertices in one call; throughput and its share of the best of the series."""
    model, count = model_of(dv.mesh.cube(3 if card.quick else 11, split="five"), card), steps_of(card)
    rows: list[Row] = []
    for scenes in (2, 4) if card.quick else (128, 256, 512, 1024, 2048, 4096, 8192):

        def one(scenes: int = scenes) -> Row:
            row = spans(card, forward(scene_of(model, scenes), sweeps, count), count)
            return row | {"updates": model.num_active * sweeps * scenes / 1e6 / (row["ms"] or row["eager_ms"])}  # [G/s]

        attempt(card, rows, {"name": f"{scenes} scenes of {label(model, sweeps)}", "steps": count}, one)
    best = max((r["updates"] for r in rows if "updates" in r), default=0.0)
    return [row | ({"share_of_best": row["updates"] / best} if "updates" in row else {}) for row in rows]


# --- sizes ------------------------------------------------------------------------------------------------------------


PARTS = ("forward", "forward + reverse")
REGIMES = ("thread", "block", "grid", "color")
GRID_STEPS = 50  # of a rollout of the grid, as in the paper
SLOW = 0.1  # [s] a step of a regime that is not followed to larger batches


def rollout_reverse(scene: Scene, sweeps: int, steps: int, tape: Any, every: Any) -> Work:
    """A rollout and its gradients; only the last frame is kept."""
    ones = torch.ones_like(scene.x)
    wanted = [t for t in scene.leaves if t.requires_grad]

    def work() -> Any:
        end = dv.rollout(scene.model, scene.x, scene.v, dv.VBD(STEP, sweeps, tape=tape), steps=steps, mu=scene.mu,
                         lam=scene.lam, checkpoint_every=every, save="last")  # fmt: skip
        return torch.autograd.grad((end.x[-1], end.v[-1]), wanted, (ones, ones))

    return work


# --- sweeps x vertices ------------------------------------------------------------------------------------------------


def grid(card: Card) -> list[Row]:
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
    row: Row = {"steps": count, **spans(card, forward(scene_of(model), sweeps, count), count, 2.0)}
    taped, reverse = timed_reverse(card, scene, sweeps, count, budget=2.0)
    row |= {"taped_ms": taped["ms"], "reverse_ms": reverse["ms"], "reverse_eager_ms": reverse["eager_ms"]}
    if reverse["ms"] is not None:
        row["ratio"] = reverse["ms"] / taped["ms"]
    card.tidy()
    step_ms = reverse["both_ms"] or reverse["both_eager_ms"]
    if 2 * GRID_STEPS * step_ms > 15e3 or not card.cuda:
        return {**row, "note": f"peak of {GRID_STEPS} steps not measured"}
    row["rollout_peak"] = card.peak(rollout_reverse(scene, sweeps, GRID_STEPS, "auto", "auto"))
    predicted = dv.memory(model, dv.VBD(0.01, sweeps, tape="full"), steps=GRID_STEPS, checkpoint_every=None)
    if predicted["total"] < int(0.5 * torch.cuda.get_device_properties(card.device).total_memory):
        own = card.allocated() - before - scene.bytes
        row["full_peak"] = own + (card.peak(rollout_reverse(scene, sweeps, GRID_STEPS, "full", None)) or 0)
        row["full_peak_bytes_per_vertex_sweep_step"] = row["full_peak"] / (size * GRID_STEPS)
    return row


# --- regimes ----------------------------------------------------------------------------------------------------------


def regimes(card: Card, sweeps: int = 10) -> list[Row]:
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
    cells: dict[str, Row] = {part: {} for part in PARTS}
    for name in ("auto", *REGIMES):
        for part, cell in cells.items():
            if (name, part) in exhausted:
                cell[name] = "slow"
                continue
            steps = 10 if part == "forward" else 2
            make = forward if part == "forward" else forward_reverse
            scene = plain if part == "forward" else wanted
            try:
                with nullcontext() if name == "auto" else regime(name):
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


# Of grippers. With this reach a scene has about 1,000 pairs, and a vertex may go 1 mm in each of two parts of a step:
# they lift by 1.5 mm a step.
CLAMPED_STEP, CLAMPED_SWEEPS, DETECTIONS, REACH = 0.005, 10, 2, 4e-3
CLOSING, CLAMPED_STEPS = 32, 5  # steps until they hold and lift evenly; steps timed
SPARE = 1.25  # of the pairs that there are then, what lists have room for


def small_contact(card: Card) -> list[Row]:
    """Milliseconds of a step of one scene, and how many steps of scenes a second many at once take."""
    rows: list[Row] = []
    attempt(card, rows, {"name": "cover-the-spot"}, lambda: _cover(card))
    for scenes in (2,) if card.quick else (1, 64, 1024):
        name = "gripper" if scenes == 1 else f"{scenes} grippers"
        attempt(card, rows, {"name": name}, lambda scenes=scenes: _grippers(card, scenes))
    return rows


def _cover(card: Card) -> list[Row]:
    settings = Settings(Path("unused"), str(card.device), 0, card.quick)
    fall = cover_the_spot.Fall(settings, cover_the_spot.RADIUS,
                               cover_the_spot.QUICK if card.quick else cover_the_spot.FULL)  # fmt: skip

    about = {"vertices": fall.model.num_vertices, "scenes": 1, "sweeps": fall.version.sweeps}
    return _timed(card, about, fall.version.steps, fall.simulate, (fall.velocity, fall.offset), (0.25, 0.6))


def _grippers(card: Card, scenes: int) -> list[Row]:
    """Scenes in which clamps hold a bar: some steps of them, and these with their gradients."""
    scene = gripper(5, (3, 5, 5), detections=DETECTIONS, reach=REACH)
    model, clamps = scene.model.to(card.device), scene.given["prescribed"]
    rest = model.rest_points
    shares = torch.ones((scenes, 1, 3)).to(rest)  # they close differently, and lift alike
    shares[..., 0] += 0.5 * torch.rand((scenes, 1), generator=torch.Generator().manual_seed(0)).to(rest)
    x, v = rest.expand(scenes, -1, -1).clone(), rest.new_zeros((scenes, *rest.shape))
    ends = [rest + shares * (clamps((k + 1) * CLAMPED_STEP).to(rest) - rest) for k in range(CLOSING + CLAMPED_STEPS)]

    def moved(at: Tensor, speed: Tensor, clamped: list[Tensor]) -> tuple[Tensor, Tensor]:
        solver = dv.VBD(CLAMPED_STEP, CLAMPED_SWEEPS)
        for end in clamped:
            at, speed = dv.step(model, at, speed, solver, mu=1e5, lam=2e5, prescribed=end)
        return at, speed

    with torch.no_grad():
        x, v = moved(x, v, ends[:CLOSING])
        moved(x, v, ends[CLOSING:])
    leaves = x.requires_grad_(), v.requires_grad_()
    status = dv.contact.status(model)
    pairs = status.pairs / scenes
    dv.contact.reserve(model, math.ceil(SPARE * pairs))
    held_up = sum(status.truncated) / (scenes * model.num_active)
    about = {"vertices": model.num_vertices, "scenes": scenes, "sweeps": CLAMPED_SWEEPS, "pairs_per_scene": pairs,
             "held_up": held_up}  # fmt: skip
    rows = _timed(card, about, CLAMPED_STEPS, lambda: moved(x, v, ends[CLOSING:])[0], leaves, (None, None))
    for row, target in zip(rows, (1e5, 3.5e4), strict=True):
        row["scene_steps_per_s"] = 1e3 * scenes / (row["ms"] or row["eager_ms"])
        row["target_rate"] = target if scenes >= 1024 else None
    return rows


def _timed(card: Card, about: Row, steps: int, end: Callable[[], Tensor], leaves: tuple[Tensor, ...],
           targets: tuple[float | None, float | None]) -> list[Row]:  # fmt: skip
    """A row of the forward and one of forward and reverse, in milliseconds a step."""

    def forward() -> Tensor:
        with torch.no_grad():
            return end()

    def both() -> tuple[Tensor, ...]:
        return torch.autograd.grad(end().sum(), leaves)

    rows: list[Row] = []
    for part, work, target in zip(PARTS, (forward, both), targets, strict=True):
        rows.append(about | {"part": part, **spans(card, work, steps, 3.0, 3, 5), "target_ms": target})
        card.tidy()
    return rows


DEVICE, ANYWHERE = "cuda", True
GROUPS: dict[str, Callable[[Card], list[Row]]] = {
    "steps": steps,
    "bunny": bunny,
    "cubes": cubes,
    "batches": batches,
    "grid": grid,
    "regimes": regimes,
    "contact": small_contact,
}
STEP_COLUMNS: dict[str, Any] = {
    "step": "name", "part": "part", "moduli": "material", "graph [ms]": "ms", "target": "target_ms",
    "eager [ms]": "eager_ms", "not measured": "error",
}  # fmt: skip
TABLES = (
    Table("Steps of one mesh", "steps", STEP_COLUMNS),
    Table("The bunny, beside the paper's 3 and 5 ms a step", "bunny", STEP_COLUMNS),
    Table("A million cubes", "cubes", STEP_COLUMNS),
    Table("Batches", "batches",
          {"batch": "name", "graph [ms]": "ms", "eager [ms]": "eager_ms", "G vertex updates/s": "updates",
           "share of the best": "share_of_best"}),
    Table("Sweeps and vertices", "grid",
          {"vertices": "vertices", "K": "sweeps", "forward [ms]": "ms", "forward, tape [ms]": "taped_ms",
           "reverse [ms]": "reverse_ms", "reverse / forward": "ratio", "eager [ms]": "eager_ms", "steps timed": "steps",
           "peak of 50 steps, auto [MB]": times("rollout_peak", 1e-6), "peak, all tapes [MB]": times("full_peak", 1e-6),
           "B per vertex, sweep, step": "full_peak_bytes_per_vertex_sweep_step"}),
    *(Table(f"Regimes, {part}", "regimes",
            {"vertices": "vertices", "scenes": "scenes", **{k: f"{part}/{k}" for k in (*REGIMES, "auto")},
             "best": f"best, {part}", "auto / best": f"auto over best, {part}"}) for part in PARTS),
    Table("Small scenes with contact", "contact",
          {"scene": "name", "part": "part", "vertices": "vertices", "K": "sweeps", "pairs a scene": "pairs_per_scene",
           "vertices held up": "held_up", "graph [ms a step]": "ms", "target": "target_ms",
           "eager [ms a step]": "eager_ms", "scene-steps/s": "scene_steps_per_s", "target rate": "target_rate"}),
)  # fmt: skip
