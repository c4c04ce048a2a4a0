"""Records that functions of the package return."""

from .adjoint.routes import LinearSolve
from .inspect.diagnose import Diagnosis
from .inspect.forces import CouplingForces, Stress
from .inspect.gradcheck import GradientCheck
from .rollout.equilibrium import Equilibrium
from .rollout.refine import GradientTest, Refinement
from .rollout.solve import Solution
from .rollout.trajectory import Trajectory
from .rollout.tune import Candidate, ErrorBudget, Prediction, Share
from .step.integrators import History
from .step.residual import ErrorEstimate
from .step.step import Tape

__all__ = [
    "Candidate",
    "CouplingForces",
    "Diagnosis",
    "Equilibrium",
    "ErrorBudget",
    "ErrorEstimate",
    "GradientCheck",
    "GradientTest",
    "History",
    "LinearSolve",
    "Prediction",
    "Refinement",
    "Share",
    "Solution",
    "Stress",
    "Tape",
    "Trajectory",
]
