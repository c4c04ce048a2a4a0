"""Contact between surfaces. The files of this folder, potentials to starts, know no Model.

What users ask of a Model with contact, ``diffvbd.contact.status`` and the like, stands in inspect/contact.py, above the
Model, and is looked up here by name when it is asked for.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..inspect.contact import (
        Bodies,
        Detection,
        ForceParts,
        Forces,
        Status,
        center_of_mass_penalty,
        forces,
        intersections,
        reserve,
        status,
    )

__all__ = [
    "Bodies",
    "Detection",
    "ForceParts",
    "Forces",
    "Status",
    "center_of_mass_penalty",
    "forces",
    "intersections",
    "reserve",
    "status",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from ..inspect import contact

        return getattr(contact, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
