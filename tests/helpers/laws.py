"""Laws of one's own in tests: compiled once for all processes of a session, in a temporary folder; a beam of one law
with every invariant and function, and all its inputs."""

import functools
import os
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv

F64 = torch.float64
STABLE = "mu/2*(I1 - 3) - mu*(J - 1) + (mu + lam)/2*(J - 1)**2"
LOG = "mu/2*(I1 - 3) - mu*log(J) + lam/2*log(J)**2"  # not quadratic in one vertex


@pytest.fixture(scope="module", autouse=True)
def compiled_laws(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    own = tmp_path_factory.getbasetemp()
    shared = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own  # by the processes of the session
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_EXTENSIONS_DIR", str(shared / "laws"))
        yield


# stress-free at rest, with every invariant; not quadratic in one vertex
TEXT = ("mu/2*(I1 - 3) - mu*log(J) + lam/2*log(J)**2 + c*(I2*J**(-4/3) - 3) + m*(trU - 3)**2"
        " + k/(2*s)*(exp(s*(I4 - 1)**2) - 1)")  # fmt: skip
VALUES = {"mu": 4e4, "lam": 9e4, "c": 8e3, "m": 1e4, "k": 3e4, "s": 1.5}
MESH = dv.mesh.beam(3, 2, 2, size=(0.3, 0.2, 0.2))
PINNED = MESH.points[:, 0] == 0.0


@functools.cache  # sympy takes seconds
def law_of(text: str) -> Any:
    return dv.law(text, **VALUES, a0=(1.0, 0.3, -0.2)) if text == TEXT else dv.law(text, mu=4e4, lam=9e4)


def model_of(*energies: Any, pinned: Any = PINNED, text: str = TEXT) -> dv.Model:
    return dv.Model(MESH, pinned=pinned, energies=(law_of(text), *energies))


def inputs_of_law(model: dv.Model, jitter: float = 0.01, lead: tuple[int, ...] = ()) -> dict[str, Any]:
    """Every differentiable input, each tet with values of its own."""
    rng = torch.Generator().manual_seed(1)

    def noise(*shape: int) -> Tensor:
        return torch.randn(shape, generator=rng, dtype=F64)

    tets, full = model.num_tets, (*lead, *model.rest_points.shape)
    out: dict[str, Any] = {"x": model.rest_points + jitter * noise(*full), "v": 0.3 * noise(*full)}
    out |= {name: value * (1 + 0.2 * torch.rand(tets, generator=rng, dtype=F64))
            for name, value in model.law.values.items()}  # fmt: skip
    if model.law.a0 is not None:
        out["a0"] = model.law.a0 + 0.3 * noise(tets, 3)
    held = model.rest_points + 0.005 * noise(*model.rest_points.shape)
    held = torch.where(model.pinned[:, None], held, torch.nan) if model.pinned.any() else None
    out |= {"density": 800 + 400 * torch.rand(tets, generator=rng, dtype=F64), "force": 0.3 * noise(*full),
            "rest_points": model.rest_points + 0.002 * noise(*model.rest_points.shape), "prescribed": held,
            "stress_free": torch.eye(3, dtype=F64) + 0.05 * noise(tets, 3, 3)}  # fmt: skip
    return {name: value for name, value in out.items() if value is not None}
