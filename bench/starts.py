"""Where the sweeps of a pinned body start: y, with gravity, or x + h v; errors of a cantilever from soft to stiff."""

from __future__ import annotations

from typing import Any

from bench.common import markdown_table
from bench.tradeoff import beam, swing


def run(quick: bool) -> list[dict[str, Any]]:
    """Error over motion after 0.5 s of the cantilever of `tradeoff`, against converged steps of the same h."""
    steps, out = (5 if quick else 30), []
    for mu in (1e5,) if quick else (1e3, 1e4, 1e5, 1e6, 1e7):
        material = {"mu": mu, "lam": 1.5 * mu}
        goal = swing(beam(1.6), 500 if quick else 5000, steps, material)
        moved = float((goal - beam().rest_points).norm(dim=-1).max())
        for k in (5,) if quick else (5, 10, 20, 50, 100):
            row: dict[str, Any] = {"mu": mu, "sweeps": k, "motion": moved}
            for start in ("predictor", "inertia"):
                for relaxation in (1.0, 1.6):
                    end = swing(beam(relaxation, start), k, steps, material)
                    row[f"{start}_{relaxation:g}"] = float((end - goal).norm(dim=-1).max()) / moved
            out.append(row)
    return out


def markdown(results: list[dict[str, Any]]) -> str:
    title = "Cantilever of 1 m released from rest: error over motion after 0.5 s, by start and relaxation"
    header = [k.replace("_", " ") for k in results[0]]
    return f"## {title}\n\n" + markdown_table(header, [list(r.values()) for r in results])
