"""What the tests of bad input share: a small scene, spoiled values, and what an error must say."""

import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv

NAN, INF = float("nan"), float("inf")
MESH = dv.mesh.cube(split="kuhn")  # 8 vertices, 6 tets
STEP = {"mu": 1e4, "lam": 1e4, "solver": dv.VBD(0.01, 1)}


def doubles(*values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def model_of(device: str, **options: Any) -> dv.Model:
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.5), dv.Anchor(1.0))
    return dv.Model(MESH, pinned=[0], energies=energies, device=device, **options)


def spoiled(value: float, *where: int) -> Tensor:
    """Positions with one bad entry."""
    out = torch.from_numpy(MESH.points.copy())
    out[where] = value
    return out


def ones(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.ones(shape, dtype=dtype)


def raises(run: Callable[[], Any], name: str, got: str) -> None:
    """run() raises ValueError or TypeError whose message names the argument first and contains what came."""
    with pytest.raises((ValueError, TypeError)) as error:
        run()
    assert type(error.value) in (ValueError, TypeError)
    message = str(error.value)
    assert re.match(rf"[\w ,.\"\[\]()]*{re.escape(name)}", message), message
    assert "expected" in message and re.search(got, message), message
