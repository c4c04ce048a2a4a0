"""Shared parts of tests and benchmarks: scenes, evaluation against the reference, and one table of tolerances."""

from ..ops.regimes import regime
from .scenes import (
    CASES,
    KINDS,
    SIZES,
    Case,
    Scene,
    bar,
    build_mesh,
    build_scene,
    delaunay,
    evaluate,
    generator,
    on_device,
    reference_result,
    relative_error,
    scenes,
    sensitivity,
    shuffled,
    spread,
    structured,
    volumes,
)
from .tolerances import tolerance

__all__ = ["CASES", "KINDS", "SIZES", "Case", "Scene", "bar", "build_mesh", "build_scene", "delaunay", "evaluate",
           "generator", "on_device", "reference_result", "regime", "relative_error", "scenes", "sensitivity",
           "shuffled", "spread", "structured", "tolerance", "volumes"]  # fmt: skip
