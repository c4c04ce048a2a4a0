"""Speed and memory of the CUDA backend: steps, batches, the grid of sweeps and vertices, regimes, peers, contact.

`--only NAME,...` runs some groups; each is written as it ends, beside what earlier runs on the same device have left.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from bench import common, newton
from bench.common import cell, markdown_table
from bench.gpu_contact import small_contact
from bench.gpu_contact import table as contact_table
from bench.gpu_grid import REGIMES, grid, memory, regimes
from bench.gpu_measure import Card, Row
from bench.gpu_scenes import batches, bunny, cost, cubes, steps
from diffvbd.adjoint.routes import FULL_TAPE_LIMIT, FULL_TAPE_SHARE

DEVICE = "cuda"


def peers(card: Card, rate: float) -> list[Row]:
    """Newton's VBD solver in the same run, where it is installed."""
    return newton.rows(str(card.device), card.quick)


GROUPS: dict[str, Callable[[Card, float], list[Row]]] = {
    "steps": steps,
    "bunny": bunny,
    "cubes": cubes,
    "batches": batches,
    "cost": cost,
    "memory": memory,
    "grid": grid,
    "regimes": regimes,
    "newton": peers,
    "contact": small_contact,
}


def run(quick: bool, *, device: str = DEVICE, only: str = "", out: Path | None = None) -> dict[str, Any]:
    names = [name.strip() for name in only.split(",") if name.strip()] or list(GROUPS)
    unknown = [name for name in names if name not in GROUPS]
    if unknown:
        raise SystemExit(f"only: expected names among {', '.join(GROUPS)}, got {', '.join(unknown)}")
    if torch.device(device).type == "cuda" and not torch.cuda.is_available():
        raise SystemExit(f"device: no CUDA device here; `--device {device}` needs one, `--device cpu --quick` does not")
    card = Card(torch.device(device), quick)
    environment = common.environment(device)
    results = common.earlier(None if out is None else out / "gpu.json", quick, environment["device"])
    rate = card.copy_rate()
    card.tidy()
    for name in names:
        start = time.perf_counter()
        rows = GROUPS[name](card, rate)
        results[name] = {
            "rows": rows,
            "copy_GB_per_s": rate / 1e9,
            "seconds": time.perf_counter() - start,
            **common.stamp(common.environment(device)),
        }
        failed = sum("error" in row for row in rows)
        print(
            f"{name}: {results[name]['seconds']:.0f} s, {len(rows)} rows, {failed} failed", file=sys.stderr, flush=True
        )
        if out is not None:
            common.write("gpu", results, out, quick=quick, device=device)
    return {name: results[name] for name in GROUPS if name in results}


# --- text -------------------------------------------------------------------------------------------------------------

NOTE = """\
Times are milliseconds per step of the public interface, predictor and velocity included, in float64 unless said:
*graph* is the median of 20 replays, by CUDA events, of one CUDA graph of 10 steps (or as many as a row says), *eager*
the same steps called from Python. A backward cannot be captured alone, so *reverse* is the time of a graph of forward
and reverse less that of a graph of the forward with its tape; state and material gradients are asked for. *Bytes* must
move through memory in a step whatever the kernel does; *floor* is the time that they take at the copy rate of this card
({rate:.0f} GB/s, read and written, measured in the same run), and *achieved* is floor over time. Scenes that fit the L2
cache may beat their floor. Regimes are the median of up to 10 replays of graphs of 10 steps (2 with reverse).
"""


def markdown(results: dict[str, Any]) -> str:
    first = next(iter(results.values()), {})
    parts = [NOTE.format(rate=float(first.get("copy_GB_per_s", 0.0)))]
    if several := common.of_several_runs(results):
        parts.append(several)
    for name, table in TABLES.items():
        if name in results:
            rows = results[name]["rows"]
            good = [row for row in rows if "error" not in row]
            failed = [f"{_about(row)}: {row['error']}" for row in rows if "error" in row]
            text = table(good) if good else ""
            parts.append(text + "".join(f"\nNot measured: {line}\n" for line in failed))
    return "\n".join(parts)


def _about(row: Row) -> str:
    known = (row.get(k) for k in ("name", "part", "material", "vertices", "sweeps", "scenes"))
    return ", ".join(str(v) for v in known if v is not None)


def _millions(value: Any) -> str:
    return cell(None if value is None else value / 1e6)


