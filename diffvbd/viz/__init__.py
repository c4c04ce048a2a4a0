"""Pictures of soft bodies. Needs matplotlib (extra [viz]), imported only when something is drawn."""

from diffvbd.viz.animation import animation
from diffvbd.viz.cloud import cloud, cloud_animation
from diffvbd.viz.comparison import comparison
from diffvbd.viz.drawing import COLORS, Scenery, box, capsule, draw, floor
from diffvbd.viz.field import field
from diffvbd.viz.landing import landing
from diffvbd.viz.learning import learning
from diffvbd.viz.paths import paths

__all__ = [
    "COLORS",
    "Scenery",
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
    "paths",
]
