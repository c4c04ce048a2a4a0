"""Motion beside contact, where the answer is known: closed forms, the same scene without contact, or steps of h / 50.

Braking of a thin sheet and of a spin, sliding and its derivative, bodies at rest, stacks, grips, crowds and impacts.
Each row has a value, its reference, a target and whether it is met. "cut" is the mean share of vertices that
pairs have held up; crossings are edges through triangles and vertices below a plane, counted at ten times of each
rollout; "not finite" are coordinates and velocities. Milliseconds are of a step without its backward, one thread.
`--only NAME,...` runs some groups; each is written as it ends, beside what earlier runs on the same device have left.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import diffvbd as dv
from bench import common
from bench import contact_motion_piles as piles
from bench import contact_motion_scenes as scenes
from bench.common import markdown_table
from bench.contact_motion_run import Row

Made = Row | list[Row]
Group = Callable[[bool, str], list[Made]]  # quick, device

SPEEDS = (0.2, 1.0, 3.0, 10.0)  # [m/s]
MOST_SWEEPS = 320
STRUCK = (  # cubes in a row, gap [m], speed of the first [m/s], time step [s]
    *((4, gap, speed, 0.01) for gap in (0.001, 0.005, 0.01, 0.02) for speed in (0.3, 1.0, 3.0, 10.0)),
    *((10, gap, speed, 0.01) for gap in (0.002, 0.02) for speed in (0.3, 1.0, 3.0, 5.0)),
    (10, 0.002, 5.0, 0.0025), (10, 0.02, 5.0, 0.0025),
)  # fmt: skip


def _slides(quick: bool, device: str) -> list[Made]:
    if quick:
        return [scenes.slide("Plane", speed=1.0, device=device)]
    rows: list[Made] = [scenes.slide(surface, device=device) for surface in scenes.SURFACES]
    return [*rows, *(scenes.slide_sweeps(surface, MOST_SWEEPS, device=device) for surface in scenes.SURFACES)]


GROUPS: dict[str, Group] = {
    "sheet": lambda quick, device: [scenes.sheet(k, device=device) for k in ((10,) if quick else (10, 20))],
    "slide": _slides,
    "incline": lambda quick, device: [scenes.incline(s, device=device) for s in scenes.SURFACES[: 2 if quick else 4]],
    "spin": lambda quick, device: [
        scenes.spin(gap, steps, device=device)
        for gap, steps in (((0.002, 1),) if quick else ((0.002, 1), (0.002, 10), (0.01, 10)))
    ],
    "grip": lambda quick, device: [piles.grip(20, seconds=0.15, device=device)] if quick else [
        *(piles.grip(k, device=device) for k in (20, 40, 100, 400)),
        *(piles.grip(k, device=device, faster={"coarse": "auto"}) for k in (8, 20, 40)),
    ],
    "gradient": lambda quick, device: [
        scenes.slide_gradient(surface, speed, device=device)
        for surface in scenes.SURFACES[:2]
        for speed in (SPEEDS[1:2] if quick else SPEEDS)
    ],
    "crowd": lambda quick, device: [piles.crowd(2, 1, seconds=0.1, parts=2, device=device)] if quick else [
        *(piles.crowd(device=device, detections=n) for n in (None, 1, 2, 4)),
        piles.crowd(sweeps=200, detections=8, device=device),
        *(piles.crowd(parts=n, time_step=n / 3000, device=device) for n in (10, 5, 2)),
        *(piles.crowd(integrator=dv.SDIRK2(), parts=n, time_step=n / 3000, device=device) for n in (50, 2)),
        piles.crowd(seconds=2.5, parts=1, device=device),
    ],
    "balls": lambda quick, device: [piles.balls(2, seconds=0.2, device=device)] if quick else [
        piles.balls(rise=rise, device=device) for rise in (1.0, 1.8)
    ],
    "stacks": lambda quick, device: [piles.stack(2, seconds=0.1, device=device)] if quick else [
        piles.stack(count, k, height, device=device)
        for count, height, sweeps in ((5, 0.2, (5, 10, 20, 160)), (10, 0.06, (10, 20, 160)))
        for k in sweeps
    ],
    "rest": lambda quick, device: [
        piles.rest(support, k, device=device)
        for support in ("Plane", "pinned box", "box")
        for k in ((5,) if quick else (5, 20))
    ],
    "fall": lambda quick, device: [
        piles.fall(both, steps=10 if quick else 60, device=device) for both in (True, False)
    ],
    "impact": lambda quick, device: [
        piles.impact(speed, parts=2 if quick else 50, device=device)
        for speed in ((10.0,) if quick else (1.0, 10.0, 50.0))
    ],
    "struck": lambda quick, device: [
        piles.struck(count, gap, speed, time_step, device=device)
        for count, gap, speed, time_step in (STRUCK[:1] if quick else STRUCK)
    ],
    "throws": lambda quick, device: [
        piles.throws(3 if quick else 150, detections=n, device=device) for n in ((None,) if quick else (None, 1, 4))
    ],
}  # fmt: skip


def run(quick: bool, device: str = "cpu", only: str | None = None, out: Path | None = None) -> dict[str, Any]:
    chosen = list(GROUPS) if only is None else [name.strip() for name in only.split(",")]
    if unknown := [name for name in chosen if name not in GROUPS]:
        raise ValueError(f"only: expected groups among {', '.join(GROUPS)}, got {', '.join(unknown)}")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the scenes are too small for two
    suffix, environment = common.device_suffix(device), common.environment(device)
    path = None if out is None else out / f"contact_motion{suffix}.json"
    results = common.earlier(path, quick, environment["device"])
    try:
        for name in chosen:
            began = time.perf_counter()
            rows = [row for made in GROUPS[name](quick, device) for row in (made if isinstance(made, list) else [made])]
            results[name] = {"rows": rows, "seconds": time.perf_counter() - began, **common.stamp(environment)}
            print(f"{name}: {results[name]['seconds']:.1f} s", file=sys.stderr, flush=True)
            if out is not None:
                common.write("contact_motion", results, out, quick=quick, device=device, suffix=suffix)
    finally:
        torch.set_num_threads(threads)
    return {name: results[name] for name in GROUPS if name in results}


def markdown(results: dict[str, Any]) -> str:
    keys = ("quantity", "case", "sweeps", "time_step", "value", "reference", "target", "met", "cut", "crossings",
            "nonfinite", "vertices", "ms_per_step")  # fmt: skip
    header = ("group", "quantity", "case", "K", "h [s]", "value", "reference", "target", "met", "cut", "crossings",
              "not finite", "vertices", "ms per step")  # fmt: skip
    rows = [(name, row) for name, group in results.items() for row in group["rows"]]
    aimed = [row["met"] for _, row in rows if row["met"] is not None]
    text = (
        f"## Against known answers\n\nTargets met: {sum(aimed)} of {len(aimed)}. {common.of_several_runs(results)}\n\n"
    )
    text += markdown_table(header, ([name, *(row[key] for key in keys)] for name, row in rows))
    notes = [f"- {name}, {row['quantity']}, {row['case']}, K = {row['sweeps']}: {remark}."
             for name, row in rows if (remark := "; ".join(filter(None, (row["error"], row["note"]))))]  # fmt: skip
    return text + "\n" + "\n".join(notes) + "\n"
