"""Records that functions of the package return."""

from .inspect.diagnose import Diagnosis
from .inspect.forces import Stress
from .inspect.gradcheck import GradientCheck
from .rollout.budget import ErrorBudget, Share
from .rollout.converge import Solution
from .rollout.prediction import Candidate, Prediction
from .rollout.refine import GradientTest, Refinement
from .rollout.trajectory import Trajectory
from .step.estimate import ErrorEstimate
from .step.integrators import History
from .step.step import Tape

__all__ = [
    "Candidate",
    "Diagnosis",
    "ErrorBudget",
    "ErrorEstimate",
    "GradientCheck",
    "GradientTest",
    "History",
    "Prediction",
    "Refinement",
    "Share",
    "Solution",
    "Stress",
    "Tape",
    "Trajectory",
]
