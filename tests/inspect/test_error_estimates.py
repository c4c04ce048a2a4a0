"""What a step says about its own error: against the true one, which many sweeps with corrections give."""

import functools
import warnings
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from helpers.results import assert_same_bits
from torch import Tensor

import diffvbd as dv
from diffvbd import results
from diffvbd.model.system import system_of
from diffvbd.rollout import rollout as rollout_module
from diffvbd.step.residual import _bodies_of, error_of
from diffvbd.testing import relative_error, tolerance

H = 1 / 60
LOOSE = tolerance("finite_difference")  # of an error of 1e-8 m, positions round at 1e-16
CORRECTIONS = 4  # of 12 sweeps
COARSE: dict[str, Any] = {"subspace": "coarse", "relaxation": 1.5}
FLOOR = {"energies": (dv.StableNeoHookean(), dv.FloorBarrier(kappa=1e3, dhat=0.02))}


class Case(NamedTuple):
    """A state of a Model, and where its step converges."""

    model: dv.Model
    x: Tensor
    v: Tensor
    material: dict[str, Any]
    end: Tensor


def contrast(mesh: dv.TetMesh) -> Tensor:
    stiff = (mesh.points[mesh.tets].mean(1)[:, 0] * 4).astype(int) % 2 == 1
    return torch.where(torch.from_numpy(stiff), 1e7, 1e5).double()


@functools.cache
def case(name: str) -> Case:
    mesh, mu, v = dv.mesh.beam(11, 3, 3, size=(1.0, 0.2, 0.2)), 1e5, None
    common: dict[str, Any] = {}
    if name == "stiff cantilever":
        mu = 1e7
    elif name == "contrast":
        mu = contrast(mesh)
    if name in ("spinning body", "body on a floor"):
        mesh = dv.mesh.cube(4)
        points = torch.from_numpy(mesh.points.copy())
        about = points - points.mean(0)
        v = 5 * torch.stack((-about[:, 1], about[:, 0], 0 * about[:, 0]), -1) + torch.sin(9 * about)
        if name == "body on a floor":
            mesh = dv.TetMesh(mesh.points + [0.0, 0.012 - mesh.points[:, 1].min(), 0.0], mesh.tets)
            v, common = torch.zeros_like(points) - torch.tensor([0.0, 1.0, 0.0]), FLOOR
    else:
        common = {"pinned": mesh.points[:, 0] < 1e-9}
    model = dv.Model(mesh, **common)
    material: dict[str, Any] = {"mu": mu, "lam": 1.5 * mu}
    x = model.rest_points
    v = torch.zeros_like(x) if v is None else v.double()
    end = dv.solve(model, x, v, dv.VBD(H, 1, **COARSE), tolerance=1e-10, **material).x
    return Case(model, x, v, material, end)


def estimate(c: Case, sweeps: int, **options: Any) -> tuple[Tensor, results.ErrorEstimate]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of few sweeps
        way = dv.rollout(c.model, c.x, c.v, dv.VBD(H, sweeps, **options), steps=1, save="last",
                         checks=dv.Checks(errors=True), **c.material)  # fmt: skip
    assert way.errors is not None
    return way.x[-1], results.ErrorEstimate(*(t[0] for t in way.errors))


def rms(model: dv.Model, way: Tensor) -> float:
    return float(way[~model.pinned].square().sum(-1).mean().sqrt())


CASES = [
    ("stiff cantilever", COARSE, 5),
    ("stiff cantilever", COARSE, 8),
    ("stiff cantilever", COARSE, 11),
    ("soft bar", {}, 10),
    ("soft bar", {}, 20),
    ("soft bar", COARSE, 8),
    ("contrast", COARSE, 11),
    ("spinning body", {}, 10),
    ("spinning body", {"relaxation": 1.5}, 10),
    ("spinning body", COARSE, 8),
    ("body on a floor", {}, 10),
    ("body on a floor", COARSE, 8),
]


def ratio_of(name: str, options: dict[str, Any], sweeps: int) -> float:
    c = case(name)
    end, errors = estimate(c, sweeps, **options)
    motion = rms(c.model, end - c.x)
    assert errors.error.shape == (1,)
    assert float(errors.relative) == pytest.approx(float(errors.error) / motion, rel=tolerance("sum"))
    return float(errors.error) / rms(c.model, end - c.end)


