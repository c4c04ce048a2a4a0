"""What the viewer opens: files of motions, mesh files, folders of runs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from ..mesh.io import load
from ..mesh.motions import read_frames
from ..mesh.tet_mesh import TetMesh
from .motion import Motion, load_motions, motions_of

MOTION, LOG = "motion.npz", "log.json"  # of the folder of a run
NOT_SHOWN = {"iteration", "stage", "seconds", "loss"}  # of a row of the log


_FOR_OTHERS = (".glb", ".gltf", ".usd", ".usda", ".usdc")  # what `write_series` writes and nothing here reads


class Opened(NamedTuple):
    """Motions by name, their mesh if the file has tets, and the course of an optimisation."""

    motions: dict[str, Motion]
    mesh: TetMesh | None = None
    losses: tuple[float, ...] = ()
    parameters: Mapping[str, float] = MappingProxyType({})


def opened(path: Path, time_step: float | None = None) -> Opened:
    """The motions of a .pvd, of a mesh file, of a motion.npz, or of the folder of a run.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file of another kind, or a run that has kept no motion.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: expected a .pvd, a mesh with tets or the folder of a run")
    if path.is_dir():
        return _run(path)
    if path.suffix.lower() == ".npz":
        return Opened(load_motions(path))
    if path.suffix.lower() == ".pvd":
        frames = read_frames(path)
        motions = motions_of(frames.points, frames.mesh, time_step)
        if time_step is None:
            motions = {name: _timed(motion, frames.times) for name, motion in motions.items()}
        return Opened(motions, frames.mesh)
    if path.suffix.lower() in _FOR_OTHERS:
        raise ValueError(
            f"{path}: expected a .pvd, a mesh with tets or the folder of a run; {path.suffix} is for other programs"
        )
    mesh = load(path)
    return Opened(motions_of(mesh, time_step=time_step), mesh)


def _timed(motion: Motion, times: Any) -> Motion:
    """A motion at other times [s], which are not those of single steps."""
    return replace(motion, times=times, steps=None) if len(times) < 2 or times[-1] > times[0] else motion


def _run(folder: Path) -> Opened:
    if not (folder / MOTION).is_file():
        kind = "a run that is not finished" if (folder / "state.pt").exists() else "none"
        raise ValueError(f"{folder}: expected the folder of a finished `diffvbd run` with {MOTION}, got {kind}")
    history: list[dict[str, Any]] = []
    losses: tuple[float, ...] = ()
    if (folder / LOG).is_file():
        try:
            history = json.loads((folder / LOG).read_text(encoding="utf-8")).get("history", [])
            losses = tuple(float(row.get("loss", math.nan)) for row in history)
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{folder / LOG}: expected the log of a run, got {error}") from None
    last = history[-1] if history else {}
    numbers = {k: v for k, v in last.items() if k not in NOT_SHOWN and isinstance(v, (int, float))}
    return Opened(load_motions(folder / MOTION), None, losses, numbers)
