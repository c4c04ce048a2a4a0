"""Looking for a fault: values checked at every step, scenes, evaluation against the reference, and tolerances."""

from ..inspect.record import debug_checks
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

__all__ = ["CASES", "KINDS", "SIZES", "Case", "Scene", "bar", "build_mesh", "build_scene", "debug_checks",
           "delaunay", "evaluate", "generator", "on_device", "reference_result", "regime", "relative_error",
           "scenes", "sensitivity", "shuffled", "spread", "structured", "tolerance", "volumes"]  # fmt: skip
