"""The step inside torch's own machinery: compile, checkpoint, autocast, copies of a Model, opcheck."""

import copy
import io
import pickle
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.marks import slow
from helpers.small_step import (
    ARGUMENTS,
    STEP,
    assert_same,
    gradients,
    loss,
    run_step,
    scalar,
    small_inputs,
    small_model,
)
from torch import Tensor

# --- torch.compile ----------------------------------------------------------------------------------------------------
from torch._dynamo import compiled_autograd
from torch.utils.checkpoint import checkpoint

import diffvbd as dv
from diffvbd import ops
from diffvbd.ops.autograd import Direct
from diffvbd.testing import relative_error, tolerance


@pytest.fixture
def fresh_compiler() -> None:
    torch._dynamo.reset()


def compiled_gradients(device: str, backend: str, names: tuple[str, ...], plain: bool, **options: Any) -> None:
    model = small_model(device, **{"energies": (dv.StableNeoHookean(),)} if plain else {})
    arguments = {k: t for k, t in small_inputs(model).items() if k in names}
    if options:  # a coarse space is built from values, in a first step outside
        run_step(model, arguments, **options)
    run = torch.compile(lambda a: loss(model, a, **options), fullgraph=True, backend=backend)
    leaves = {k: t.clone().requires_grad_() for k, t in arguments.items()}
    value = run(leaves)
    actual = dict(zip(leaves, torch.autograd.grad(value, list(leaves.values())), strict=True))
    assert relative_error(value, loss(model, arguments, **options)) <= tolerance("formula")
    assert_same(actual, gradients(model, arguments, **options))


def test_compile_of_a_plain_step(device: str, fresh_compiler: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ops, "direct", Direct(ops.raw))  # as new: no earlier backward has looked up operators
    compiled_gradients(device, "aot_eager", ("x", "v", "mu", "lam"), plain=True)


@pytest.mark.slow  # the next one has them all, too
def test_compile_of_a_step_with_every_argument(device: str, fresh_compiler: None) -> None:
    compiled_gradients(device, "aot_eager", ARGUMENTS, plain=False)


@pytest.mark.slow
def test_compile_of_a_step_with_coarse_corrections(device: str, fresh_compiler: None) -> None:
    solver = replace(STEP["solver"], subspace=dv.CoarseSpace(functions=4, groups=1))
    compiled_gradients(device, "aot_eager", ARGUMENTS, plain=False, solver=solver)


def test_compile_of_a_first_step_with_coarse_corrections(device: str, fresh_compiler: None) -> None:
    model, solver = small_model(device), replace(STEP["solver"], subspace=dv.CoarseSpace(functions=4, groups=1))
    arguments = small_inputs(model)
    x, v = torch.compile(lambda a: run_step(model, a, solver=solver), backend="eager")(arguments)  # with graph breaks
    expected = run_step(model, arguments, solver=solver)
    assert torch.equal(x, expected[0]) and torch.equal(v, expected[1])


@pytest.mark.slow
def test_compile_with_inductor(device: str, fresh_compiler: None) -> None:
    compiled_gradients(device, "inductor", ARGUMENTS, plain=False)


@pytest.mark.parametrize("pinned", [[0, 1], slow([])], ids=["pinned", "free"])
def test_compile_of_a_step_without_gradients(device: str, fresh_compiler: None, pinned: list[int]) -> None:
    model = small_model(device, pinned=pinned)
    arguments = small_inputs(model)
    with torch.no_grad():
        x, v = torch.compile(lambda a: run_step(model, a), fullgraph=True, backend="aot_eager")(arguments)
    expected = run_step(model, arguments)
    assert torch.equal(x, expected[0]) and torch.equal(v, expected[1])


@pytest.mark.parametrize("batched", [False, True])
def test_compile_of_one_tensor_as_two_arguments(device: str, fresh_compiler: None, batched: bool) -> None:
    model = small_model(device, energies=(dv.StableNeoHookean(),))
    inputs = small_inputs(model)
    x, v = (inputs[k].expand(2, -1, -1).contiguous() if batched else inputs[k] for k in ("x", "v"))
    modulus = inputs["mu"][None] if batched else inputs["mu"]

    def run(modulus: Tensor) -> Tensor:
        return scalar(*dv.step(model, x, v, mu=modulus, lam=modulus, **STEP))

    grads = []
    for function in (run, torch.compile(run, fullgraph=True, backend="aot_eager")):
        leaf = modulus.clone().requires_grad_()
        grads += torch.autograd.grad(function(leaf), leaf)
    assert grads[0].abs().max() > 1e-3
    assert relative_error(grads[1], grads[0]) <= tolerance("formula")


