"""Search for neighboring bodies and the penalty between their centers of mass, 1e3 to 1e6 bodies of 8 vertices.

Milliseconds, medians of several calls of the public interface; on CUDA also of replays of one CUDA graph, whose time
has no share of the host. Clouds are random, one body in a cube as wide as the radius; the layer is one body thick.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bench.common import markdown_table
from bench.gpu_measure import Card
from diffvbd.inspect.penalty import PAIRS_PER_BODY, Bodies, center_of_mass_penalty
from diffvbd.ops import contact as ops_neighbors

RADIUS, VERTICES = 1.0, 8
SHARPNESS = 100.0  # [1/m]: the search reaches 1.36 radii in float64
TARGET_MS = {"cpu": 1000.0, "cuda": 3.0}  # of a search among a million bodies


def run(quick: bool, device: str = "cpu") -> dict[str, Any]:
    card = Card(torch.device(device), quick)
    rows = []
    for count in (1_000, 10_000) if quick else (1_000, 10_000, 100_000, 1_000_000):
        for shape, dtype in (("cloud", torch.float64), ("cloud", torch.float32), ("layer", torch.float64)):
            rows.append(measure(card, count, shape, dtype))
            card.tidy()
    return {"rows": rows}


def centers_of(count: int, shape: str, dtype: torch.dtype, device: torch.device) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    size = torch.full((3,), count ** (1 / 3)) if shape == "cloud" else torch.tensor([count**0.5, 0.0, count**0.5])
    return (torch.rand(count, 3, generator=generator, dtype=torch.float64) * size).to(device, dtype)


def measure(card: Card, count: int, shape: str, dtype: torch.dtype) -> dict[str, Any]:
    centers = centers_of(count, shape, dtype, card.device)
    room = PAIRS_PER_BODY * count
    body = torch.arange(count, device=card.device).repeat_interleave(VERTICES)
    bodies = Bodies(body, torch.ones(len(body), dtype=dtype, device=card.device))
    corners = 0.1 * torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3).to(centers)
    x = (centers[:, None] + corners).reshape(-1, 3)
    leaf = x.clone().requires_grad_()

    def search() -> Any:
        return ops_neighbors.neighbor_pairs(centers[None], RADIUS, room)

    def forward(sharpness: float | None = None) -> Tensor:
        return center_of_mass_penalty(x, bodies, RADIUS, 1.0, sharpness, max_pairs=room)

    def both(sharpness: float | None = None) -> Tensor:
        force = center_of_mass_penalty(leaf, bodies, RADIUS, 1.0, sharpness, max_pairs=room)
        return torch.autograd.grad(force, leaf, x)[0]

    row: dict[str, Any] = {"bodies": count, "shape": shape, "dtype": str(dtype)[6:], "pairs": len(search()[0])}
    works: dict[str, Callable[[], Any]] = {
        "search": search,
        "forward": forward,
        "forward_backward": both,
        "softplus_forward_backward": lambda: both(SHARPNESS),
    }
    for name, work in works.items():
        row[f"{name}_ms"] = 1e3 * card.eager(work)
        replayed = card.graph(work)
        row[f"{name}_graph_ms"] = None if replayed is None else 1e3 * replayed
    row["search_target_ms"] = TARGET_MS[card.device.type] if count == 1_000_000 else None
    return row


def markdown(results: dict[str, Any]) -> str:
    names = ("search", "forward", "forward_backward", "softplus_forward_backward")
    header = ("bodies", "arrangement", "scalars", "pairs", "search [ms]", "target", "penalty, forward [ms]",
              "forward + backward [ms]", "the same, softplus [ms]")  # fmt: skip

    def cells(row: dict[str, Any], suffix: str) -> tuple:
        times = [row[f"{name}{suffix}"] for name in names]
        return (row["bodies"], row["shape"], row["dtype"], row["pairs"], times[0], row["search_target_ms"], *times[1:])

    rows = results["rows"]
    text = "One call after another, from Python:\n\n" + markdown_table(header, (cells(r, "_ms") for r in rows))
    if rows[0]["search_graph_ms"] is not None:
        replayed = markdown_table(header, (cells(r, "_graph_ms") for r in rows))
        text += (
            f"\nAs a CUDA graph, with room for {PAIRS_PER_BODY} pairs a body, all of which it works on:\n\n{replayed}"
        )
    return text
