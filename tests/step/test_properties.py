"""Claim: in any legal scene a step is finite, equals the reference, and touches nothing that it was given."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.marks import slow
from helpers.results import evaluated
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

import diffvbd as dv
from diffvbd import testing
from diffvbd.testing import relative_error, tolerance

QUICK = settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])


@st.composite
def meshes(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Up to 12 points and 8 tets between any of them: shared faces, mere shared vertices, slivers, loose points."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(4, 12))
    flat = 10.0 ** draw(st.sampled_from((0, 0, -1, -3)))  # the last makes every tet a sliver
    points = rng.uniform(-1, 1, (count, 3)) * [1.0, 1.0, flat] * 10.0 ** draw(st.integers(-3, 3))
    tets = np.array([rng.permutation(count)[:4] for _ in range(draw(st.integers(1, 8)))])
    tets = tets[np.unique(np.sort(tets, axis=1), axis=0, return_index=True)[1]]  # each once
    volume = testing.volumes(points, tets)
    tets[volume < 0] = tets[volume < 0][:, [0, 2, 1, 3]]
    box = np.prod(np.ptp(points, axis=0))
    return points, tets[np.abs(volume) > 1e-4 * box]


def material(draw: st.DrawFn, rng: np.random.Generator, tets: int) -> Tensor:
    """Log-uniform over 12 decades, per tet or one for all; or zero."""
    if draw(st.integers(0, 5)) == 0:
        return torch.zeros(tets, dtype=torch.float64)
    value = 10.0 ** draw(st.floats(-4, 8))
    contrast = draw(st.sampled_from((0, 1, 3)))
    return torch.as_tensor(value * 10.0 ** rng.uniform(-contrast, contrast, tets))


@st.composite
def scenes(draw: st.DrawFn) -> tuple[dv.Model, dict[str, Any], dv.VBD]:
    """A Model, the inputs of a step as fresh tensors, and a solver."""
    points, tets = draw(meshes())
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    pinned = rng.random(len(points)) < draw(st.sampled_from((0.0, 0.2, 0.8)))
    pinned[np.setdiff1d(np.arange(len(points)), tets)] = True
    exact = draw(st.integers(0, 2)) > 0  # the paper's block may diverge where lam < mu, unless it is saturated
    energies: list[Any] = [dv.StableNeoHookean()]
    size = float(np.ptp(points, axis=0).max())
    strain = 10.0 ** draw(st.sampled_from((-2, -1, 0)))  # from smooth to inverted
    x = points + strain * size * rng.standard_normal(points.shape)
    if draw(st.integers(0, 2)) == 0:
        free = x[~pinned, 1] if (~pinned).any() else x[:, 1]
        height = float(free.min()) - 0.05 * size
        damping = draw(st.sampled_from((0.0, 5.0)))
        energies.append(dv.FloorBarrier(height=height, kappa=1e3, dhat=0.1 * size, damping=damping))
    if draw(st.integers(0, 3)) == 0:
        energies.append(dv.Anchor(10.0 ** draw(st.floats(-3, 6))))
    model = dv.Model(
        dv.TetMesh(points, tets),
        density=10.0 ** draw(st.floats(0, 4)),
        pinned=torch.from_numpy(pinned),
        energies=energies,
    )
    inputs = {
        "x": torch.as_tensor(x),
        "v": torch.as_tensor(size * rng.standard_normal(points.shape)),
        "mu": material(draw, rng, len(tets)),
        "lam": material(draw, rng, len(tets)),
        "force": torch.as_tensor(rng.standard_normal(points.shape)) * model.mass[:, None],
        "prescribed": torch.as_tensor(
            np.where(pinned[:, None], x + 0.1 * size * rng.standard_normal(points.shape), np.nan)
        ),
        "rest_points": torch.as_tensor(points),
        "density": model.density.clone(),
        "gravity": torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64),
    }
    saturation = draw(st.sampled_from((None, None, 0.1 * size))) if exact else 0.1 * size
    solver = dv.VBD(10.0 ** draw(st.floats(-5, 0)), draw(st.integers(0, 20)), saturation=saturation,
                    block="exact" if exact else "paper", regularization=draw(st.sampled_from((0.0, 1e-6))),
                    relaxation=draw(st.sampled_from((1.0, 1.6))))  # fmt: skip
    return model, inputs, solver


def rounding(model: dv.Model, inputs: dict[str, Any], solver: dv.VBD, expected: dict[str, Tensor]) -> float:
    """What rounding alone does to the worst entry of a scene."""
    samples = [sample(model, inputs, solver, 1, expected) for sample in (testing.spread, testing.sensitivity)]
    return max(e for errors in samples for e in errors.values() if np.isfinite(e))


@pytest.mark.parametrize("examples", (20, slow(60)))
def test_finite_and_equal_to_the_reference(examples: int) -> None:
    compared = []

    @settings(QUICK, max_examples=examples)
    @given(scenes(), st.sampled_from(("full", "compact", "recompute")))
    def check(scene: tuple, tape: str) -> None:
        model, inputs, solver = scene
        before = {name: a.clone() for name, a in inputs.items()}
        result = evaluated(model, inputs, replace(solver, tape=tape))
        assert all(torch.equal(a.nan_to_num(), inputs[name].nan_to_num()) for name, a in before.items())
        assert all(bool(torch.isfinite(a).all()) for a in result.values())
        expected = testing.reference_result(model, inputs, solver)
        predictor = evaluated(model, inputs, replace(solver, sweeps=0))

        def beyond(bar: float) -> list[str]:
            names = [] if relative_error(result["x"], expected["x"]) <= bar else ["x"]
            for name, value in expected.items():
                if name.startswith("grad_"):
                    # stiff sweeps cancel most of what the predictor alone would pass on: its rounding stays
                    scale = bar * float(value.abs().max()) + tolerance("forward") * float(predictor[name].abs().max())
                    names += [] if float((result[name] - value).abs().max()) <= scale else [name]
            return names

        compared.append(True)
        if beyond(tolerance("adjoint")):  # executes the reference some more times
            spread = rounding(model, inputs, solver, expected)
            compared[-1] = spread < 1e-3  # otherwise a block is singular to rounding: finite is all that can be asked
            assert not compared[-1] or not beyond(tolerance("property_factor") * spread)

    check()
    assert np.mean(compared) > 0.8


@QUICK
@given(scenes(), st.data())
def test_gradients_only_of_what_is_asked(scene: tuple, data: st.DataObject) -> None:
    model, inputs, solver = scene
    names = list(inputs)
    asked = data.draw(st.lists(st.sampled_from(names), unique=True, max_size=4))
    everything = evaluated(model, inputs, solver)
    leaves = {name: inputs[name].clone().requires_grad_(name in asked) for name in names}
    x, v = dv.step(model, solver=solver, **leaves)
    assert x.requires_grad == v.requires_grad == bool(asked)
    assert relative_error(x, everything["x"]) <= tolerance("forward")
    if not asked:
        return
    weights = testing.generator("loss")
    loss = sum(f * (torch.as_tensor(weights.standard_normal(tuple(a.shape))) * a).sum()
               for f, a in ((1.0, x), (solver.time_step, v)))  # fmt: skip
    loss.backward()
    for name, leaf in leaves.items():
        if name not in asked:
            assert leaf.grad is None
            continue
        grad = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        assert relative_error(grad, everything[f"grad_{name}"]) <= tolerance("property_subset"), name


@QUICK
@given(scenes(), st.data())
def test_strides_do_not_matter(scene: tuple, data: st.DataObject) -> None:
    """Transposed, sliced and expanded tensors give the bits of contiguous ones."""
    model, inputs, solver = scene

    def strided(a: Tensor) -> Tensor:
        how = data.draw(st.sampled_from(("transposed", "sliced", "offset")))
        if how == "transposed" and a.dim() == 2:
            return a.T.contiguous().T
        if how == "sliced":
            wide = torch.full((*a.shape, 2), torch.nan, dtype=a.dtype)
            wide[..., 1] = a
            return wide[..., 1]
        return torch.cat((torch.full_like(a[:1], torch.nan), a))[1:]

    odd = {name: strided(a) for name, a in inputs.items()}
    x, v = dv.step(model, solver=solver, **inputs)
    x1, v1 = dv.step(model, solver=solver, **odd)
    assert torch.equal(x, x1) and torch.equal(v, v1)


@pytest.mark.parametrize("lead", ((), (0,), (2,)))
@pytest.mark.parametrize("vertices", (0, 3))
def test_meshes_without_tets(vertices: int, lead: tuple) -> None:
    """No vertices at all, or only loose pinned ones: nothing moves but what is prescribed, with its gradient."""
    mesh = dv.TetMesh(np.arange(3.0 * vertices).reshape(vertices, 3), np.zeros((0, 4), dtype=np.int64))
    model = dv.Model(mesh, pinned=torch.ones(vertices, dtype=torch.bool))
    x = model.rest_points.expand(*lead, vertices, 3).clone().requires_grad_()
    mu = torch.ones(0, dtype=torch.float64, requires_grad=True)
    held = (x.detach() + 1).requires_grad_()
    end, v = dv.step(model, x, torch.ones_like(x), dv.VBD(0.1, 3), mu=mu, lam=1.0, prescribed=held)
    assert torch.equal(end, held) and end.shape == v.shape == (*lead, vertices, 3)
    gradients = torch.autograd.grad(end.sum() + v.sum(), (x, held, mu), allow_unused=True, materialize_grads=True)
    assert torch.allclose(gradients[0], torch.full_like(x, -10.0)) and gradients[2].shape == (0,)
    assert torch.allclose(gradients[1], torch.full_like(x, 11.0))
