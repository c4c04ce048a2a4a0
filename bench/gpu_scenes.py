"""Groups of the GPU benchmark: steps of one mesh, the bunny, a million cubes, batches, unrolled autograd."""

from __future__ import annotations

from typing import Any

import torch

import diffvbd as dv
from bench.gpu_measure import (
    MODULUS,
    STEP,
    Card,
    Counts,
    Row,
    Scene,
    attempt,
    forward,
    forward_reverse,
    milliseconds,
    model_of,
    rated,
    resident_traffic,
    scene_of,
    sweep_traffic,
)
from diffvbd import reference, testing

GRADIENTS = ("x", "v", "material")


def label(model: dv.Model, sweeps: int) -> str:
    return f"{model.num_vertices} v / {model.num_tets} t, K = {sweeps}, {str(model.dtype)[6:]}"


def timed_forward(
    card: Card, scene: Scene, sweeps: int, steps: int, tape: Any = "auto", budget: float | None = None
) -> Row:
    """Graph and eager time per step; with a tape where a tensor of the scene requires grad."""
    work = forward(scene, sweeps, steps, tape)
    eager = card.eager(work)
    return {"ms": milliseconds(card.graph(work, budget=budget), steps), "eager_ms": milliseconds(eager, steps)}


def timed_reverse(
    card: Card, scene: Scene, sweeps: int, steps: int, tape: Any = "auto", budget: float | None = None
) -> tuple[Row, Row]:
    """Times per step of the forward with tape, and of the reverse: forward with reverse, less the former."""
    taped = timed_forward(card, scene, sweeps, steps, tape, budget)
    work = forward_reverse(scene, sweeps, steps, tape)
    eager = milliseconds(card.eager(work), steps)
    both = milliseconds(card.graph(work, budget=budget), steps)
    reverse = {
        "ms": None if both is None or taped["ms"] is None else both - taped["ms"],
        "eager_ms": None if eager is None else eager - taped["eager_ms"],
        "both_ms": both,
        "both_eager_ms": eager,
    }
    return taped, reverse


def seconds_of(row: Row) -> float | None:
    return None if row["ms"] is None else row["ms"] / 1e3


# --- one mesh ---------------------------------------------------------------------------------------------------------


def steps(card: Card, rate: float) -> list[Row]:
    """Forward and reverse of a step of cubes from 125 to 200k vertices, moduli as one number and per tet."""
    large = (3.0, 6.0)  # targets [ms]: forward, reverse with state and material
    cases: list[tuple[dv.TetMesh, tuple[float | None, float | None]]] = [
        (dv.mesh.cube(5, split="five"), (0.2, 0.25)),
        (dv.mesh.cube(11, split="five"), (0.35, None)),
        (dv.mesh.cube(31, split="five"), (0.6, None)),
        (dv.mesh.cube(58, split="five"), large),
        (dv.mesh.box((58, 58, 60), split="kuhn"), large),
    ]
    if card.quick:
        cases = [(dv.mesh.cube(4, split="five"), (None, None))]
    rows: list[Row] = []
    for mesh, targets in cases:
        attempt(card, rows, {"name": f"{mesh.num_vertices} v"}, lambda m=mesh, t=targets: _mesh_rows(card, rate, m, t))
        if mesh.num_vertices == 58**3 or card.quick:
            attempt(card, rows, {"name": f"{mesh.num_vertices} v, float32"}, lambda m=mesh: _float32(card, rate, m))
    return rows


def _mesh_rows(
    card: Card, rate: float, mesh: dv.TetMesh, targets: tuple[float | None, float | None], sweeps: int = 20
) -> list[Row]:
    model, count = model_of(mesh, card), 2 if card.quick else 10
    counts, item = Counts.of(model), model.mass.element_size()
    rows: list[Row] = []
    for material in ("scalar", "per tet"):
        per_tet = material == "per tet"
        scene = scene_of(model, material=material)
        about = {"name": label(model, sweeps), "material": material, "steps": count}

        def one(part: str, row: Row, target: float | None, tape: str | None, reverse: bool, per_tet: bool) -> Row:
            moved, near = sweep_traffic(counts, sweeps, item, per_tet=per_tet, tape=tape, reverse=reverse)
            row = {"part": part, "target_ms": target, "l2_bytes": near, **row}
            return rated(row, seconds_of(row), moved, rate)

        attempt(card, rows, {**about, "part": "forward"}, lambda s=scene, p=per_tet: one(
            "forward", timed_forward(card, s, sweeps, count), targets[0], None, False, p))  # fmt: skip
        for tape in ("full", "compact"):

            def both(s: Scene = scene, tape: str = tape, per_tet: bool = per_tet) -> list[Row]:
                taped, reverse = timed_reverse(card, s.requiring(*GRADIENTS), sweeps, count, tape)
                return [
                    one(f"forward with {tape} tape", taped, None, tape, False, per_tet),
                    one(f"reverse, {tape} tape", reverse, targets[1], tape, True, per_tet),
                ]

            attempt(card, rows, {**about, "part": f"reverse, {tape} tape"}, both)
    return rows


