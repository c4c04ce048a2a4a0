"""Draws the pictures of docs/concepts.md into docs/images/concepts: `python docs/images/concepts.py`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

FOLDER = Path(__file__).parent / "concepts"
BLUE, RED, GREEN, GREY, DARK = "#3b6ea8", "#d0563f", "#3f9b57", "#b8bec6", "#333a42"
ARROW = {"arrowstyle": "-|>", "color": DARK, "lw": 1.4, "shrinkA": 0, "shrinkB": 0}


def grid() -> tuple[np.ndarray, Triangulation, np.ndarray]:
    """A small mesh of the plane, and colors of its vertices: no edge joins two of one color."""
    points = np.array([(i + 0.5 * (j % 2), 0.87 * j) for j in range(4) for i in range(5)])
    colors = np.array([(i - j // 2 - j) % 3 for j in range(4) for i in range(5)])
    mesh = Triangulation(*points.T)
    corners = points[mesh.triangles]
    mesh.set_mask(np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1) > 1.2)  # beyond the zigzag sides
    return points, mesh, colors


def sweep(figure: Any) -> None:
    points, mesh, colors = grid()
    assert all(colors[a] != colors[b] for a, b in mesh.edges)
    palette, moved = np.array([BLUE, RED, GREEN]), points.copy()
    for k, ax in enumerate(figure.subplots(1, 3)):
        ax.triplot(Triangulation(*moved.T, mesh.triangles, mesh.mask), color=GREY, lw=1)
        mine = colors == k
        target = moved + np.array([0.14, -0.34])
        for a, b in zip(moved[mine], target[mine], strict=True):
            ax.annotate("", b, a, arrowprops=ARROW | {"color": palette[k]})
        ax.scatter(*moved[~mine].T, s=28, color=palette[colors[~mine]], alpha=0.35, zorder=3)
        ax.scatter(*moved[mine].T, s=46, color=palette[k], zorder=4)
        moved[mine] = target[mine]
        ax.set_title(f"color {k + 1} of 3 moves", fontsize=11, color=palette[k])
        ax.set_aspect("equal")
        ax.axis("off")


def boxes(ax: Any, names: list[str], y: float, color: str, width: float = 0.74) -> None:
    for i, name in enumerate(names):
        ax.add_patch(_box(i, y, width, color))
        ax.text(i, y, name, ha="center", va="center", fontsize=10, color="white")


def _box(x: float, y: float, width: float, color: str) -> Any:
    from matplotlib.patches import FancyBboxPatch

    return FancyBboxPatch((x - width / 2, y - 0.16), width, 0.32, boxstyle="round,pad=0.02", color=color, lw=0)


def adjoint(figure: Any) -> None:
    ax = figure.subplots()
    boxes(ax, ["$x_0, v_0, \\mu$", "sweep 1", "sweep 2", "...", "sweep K", "loss"], 1.0, BLUE)
    back = ["gradients", "sweep 1$^T$", "sweep 2$^T$", "...", "sweep K$^T$", "1"]
    boxes(ax, back, 0.0, RED)
    for i in range(5):
        ax.annotate("", (i + 0.6, 1.0), (i + 0.4, 1.0), arrowprops=ARROW)
        ax.annotate("", (i + 0.4, 0.0), (i + 0.6, 0.0), arrowprops=ARROW)
        if i:
            ax.annotate("", (i, 0.2), (i, 0.8), arrowprops=ARROW | {"color": GREY, "ls": "--"})
    ax.annotate("", (5, 0.2), (5, 0.8), arrowprops=ARROW)
    ax.text(2.5, 0.5, "tape: what each sweep met", ha="center", va="center", fontsize=10, color=DARK,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 2})  # fmt: skip
    ax.text(-0.55, 1.0, "forward", ha="right", va="center", color=BLUE)
    ax.text(-0.55, 0.0, "backward", ha="right", va="center", color=RED)
    ax.set(xlim=(-1.4, 5.5), ylim=(-0.35, 1.35))
    ax.axis("off")


def tape(figure: Any) -> None:
    ax = figure.subplots()
    steps, every = 16, 4
    rows = (("all tapes kept", None), (f"checkpoint every {every} steps", every), ("one tape, few states", "few"))
    for row, (name, kind) in enumerate(rows):
        y = -row
        for k in range(steps):
            taped = kind is None or k >= steps - (every if kind == every else 1)
            state = kind == every and k % every == 0 or kind == "few" and k in (0, 8, 12, 14, 15)
            color = RED if taped else BLUE if state else "#e6e9ed"
            ax.barh(y, 0.86, left=k, height=0.5, color=color)
        ax.text(-0.4, y, name, ha="right", va="center", fontsize=10, color=DARK)
    ax.annotate("", (steps, 0.62), (0, 0.62), arrowprops=ARROW)
    ax.text(steps / 2, 0.75, "time steps", ha="center", fontsize=10, color=DARK)
    for x, color, text in (
        (0, RED, "tape"),
        (3, BLUE, "state only"),
        (7.5, "#e6e9ed", "nothing: run again when needed"),
    ):
        ax.barh(-3.0, 0.7, left=x, height=0.35, color=color)
        ax.text(x + 0.95, -3.0, text, va="center", fontsize=10, color=DARK)
    ax.set(xlim=(-6, steps + 0.2), ylim=(-3.4, 1.15))
    ax.axis("off")


def hanging(sweeps: int, coarse: bool, n: int = 48) -> np.ndarray:
    """Displacements of a chain of springs that hangs from its top after some Gauss-Seidel sweeps."""
    a = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    a[-1, -1] = 1.0
    b, x = np.full(n, 1.0 / n**2), np.zeros(n)
    s = np.arange(1, n + 1) / n
    knots = np.linspace(0, 1, 7)
    functions = np.stack([np.interp(s, knots, np.eye(7)[i]) for i in range(1, 7)], 1)  # none moves the top
    for k in range(sweeps):
        for i in range(n):
            x[i] += (b[i] - a[i] @ x) / a[i, i]
        if coarse and k % 3 == 1:
            x += functions @ np.linalg.solve(functions.T @ a @ functions, functions.T @ (b - a @ x))
    return x if sweeps else np.linalg.solve(a, b)


def two_level(figure: Any) -> None:
    left, right = figure.subplots(1, 2, width_ratios=(1.35, 1))
    exact = hanging(0, False)
    s = np.arange(1, len(exact) + 1) / len(exact)
    left.plot(s, exact, color=DARK, lw=5, alpha=0.25, label="where it should hang")
    left.plot(s, hanging(5, False), color=RED, ls="--", label="5 plain sweeps")
    left.plot(s, hanging(60, False), color=RED, label="60 plain sweeps")
    left.plot(s, hanging(5, True), color=GREEN, lw=1.8, label="5 sweeps with 2 corrections")
    left.set(xlabel="place along the chain", ylabel="sag")
    left.legend(frameon=False, fontsize=9)
    knots = np.linspace(0, 1, 7)
    for i in range(1, 7):
        right.plot(knots, np.eye(7)[i], color=GREEN, lw=1.6)
    right.set(xlabel="place along the chain", title="what a correction may add")
    right.title.set_fontsize(10)
    for ax in (left, right):
        ax.set(xticks=[], yticks=[])
        ax.spines[["top", "right"]].set_visible(False)


def planes(figure: Any) -> None:
    lower = np.array([(0, 0), (1, 0.05), (2, 0.0), (3, 0.1), (0.4, -0.8), (1.5, -0.9), (2.6, -0.8)], float)
    upper = np.array([(0.6, 1.5), (1.7, 1.6), (2.8, 1.5), (1.0, 0.55), (2.2, 0.5)], float)
    titles = ("a plane keeps each pair apart", "across it: half of the way, or a quarter", "along it: all of the way")
    wish = (None, (0.15, -0.75), (0.75, 0.0))
    for ax, title, move in zip(figure.subplots(1, 3), titles, wish, strict=True):
        shown = upper.copy()
        if move is not None:
            start = upper[3]
            taken = np.array(move) * (0.25 if move[1] < 0 else 1.0)
            ax.annotate("", start + move, start, arrowprops=ARROW | {"color": GREY, "ls": "--"})
            shown[3] = start + taken
            ax.scatter(*start, s=24, color=BLUE, alpha=0.35, zorder=5)
            ax.annotate("", start + taken, start, arrowprops=ARROW | {"color": BLUE, "lw": 2})
        for points, color in ((lower, RED), (shown, BLUE)):
            triangles = Triangulation(*(lower if points is lower else upper).T).triangles
            mesh = Triangulation(*points.T, triangles)
            ax.tripcolor(mesh, np.zeros(len(points)), cmap=_plain(color), alpha=0.25)
            ax.triplot(mesh, color=color, lw=1)
            ax.scatter(*points.T, s=14, color=color, zorder=4)
        ax.plot((-0.3, 3.3), (0.28, 0.31), color=DARK, lw=1.3, ls=(0, (6, 3)))
        ax.set_title(title, fontsize=10.5, color=DARK)
        ax.set(xlim=(-0.4, 3.4), ylim=(-1.1, 1.8), aspect="equal")
        ax.axis("off")


def _plain(color: str) -> Any:
    from matplotlib.colors import ListedColormap

    return ListedColormap([color])


def swing(scheme: str, h: float, steps: int) -> np.ndarray:
    """Positions of a mass on a spring of frequency 1 rad/s, from 1 and at rest."""
    a, state = np.array([(0.0, 1.0), (-1.0, 0.0)]), [np.array([1.0, 0.0])]
    implicit = np.linalg.inv(np.eye(2) - h * a)
    g = 1 - np.sqrt(0.5)
    stage = np.linalg.inv(np.eye(2) - g * h * a)
    for k in range(steps):
        y = state[-1]
        if scheme == "BDF2" and k:
            y = np.linalg.inv(np.eye(2) - 2 / 3 * h * a) @ (4 / 3 * y - 1 / 3 * state[-2])
        elif scheme == "SDIRK2":
            first = a @ (stage @ y)
            y = stage @ (y + (1 - g) * h * first)
        else:
            y = implicit @ y
        state.append(y)
    return np.array(state)[:, 0]


def integrators(figure: Any) -> None:
    ax = figure.subplots()
    h, steps = 0.25, 100
    t = h * np.arange(steps + 1)
    fine = np.linspace(0, t[-1], 600)
    ax.plot(fine, np.cos(fine), color=DARK, lw=5, alpha=0.22, label="exact")
    for scheme, color in (("implicit Euler", RED), ("BDF2", BLUE), ("SDIRK2", GREEN)):
        ax.plot(t, swing(scheme, h, steps), color=color, marker=".", ms=3, lw=1.2, label=scheme)
    ax.set(xlabel="time", ylabel="swing", xticks=[], yticks=[])
    ax.legend(frameon=False, fontsize=9, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.16))
    ax.spines[["top", "right"]].set_visible(False)


PICTURES: dict[Callable[[Any], None], tuple[float, float]] = {
    sweep: (9, 2.4),
    adjoint: (9, 2.4),
    tape: (9, 2.5),
    two_level: (9, 2.9),
    planes: (9, 2.6),
    integrators: (9, 2.7),
}


def main() -> None:
    rcParams["svg.hashsalt"] = "concepts"  # the same bytes from run to run
    FOLDER.mkdir(exist_ok=True)
    for draw, size in PICTURES.items():
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        figure.savefig(FOLDER / f"{draw.__name__}.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
