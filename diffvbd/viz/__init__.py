"""Pictures and a live view of soft bodies. What they need (extra [viz]) is imported only when something is drawn."""

from diffvbd.viz.live import live
from diffvbd.viz.pictures import (
    COLORS,
    animation,
    cloud,
    cloud_animation,
    comparison,
    draw,
    field,
    landing,
    learning,
    paths,
)
from diffvbd.viz.render import render
from diffvbd.viz.scenery import Scenery, box, capsule, floor
from diffvbd.viz.viewer import Viewer

__all__ = [
    "COLORS",
    "Scenery",
    "Viewer",
    "animation",
    "box",
    "capsule",
    "cloud",
    "cloud_animation",
    "comparison",
    "draw",
    "field",
    "floor",
    "landing",
    "learning",
    "live",
    "paths",
    "render",
]
