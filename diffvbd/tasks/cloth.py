"""Parts that several tasks with cloth share: a sheet that hangs, the rings of a dress, means over vertices."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffvbd as dv


def hanging(nx: int, ny: int, width: float, length: float, thickness: float) -> tuple[dv.TetMesh, NDArray[np.bool_]]:
    """A cloth in the xy plane, with nx vertices across and ny down each of its two layers, and the mask [V] of its top
    edge; lengths in m."""
    # a quarter turn about x: what lay along z hangs along y
    upright = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    mesh = dv.mesh.sheet(nx, ny, (width, length), thickness).transform(upright)
    return mesh, mesh.points[:, 1] > length - 1e-9


@contextmanager
def few_sweeps() -> Iterator[None]:
    """No warning that sweeps are too few, by tets or by energy, nor that pairs truncate the motion: a quick version's
    cloth is coarse, and thick as the full one. Target and fit take the same steps, so the fit still has an exact
    solution."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "contact: pairs", UserWarning)
        warnings.filterwarnings("ignore", "sweeps: .* (too few for tets|has gained|may be off by)", UserWarning)
        warnings.filterwarnings("ignore", "mesh: tets .* bend", UserWarning)
        yield


def ring_of_vertices(dress: dv.TetMesh, segments: int, rings: int) -> NDArray[np.int64]:
    """For each vertex of a `dv.mesh.dress` the number of its ring, from 0 at the neck to rings - 1 at the hem."""
    return np.arange(dress.num_vertices) % (segments * rings) // segments


def mean_weights(chosen: NDArray[np.bool_], like: Tensor) -> Tensor:
    """Weights [V] whose dot product with values of vertices is the mean over the chosen ones, a mask [V]."""
    return torch.as_tensor(chosen / chosen.sum(), dtype=like.dtype, device=like.device)
