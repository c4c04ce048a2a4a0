"""diffvbd: differentiable soft-body simulation by Vertex Block Descent, by the exact adjoint of the executed solver."""

import importlib as _importlib
import os as _os

# Idle threads that spin make a parallel region cost milliseconds on a busy machine; only the first import decides.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from . import colliders, contact, mesh, solvers, viz
from ._contact.barrier import Friction, PairBarrier
from ._version import __version__ as __version__
from .adjoint.routes import GlobalAdjoint, ReverseSweep, Unrolled
from .couplings import Pressure, Springs, Tendons
from .embedding import Embedding
from .energies import Anchor, FloorBarrier, StableNeoHookean
from .inspect.diagnose import diagnose
from .inspect.forces import coupling_forces, reactions, stress
from .inspect.gradcheck import check_gradients
from .inspect.record import record
from .laws import law
from .mesh import TetMesh
from .model.coarse import CoarseSpace
from .model.material import fibre_contraction, lame, young_poisson
from .model.model import Model
from .model.solver import BDF2, SDIRK2, VBD, ImplicitEuler
from .rollout.checks import Checks
from .rollout.equilibrium import equilibrium
from .rollout.memory import BinomialCheckpoints, memory
from .rollout.refine import refine
from .rollout.rollout import rollout
from .rollout.solve import solve
from .rollout.trajectory import per_step, step_average
from .rollout.tune import advise, error_budget
from .step.step import step, step_backward, step_forward

__all__ = [
    "BDF2",
    "SDIRK2",
    "VBD",
    "Anchor",
    "BinomialCheckpoints",
    "Checks",
    "CoarseSpace",
    "Embedding",
    "FloorBarrier",
    "Friction",
    "GlobalAdjoint",
    "ImplicitEuler",
    "Model",
    "PairBarrier",
    "Pressure",
    "ReverseSweep",
    "Springs",
    "StableNeoHookean",
    "Tendons",
    "TetMesh",
    "Unrolled",
    "advise",
    "check_gradients",
    "colliders",
    "contact",
    "coupling_forces",
    "diagnose",
    "equilibrium",
    "error_budget",
    "fibre_contraction",
    "lame",
    "law",
    "memory",
    "mesh",
    "per_step",
    "reactions",
    "record",
    "refine",
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


def __getattr__(name: str) -> object:
    """Modules that are imported at their first use, so that ``dir`` shows what a scene is written with."""
    if name in ("distributed", "envs", "results", "robots", "testing"):
        return _importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
