"""How the sweeps of a step are spread over a CUDA device: four regimes, chosen by the size of the work."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Literal

from .._common.checks import fail
from .fields import THREAD

Regime = Literal["thread", "block", "grid", "color"]

# twins of Regime, kFewLanes, kSomeLanes, kSomeReverseLanes and kManyLanes in csrc/cuda/step.h, of kSmallMesh in
# csrc/core/views.h
BLOCK, GRID, COLOR = 2, 3, 4
CODES: dict[str, int] = {"thread": THREAD, "block": BLOCK, "grid": GRID, "color": COLOR}
FEW_LANES, SOME_LANES, SOME_REVERSE_LANES, MANY_LANES = 2, 8, 4, 32
SMALL_MESH = 64

# Where one regime overtakes another on an H100 and an H200: the table "regimes" of docs/performance.md.
THREAD_VERTICES = 8  # up to here a scene per thread is the fastest or within 5 % of it, however few scenes there are
THREAD_SCENES = 4096  # of larger scenes: below, a scene per thread leaves most of the device idle
TINY_VERTICES = 32  # up to here a scene per thread or, of fewer scenes, per block beats whatever spreads a scene out
BLOCK_SCENES = 256  # of larger scenes: below, a scene per block leaves multiprocessors idle
BLOCK_VERTICES = 1_000  # above, a block has too few threads for a scene
# Vertices of all scenes up to which a cooperative grid's barriers cost less than launches, in the sweeps and in their
# reverse; where there are BLOCK_SCENES, also scenes of up to so many vertices each.
GRID_VERTICES, GRID_SCENE_VERTICES = (100_000, 50_000), 10_000
MANY_SCENES = 64  # of a scene per block: from here on they fill a multiprocessor with few threads per vertex
# Vertices of all scenes in a color up to which that many threads of each find room, in the sweeps and in their reverse.
MANY_LANES_VERTICES = (1_500, 1_000)
SOME_LANES_VERTICES = (16_000, 8_000)
CONTACT_VERTICES = 256  # and up to which, with contact, all sweeps are one launch, in which each has a block

_forced: str | None = None


@contextlib.contextmanager
def regime(name: Regime | None) -> Iterator[None]:
    """Inside, steps on CUDA run in the named regime; None: chosen by size (the default). For measuring.

    Args:
        name: ``"thread"``: a scene per thread (meshes of at most 64 vertices); ``"block"``: a scene per thread block, a
            step per launch; ``"grid"``: all scenes by one cooperative grid, a step per launch; ``"color"``: a launch
            per color. Each is reproducible to the bit; they differ from each other by rounding. With contact
            everything but ``"grid"`` runs as ``"color"``, and ``"grid"`` too above 1,500 vertices in a color on
            average. No effect on the CPU. The setting is of the process: threads share it.

    Raises:
        ValueError: For another name; in a step, where the regime cannot run the scene.
    """
    if name is not None and not (isinstance(name, str) and name in CODES):
        fail("regime", f"one of {sorted(CODES)} or None", repr(name))
    global _forced
    before, _forced = _forced, name
    try:
        yield
    finally:
        _forced = before


def choose(vertices: int, colors: int, scenes: int, contact: bool = False, together: bool = False
           ) -> tuple[int, int, int, int]:  # fmt: skip
    """Regimes of the sweeps and of their reverse, and threads per vertex of both, for SweepSettings.launch. together:
    No scene is left to one thread, as with coarse corrections, which are launches between sweeps, and with a law of
    one's own, which has no such kernel."""
    at_once = vertices * scenes / max(1, colors)
    if contact:
        if at_once > MANY_LANES_VERTICES[0]:  # pairs are summed up in launches of their own
            return COLOR, COLOR, SOME_LANES, SOME_REVERSE_LANES
        grid = at_once <= CONTACT_VERTICES if _forced is None else _forced == "grid"
        code = GRID if grid else COLOR
        return code, code, MANY_LANES, MANY_LANES
    code, back = (CODES[_forced],) * 2 if _forced else _automatic(vertices, scenes)
    if code == THREAD and together:
        code = back = BLOCK
    if code == THREAD and vertices > SMALL_MESH:
        fail("regime", f"a mesh of at most {SMALL_MESH} vertices for a scene per thread", f"{vertices} vertices")
    if code == BLOCK:  # scenes enough fill a multiprocessor; one alone wants its threads
        lone = scenes < MANY_SCENES
        return code, back, SOME_LANES if lone else FEW_LANES, SOME_REVERSE_LANES if lone else FEW_LANES
    some, limits = (SOME_LANES, SOME_REVERSE_LANES), zip(MANY_LANES_VERTICES, SOME_LANES_VERTICES, strict=True)
    forward, reverse = (
        MANY_LANES if at_once <= up_to_many else lanes if at_once <= up_to_some else FEW_LANES
        for lanes, (up_to_many, up_to_some) in zip(some, limits, strict=True)
    )
    return code, back, forward, reverse


def _automatic(vertices: int, scenes: int) -> tuple[int, int]:
    """Of the sweeps, and of their reverse; a scene per thread of both or of neither, as its tape is its own."""
    if vertices <= TINY_VERTICES:
        code = THREAD if vertices <= THREAD_VERTICES or scenes >= THREAD_SCENES else BLOCK
        return code, code
    if scenes >= BLOCK_SCENES and vertices <= GRID_SCENE_VERTICES:
        code = BLOCK if vertices <= BLOCK_VERTICES else GRID
        return code, code
    forward, reverse = (GRID if vertices * scenes <= up_to else COLOR for up_to in GRID_VERTICES)
    return forward, reverse
