"""diffvbd: differentiable soft-body simulation by Vertex Block Descent, by the exact adjoint of the executed solver."""

import os as _os

# Idle threads that spin make a parallel region cost milliseconds on a busy machine; only the first import decides.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from . import colliders, contact, mesh, solvers
from .adjoints import GlobalAdjoint, LinearSolve, ReverseSweep, Unrolled
from .debug import debug_checks
from .diagnostics import Diagnosis, diagnose
from .energies import Anchor, FloorBarrier, StableNeoHookean
from .gradcheck import GradientCheck, check_gradients
from .mesh import TetMesh
from .model import Model
from .moduli import lame, young_poisson
from .pair_barrier import Friction, PairBarrier
from .regimes import regime
from .rollout import Trajectory, per_step, rollout
from .schedule import Binomial
from .solve import Solution, solve
from .step import step
from .tape import Tape, step_backward, step_forward

__version__ = "0.1.0"

__all__ = [
    "Anchor",
    "Binomial",
    "Diagnosis",
    "FloorBarrier",
    "Friction",
    "GlobalAdjoint",
    "GradientCheck",
    "LinearSolve",
    "Model",
    "PairBarrier",
    "ReverseSweep",
    "Solution",
    "StableNeoHookean",
    "Tape",
    "TetMesh",
    "Trajectory",
    "Unrolled",
    "check_gradients",
    "colliders",
    "contact",
    "debug_checks",
    "diagnose",
    "lame",
    "mesh",
    "per_step",
    "regime",
    "rollout",
    "solve",
    "solvers",
    "step",
    "step_backward",
    "step_forward",
    "young_poisson",
]
