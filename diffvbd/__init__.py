"""diffvbd: differentiable soft-body simulation by Vertex Block Descent, by the exact adjoint of the executed solver."""

import os as _os

# Idle threads that spin make a parallel region cost milliseconds on a busy machine; only the first import decides.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from . import colliders, contact, distributed, mesh, results, solvers, viz
from ._version import __version__ as __version__
from .adjoint.routes import GlobalAdjoint, LinearSolve, ReverseSweep, Unrolled
from .contact.barrier import Friction, PairBarrier
from .energies import Anchor, FloorBarrier, StableNeoHookean
from .inspect.debug import debug_checks
from .inspect.diagnose import diagnose
from .inspect.forces import reactions, stress
from .inspect.gradcheck import check_gradients
from .inspect.record import record
from .mesh import TetMesh
from .model.coarse import CoarseSpace
from .model.integrators import BDF2, SDIRK2, ImplicitEuler
from .model.model import Model
from .model.moduli import lame, young_poisson
from .model.solver import VBD
from .rollout.advise import advise
from .rollout.budget import error_budget
from .rollout.checkpoints import BinomialCheckpoints
from .rollout.checks import Checks
from .rollout.converge import solve
from .rollout.memory import memory
from .rollout.refine import refine
from .rollout.rollout import rollout
from .rollout.trajectory import per_step, step_average
from .step.step import step, step_backward, step_forward

__all__ = [
    "BDF2",
    "SDIRK2",
    "VBD",
    "Anchor",
    "BinomialCheckpoints",
    "Checks",
    "CoarseSpace",
    "FloorBarrier",
    "Friction",
    "GlobalAdjoint",
    "ImplicitEuler",
    "LinearSolve",
    "Model",
    "PairBarrier",
    "ReverseSweep",
    "StableNeoHookean",
    "TetMesh",
    "Unrolled",
    "advise",
    "check_gradients",
    "colliders",
    "contact",
    "debug_checks",
    "diagnose",
    "distributed",
    "error_budget",
    "lame",
    "memory",
    "mesh",
    "per_step",
    "reactions",
    "record",
    "refine",
    "results",
    "rollout",
    "solve",
    "solvers",
    "step",
    "step_average",
    "step_backward",
    "step_forward",
    "stress",
    "viz",
    "young_poisson",
]


def __dir__() -> list[str]:
    return __all__
