"""Claim: compose() refuses updates for which its gradient would be wrong, and names rows that no state has."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.solvers import BlockUpdate, Update, compose
from diffvbd.testing import generator

X = torch.from_numpy(generator("contract").standard_normal((4, 3)))


def leaf(value: float = 0.7) -> Tensor:
    return torch.tensor(value, dtype=X.dtype, requires_grad=True)


def doubled_vjp(state: tuple, rows_bar: tuple, parameters: tuple) -> tuple:
    bar = torch.zeros_like(state[0])
    bar[:2] = 2 * rows_bar[0]
    return (bar,), (None,) * len(parameters)


# --- tensors that an update closes over -------------------------------------------------------------------------------


@pytest.mark.parametrize("vjp", [None, doubled_vjp])
@pytest.mark.parametrize("recorded", [True, False])
def test_closed_over_tensors_that_require_grad_are_refused(vjp: Any, recorded: bool) -> None:
    """Also where nothing else requires grad, so that the result would not."""
    scale, x = leaf(), X.clone().requires_grad_(recorded)
    solver = compose([Update(lambda s, p: scale * s[0][:2], slice(2), vjp=vjp)])
    with pytest.raises(RuntimeError, match="update of Update: expected rows of state and parameters alone.*parameters"):
        solver(x, sweeps=1)
    with torch.no_grad():  # where no gradient is lost
        assert torch.equal(solver(x, sweeps=1)[:2], scale * X[:2])
    scale.requires_grad_(False)
    assert solver(x, sweeps=1).requires_grad == recorded
    scale.requires_grad_()  # the look is not at the first call only
    with pytest.raises(RuntimeError, match="update of Update"):
        solver(x, sweeps=1)


def test_a_module_inside_an_update_is_refused() -> None:
    class Learned(BlockUpdate):
        def __init__(self) -> None:
            self.rows, self.net = (slice(2),), torch.nn.Linear(3, 3, dtype=X.dtype)

        def update(self, state: tuple, parameters: tuple) -> tuple:
            return (self.net(state[0][:2]),)

    with pytest.raises(RuntimeError, match="update of Learned: expected rows of state and parameters alone"):
        compose([Learned()])(X.clone().requires_grad_(), sweeps=1)


# --- purity -----------------------------------------------------------------------------------------------------------


class Counting(BlockUpdate):
    """Depends on how often it was called, until it is told not to."""

    def __init__(self, impure: bool = True) -> None:
        self.rows, self.calls, self.impure = (slice(2),), 0, impure

    def update(self, state: tuple, parameters: tuple) -> tuple:
        self.calls += self.impure
        return ((1 + 0.1 * self.calls) * state[0][:2],)


class CountingByHand(Counting):
    def vjp(self, state: tuple, rows_bar: tuple, parameters: tuple) -> tuple:
        return doubled_vjp(state, rows_bar, parameters)


@pytest.mark.parametrize("kind", [Counting, CountingByHand])
def test_debug_checks_see_an_impure_update(kind: type[Counting]) -> None:
    for impure in (True, False):
        x = X.clone().requires_grad_()
        out = compose([kind(impure)])(x, sweeps=2)
        with dv.debug_checks():
            if impure:
                with pytest.raises(RuntimeError, match=f"update of {kind.__name__}: .*pure and deterministic"):
                    out.sum().backward()
            else:
                out.sum().backward()
                assert x.grad is not None and x.grad.all()


def test_debug_checks_change_no_gradient() -> None:
    """Rows that are NaN are the same rows."""
    at = torch.tensor([0, 2])
    update = Update(lambda s, p: (torch.sqrt(p[0] * s[0][at]), None), (at, None))
    results = []
    for debug in (False, True):
        x, p = X.clone().requires_grad_(), leaf()
        with dv.debug_checks(debug):
            end, _ = compose([update])((x, X), p, sweeps=2)
            end[1:2].sum().backward()
        assert end.isnan().any() and x.grad is not None and x.grad.any()
        results.append(x.grad)
    assert torch.allclose(*results, rtol=0, atol=0, equal_nan=True)


# --- rows -------------------------------------------------------------------------------------------------------------


def made(rows: Any, dim: int = -2) -> Update:
    return Update(lambda s, p: s[0][rows], rows, dim)


def test_rows_that_no_state_has_are_named() -> None:
    with pytest.raises(ValueError, match=r"state\[0\]: expected at least 2 dimensions .* dim=-2., got .*\[4\]"):
        compose([made(slice(1, 2))])(X[:, 0], sweeps=1)  # dim=-1 forgotten
    with pytest.raises(ValueError, match=r"updates\[1\].rows: expected some of the 4 rows of state\[0\] .*slice\(4, 6"):
        compose([made(slice(2)), made(slice(4, 6))])(X, sweeps=1)
    for step in (-1, 0, 1.5):
        with pytest.raises(ValueError, match=r"updates\[0\].rows: expected a slice with a step > 0, got slice"):
            compose([made(slice(None, None, step))])
    empty = compose([made(slice(None))])(X[:0], sweeps=1)  # a state without rows has nothing to select
    assert empty.shape == (0, 3)
    every = compose([Update(lambda s, p: -s[0][..., ::2], slice(None, None, 2), dim=-1)])(X[:, 0], sweeps=1)
    assert torch.equal(every, X[:, 0] * X.new_tensor([-1, 1, -1, 1]))
