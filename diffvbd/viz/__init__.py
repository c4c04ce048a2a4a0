"""Pictures and a live view of soft bodies. What they need (extra [viz]) is imported only when something is drawn."""

from diffvbd.viz.drawing import COLORS, Scenery, box, capsule, draw, floor
from diffvbd.viz.live import live
from diffvbd.viz.pictures import animation, cloud, cloud_animation, comparison, field, landing, learning, paths
from diffvbd.viz.render import render
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
