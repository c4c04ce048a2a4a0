"""A gripper of two fingers, of the environment SoftLift and the task lift."""

from __future__ import annotations

from torch import Tensor

from .files import loads
from .robot import Robot


def gripper(finger: tuple[float, float, float], opening: float, base: Tensor | None = None, *, rise: float,
            travel: float, height: float = 0.0, tilt: float = 0.0) -> Robot:  # fmt: skip
    """A hand that the joint ``lift`` raises along y, with fingers that the joint ``close`` moves toward each other.

    Args:
        finger: Size of a finger, a box, along x, y and z [m].  opening: Between the fingers at the position 0 [m].
        base: As of :func:`load`.  rise, travel: Largest positions of lift and close [m].
        height: Of the fingers' middle over the hand [m].  tilt: Turn of the fingers about x [rad].
    """

    def side(name: str, joint: str, inward: int, mimic: str = "") -> str:
        at = -inward * (opening + finger[0]) / 2
        return f"""<link name="{name}"><collision><geometry><box size="{finger[0]} {finger[1]} {finger[2]}"/></geometry>
</collision></link><joint name="{joint}" type="prismatic"><parent link="hand"/><child link="{name}"/>
<origin xyz="{at} {height} 0" rpy="{tilt} 0 0"/><axis xyz="{inward} 0 0"/>
<limit lower="0" upper="{travel}" effort="20" velocity="1"/>{mimic}</joint>"""

    return loads(f"""<?xml version="1.0"?><robot name="gripper"><link name="world"/><link name="hand"/>
<joint name="lift" type="prismatic"><parent link="world"/><child link="hand"/><axis xyz="0 1 0"/>
<limit lower="0" upper="{rise}" effort="50" velocity="1"/></joint>
{side("left", "close", 1)}{side("right", "follow", -1, '<mimic joint="close"/>')}</robot>""", base)  # fmt: skip
