"""Environments for reinforcement learning: many scenes in one batch, torch tensors in and out, on gymnasium's vector
interface (docs/guides/environments.md). They take ``pip install "diffvbd[envs]"``, and SoftLift ``"diffvbd[robots]"``.
"""

try:
    import gymnasium as _  # noqa: F401
except ImportError:
    raise ImportError("envs: expected gymnasium, which is not installed: pip install 'diffvbd[envs]'") from None

from .crawler import Crawler
from .environment import Environment, State
from .soft_lift import SoftLift
from .tactile_push import TactilePush

__all__ = ["Crawler", "Environment", "SoftLift", "State", "TactilePush"]
