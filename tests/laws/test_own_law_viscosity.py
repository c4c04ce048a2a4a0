"""Claim: a law of one's own has the viscosity that the built-in law has, with the exact gradient of the executed step:
in sweeps, corrections, integrators and contact; it damps no rigid motion."""

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from helpers.laws import STABLE, TEXT, compiled_laws, inputs_of_law, model_of
from helpers.paths import needs_csrc
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import evaluate, relative_error

pytestmark = [needs_csrc, pytest.mark.slow]  # a law is compiled
__all__ = ["compiled_laws"]
F64 = torch.float64


@pytest.fixture(scope="module", autouse=True)
def compiled_with_less_optimisation(compiled_laws: None) -> Iterator[None]:
    """But for the law without viscosity, which the other tests have, too."""
    model_of(text=TEXT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DIFFVBD_QUICK", "1")
        yield


def viscous(model: dv.Model, jitter: float = 0.01) -> dict[str, Tensor]:
    rng = torch.Generator().manual_seed(2)
    rates = {name: size * (1 + torch.rand(model.num_tets, generator=rng, dtype=F64))
             for name, size in (("viscosity", 300.0), ("volume_viscosity", 200.0))}  # fmt: skip
    return inputs_of_law(model, jitter) | rates


def both(model: dv.Model, solver: dv.VBD, inputs: dict[str, Any], second: Any, bar: float = 1e-10) -> None:
    """Steps of a Model beside those by another route, or of another Model."""
    ends = []
    for own, adjoint in ((model, dv.ReverseSweep()), second):

        def run(x: Tensor, v: Tensor, own: Any = own, adjoint: Any = adjoint, **given: Any) -> tuple[Tensor, Tensor]:
            return dv.step(own, x, v, solver, adjoint=adjoint, **given)

        ends.append(evaluate(run, inputs, solver.time_step))
    for name, value in ends[1].items():
        assert value.nan_to_num().any() and relative_error(ends[0][name], value) <= bar, name


@pytest.mark.parametrize("sweeps", [1, 4])
def test_gradients_are_those_of_the_executed_sweeps(sweeps: int) -> None:
    model = model_of(text=TEXT)
    both(model, dv.VBD(0.01, sweeps, relaxation=1.3), viscous(model), (model, dv.Unrolled()))


@pytest.mark.hours  # another law is compiled
@pytest.mark.parametrize("options", [{}, {"subspace": "coarse"}], ids=str)
def test_the_built_in_law_as_ones_own(options: Any) -> None:
    own = model_of(text=STABLE)
    built_in = dv.Model(own.mesh, pinned=own.pinned)
    both(own, dv.VBD(0.01, 5, **options), viscous(own), (built_in, dv.ReverseSweep()), 1e-9)


@pytest.mark.parametrize("options", [{"subspace": "coarse"}, {"integrator": dv.SDIRK2()}, {"integrator": dv.BDF2()}],
                         ids=str)  # fmt: skip
def test_central_differences(options: Any) -> None:
    model, solver = model_of(text=TEXT), dv.VBD(0.01, 3, **options)
    x, v = model.rest_points, 0.3 * torch.cos(torch.arange(3 * model.num_vertices, dtype=F64)).view(-1, 3)

    def end(viscosity: Tensor, mu: Tensor) -> Tensor:
        given = {"viscosity": viscosity, "volume_viscosity": 100.0, "mu": mu}
        return dv.rollout(model, x, v, solver, steps=3, **given).x[-1, :, 1].square().sum()

    leaves = [torch.tensor(value, dtype=F64, requires_grad=True) for value in (200.0, 4e4)]
    found = torch.autograd.grad(end(*leaves), leaves)
    for i, (slope, size) in enumerate(zip(found, (1e-2, 1.0), strict=True)):
        with torch.no_grad():
            ends = [end(*(leaf + sign * size * (i == k) for k, leaf in enumerate(leaves))) for sign in (1, -1)]
        assert slope.abs() > 0 and relative_error(slope, (ends[0] - ends[1]) / (2 * size)) < 1e-5


def test_no_rigid_motion_is_damped() -> None:
    """A turn by half a radian in one step is where the step ends, with viscosity too; a stretch by a tenth is not."""
    model, solver = model_of(text=TEXT, pinned=None), dv.VBD(1e-2, 3, start="predictor", subspace=None)
    x, turn = model.rest_points, torch.linalg.matrix_exp(torch.tensor([[0.0, -0.5, 0.2], [0.5, 0.0, 0.1],
                                                                      [-0.2, -0.1, 0.0]], dtype=F64))  # fmt: skip
    for motion, is_rigid in ((turn, True), (1.1 * torch.eye(3, dtype=F64), False)):
        y = x @ motion.mT
        end, free = (dv.step(model, x, (y - x) / 1e-2, solver, gravity=(0.0, 0.0, 0.0), viscosity=rate,
                             volume_viscosity=rate)[0] for rate in (500.0, 0.0))  # fmt: skip
        assert (float((end - y).abs().max()) < 1e-12) is is_rigid
        assert is_rigid or float((end - free).abs().max()) > 1e-3 * float((y - x).abs().max())
