"""Robots as colliders: links of a URDF or MJCF file whose poses follow from joint positions, in torch
(docs/guides/robots.md).

A Robot is kinematic: joint positions move its links, each of which is an Obstacle of a Model, and forces of contact are
read as joint torques.
"""

from .files import load, loads
from .robot import Robot

__all__ = ["Robot", "load", "loads"]
