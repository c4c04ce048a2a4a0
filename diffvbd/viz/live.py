"""`live`: a motion, a file, an optimisation or a simulation behind sliders, in a browser."""

from __future__ import annotations

import math
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._common.checks import check_bool, check_count, fail
from ..inspect.gradcheck import check_names
from ..model.model import Model
from .motion import Mesh, mesh_of, motions_of, opened, scenery_of
from .scenery import Scenery
from .values import Values, values_of
from .viewer import Slider, Viewer


def live(
    source: Any,
    mesh: Mesh | None = None,
    *,
    color: str = "body",
    time_step: float | None = None,
    mu: Any = None,
    lam: Any = None,
    sliders: Mapping[str, Sequence[float]] | None = None,
    scenery: Sequence[Scenery] = (),
    colliders: Any = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    play: bool = True,
    browser: bool = False,
) -> Viewer:
    """A page of a local server that shows a motion: play, scrub, color, watch an optimisation, move sliders.

    Args:
        source: What to show:

            * a Trajectory, or positions [m], shape [N, V, 3] or [N, B, V, 3], array or tensor; a dict of such things
              by name;
            * a dv.Model or dv.TetMesh, for :meth:`Viewer.update`;
            * a file: a .pvd that `write_series` wrote, a mesh with tets, or the folder of a `diffvbd run`;
            * a function of the parameters in ``sliders`` that returns a trajectory or positions.
        mesh: The dv.Model of the motion, or its dv.TetMesh; stress, contact force, floor and colliders need a Model.
        color: "body", "speed", "stress" (von Mises), "stiffness" (mu) or "contact" (force).
        time_step: Between steps [s]. Without it motions have no times, and positions no speed.
        mu, lam: Material [Pa], a number, [T] or [B, T], for stress and stiffness. Those of sliders named so are taken.
        sliders: Lowest and highest value of each parameter, and the first one, if it is not the middle.
        scenery: What else stands there, from `diffvbd.viz.floor`, `box`, `capsule`.
        colliders: Where the corner points of the Model's colliders are in each frame [m], shape [N, Vc, 3].
        host, port: Of the server. Another free port is taken where this one is in use; ``viewer.url`` has it.
        play: Whether the motion runs from the beginning.
        browser: Open the page in the system's browser.

    Returns:
        A :class:`Viewer`, which runs until it is stopped. In a notebook it shows the page.

    Raises:
        ImportError: viser is not installed.
        FileNotFoundError: no such file.
        ValueError, TypeError: another shape, file, color or range.
    """
    check_count("port", port, 0, 65535)
    if not isinstance(host, str) or not host:
        raise TypeError(f"host: expected the name or address of a network interface, got {host!r}")
    check_bool("play", play)
    ranges, simulate, course = _ranges({} if sliders is None else sliders), None, None
    if isinstance(source, (str, Path)):
        course = opened(Path(source), time_step)
        motions, mesh = course.motions, course.mesh if mesh is None else mesh
    elif callable(source) and not isinstance(source, (Model, torch.Tensor)):
        if not ranges:
            fail("sliders", "ranges of the function's parameters by name", "none")
        check_names("source", source, ranges)
        simulate = torch.no_grad()(source)
        motions = motions_of(simulate(**{name: first for name, (_, _, first) in ranges.items()}), mesh, time_step)
    else:
        mesh = source if mesh is None and isinstance(source, Model) else mesh
        motions = motions_of(source, mesh, time_step)
    if ranges and simulate is None:
        raise TypeError(f"source: expected a function of {', '.join(ranges)} for sliders, got {type(source).__name__}")
    body, values = mesh_of(mesh), values_of(mesh, mu, lam, colliders)
    if simulate is not None:
        simulate = _with_material(simulate, values)
        values.mu, values.lam = (ranges[n][2] if n in ranges else value for n, value in (("mu", mu), ("lam", lam)))
    if not isinstance(scenery, Sequence) or not all(isinstance(thing, Scenery) for thing in scenery):
        raise TypeError(f"scenery: expected a sequence of dv.viz.Scenery, got {type(scenery).__name__}")
    things = tuple(scenery)
    if isinstance(mesh, Model):
        corners = np.stack([motion.bounds for motion in motions.values()])
        things += scenery_of(mesh, corners[:, 0].min(0), corners[:, 1].max(0), colliders)
    elif colliders is not None:
        fail("mesh", "a dv.Model with colliders", type(mesh).__name__)
    viewer = Viewer(motions, body if mesh is None else mesh, values, color=color, time_step=time_step, scenery=things,
                    sliders=ranges, simulate=simulate, host=host, port=port)  # fmt: skip
    if course is not None:
        viewer.show_course(course.losses, course.parameters)
    if play:
        viewer.play()
    if browser:
        webbrowser.open(viewer.url)
    return viewer


def _ranges(sliders: Mapping[str, Sequence[float]]) -> dict[str, Slider]:
    if not isinstance(sliders, Mapping):
        raise TypeError(f"sliders: expected ranges by name, got {type(sliders).__name__}")
    found = {}
    for name, given in sliders.items():
        try:
            numbers = [float(value) for value in given]
        except (TypeError, ValueError):
            numbers = []
        low, high = numbers[:2] if len(numbers) in (2, 3) else (1.0, 0.0)
        first = numbers[2] if len(numbers) == 3 else 0.5 * (low + high)
        if not (all(map(math.isfinite, numbers)) and low < high and low <= first <= high):
            fail(f"sliders[{name!r}]", "(lowest, highest) or (lowest, highest, first), ascending", repr(given))
        found[name] = (low, high, first)
    return found


def _with_material(simulate: Callable[..., Any], values: Values) -> Callable[..., Any]:
    def run(**arguments: float) -> Any:
        result = simulate(**arguments)
        values.mu, values.lam = (arguments.get(name, getattr(values, name)) for name in ("mu", "lam"))
        return result

    return run
