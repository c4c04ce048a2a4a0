"""What the rigid correction costs beside a sweep and a step, from one small body to a million."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

import diffvbd as dv
from bench.measure import Card
from bench.tables import Table, times


def corrections(card: Card) -> list[dict[str, Any]]:
    quick, device = card.quick, str(card.device)
    out = []
    sizes: list[tuple[str, Callable[[], dv.TetMesh], int, int]] = [
        ("cube of 27", lambda: dv.mesh.cube(3, size=0.2, split="kuhn"), 20, 1),
        ("cube of 1,331", lambda: dv.mesh.cube(11, split="kuhn"), 20, 1),
    ]
    if not quick:
        sizes += [
            ("cube of 195,112", lambda: dv.mesh.cube(58, split="kuhn"), 20, 1),
            ("10,000 cubes of 8, one mesh", lambda: _cubes(10_000), 5, 1),
        ]
        if device != "cpu":
            sizes.append(
                ("1,000,000 cubes of 8, a scene each", lambda: dv.mesh.cube(2, size=0.2, split="kuhn"), 5, 1_000_000)
            )
    for name, make, sweeps, scenes in sizes:
        mesh = make()
        for energies in ("none", "floor, in contact"):
            floor = (dv.FloorBarrier(height=-0.005, kappa=1e3, dhat=0.01),) if energies != "none" else ()
            row: dict[str, Any] = {"scene": name, "vertices": mesh.num_vertices, "energies": energies, "sweeps": sweeps}
            for rigid in (False, True):
                # without: the sweeps alone, from the predictor
                start = "auto" if rigid else "predictor"
                energies_of = (dv.StableNeoHookean(), *floor)
                model = dv.Model(mesh, energies=energies_of, rigid=rigid, start=start, device=device)
                key = "with" if rigid else "without"
                row[f"step_{key}"] = _seconds(card, model, scenes, sweeps, False)
                if not rigid:
                    few = _seconds(card, model, scenes, 1, False)
                    row["sweep"] = (row["step_without"] - few) / (sweeps - 1)
                row[f"both_{key}"] = _seconds(card, model, scenes, sweeps, True)
            row["corrections_over_sweep"] = (row["step_with"] - row["step_without"]) / row["sweep"]
            row["step_ratio"] = row["step_with"] / row["step_without"]
            row["both_ratio"] = row["both_with"] / row["both_without"]
            out.append(row)
    return out


def _cubes(count: int) -> dv.TetMesh:
    side = round(count ** (1 / 2))
    offsets = torch.cartesian_prod(torch.arange(side), torch.arange(-(-count // side)))[:count].double()
    place = torch.stack([offsets[:, 0], torch.zeros(count, dtype=torch.float64), offsets[:, 1]], -1) * 0.3
    return dv.mesh.replicate(dv.mesh.cube(2, size=0.2, split="kuhn"), place.numpy())


def _seconds(card: Card, model: dv.Model, scenes: int, sweeps: int, backward: bool) -> float:
    """Median time of a step, or of a step and its backward; on CUDA of a graph, which has no share of the host."""
    x = model.rest_points
    x = (x if scenes == 1 else x.expand(scenes, -1, -1).contiguous()).requires_grad_(backward)
    v = torch.zeros_like(x)

    def once() -> Any:
        x1, v1 = dv.step(model, x, v, mu=1e5, lam=1e5, time_step=0.01, sweeps=sweeps)
        return torch.autograd.grad(x1.sum() + v1.sum(), x) if backward else (x1, v1)

    return card.graph(once) or card.eager(once, 50)


ANYWHERE = True
GROUPS = {"corrections": corrections}
TABLES = (
    Table("What the rigid corrections at the start and the end of a step cost", "corrections",
          {"scene": "scene", "energies": "energies", "K": "sweeps", "a sweep [us]": times("sweep", 1e6),
           "both corrections over a sweep": "corrections_over_sweep", "step with over without": "step_ratio",
           "step and backward, with over without": "both_ratio"}),
)  # fmt: skip
