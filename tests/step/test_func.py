"""torch.func and gradcheck of every argument; what cannot be differentiated says so."""

from typing import Any

import pytest
import torch
from helpers.small_step import (
    ARGUMENTS,
    STEP,
    Arguments,
    loss,
    run_step,
    scalar,
    small_inputs,
    small_model,
)
from torch import Tensor
from torch.autograd import forward_ad

import diffvbd as dv
from diffvbd.rollout import memory
from diffvbd.testing import relative_error, tolerance

# --- gradcheck --------------------------------------------------------------------------------------------------------


def gradcheck(run: Any, values: tuple[Tensor, ...]) -> bool:
    near_zero, bar = tolerance("gradcheck_near_zero"), tolerance("gradcheck")
    return torch.autograd.gradcheck(run, values, atol=near_zero, rtol=bar, check_batched_grad=True)


@pytest.mark.parametrize("name", ARGUMENTS)
def test_gradcheck_of_every_argument(device: str, name: str) -> None:
    model = small_model(device)
    fixed = small_inputs(model)

    def run(value: Tensor) -> tuple[Tensor, Tensor]:
        return run_step(model, fixed | {name: value})

    value = fixed[name].clone().requires_grad_()
    (jacobian,) = torch.autograd.grad(scalar(*run(value)), value)
    assert jacobian.abs().max() > 1e-3
    assert gradcheck(run, (value,))


# --- torch.func -------------------------------------------------------------------------------------------------------


def members(inputs: Arguments, name: str, count: int = 3) -> Tensor:
    """`count` different values of one argument, stacked."""
    generator = torch.Generator().manual_seed(1)
    shape = (count, *inputs[name].shape)
    return inputs[name] + 0.1 * torch.rand(shape, dtype=inputs[name].dtype, generator=generator).to(inputs[name])


@pytest.mark.parametrize("name", ARGUMENTS)
def test_vmap_and_its_gradients_over_each_argument(device: str, one_regime: None, name: str) -> None:
    model = small_model(device)
    inputs = small_inputs(model)
    batch = members(inputs, name)

    def one(value: Tensor) -> Tensor:
        return loss(model, inputs | {name: value})

    values = torch.func.vmap(one)(batch)
    expected = torch.stack([one(value) for value in batch])
    assert expected.std() > 1e-6
    assert relative_error(values, expected) <= tolerance("formula")
    slopes = torch.stack([torch.func.grad(one)(value) for value in batch])
    assert slopes.abs().max() > 1e-3
    assert relative_error(torch.func.vmap(torch.func.grad(one))(batch), slopes) <= tolerance("sum")
    assert relative_error(torch.func.grad(lambda b: torch.func.vmap(one)(b).sum())(batch), slopes) <= tolerance("sum")


def test_vmap_over_several_arguments_and_gradient_of_a_shared_one(device: str) -> None:
    model = small_model(device)
    inputs = small_inputs(model)
    x, mu = members(inputs, "x"), members(inputs, "mu")

    def one(x: Tensor, mu: Tensor, lam: Tensor, gravity: Tensor) -> Tensor:
        return loss(model, inputs | {"x": x, "mu": mu, "lam": lam, "gravity": gravity})

    shared = (inputs["lam"], inputs["gravity"])

    def total(*values: Tensor) -> Tensor:
        return torch.func.vmap(one, in_dims=(0, 0, None, None))(*values).sum()

    def looped(x: Tensor, mu: Tensor, *rest: Tensor) -> Tensor:
        return torch.stack([one(a, b, *rest) for a, b in zip(x, mu, strict=True)]).sum()

    actual = torch.func.grad(total, argnums=(0, 1, 2, 3))(x, mu, *shared)
    expected = torch.func.grad(looped, argnums=(0, 1, 2, 3))(x, mu, *shared)
    for a, b in zip(actual, expected, strict=True):
        assert b.abs().max() > 1e-3
        assert relative_error(a, b) <= tolerance("sum")
    # vmap of grad: each member its own gradient of what it shares
    each = torch.func.vmap(torch.func.grad(one, argnums=2), in_dims=(0, 0, None, None))(x, mu, *shared)
    single = torch.stack([torch.func.grad(one, argnums=2)(a, b, *shared) for a, b in zip(x, mu, strict=True)])
    assert relative_error(each, single) <= tolerance("sum")


@pytest.mark.parametrize("pinned", [[0, 1], []], ids=["pinned", "free"])
@pytest.mark.parametrize("name", ["x", "mu", "rest_points", "floor_kappa", "anchor_points"])
def test_jacrev_and_batched_gradients_equal_one_row_at_a_time(device: str, name: str, pinned: list[int]) -> None:
    model = small_model(device, pinned=pinned)
    inputs = small_inputs(model)

    def run(value: Tensor) -> Tensor:
        return run_step(model, inputs | {name: value})[0]

    leaf = inputs[name].clone().requires_grad_()
    out = run(leaf)
    rows = torch.eye(out.numel(), dtype=out.dtype, device=device).reshape(-1, *out.shape)
    expected = torch.stack([torch.autograd.grad(out, leaf, row, retain_graph=True)[0] for row in rows])
    (batched,) = torch.autograd.grad(out, leaf, rows, is_grads_batched=True)
    assert expected.abs().max() > 1e-3
    assert relative_error(batched, expected) <= tolerance("sum")
    jacobian = torch.func.jacrev(run)(inputs[name])
    assert relative_error(jacobian.reshape(expected.shape), expected) <= tolerance("sum")