@pytest.mark.parametrize("every", [slow(None), 2])
def test_compile_of_a_rollout(device: str, fresh_compiler: None, every: Any) -> None:
    model = small_model(device)
    inputs = small_inputs(model)

    def run(v: Tensor, mu: Tensor, force: Tensor) -> Tensor:
        trajectory = dv.rollout(model, inputs["x"], v, steps=3, mu=mu, lam=2.0, force=dv.per_step(force),
                                checkpoint_every=every, **STEP)  # fmt: skip
        return scalar(trajectory.x[-1], trajectory.v[-1]) + trajectory.x.square().sum()

    values = {"v": inputs["v"], "mu": inputs["mu"], "force": torch.stack([k * inputs["force"] for k in (1, 2, 3)])}
    results = []
    for function in (run, torch.compile(run, fullgraph=True, backend="aot_eager")):
        leaves = {k: t.clone().requires_grad_() for k, t in values.items()}
        results.append(dict(zip(values, torch.autograd.grad(function(**leaves), list(leaves.values())), strict=True)))
    assert_same(results[1], results[0])
    arrays = (getattr(model.mesh, name) for name in ("points", "tets", "body", "volume"))
    assert not any(array.flags.writeable for array in arrays)  # as torch.compile makes those it meets


# --- checkpoint, autocast, copies -------------------------------------------------------------------------------------


@pytest.mark.parametrize("reentrant", [False, True])
def test_checkpoint(device: str, reentrant: bool) -> None:
    model = small_model(device)
    inputs = small_inputs(model)
    leaves = {k: t.clone().requires_grad_() for k, t in inputs.items()}
    names = list(leaves)

    def run(*values: Tensor) -> tuple[Tensor, Tensor]:
        return run_step(model, dict(zip(names, values, strict=True)))

    scalar(*checkpoint(run, *leaves.values(), use_reentrant=reentrant)).backward()
    assert_same({k: t.grad for k, t in leaves.items()}, gradients(model, inputs), 0.0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_autocast_changes_nothing(device: str, dtype: torch.dtype) -> None:
    model = small_model(device, dtype)
    inputs = small_inputs(model)
    expected = run_step(model, inputs)
    slopes = gradients(model, inputs)
    with torch.autocast(device, dtype=torch.bfloat16):
        actual = run_step(model, inputs)
        cast = gradients(model, inputs)
        rebuilt = small_model(device, dtype)
    assert actual[0].dtype == dtype
    assert torch.equal(actual[0], expected[0]) and torch.equal(actual[1], expected[1])
    assert_same(cast, slopes, 0.0)
    assert torch.equal(rebuilt.mass, model.mass)


def saved_and_loaded(model: dv.Model) -> dv.Model:
    buffer = io.BytesIO()
    torch.save(model, buffer)
    return torch.load(io.BytesIO(buffer.getvalue()), weights_only=False)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m)), saved_and_loaded])
def test_copies_of_a_model_compute_the_same(device: str, copied: Any) -> None:
    model, solver = small_model(device), replace(STEP["solver"], saturation=0.3, relaxation=1.2)
    inputs = small_inputs(model)
    twin = copied(model)
    assert twin is not model and twin._mass.data_ptr() != model._mass.data_ptr()
    assert repr(twin) == repr(model)
    for a, b in zip(run_step(twin, inputs, solver=solver), run_step(model, inputs, solver=solver), strict=True):
        assert torch.equal(a, b)
    assert_same(gradients(twin, inputs, solver=solver), gradients(model, inputs, solver=solver), 0.0)


# --- compiled autograd ------------------------------------------------------------------------------------------------


PAIRS = (dv.PairBarrier(dhat=0.02), dv.Friction(0.3))
FLOOR = dv.FloorBarrier(height=-0.005)


@pytest.mark.slow
@pytest.mark.parametrize(
    "energies", [*(pytest.param(e, marks=pytest.mark.hours) for e in [(), (FLOOR,), PAIRS]), (FLOOR, *PAIRS)]
)
def test_gradients_are_those_of_a_plain_backward(device: str, energies: tuple) -> None:
    boxes = [dv.mesh.box(2, 0.2), dv.mesh.box(2, 0.2).translate((0.01, 0.21, 0.0))]
    model = dv.Model(dv.mesh.join(boxes), energies=(dv.StableNeoHookean(), *energies), device=device)

    def gradients(compiled: bool) -> list[Tensor]:
        x = model.rest_points.clone()
        given = {"x": x, "v": torch.zeros_like(x), "force": torch.zeros_like(x), "rest_points": x.clone()}
        given |= {"mu": x.new_tensor(2e4), "lam": x.new_tensor(4e4), "density": x.new_tensor(1e3)}
        given = {name: value.requires_grad_() for name, value in given.items()}
        end, v = dv.step(model, solver=dv.VBD(0.01, 3), **given)
        loss = end.square().sum() + v.sum()
        if compiled:
            with compiled_autograd._enable(torch.compile(backend="eager")):
                loss.backward()
        else:
            loss.backward()
        found = [value.grad for value in given.values() if value.grad is not None]
        assert len(found) == len(given) and all(grad.abs().max() > 0 for grad in found)
        return found

    torch._dynamo.reset()
    for got, expected in zip(gradients(True), gradients(False), strict=True):
        assert relative_error(got, expected) <= tolerance("adjoint")
