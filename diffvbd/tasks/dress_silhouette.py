"""Identify both Lame parameters of a dress that drapes over a mannequin, from its outline (paper, section 6.5).

The scene, the two stages and the choices are those of `dress`, but all that is seen of a frame is its profile: the
radius of the outline around the mannequin's axis at 21 heights, which says nothing of which vertex is where. It is
differentiable: a soft maximum of the vertices' distances from the axis, in a window around each height.

Choices the paper leaves open: heights from the floor to the neck, 4.25 cm apart; Gaussian windows of 3 cm, half the
distance of rings; the weight of a vertex grows by a factor e per cm of its distance from the axis.
"""

import torch
from torch import Tensor

from diffvbd.tasks import dress
from diffvbd.tasks.problem import Problem, Settings

HEIGHTS = 21
WINDOW = 0.03  # standard deviation [m]
SOFTNESS = 0.01  # [m]


def problem(settings: Settings) -> Problem:
    heights = torch.linspace(0.0, dress.NECK, HEIGHTS, dtype=torch.float64, device=settings.device)
    return dress.problem("dress-silhouette", settings, observe=lambda frames: profile(frames, heights)[..., None])


def profile(x: Tensor, heights: Tensor) -> Tensor:
    """Radius of the outline around the y axis [m] at each height, shape [..., H].

    Args:
        x: Positions [m], shape [..., V, 3].
        heights: [m], shape [H].
    """
    radius = x[..., ::2].norm(dim=-1)[..., None, :]
    below = (x[..., None, :, 1] - heights[:, None]) / WINDOW
    return ((radius / SOFTNESS - 0.5 * below.square()).softmax(-1) * radius).sum(-1)