# --- what cannot be differentiated says so ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["x", "mu", "rest_points", "anchor_points"])
def test_second_order_raises(device: str, name: str) -> None:
    model = small_model(device)
    inputs = small_inputs(model)

    def one(value: Tensor) -> Tensor:
        return loss(model, inputs | {name: value})

    leaf = inputs[name].clone().requires_grad_()
    (slope,) = torch.autograd.grad(one(leaf), leaf, create_graph=True)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        torch.autograd.grad(slope.sum(), leaf)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        torch.func.jacrev(torch.func.grad(one))(inputs[name])
    with pytest.raises(NotImplementedError, match="derivatives in forward mode .* are not supported"):
        torch.func.hessian(one)(inputs[name])
    with pytest.raises(NotImplementedError, match="second derivatives"):
        torch.autograd.functional.hessian(one, inputs[name])
    with pytest.raises(NotImplementedError, match=r"nor is torch\.autograd\.functional\.jvp"):
        torch.autograd.functional.jvp(one, inputs[name], inputs[name])


@pytest.mark.parametrize("name", ["x", "v", "mu", "rest_points", "density", "gravity", "floor_kappa"])
def test_forward_mode_raises(device: str, name: str) -> None:
    model = small_model(device)
    inputs = small_inputs(model)
    tangent = torch.ones_like(inputs[name])

    def one(value: Tensor) -> Tensor:
        return loss(model, inputs | {name: value})

    with pytest.raises(
        NotImplementedError, match="derivatives in forward mode .* are not supported; take reverse mode"
    ):
        torch.func.jvp(one, (inputs[name],), (tangent,))
    with forward_ad.dual_level():
        with pytest.raises((NotImplementedError, RuntimeError), match="(?i)forward.mode|jvp|forward AD"):
            one(forward_ad.make_dual(inputs[name], tangent))


@pytest.mark.parametrize("integrator", [dv.ImplicitEuler(), dv.SDIRK2(), dv.BDF2()], ids=str)
def test_what_has_no_transforms_says_so(device: str, integrator: Any) -> None:
    """Steps with contact, dv.solve and step_forward: torch would name functions of ours that nobody has called."""
    plain = dv.Model(dv.mesh.cube(), device=device)
    touching = plain.replace(energies=(dv.StableNeoHookean(), dv.PairBarrier()))
    x = plain.rest_points
    solver = dv.VBD(0.01, 2, integrator=integrator)
    ends = [
        lambda mu: dv.rollout(touching, x, 0 * x, solver, mu=mu, lam=1e4, steps=2).x[-1],
        lambda mu: dv.solve(plain, x, 0 * x, solver, mu=mu, lam=1e4).x,
        lambda mu: dv.step_forward(plain, x, 0 * x, solver, mu=mu, lam=1e4)[0],
    ]
    mu = torch.full((2,), 1e4, dtype=x.dtype, device=device)
    if not isinstance(integrator, dv.BDF2):  # whose history lives in rollouts
        ends.append(lambda mu: dv.step(touching, x, 0 * x, solver, mu=mu, lam=1e4)[0])
    for end in ends:
        with pytest.raises(NotImplementedError, match=r"torch\.func transforms"):
            torch.func.vmap(end)(mu)
        with pytest.raises(NotImplementedError, match=r"torch\.func transforms"):
            torch.func.grad(lambda mu, end=end: end(mu).sum())(mu[0])


def test_rollouts_have_no_checkpoints_inside_transforms(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """torch has none there: "auto" keeps all tapes, however large, and another schedule says so."""
    model = small_model(device)
    inputs = small_inputs(model)

    def one(mu: Tensor, every: Any) -> Tensor:
        found = dv.rollout(model, **inputs | {"mu": mu}, checkpoint_every=every, steps=5, **STEP)
        return scalar(found.x[-1], found.v[-1])

    says = r'^checkpoint_every: expected None or "auto".*inside torch\.func'
    for schedule in (2, dv.BinomialCheckpoints(2)):
        with pytest.raises(NotImplementedError, match=says):
            torch.func.grad(one)(inputs["mu"], schedule)
        with pytest.raises(NotImplementedError, match=says):
            torch.func.vmap(one, (0, None))(inputs["mu"][None], schedule)
    whole = torch.func.grad(one)(inputs["mu"], None)
    monkeypatch.setattr(memory, "TAPE_BUDGET", 0)
    leaf = inputs["mu"].clone().requires_grad_()
    (expected,) = torch.autograd.grad(one(leaf, "auto"), leaf)
    assert expected.abs().max() > 0
    for found in (whole, torch.func.grad(one)(inputs["mu"], "auto")):
        assert relative_error(found, expected) <= tolerance("sum")