def test_estimates_are_near_the_true_error() -> None:
    ratios = torch.tensor([ratio_of(*given) for given in CASES])
    assert 0.1 < float(ratios.median()) < 1.5
    assert 0.1 < float(ratios.min()) and float(ratios.max()) < 10, ratios


@pytest.mark.parametrize(
    ("name", "options"), [("soft bar", {}), ("stiff cantilever", COARSE), ("body on a floor", COARSE)]
)
def test_estimates_fall_with_sweeps(name: str, options: dict[str, Any]) -> None:
    errors = [float(estimate(case(name), sweeps, **options)[1].error) for sweeps in (5, 17, 35)]
    assert errors[0] > 2 * errors[1] > 4 * errors[2] > 0


@pytest.mark.parametrize("options", [{}, COARSE])
@pytest.mark.parametrize("schedule", [None, 2, dv.BinomialCheckpoints(1)])
def test_states_and_gradients_keep_their_bits(options: dict[str, Any], schedule: Any,
                                              monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    c = case("body on a floor")
    count = []
    monkeypatch.setattr(rollout_module, "error_of", lambda *a, **k: (count.append(1), error_of(*a, **k))[1])

    def run(asked: bool) -> tuple[dict[str, Tensor], Any]:
        x, v, mu = (t.detach().clone().requires_grad_() for t in (c.x, c.v, torch.tensor(1e5).double()))
        way = dv.rollout(c.model, x, v, dv.VBD(H, 12, **options), steps=4, mu=mu, lam=1.5e5, checkpoint_every=schedule,
                         checks=dv.Checks(errors=asked))  # fmt: skip
        bars = torch.autograd.grad((way.x**2).sum() + (way.v**3).sum(), (x, v, mu))
        return dict(zip("abcde", (way.x.detach(), way.v.detach(), *bars), strict=True)), way.errors

    with_them, errors = run(True)
    assert len(count) == 4  # what the backward runs again is not estimated again
    without, none = run(False)
    assert none is None and len(count) == 4
    assert_same_bits(with_them, without)
    assert errors.error.shape == (4, 1) and not any(t.requires_grad for t in errors)
    assert torch.isfinite(errors.error).all() and (errors.error > 0).all()


def two_bodies(dtype: torch.dtype = torch.float64) -> dv.Model:
    """A held beam and, with fewer vertices and lower numbers in the coarse space, a free cube; one more body rests."""
    beam, cube = dv.mesh.beam(11, 3, 3, size=(1.0, 0.2, 0.2)), dv.mesh.cube(3)
    far, held = cube.points + [5.0, 0.0, 0.0], cube.points + [-5.0, 0.0, 0.0]
    n, m = len(beam.points), len(far)
    points = np.concatenate((beam.points, held, far))
    mesh = dv.TetMesh(points, np.concatenate((beam.tets, cube.tets + n, cube.tets + n + m)))
    pinned = points[:, 0] < 1e-9
    return dv.Model(mesh, pinned=pinned, dtype=dtype)


@pytest.mark.parametrize("options", [{}, COARSE])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_scenes_and_bodies_have_their_own(options: dict[str, Any], dtype: torch.dtype) -> None:
    model = two_bodies(dtype)
    generator = torch.Generator().manual_seed(0)
    x = model.rest_points.expand(2, 3, -1, -1)
    v = torch.randn(x.shape, generator=generator, dtype=dtype)
    mu = torch.tensor([1e5, 1e6, 1e7], dtype=dtype)[:, None]
    solver, checks = dv.VBD(H, 12, **options), dv.Checks(errors=True)
    errors = dv.rollout(model, x, v, solver, steps=2, mu=mu, lam=mu, checks=checks).errors
    assert errors is not None and errors._fields == ("change", "ratio", "error", "relative", "lengths")
    assert all(t.shape == (2, 2, 3, 2) and t.dtype == dtype for t in errors[:4])
    corrections = CORRECTIONS if "subspace" in options else 0
    assert errors.lengths.shape == (2, 2, 3, corrections, 2)
    alone = dv.rollout(model, x[1, 2], v[1, 2], solver, steps=2, mu=mu[2], lam=mu[2], checks=checks).errors
    assert alone is not None
    for own, of_all in zip(alone, errors, strict=True):
        assert relative_error(of_all[:, 1, 2], own) < tolerance("sum")


def test_each_body_is_named_where_it_stands() -> None:
    """The free body falls exactly; the order is that of vertices, also of lengths."""
    model, solver = two_bodies(), dv.VBD(H, 8, **COARSE)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    with dv.record("subspace") as found:
        errors = dv.rollout(model, x, v, solver, steps=1, mu=1e7, lam=1e7, checks=dv.Checks(errors=True)).errors
    assert errors is not None and len(found) == 1  # the estimate's own corrections are not recorded
    assert float(errors.error[0, 1]) < tolerance("closed_form") < float(errors.error[0, 0])
    assert _bodies_of(system_of(model, solver)).corrected.tolist() == [1, 0]
    assert sorted(errors.lengths.flatten().tolist()) == sorted(found[0].flatten().tolist())
    left = dv.diagnose(model, x, dv.VBD(H, 1, **COARSE), previous=(x, v), mu=1e7, lam=1e7, warn=False)
    assert left.errors is not None and left.errors.change.isnan().all()


def test_diagnose_names_the_worst_body() -> None:
    model = two_bodies()
    x = model.rest_points.expand(2, -1, -1)
    given: dict[str, Any] = {"previous": (x, torch.zeros_like(x)), "mu": 1e7, "lam": 1e7, "warn": False}
    solver = dv.VBD(H, 10)
    end, _ = dv.step(model, x, torch.zeros_like(x), solver, mu=1e7, lam=1e7)
    result = dv.diagnose(model, end, solver, **given)
    message = [m for m in result.messages if "in body 0 of scene [0]" in m]
    assert len(message) == 1 and 'take more sweeps, or subspace="coarse"' in message[0]
    assert result.errors is not None and result.relative_error == float(result.errors.relative[:, 0].max())
    assert "error over motion, worst body" in str(result)
    result = dv.diagnose(model, end, dv.VBD(H, 17, **COARSE), **given)
    assert not any("would converge" in m for m in result.messages)
    assert result.relative_error is not None and result.relative_error < 0.01


def test_bad_input() -> None:
    c, solver = case("soft bar"), dv.VBD(H, 5)
    with pytest.raises(ValueError, match="previous: expected x's shape"):
        dv.diagnose(c.model, c.x[None], solver, previous=(c.x, c.v), **c.material)
    with pytest.raises(TypeError, match="errors: expected a bool"):
        dv.Checks(errors=1)  # pyright: ignore[reportArgumentType]
    for energies in ((dv.PairBarrier(),), (dv.FloorBarrier(height=-9.0), dv.Friction(0.3))):
        model = dv.Model(c.model.mesh, energies=(dv.StableNeoHookean(), *energies))
        with pytest.raises(NotImplementedError, match="errors: .* contact or friction"):
            dv.rollout(model, c.x, c.v, solver, steps=1, checks=dv.Checks(errors=True), **c.material)


@pytest.mark.cuda
@pytest.mark.parametrize("options", [{}, COARSE])
def test_cuda_estimates_as_the_cpu_does_and_waits_for_nothing(options: dict[str, Any]) -> None:
    c = case("body on a floor")

    solver, checks = dv.VBD(H, 12, **options), dv.Checks(errors=True)

    def errors(device: str) -> Any:
        x, v = (t.to(device) for t in (c.x, c.v))
        return dv.rollout(c.model.to(device), x, v, solver, steps=2, mu=1e5, lam=1e5, checks=checks).errors

    of_cpu, of_cuda = errors("cpu"), errors("cuda")
    for one, other in zip(of_cpu, of_cuda, strict=True):
        assert one.shape == other.shape and (not one.numel() or relative_error(other.cpu(), one) < LOOSE)

    model = c.model.to("cuda")
    x, v, mu = (t.to("cuda") for t in (c.x, c.v, torch.tensor(1e5).double()))
    dv.rollout(
        model, x, v, solver, steps=2, mu=mu, lam=mu, checks=checks
    )  # what a Model keeps is built at the first use
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        dv.rollout(model, x, v, solver, steps=2, mu=mu, lam=mu, checks=checks)
    finally:
        torch.cuda.set_sync_debug_mode("default")