def _step_table(rows: list[Row]) -> str:
    header = ("step", "part", "moduli", "graph [ms]", "target", "eager [ms]", "bytes [MB]", "from L2 [MB]",
              "floor [ms]", "achieved")  # fmt: skip
    return markdown_table(header, [
        (r["name"], r["part"], r.get("material"), r["ms"], r.get("target_ms"), r["eager_ms"], _millions(r["bytes"]),
         _millions(r.get("l2_bytes")), r["floor_ms"], r["fraction"]) for r in rows])  # fmt: skip


def _batch_table(rows: list[Row]) -> str:
    header = ("batch", "graph [ms]", "eager [ms]", "G vertex updates/s", "target", "share of the best", "target")
    return markdown_table(header, [
        (r["name"], r["ms"], r["eager_ms"], r["updates"], r["target_updates"], r["share_of_best"], r["target_share"])
        for r in rows])  # fmt: skip


def _cost_table(rows: list[Row]) -> str:
    header = (f"against unrolled autograd: {rows[0]['name']}", "measured", "target", "unit")
    return markdown_table(header, [(r["what"], _number(r["value"]), r.get("target"), r["unit"]) for r in rows])


def _memory_table(rows: list[Row]) -> str:
    header = ("peak memory", "part", "measured [MB]", "predicted [MB]", "measured / predicted", "target")
    return markdown_table(header, [
        (r["name"], r["part"], _millions(r.get("peak")), _millions(r["predicted"]), r.get("ratio"),
         f"<= {r['target_ratio']}" if "target_ratio" in r else None) for r in rows])  # fmt: skip


def _grid_table(rows: list[Row]) -> str:
    header = ("vertices", "K", "forward [ms]", "forward, tape [ms]", "reverse [ms]", "reverse / forward", "eager [ms]",
              "steps timed", "peak of 50 steps, auto [MB]", "peak, all tapes [MB]",
              "B per vertex, sweep, step")  # fmt: skip
    text = markdown_table(header, [
        (r["vertices"], r["sweeps"], r["ms"], r.get("taped_ms"), r.get("reverse_ms"), r.get("ratio"),
         f"{cell(r['eager_ms'])} + {cell(r.get('reverse_eager_ms'))}", r["steps"], _millions(r.get("rollout_peak")),
         _millions(r.get("full_peak")), r.get("full_peak_bytes_per_vertex_sweep_step")) for r in rows])  # fmt: skip
    limit = f"{FULL_TAPE_LIMIT >> 20} MiB a step, or 1/{1 / FULL_TAPE_SHARE:.0f} of the device's memory if that is more"
    text += f'\nTimes with tape="auto": beyond {limit}, the tape is compact, and the reverse takes longer.\n'
    each = [float(r["full_peak_bytes_per_vertex_sweep_step"]) for r in rows if r.get("full_peak")]
    if each:
        spread = (max(each) - min(each)) / (max(each) + min(each))
        text += f"\nPeak memory with all tapes kept is linear in K x V within +- {100 * spread:.1f} % (target 13 %).\n"
    return text


def _regime_table(rows: list[Row]) -> str:
    tables = []
    for part in ("forward", "forward + reverse"):
        header = (f"{part}, K = {rows[0]['sweeps']}: vertices", "scenes", *REGIMES, "auto", "best", "auto / best")
        tables.append(markdown_table(header, [
            (r["vertices"], r["scenes"], *(_number(r[part].get(k)) for k in (*REGIMES, "auto")), r.get(f"best, {part}"),
             r.get(f"auto over best, {part}")) for r in rows]))  # fmt: skip
    return "\n".join(tables)


def _number(value: Any) -> str:
    return cell(float(value)) if isinstance(value, (int, float)) else cell(value)


def _peer_table(rows: list[Row]) -> str:
    header = ("peer", "part", "graph [ms]", "eager [ms]", "earlier version, H100 [ms]", "colors")
    return markdown_table(header, [
        (r["name"], r["part"], r["ms"], r["eager_ms"], r["earlier_ms"], r["colors"]) for r in rows])  # fmt: skip


TABLES: dict[str, Callable[[list[Row]], str]] = {
    "steps": _step_table,
    "bunny": _step_table,
    "cubes": _step_table,
    "batches": _batch_table,
    "cost": _cost_table,
    "memory": _memory_table,
    "grid": _grid_table,
    "regimes": _regime_table,
    "newton": _peer_table,
    "contact": contact_table,
}
