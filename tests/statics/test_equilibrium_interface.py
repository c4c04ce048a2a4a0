"""Claim: dv.equilibrium takes batches, both dtypes and moved pins, says what fails, and refuses what it cannot do."""

import logging
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.results import Equilibrium, LinearSolve

SOLVER = dv.VBD(1.0, 0)
SOFT = {"young": 5e4, "poisson": 0.3}


def beam(device: str = "cpu", dtype: torch.dtype = torch.float64, **options: Any) -> dv.Model:
    mesh = dv.mesh.beam(5, 2, 2, size=(0.4, 0.1, 0.1))
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, device=device, dtype=dtype, **options)


def free(*energies: Any) -> dv.Model:
    return dv.Model(dv.mesh.cube(2, size=0.2), energies=(dv.StableNeoHookean(), *energies))


def rest(model: dv.Model, x: Tensor | None = None, **inputs: Any) -> Equilibrium:
    given: dict[str, Any] = SOFT | inputs
    return dv.equilibrium(model, model.rest_points if x is None else x, SOLVER, **given)


def test_each_scene_of_a_batch_rests_as_it_does_alone(device: str) -> None:
    """Also where one has long converged, and where there is none."""
    model = beam(device)
    young = torch.tensor([[1e8], [3e4]], dtype=torch.float64, device=device)
    both = dv.equilibrium(model, model.rest_points.expand(2, -1, -1), SOLVER, young=young, poisson=0.3, tolerance=1e-11)
    for scene, modulus in enumerate(young[:, 0].tolist()):
        alone = rest(model, young=modulus, tolerance=1e-11).x
        assert float((both.x[scene] - alone).abs().max()) < 1e-9
    assert float((both.x[1] - both.x[0]).abs().max()) > 0.1
    none = rest(model, model.rest_points.expand(0, -1, -1))
    assert none.converged and none.x.shape == (0, model.num_vertices, 3) and none.iterations == 0


def test_float32_is_float64_rounded(device: str) -> None:
    single, double = beam(device, torch.float32), beam(device)
    young = [torch.tensor(5e4, dtype=m.dtype, device=device, requires_grad=True) for m in (single, double)]
    ends = [dv.equilibrium(m, m.rest_points, SOLVER, young=y, poisson=0.3).x
            for m, y in zip((single, double), young, strict=True)]  # fmt: skip
    assert ends[0].dtype == torch.float32
    assert float((ends[0].double() - ends[1]).abs().max()) < 1e-6
    for end in ends:
        end[:, 1].sum().backward()
    grads = [float(y.grad) for y in young if y.grad is not None]
    assert grads[0] != 0 and grads[0] == pytest.approx(grads[1], rel=1e-5)


