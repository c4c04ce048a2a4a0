"""What `python -m bench contact` says of time: steps with n pairs and without contact, a crowd in real time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table
from bench.cpu import kept_bytes, least
from bench.gpu_measure import Card
from diffvbd import mesh
from diffvbd.contact import detection
from diffvbd.step.motion import motion_of
from diffvbd.step.rooms import rooms

DHAT = 2e-3  # [m]
CLOSE = 0.5 * DHAT  # gap of bodies that touch [m]
FAR = 0.2  # [m], of those that do not: beyond any reach
SHORT = 2 * DHAT  # [m], a reach that lists the fewest pairs
SWEEPS, DETECTIONS, TIME_STEP, MODULUS = 10, 2, 1 / 60, 1e5
FRAME = 1e3 * TIME_STEP  # [ms] that a step at real time may take


def piles(count: int, n: int, close: int) -> dv.TetMesh:
    """`count` pairs of boxes of n^3 vertices and 0.1 m, one above the other; the first `close` pairs touch."""
    box, side = mesh.box(n, 0.1, split="kuhn"), int(np.ceil(np.sqrt(count)))
    offsets = []
    for k in range(count):
        place = np.array([(k % side) * (0.1 + FAR), 0.0, (k // side) * (0.1 + FAR)])
        # a shift along the face, lest edges lie on edges
        offsets += [place, place + [0.013, 0.1 + (CLOSE if k < close else FAR), 0.017]]
    return mesh.replicate(box, np.array(offsets))


def model_of(tets: dv.TetMesh, card: Card, contact: bool, reach: float | None = None) -> dv.Model:
    barrier = (dv.PairBarrier(kappa=100.0, dhat=DHAT, detections=DETECTIONS, reach=reach),) if contact else ()
    return dv.Model(tets, energies=(dv.StableNeoHookean(), *barrier), device=card.device)


def stepping(model: dv.Model, reverse: bool) -> Callable[[], Any]:
    """A step from rest, or one and the gradient toward its state; as gpu_measure times it."""
    x = model.rest_points.clone().requires_grad_(reverse)
    v = torch.zeros_like(x).requires_grad_(reverse)
    modulus = torch.full((), MODULUS, dtype=x.dtype, device=x.device)
    ones = torch.ones_like(x)

    def work() -> tuple[Tensor, ...]:
        end = dv.step(model, x, v, mu=modulus, lam=modulus, time_step=TIME_STEP, sweeps=SWEEPS, gravity=(0.0, 0.0, 0.0))
        return torch.autograd.grad(end, (x, v), (ones, ones)) if reverse else end

    return work


def searching(model: dv.Model) -> Callable[[], Any]:
    """The rooms, islands and detections of one step from rest."""
    surface, barrier = model.surface_of_contact, model.contact
    assert surface is not None and barrier is not None
    x = model.rest_points[None].contiguous()
    none, points, mass = x.new_empty((0,)), surface.collider_points[None].contiguous(), model.mass[None].contiguous()
    move = fall = torch.zeros_like(x)  # as in the steps

    def work() -> list[Any]:
        out = []
        for _ in range(DETECTIONS):
            motion = motion_of(surface, x, none, mass, move, fall)
            found = rooms(motion, surface, barrier, x, none, mass, points, points, None, False)
            given = (x, none, points, points, surface, barrier, surface.capacity, found.room, found.own_room)
            out.append((found.island, detection.detect(*given)))
        return out

    return work


def milliseconds(card: Card, work: Callable[[], Any]) -> float:
    """Median of replays of a CUDA graph; on the CPU the least of several calls, in processor time of one thread, which
    other programs on the machine do not stretch."""
    replayed = card.graph(work)
    if replayed is not None:
        return 1e3 * replayed

    def span() -> float:
        start = time.process_time()
        work()
        return time.process_time() - start

    return 1e3 * least(span, 3 if card.quick else 7)


def measured(card: Card, count: int, n: int, close: int, reach: float | None = None) -> dict[str, Any]:
    """Times of piles with contact and without."""
    tets = piles(count, n, close)
    row: dict[str, Any] = {"bodies": 2 * count, "vertices": tets.num_vertices, "reach": reach}
    for key, contact in (("without", False), ("with", True)):
        model = model_of(tets, card, contact, reach)
        row[f"{key}_ms"] = milliseconds(card, stepping(model, False))
        row[f"{key}_reverse_ms"] = milliseconds(card, stepping(model, True))
        row[f"{key}_kept"] = kept_bytes(model.to("cpu"), model.rest_points.cpu(), SWEEPS, ("state",))
        if contact:
            stepping(model, False)()  # raises where a captured one would have returned NaN
            status = dv.contact.status(model)
            row["pairs"], row["detection_ms"] = status.pairs, milliseconds(card, searching(model))
        card.tidy()
    row["detection_share"] = row["detection_ms"] / row["with_ms"]
    return row


def line(rows: list[dict[str, Any]], key: str) -> dict[str, float]:
    """Least-squares line through a time over the number of pairs, and the share of the variance that it explains."""
    n, t = np.array([r["pairs"] for r in rows], float), np.array([r[key] for r in rows])
    slope, start = np.polyfit(n, t, 1)
    left = float(((t - start - slope * n) ** 2).sum() / ((t - t.mean()) ** 2).sum())
    return {"start_ms": float(start), "ns_per_pair": 1e6 * float(slope), "explained": 1 - left}


def contact_operators(model: dv.Model) -> list[str]:
    """Operators of contact that a step and its backward call."""
    work = stepping(model, True)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        work()
    return sorted({e.key for e in profile.key_averages() if "diffvbd" in e.key and "contact" in e.key})


def measure(card: Card) -> dict[str, Any]:
    count, n = (8, 3) if card.quick else (64, 4)
    rows = [measured(card, count, n, close) for close in sorted({0, count // 8, count // 4, count // 2, count})]
    count, n = (4, 4) if card.quick else (50, 10)
    crowd, slow_crowd = (measured(card, count, n, count, reach) for reach in (None, SHORT))
    without, touching = (contact_operators(model_of(piles(2, 3, 2), card, contact)) for contact in (False, True))
    return {
        "rows": rows,
        "lines": {key: line(rows, key) for key in ("with_ms", "with_reverse_ms", "detection_ms")},
        "crowd": crowd,
        "slow crowd": slow_crowd,
        "contact_operators": {"without": without, "with": touching},
    }


def markdown(results: dict[str, Any]) -> str:
    keys = ("bodies", "vertices", "pairs", "without_ms", "with_ms", "detection_ms", "detection_share",
            "without_reverse_ms", "with_reverse_ms")  # fmt: skip
    header = ("bodies", "vertices", "pairs", "step without contact [ms]", "with [ms]", "of which detection [ms]",
              "share", "forward + backward without [ms]", "with [ms]", "kept without [MB]", "with [MB]")  # fmt: skip

    def cells(row: dict[str, Any]) -> list[Any]:
        return [row[k] for k in keys] + [row["without_kept"] / 1e6, row["with_kept"] / 1e6]

    text = (f"## Cost\n\nOne step of h = 1/60 s, K = {SWEEPS}, R = {DETECTIONS}: boxes in pairs, one above the other, "
            "of which some touch. Times on the CPU are processor time of one thread. What is kept for the backward is "
            "counted on the CPU.\n\n")  # fmt: skip
    text += markdown_table(header, map(cells, results["rows"]))
    names = {"with_ms": "step", "with_reverse_ms": "forward + backward", "detection_ms": "detection"}
    lines = [(names[k], v["start_ms"], v["ns_per_pair"], v["explained"]) for k, v in results["lines"].items()]
    text += "\n" + markdown_table(("time over pairs", "at none [ms]", "ns per pair", "variance explained"), lines)
    crowds = [results[name] for name in ("crowd", "slow crowd") if name in results]
    text += f"\nA crowd, all touching; a frame lasts {FRAME:.1f} ms. "
    if len(crowds) > 1:
        text += f"Then the same with a reach of {1e3 * SHORT:g} mm, enough for bodies that hardly move. "
    text = text.rstrip() + "\n\n" + markdown_table(header, map(cells, crowds))
    called = {k: ", ".join(names) or "no operator of contact" for k, names in results["contact_operators"].items()}
    return text + f"\nA Model with a PairBarrier calls {called['with']}; one without {called['without']}.\n"
