"""What the tests of CUDA share: regimes, scenes of any size, capture in a graph."""

import contextlib
from collections.abc import Callable
from typing import Any

import torch

import diffvbd as dv
from diffvbd import testing
from diffvbd.testing import generator, structured

REGIMES = ("thread", "block", "grid", "color")
ANY_SIZE = ("grid", "color")


def forced(regime: str | None) -> contextlib.AbstractContextManager:
    """The CUDA regime in which everything inside runs; None: the package chooses."""
    return contextlib.nullcontext() if regime is None else testing.regime(regime)


def large_solver(sweeps: int, **options: Any) -> dv.VBD:
    """The solver of the scenes of large_inputs."""
    return dv.VBD(1 / 60, sweeps, relaxation=1.2, **options)


def large_inputs(cells: int, *lead: int, dtype: torch.dtype = torch.float64) -> tuple[dv.Model, dict[str, Any]]:
    """Scenes of (cells + 1)^3 vertices over a floor on the GPU, with a material for each tet of each scene."""
    points, tets = structured((cells,) * 3)
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.01, kappa=1e3, dhat=0.05, damping=5.0))
    model = dv.Model(dv.TetMesh(points, tets), pinned=points[:, 0] == 0, energies=energies)
    rng = generator("large", cells)
    shape = (*lead, *points.shape)
    inputs: dict[str, Any] = {
        "x": model.rest_points + torch.as_tensor(1e-3 * rng.uniform(-1, 1, shape)),
        "v": torch.as_tensor(rng.uniform(-1, 1, shape) - [0.0, 2.0, 0.0]),
        "mu": torch.as_tensor(1e4 * rng.uniform(0.5, 1.5, (*lead, len(tets)))),
        "lam": torch.tensor(2e4, dtype=torch.float64),
        "density": torch.tensor(1e3, dtype=torch.float64),
        "rest_points": model.rest_points,
        "floor_kappa": torch.tensor(1e3, dtype=torch.float64),
    }
    return model.to("cuda", dtype), {name: value.to("cuda", dtype) for name, value in inputs.items()}


def captured(run: Callable[[], None], warm: int = 3) -> torch.cuda.CUDAGraph:
    """`run` warmed up on a side stream, as torch asks for, and captured (which does not execute it)."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(warm):
            run()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    return graph