def test_without_sparse_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with a torch without MKL."""
    ends = []
    for stored in (True, False):
        monkeypatch.setattr(torch.backends.mkl, "is_available", lambda stored=stored: stored)
        young = torch.tensor(5e4, dtype=torch.float64, requires_grad=True)
        end = dv.equilibrium(beam(), beam().rest_points, dv.VBD(1.0, 0, subspace="coarse"), young=young, poisson=0.3).x
        ends.append((end.detach(), *torch.autograd.grad(end.sum(), young)))
    assert float((ends[0][0] - ends[1][0]).abs().max()) < 1e-8
    assert float(ends[0][1]) != 0 and float(ends[1][1]) == pytest.approx(float(ends[0][1]), rel=1e-6)


def test_a_large_move_of_pins_goes_in_increments() -> None:
    """Of a block that is pressed onto another one by more than the gap between them, in one scene of two."""
    low, high = dv.mesh.cube(2, size=0.2), dv.mesh.cube(2, size=0.16).translate([0.013, 0.21, 0.009])
    mesh = dv.mesh.join([low, high])
    y = torch.as_tensor(mesh.points[:, 1])
    top = (y > float(y.max()) - 1e-9)[:, None]
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e4, dhat=0.02))
    model = dv.Model(mesh, pinned=top[:, 0] | (y < 1e-9), energies=energies)
    x = model.rest_points
    where = torch.stack([x, x - x.new_tensor([0, 0.05, 0])])
    done = rest(model, x.expand(2, -1, -1), prescribed=torch.where(top, where, x))
    assert done.converged and torch.equal(done.x[:, top[:, 0]], where[:, top[:, 0]])
    assert not bool(dv.contact.intersections(model, done.x).any())
    assert torch.equal(done.x[0], rest(model).x)  # which needs none


def test_a_body_falls_onto_a_floor_and_rests() -> None:
    model = free(dv.FloorBarrier(height=-1.0, kappa=1e4, dhat=0.02))
    done = rest(model)
    assert done.converged and -1.0 < float(done.x[:, 1].min()) < -0.98


def test_friction_and_damping_have_no_part() -> None:
    floor = dv.FloorBarrier(height=-0.01, kappa=1e4, dhat=0.02, damping=10.0)
    rough, smooth = free(floor, dv.Friction(0.5)), free(floor)
    assert torch.equal(rest(rough).x, rest(smooth).x)
    damping = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    assert not rest(smooth, floor_damping=damping).x.requires_grad


def test_a_body_that_nothing_holds_has_no_equilibrium() -> None:
    message = r"equilibrium: expected bodies that are held .* got body 0 of scene 0, which nothing holds .* 78.5 N"
    with pytest.raises(RuntimeError, match=message):
        rest(free())
    with pytest.raises(RuntimeError, match="went far away in scene 0: the potential is unbounded"):
        rest(free(dv.FloorBarrier(height=-0.01)), gravity=(0.0, 9.81, 0.0))
    assert rest(free(), gravity=(0.0, 0.0, 0.0)).iterations == 0


def test_a_body_that_may_slide_has_no_gradient() -> None:
    young = torch.tensor(5e4, dtype=torch.float64, requires_grad=True)
    done = rest(free(dv.FloorBarrier(height=-0.01)), young=young)
    with pytest.raises(RuntimeError, match="equilibrium: expected conjugate gradients"):
        done.x[:, 0].sum().backward()


def test_not_converging_is_never_silent() -> None:
    message = "equilibrium: expected a residual of at most 1e-08, got .* in scene 0 after 2 iterations"
    with pytest.raises(RuntimeError, match=message):
        rest(beam(), max_iterations=2)
    with pytest.warns(RuntimeWarning, match=message):
        done = rest(beam(), max_iterations=2, on_failure="warn")
    assert not done.converged and done.iterations == 2 and done.residual > 1e-8


@pytest.mark.slow
def test_tets_that_end_inside_out_are_said() -> None:
    mesh = dv.mesh.cube(5, size=0.2)
    y = torch.as_tensor(mesh.points[:, 1])
    model = dv.Model(mesh, pinned=(y < 1e-9) | (y > 0.2 - 1e-9))
    low = torch.where(model.pinned[:, None], model.rest_points * y.new_tensor([1.0, 0.2, 1.0]), torch.nan)
    with pytest.warns(UserWarning, match="equilibrium: tets of scene 0 ended inside out: load less, or take a law"):
        assert rest(model, prescribed=low, poisson=0.4).converged


def test_it_is_printed_by_its_shape() -> None:
    assert "x of shape [20, 3], residual=" in repr(rest(beam()))


def test_progress_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "diffvbd"):
        done = rest(beam(), progress=True)
    assert len(caplog.messages) == done.iterations + 1
    assert caplog.messages[-1].startswith("equilibrium: residual") and "iterations" in caplog.messages[-1]


def test_the_backward_reports_and_is_taken_once() -> None:
    reports: list[LinearSolve] = []
    young = torch.tensor(5e4, dtype=torch.float64, requires_grad=True)
    done = rest(beam(), young=young, adjoint=dv.GlobalAdjoint(report=reports.append))
    (grad,) = torch.autograd.grad(done.x[:, 1].sum(), young, create_graph=True)
    assert len(reports) == 1 and reports[0].converged
    with pytest.raises(NotImplementedError, match="second derivatives"):
        grad.backward()


BELOW = {"energies": (dv.StableNeoHookean(), dv.FloorBarrier(height=0.05))}
PAIRS = {"energies": (dv.StableNeoHookean(), dv.PairBarrier(1e4, dhat=0.02)),
         "colliders": dv.colliders.Plane((0, 0.05, 0))}  # fmt: skip
BAD = [
    ({}, {"tolerance": 0.0}, ValueError, "tolerance: expected a finite number > 0"),
    ({}, {"tolerance": 1.0}, ValueError, r"tolerance: expected a number in \(0, 1\), got 1.0"),
    ({}, {"max_iterations": 0}, ValueError, "max_iterations: expected an integer >= 1"),
    ({}, {"on_failure": "pass"}, ValueError, "on_failure: expected"),
    ({}, {"progress": 1}, TypeError, "progress: expected"),
    ({}, {"adjoint": dv.ReverseSweep()}, TypeError, "adjoint: expected a .*GlobalAdjoint, got"),
    ({}, {"gravity": (0.0, float("nan"), 0.0)}, ValueError, "gravity: expected finite values, got nan"),
    ({}, {"young": float("inf")}, ValueError, "young: expected"),
    ({}, {"force": torch.full((1, 3), float("inf"), dtype=torch.float64)}, ValueError, "force: expected finite"),
    ({}, {"prescribed": torch.ones(20, 3, dtype=torch.float64)}, ValueError, "prescribed: expected positions"),
    ({}, {"colliders": torch.ones(3, 3, dtype=torch.float64)}, ValueError, "colliders: expected a Model with"),
    ({}, {"colliders_before": torch.ones(3, 3)}, ValueError, "colliders_before: expected none"),
    ({}, {"anchor_points": 1.0}, TypeError, "anchor_points: expected an input of this Model"),
    ({}, {"young": 0.0}, ValueError, "young, mu or energies: expected stiffness at every free vertex"),
    (BELOW, {}, ValueError, "x: expected every unpinned vertex above the floor"),
    (PAIRS, {}, ValueError, "x: expected surfaces that do not touch"),
]  # fmt: skip


@pytest.mark.parametrize(("options", "inputs", "error", "message"), BAD)
def test_bad_arguments_are_named(options: dict, inputs: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        rest(beam(**options), **inputs)


def test_transforms_and_batched_gradients_are_refused() -> None:
    model = beam()
    young = torch.tensor(5e4, dtype=torch.float64, requires_grad=True)
    with pytest.raises(NotImplementedError, match="torch.func transforms of dv.equilibrium"):
        torch.func.grad(lambda y: rest(model, young=y).x.sum())(young)
    end = rest(model, young=young).x
    with pytest.raises((NotImplementedError, RuntimeError), match="batched"):
        torch.autograd.grad(end, young, torch.ones(2, *end.shape, dtype=end.dtype), is_grads_batched=True)
