"""Pictures and a live view of soft bodies. What they need (extra [viz]) is imported only when something is drawn."""

from diffvbd.viz.animation import animation
from diffvbd.viz.cloud import cloud, cloud_animation
from diffvbd.viz.comparison import comparison
from diffvbd.viz.drawing import COLORS, Scenery, box, capsule, draw, floor
from diffvbd.viz.field import field
from diffvbd.viz.landing import landing
from diffvbd.viz.learning import learning
from diffvbd.viz.live import live
from diffvbd.viz.paths import paths
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
