"""`prescribed` moves pinned vertices. A row of it that would be ignored says so, unless it says nothing of its own."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv

GIVEN: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "solver": dv.VBD(0.01, 2)}
MESSAGE = r"prescribed: expected positions for pinned vertices .*, got another position for vertex 5.*not pinned"


@pytest.fixture
def model(device: str) -> dv.Model:
    return dv.Model(dv.mesh.cube(3, size=0.2), pinned=[0, 1, 2], device=device)


def moved(x: Tensor, vertex: int, by: float = 0.01) -> Tensor:
    out = x.clone()
    out[..., vertex, 1] += by
    return out


def start(model: dv.Model) -> tuple[Tensor, Tensor]:
    """Neither at rest nor at the origin."""
    return model.rest_points + 0.05, torch.zeros_like(model.rest_points)


@pytest.mark.usefixtures("value_checks")
def test_a_row_that_would_be_ignored_raises(model: dv.Model) -> None:
    x, v = start(model)
    everywhere = moved(x, 5)
    with pytest.raises(ValueError, match=MESSAGE):
        dv.step(model, x, v, prescribed=everywhere, **GIVEN)
    for how in (everywhere, dv.per_step(torch.stack([x, everywhere])), lambda k, x, v: moved(x, 5) if k else x):
        with pytest.raises(ValueError, match=MESSAGE):
            dv.rollout(model, x, v, steps=2, prescribed=how, **GIVEN)
    with pytest.raises(ValueError, match=MESSAGE):
        dv.solve(model, x, v, prescribed=everywhere, **GIVEN)
    with pytest.raises(ValueError, match=MESSAGE):
        dv.diagnose(model, x, previous=(x, v), prescribed=everywhere, **GIVEN)
    scenes = torch.stack([x, everywhere])
    with pytest.raises(ValueError, match=r"vertex 5 of scene \[1\]"):
        dv.step(model, torch.stack([x, x]), torch.stack([v, v]), prescribed=scenes, **GIVEN)


@pytest.mark.usefixtures("value_checks")
def test_nothing_is_done_before_a_rollout_raises(model: dv.Model) -> None:
    x, v = start(model)
    seen: list[int] = []
    values = torch.stack([x] * 9 + [moved(x, 5)])
    with pytest.raises(ValueError, match=MESSAGE):
        dv.rollout(
            model, x, v, steps=10, prescribed=dv.per_step(values), observe=lambda k, x, v: seen.append(k), **GIVEN
        )
    assert seen == []


@pytest.mark.usefixtures("value_checks")
def test_rows_that_say_nothing_of_their_own(model: dv.Model) -> None:
    x, v = start(model)
    held = model.pinned[:, None]
    target = moved(x, 1)
    expected = dv.step(model, x, v, prescribed=target, **GIVEN)
    assert torch.equal(expected[0][1], target[1]) and not torch.equal(expected[0][5], x[5])
    for elsewhere in (x, model.rest_points, torch.full_like(x, torch.nan)):
        end = dv.step(model, x, v, prescribed=torch.where(held, target, elsewhere), **GIVEN)
        assert torch.equal(end[0], expected[0]) and torch.equal(end[1], expected[1])
    one = target[1].clone()  # one position for all that are pinned
    assert torch.equal(dv.step(model, x, v, prescribed=one, **GIVEN)[0][:3], one.expand(3, 3))


@pytest.mark.usefixtures("value_checks")
def test_a_rollout_may_repeat_its_initial_positions(model: dv.Model) -> None:
    x, v = start(model)
    path = torch.stack([moved(x, 1, 0.001 * k) for k in (1, 2, 3)])
    expected = dv.rollout(model, x, v, steps=3, prescribed=dv.per_step(path), **GIVEN).x
    assert torch.equal(expected[1:, 1], path[:, 1])
    by_call = dv.rollout(model, x, v, steps=3, prescribed=lambda k, x, v: path[k], **GIVEN).x
    now = dv.rollout(model, x, v, steps=3, prescribed=lambda k, now, v: moved(x, 1, 0.001 * (k + 1)), **GIVEN).x
    assert torch.equal(by_call, expected) and torch.equal(now, expected)
    constant = dv.rollout(model, x, v, steps=3, prescribed=path[0], **GIVEN).x
    assert torch.equal(constant[-1, 1], path[0, 1]) and not torch.equal(constant[-1, 5], x[5])


@pytest.mark.usefixtures("value_checks")
def test_gradients_pass_where_pinned_and_nowhere_else(model: dv.Model) -> None:
    x, v = start(model)
    target = torch.where(model.pinned[:, None], moved(x, 1), torch.nan).requires_grad_()
    (slope,) = torch.autograd.grad(dv.rollout(model, x, v, steps=2, prescribed=target, **GIVEN).x[-1].sum(), target)
    assert (slope[:3] != 0).all() and not slope[3:].any()
