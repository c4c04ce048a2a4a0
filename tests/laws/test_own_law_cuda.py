"""Claim: a law of one's own does on CUDA what it does on the CPU, to rounding: steps, and the gradients of all inputs,
with one sweep and several, floors and anchors, corrections, couplings, contact, in float32, captured."""

from typing import Any

import pytest
import torch
from conftest import why_no_cuda
from helpers.laws import LOG, compiled_laws, inputs_of_law, law_of, model_of
from helpers.paths import needs_csrc
from torch import Tensor

import diffvbd as dv
from diffvbd.ops import regimes
from diffvbd.testing import evaluate, relative_error
from diffvbd.testing.contact_scenes import GRAVITY, SCENES

pytestmark = [needs_csrc, pytest.mark.cuda, pytest.mark.slow,
              pytest.mark.skipif(bool(why_no_cuda()), reason=f"no CUDA: {why_no_cuda()}")]  # fmt: skip
__all__ = ["compiled_laws"]


def moved(value: Any, device: str) -> Any:
    return value.to(device) if isinstance(value, Tensor) else value


def same_on_both(model: dv.Model, solver: dv.VBD, inputs: dict[str, Any], bar: float = 1e-10, **fixed: Any) -> None:
    ends = []
    for device in ("cpu", "cuda"):
        own = model.to(device)

        def run(own: dv.Model = own, **given: Any) -> tuple[Tensor, Tensor]:
            return dv.step(own, given.pop("x"), given.pop("v"), solver, **fixed, **given)

        ends.append(evaluate(run, {k: moved(v, device) for k, v in inputs.items()}, solver.time_step))
    for name, value in ends[0].items():
        assert value.nan_to_num().any() or name in ("grad_friction", "grad_pair_damping"), name
        assert relative_error(ends[1][name].cpu(), value) <= bar, name


@pytest.mark.parametrize(("sweeps", "jitter", "subspace"), [(1, 0.005, None), (1, 0.06, None), (5, 0.01, None),
                                                            (5, 0.003, "coarse")])  # fmt: skip
def test_every_input(sweeps: int, jitter: float, subspace: Any) -> None:
    model = model_of()
    saturation = 0.5 if subspace is None else None
    solver = dv.VBD(0.01, sweeps, relaxation=1.3, saturation=saturation, regularization=0.01, subspace=subspace)
    same_on_both(model, solver, inputs_of_law(model, jitter), 1e-10 if subspace is None else 1e-9)


def test_batches_floors_anchors() -> None:
    model = model_of(dv.FloorBarrier(height=-0.03, kappa=500.0, dhat=0.05, damping=5.0), dv.Anchor(40.0), pinned=None)
    inputs = {k: v for k, v in inputs_of_law(model, 0.004, (70,)).items() if k != "stress_free"}
    same_on_both(model, dv.VBD(0.005, 2), inputs)


def test_some_threads_a_vertex(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on meshes of more than 1,500 vertices a color."""
    monkeypatch.setattr(regimes, "MANY_LANES_VERTICES", (0, 0))
    test_every_input(5, 0.01, None)
    test_batches_floors_anchors()
    test_contact("fast", None)


@pytest.mark.parametrize("subspace", [None, "coarse"])
@pytest.mark.parametrize("name", ["stacked", "fast"])
def test_contact(name: str, subspace: Any) -> None:
    scene = SCENES[name]()
    energies = (law_of(LOG), *scene.model.energies[1:])
    model = dv.Model(scene.model.mesh, energies=energies)
    inputs = {"x": scene.x, "v": scene.v, **scene.inputs, **scene.parameters}
    same_on_both(model, scene.solver(4, subspace=subspace), inputs, 1e-9, gravity=GRAVITY)


def test_viscosity() -> None:
    model = model_of(text=LOG)
    inputs = inputs_of_law(model, 0.01) | {"viscosity": torch.full((model.num_tets,), 300.0, dtype=torch.float64)}
    same_on_both(model, dv.VBD(0.01, 4), inputs)


def test_float32_and_a_captured_step() -> None:
    model, solver = model_of(text=LOG), dv.VBD(0.01, 8)
    rest = model.rest_points
    x, v = rest + 0.01 * torch.sin(torch.arange(rest.numel()).view_as(rest)), torch.zeros_like(rest)
    expected = dv.step(model, x, v, solver)[0]
    found = dv.step(model.to("cuda", torch.float32), *(t.to("cuda", torch.float32) for t in (x, v)), solver)[0]
    assert relative_error(found.cpu().double(), expected) < 1e-5
    own, given = model.to("cuda"), (x.cuda(), v.cuda())
    dv.step(own, *given, solver)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        end = dv.step(own, *given, solver)[0]
    graph.replay()
    assert relative_error(end.cpu(), expected) < 1e-11


def test_many_scenes_of_a_small_mesh_and_a_long_rollout() -> None:
    """Where a built-in law has a scene per thread; and derivatives through steps with checkpoints."""
    model, count = model_of(pinned=None, text=LOG), 5000
    noise = torch.randn(
        count, *model.rest_points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    x, ends = model.rest_points + 0.003 * noise, []
    for device in ("cpu", "cuda"):
        mu = torch.tensor(4e4, dtype=torch.float64, device=device, requires_grad=True)
        start = x[:: 500 if device == "cpu" else 1].to(device)
        done = dv.rollout(model.to(device), start, 0 * start, dv.VBD(0.01, 4), steps=6, checkpoint_every=2, mu=mu)
        end = done.x[-1] if device == "cpu" else done.x[-1][::500]
        (grad,) = torch.autograd.grad(end.square().sum(), mu)
        ends.append((end.detach().cpu(), grad.cpu()))
    assert relative_error(ends[1][0], ends[0][0]) < 1e-10
    assert ends[0][1].abs() > 0 and relative_error(ends[1][1], ends[0][1]) < 1e-8
