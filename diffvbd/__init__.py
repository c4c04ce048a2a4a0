"""diffvbd: differentiable soft-body simulation by Vertex Block Descent, by the exact adjoint of the executed solver."""

import os as _os
import warnings as _warnings
from typing import Any as _Any

# Idle threads that spin make a parallel region cost milliseconds on a busy machine; only the first import decides.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from . import colliders, contact, distributed, mesh, solvers, viz
from ._version import __version__ as __version__
from .adjoint.routes import GlobalAdjoint, LinearSolve, ReverseSweep, Unrolled
from .contact.barrier import Friction, PairBarrier
from .energies import Anchor, FloorBarrier, StableNeoHookean
from .inspect import coarse, integrators
from .inspect.debug import debug_checks
from .inspect.diagnose import Diagnosis, diagnose
from .inspect.forces import Stress, reactions, stress
from .inspect.gradcheck import GradientCheck, check_gradients
from .mesh import TetMesh
from .model.coarse import CoarseSpace
from .model.model import Model
from .model.moduli import lame, young_poisson
from .ops.regimes import regime
from .rollout.advise import advise
from .rollout.budget import ErrorBudget, Share, error_budget
from .rollout.checkpoints import BinomialCheckpoints
from .rollout.converge import Solution, solve
from .rollout.refine import Refinement, refine
from .rollout.rollout import rollout
from .rollout.settings import Candidate, Prediction, Settings
from .rollout.trajectory import Trajectory, per_step, step_average
from .step.estimate import ErrorEstimate
from .step.integrators import BDF2, SDIRK2, History, ImplicitEuler
from .step.manual import Tape, step_backward, step_forward
from .step.step import step

__all__ = [
    "BDF2",
    "SDIRK2",
    "Anchor",
    "BinomialCheckpoints",
    "Candidate",
    "CoarseSpace",
    "Diagnosis",
    "ErrorBudget",
    "ErrorEstimate",
    "FloorBarrier",
    "Friction",
    "GlobalAdjoint",
    "GradientCheck",
    "History",
    "ImplicitEuler",
    "LinearSolve",
    "Model",
    "PairBarrier",
    "Refinement",
    "Prediction",
    "ReverseSweep",
    "Settings",
    "Share",
    "Solution",
    "StableNeoHookean",
    "Stress",
    "Tape",
    "TetMesh",
    "Trajectory",
    "Unrolled",
    "advise",
    "check_gradients",
    "coarse",
    "colliders",
    "contact",
    "debug_checks",
    "diagnose",
    "distributed",
    "error_budget",
    "integrators",
    "lame",
    "mesh",
    "per_step",
    "reactions",
    "refine",
    "regime",
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


def __getattr__(name: str) -> _Any:
    if name == "Binomial":
        _warnings.warn("diffvbd.Binomial is now diffvbd.BinomialCheckpoints", DeprecationWarning, stacklevel=2)
        return BinomialCheckpoints
    raise AttributeError(f"module 'diffvbd' has no attribute {name!r}")
