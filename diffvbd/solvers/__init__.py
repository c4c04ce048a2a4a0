"""The reverse sweep of other block solvers: your own, XPBD, projective dynamics, and VBD in the same terms."""

from .compose import BlockUpdate, Solver, Update, compose
from .projective_dynamics import Factor, LocalGlobal, ProjectiveDynamics
from .vertex_block import VertexBlock, vertex_block_descent
from .xpbd import XPBD, DistanceProjection

__all__ = [
    "XPBD",
    "BlockUpdate",
    "DistanceProjection",
    "Factor",
    "LocalGlobal",
    "ProjectiveDynamics",
    "Solver",
    "Update",
    "VertexBlock",
    "compose",
    "vertex_block_descent",
]
