"""The executed step in plain torch: slow, readable, differentiated by autograd.

It is the oracle of the exactness tests and the unrolled opponent in benchmarks. It works from deformation gradients,
not from the pair scalars of the compiled sweep, and imports nothing compiled, so the two agree only if both are right.
"""

from .contact import Substep, contact_step
from .distance import intersections
from .scene import build_layout
from .sweep import Trajectory, incremental_potential, residual, rollout, step, stepper

__all__ = [
    "Substep",
    "Trajectory",
    "build_layout",
    "contact_step",
    "incremental_potential",
    "intersections",
    "residual",
    "rollout",
    "step",
    "stepper",
]
