"""diffvbd: differentiable soft-body simulation by Vertex Block Descent, with the exact adjoint of the executed solver."""

import os as _os

# Idle threads that spin make a parallel region cost milliseconds on a busy machine; only the first import decides.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from . import mesh  # noqa: E402
from .adjoints import ReverseSweep  # noqa: E402
from .energies import Anchor, FloorBarrier, StableNeoHookean  # noqa: E402
from .mesh import TetMesh  # noqa: E402
from .model import Model  # noqa: E402
from .step import debug_checks, step  # noqa: E402

__version__ = "0.1.0"
