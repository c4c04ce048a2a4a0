"""Plots of results, for the pages in docs/results. They need matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

CAPTIONS = {
    "exactness": "Gradient error over the number of sweeps, by route",
    "cost": "Iterations and time of the backward over stiffness, by route",
    "ablation": "Gradient error without each exactness term, over mesh refinement",
    "fd": "Error of the gradients over the step of the difference",
    "tradeoff": "Error of the motion over the time of a rollout: each point is a way, a number of sweeps and a step",
    "twolevel": "Error over motion against the time of a step, with coarse corrections and with plain sweeps",
}
LABELS = {"reverse sweep": ("o", "C0"), "global, assembled": ("s", "C1"), "global, matrix-free": ("x", "C2"),
          "reverse sweep, full tape": ("o", "C0"), "unrolled autograd": ("d", "C3")}  # fmt: skip

NO_ERROR = 1e-17  # where an error of zero is drawn


def draw(name: str, results: dict[str, Any], path: Path) -> bool:
    """Writes the plot of a benchmark's results as PNG; False if it has none, or matplotlib is not installed."""
    if name not in FIGURES:
        return False
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return False
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    FIGURES[name](figure, results)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=100)
    keep_picture(drawn, path)
    return True


def keep_picture(drawn: Path | io.BytesIO, to: Path, width: int = 1200) -> None:
    """A picture for the repository: at most so many pixels wide and in 64 colors, an eighth of the bytes."""
    from PIL import Image  # matplotlib needs it, too

    picture = Image.open(drawn).convert("RGB")
    picture.thumbnail((width, width))
    picture.quantize(64).save(to, optimize=True)


def exactness(figure: Any, results: dict[str, Any]) -> None:
    axes = figure.subplots(1, 2, sharey=True)
    for ax, (name, rows) in zip(axes, results["scenes"].items(), strict=True):
        sweeps = [row["sweeps"] for row in rows]
        for route in rows[0]["routes"]:
            marker, color = LABELS[route]
            # no error at all has no place on a logarithmic axis
            errors = [max(row["routes"][route]["error"], NO_ERROR) for row in rows]
            label = f"{route} (0)" if max(errors) == NO_ERROR else route
            ax.loglog(sweeps, errors, marker=marker, color=color, label=label)
        ax.loglog(sweeps, [row["relative_residual"] for row in rows], "k:", label="residual, relative")
        ax.set(title=f"{name} scene", xlabel="sweeps K", xticks=sweeps, xticklabels=sweeps)
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("gradient error")
    axes[0].legend(fontsize="small")


def cost(figure: Any, results: dict[str, Any]) -> None:
    rows = results["stiffness"]
    moduli = [row["modulus"] for row in rows]
    left, right = figure.subplots(1, 2)
    for route in rows[0]["routes"]:
        marker, color = LABELS[route]
        entries = [row["routes"][route] for row in rows]
        right.loglog(moduli, [e["backward_ms"] for e in entries], marker=marker, color=color, label=route)
        if "iterations" in entries[0]:
            left.loglog(moduli, [e["iterations"] for e in entries], marker=marker, color=color, label=route)
    left.set(xlabel="mu = lam [Pa]", ylabel="iterations of the longest solve")
    right.set(xlabel="mu = lam [Pa]", ylabel="backward [ms]")
    for ax in (left, right):
        ax.grid(alpha=0.3)
    figure.legend(*right.get_legend_handles_labels(), fontsize="small", loc="outside right center")


def ablation(figure: Any, results: dict[str, Any]) -> None:
    rows = results["rows"]
    depths = sorted({row["sweeps"] for row in rows})
    all_axes = figure.subplots(1, len(depths), sharey=True, squeeze=False)[0]
    for ax, sweeps in zip(all_axes, depths, strict=True):
        for name in dict.fromkeys(row["variant"] for row in rows):
            chosen = [row for row in rows if row["variant"] == name and row["sweeps"] == sweeps]
            ax.loglog([r["vertices"] for r in chosen], [r["error"] for r in chosen], marker=".", label=name)
        sizes = sorted({row["vertices"] for row in rows})
        ax.set(title=f"K = {sweeps}", xlabel="vertices")
        ax.set_xticks(sizes, labels=[str(n) for n in sizes])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    all_axes[0].set_ylabel("gradient error")
    figure.legend(*all_axes[0].get_legend_handles_labels(), fontsize="small", loc="outside right center")