def _float32(card: Card, rate: float, mesh: dv.TetMesh, sweeps: int = 20) -> list[Row]:
    model, count = model_of(mesh, card, torch.float32), 2 if card.quick else 10
    counts, out = Counts.of(model), []
    for material in ("scalar", "per tet"):
        row = {"name": label(model, sweeps), "part": "forward", "material": material, "steps": count, "target_ms": 1.8}
        row |= timed_forward(card, scene_of(model, material=material), sweeps, count)
        moved, row["l2_bytes"] = sweep_traffic(counts, sweeps, 4, per_tet=material == "per tet")
        out.append(rated(row, seconds_of(row), moved, rate))
    return out


def bunny(card: Card, rate: float, sweeps: int = 20) -> list[Row]:
    """40 steps of the rabbit in one graph, against the paper's 3 and 5 ms per step for 339 vertices."""
    model, count = model_of(dv.mesh.bunny(), card, pinned=False), 2 if card.quick else 40
    counts, rows = Counts.of(model), []
    scene = scene_of(model)
    about = {"name": f"bunny-like, {label(model, sweeps)}, {count} steps", "material": "scalar", "steps": count}

    def one(part: str, row: Row, target: float, tape: str | None, reverse: bool) -> Row:
        moved, near = sweep_traffic(counts, sweeps, 8, per_tet=False, tape=tape, reverse=reverse)
        return rated({"part": part, "target_ms": target, "l2_bytes": near, **row}, seconds_of(row), moved, rate)

    def both() -> list[Row]:
        taped, reverse = timed_reverse(card, scene.requiring(*GRADIENTS), sweeps, count, "full")
        return [
            one("forward with full tape", taped, 3.0, "full", False),
            one("reverse, full tape", reverse, 5.0, "full", True),
        ]

    attempt(card, rows, {**about, "part": "forward"},
            lambda: one("forward", timed_forward(card, scene, sweeps, count), 3.0, None, False))  # fmt: skip
    attempt(card, rows, {**about, "part": "reverse, full tape"}, both)
    return rows


# --- many scenes ------------------------------------------------------------------------------------------------------


def cubes(card: Card, rate: float) -> list[Row]:
    """A million scenes of one cube of eight vertices, mu of each scene; forward without tape, and with reverse. By
    sweeps alone, too: to choose a start and to correct rigid motion is work around them."""
    return [*_cubes(card, rate, ""), *_cubes(card, rate, ", sweeps alone", rigid=False, start="predictor")]


def _cubes(card: Card, rate: float, note: str, sweeps: int = 5, **options: Any) -> list[Row]:
    scenes, count = (100, 2) if card.quick else (1_000_000, 10)
    model = model_of(dv.mesh.cube(size=0.003, split="kuhn"), card, pinned=False, **options)
    scene = scene_of(model, scenes, "per scene", noise=1e-5)
    vertices = scenes * model.num_vertices
    about = {"name": f"{scenes} scenes of {label(model, sweeps)}{note}", "material": "per scene", "steps": count}
    rows: list[Row] = []

    def plain() -> Row:
        row = {"part": "forward", "target_ms": 1.2, **timed_forward(card, scene, sweeps, count)}
        return rated(row, seconds_of(row), resident_traffic(vertices, 8), rate)

    def both() -> list[Row]:
        given = scene.requiring("x", "v", "mu")
        taped, reverse = timed_reverse(card, given, sweeps, count, "recompute")
        whole = {"ms": reverse["both_ms"], "eager_ms": reverse["both_eager_ms"]}
        moved = {"forward, for recompute": resident_traffic(vertices, 8),
                 "reverse, recompute": resident_traffic(vertices, 8, True)}  # fmt: skip
        moved["forward + reverse, recompute"] = sum(moved.values())
        return [
            rated({"part": part, "target_ms": 4.5 if "+" in part else None, **row}, seconds_of(row), moved[part], rate)
            for part, row in zip(moved, (taped, reverse, whole), strict=True)
        ]

    attempt(card, rows, {**about, "part": "forward"}, plain)
    attempt(card, rows, {**about, "part": "forward + reverse, recompute"}, both)
    return rows


