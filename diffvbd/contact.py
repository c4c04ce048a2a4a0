"""State, forces and detections of contact: what a user asks of a Model with a PairBarrier, Friction or a floor."""

from .inspect.contact import Status, intersections, reserve, status
from .inspect.forces import ForceParts, Forces, forces
from .inspect.penalty import Bodies, center_of_mass_penalty
from .inspect.pressure import PressureMap, pressure
from .step.contact import Detection

__all__ = ["Bodies", "Detection", "ForceParts", "Forces", "PressureMap", "Status", "center_of_mass_penalty", "forces",
           "intersections", "pressure", "reserve", "status"]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