def finite_differences(figure: Any, results: dict[str, Any]) -> None:
    from bench.fd import BAR, STEPS

    ax = figure.subplots()
    for row in results["checks"]:
        if "errors" in row:
            worst = [max(values) for values in zip(*row["errors"].values(), strict=True)]
            ax.loglog(STEPS, worst, marker=".", label=row["name"])
    ax.axhline(BAR, color="k", linestyle=":")
    ax.set(xlabel="relative step of the difference", ylabel="error of the worst argument")
    ax.grid(alpha=0.3)
    figure.legend(fontsize="small", loc="outside right center")


def two_level(figure: Any, results: dict[str, Any]) -> None:
    rows = results["scenes"]
    names = ("cantilever, 1029 vertices", "cantilever, 6929 vertices", "sheet, thickness 1/4 cell", "contrast 1e+03")
    rows = [row for row in rows if row["scene"] in names] or rows[:4]
    all_axes = figure.subplots(1, len(rows), sharey=True, squeeze=False)[0]
    for ax, row in zip(all_axes, rows, strict=True):
        for name, marker, color in (("two_level", "o", "C0"), ("plain", "s", "C1")):
            shown = [entry for entry in row[name] if entry["error"] > 1e-7 and entry["sweeps"] > 1]
            label = {"two_level": "coarse corrections", "plain": "plain sweeps"}[name]
            ax.loglog([e["ms"] for e in shown], [e["error"] for e in shown], marker, linestyle="-", color=color,
                      markersize=3, label=label)  # fmt: skip
        ax.set_title(row["scene"], fontsize="small")
        ax.set(xlabel="ms a step", ylim=(5e-8, 5))
        ax.grid(alpha=0.3)
    all_axes[0].set_ylabel("error over motion")
    all_axes[min(2, len(rows) - 1)].legend(fontsize="x-small", loc="lower left")


def tradeoff(figure: Any, results: dict[str, Any]) -> None:
    """Points of the common ways, the front of all, and what dv.advise says."""
    from bench.tradeoff import ASIDE, front_of

    drawn = {"implicit Euler": ("o", "C1"), "implicit Euler, coarse": ("s", "C3"), "SDIRK2": ("^", "C0"),
             "SDIRK2, coarse": ("D", "C2"), "BDF2, coarse": ("v", "C4")}  # fmt: skip
    groups = list(results.values())
    columns = min(3, len(groups))
    figure.set_size_inches(10, 3.0 * -(-len(groups) // columns))
    all_axes = figure.subplots(-(-len(groups) // columns), columns, squeeze=False).ravel()
    for ax, group in zip(all_axes, groups, strict=False):
        rows = [r for r in group["rows"] if isinstance(r.get("error"), float) and isinstance(r["ms"], float)]
        rows = [r for r in rows if r["way"] not in ASIDE]
        for name, (marker, color) in drawn.items():
            shown = [r for r in rows if r["way"] == name]
            ax.loglog([r["ms"] for r in shown], [r["error"] for r in shown], marker, color=color, markersize=3,
                      alpha=0.7, label=name)  # fmt: skip
        front = front_of(rows)
        ax.loglog([r["ms"] for r in front], [r["error"] for r in front], "k-", linewidth=0.8, label="front of all")
        told = [a for a in group["advised"] if a["reached"] and isinstance(a["error"], float)]
        ax.loglog([a["ms"] for a in told], [a["error"] for a in told], "*", color="k", label="dv.advise")
        if isinstance(group["unsure"], float):
            ax.axhline(group["unsure"], color="0.6", linestyle=":", label="the reference's own error")
        ax.set_title(group["scene"], fontsize="small")
        ax.set(ylim=(1e-5, 3), xlabel="ms of a rollout")
        ax.xaxis.set_minor_formatter("")
        ax.set_xlabel("ms of a rollout", fontsize="small")
        ax.grid(alpha=0.3)
    for ax in all_axes[len(groups) :]:
        ax.axis("off")
    all_axes[0].set_ylabel("error over motion")
    figure.legend(*all_axes[0].get_legend_handles_labels(), fontsize="x-small", loc="outside lower center", ncols=4)


FIGURES: dict[str, Callable[[Any, dict[str, Any]], None]] = {
    "exactness": exactness,
    "ablation": ablation,
    "cost": cost,
    "fd": finite_differences,
    "tradeoff": tradeoff,
    "twolevel": two_level,
}