def batches(card: Card, rate: float, sweeps: int = 10) -> list[Row]:
    """Scenes of 1,331 vertices in one call; throughput and its share of the best of the series."""
    model, count = model_of(dv.mesh.cube(3 if card.quick else 11, split="five"), card), 2 if card.quick else 10
    rows: list[Row] = []
    for scenes in (2, 4) if card.quick else (128, 256, 512, 1024, 2048, 4096, 8192):

        def one(scenes: int = scenes) -> Row:
            row = timed_forward(card, scene_of(model, scenes), sweeps, count)
            row["updates"] = model.num_active * sweeps * scenes / 1e6 / (row["ms"] or row["eager_ms"])  # [G/s]
            return rated(row, seconds_of(row), resident_traffic(scenes * model.num_vertices, 8), rate)

        last = scenes == 8192
        about = {"name": f"{scenes} scenes of {label(model, sweeps)}", "part": "forward", "steps": count,
                 "target_updates": 2.0 if last else None, "target_share": 0.97 if last else None}  # fmt: skip
        attempt(card, rows, about, one)
    best = max((r["updates"] for r in rows if "updates" in r), default=0.0)
    for row in rows:
        if "updates" in row:
            row["share_of_best"] = row["updates"] / best
    return rows


# --- unrolled autograd ------------------------------------------------------------------------------------------------


def cost(card: Card, rate: float, sweeps: int = 20) -> list[Row]:
    """The paper's small row: 115 vertices, 4 steps, gradients to state and material, against unrolled autograd."""
    count = 2 if card.quick else 4
    try:
        mesh = dv.TetMesh(*testing.delaunay("small" if card.quick else "medium"))
    except ImportError:  # scipy is not there
        mesh = dv.mesh.cube(5, split="five")
    model = model_of(mesh, card)
    scene = scene_of(model).requiring(*GRADIENTS)
    ones = torch.ones_like(scene.x)

    def unrolled() -> Any:
        end = reference.rollout(model, scene.x, scene.v, steps=count, mu=scene.mu, lam=scene.lam, time_step=STEP,
                                sweeps=sweeps)  # fmt: skip
        return torch.autograd.grad((end.x[-1], end.v[-1]), scene.leaves, (ones, ones))

    rows: list[Row] = []
    name = f"{label(model, sweeps)}, {count} steps, forward + reverse"

    def both() -> list[Row]:
        theirs = unrolled()  # warms up, too
        slow, slow_peak = card.eager(unrolled, 3), card.peak(unrolled)
        out: list[Row] = [
            {"what": "unrolled autograd, eager", "value": 1e3 * slow, "unit": "ms"},
            {"what": "unrolled autograd, growth of peak memory", "value": slow_peak, "unit": "bytes"},
        ]
        for tape in ("full", "compact"):
            ours = forward_reverse(scene, sweeps, count, tape)
            error = max(float((a - b).abs().max() / b.abs().max()) for a, b in zip(ours(), theirs, strict=True))
            fast, peak, graph = card.eager(ours, 20), card.peak(ours), card.graph(ours)
            captured = None if graph is None else slow / graph
            ratio = None if slow_peak is None or not peak else slow_peak / peak
            for what, value, unit, target in (
                ("eager", 1e3 * fast, "ms", None),
                ("graph", milliseconds(graph), "ms", None),
                ("less time, graph", captured, "times", 300),
                ("less time, eager", slow / fast, "times", None),
                ("growth of peak memory", peak, "bytes", None),
                ("less memory", ratio, "times", 71),
                ("largest relative difference of the gradients", error, "", None),
            ):
                out.append({"what": f"{tape} tape, {what}", "value": value, "unit": unit, "target": target})
        return out

    attempt(card, rows, {"name": name, "modulus": MODULUS}, both)
    return rows
