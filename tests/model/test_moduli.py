"""Young's modulus and Poisson's ratio in place of the Lame parameters: the same step, with gradients of their own."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance

E, NU = 1.3e5, 0.3
MU, LAM = 5e4, 7.5e4
STEP: dict[str, Any] = {"solver": dv.VBD(0.01, 4)}


def scalar(value: float, device: str = "cpu", **options: Any) -> Tensor:
    return torch.tensor(value, dtype=torch.float64, device=device, **options)


def scene(device: str, lead: tuple[int, ...] = ()) -> tuple[dv.Model, Tensor, Tensor]:
    model = dv.Model(dv.mesh.cube(3, size=0.2, split="kuhn"), pinned=[0, 1, 2], device=device)
    x = (1.1 * model.rest_points).repeat(*lead, 1, 1)
    return model, x, torch.zeros_like(x)


def test_values() -> None:
    assert dv.lame(E, NU) == pytest.approx((MU, LAM), rel=tolerance("ulps"))
    assert dv.young_poisson(MU, LAM) == pytest.approx((E, NU), rel=tolerance("ulps"))
    assert all(isinstance(value, float) for value in (*dv.lame(1, 0), *dv.young_poisson(np.float32(1), 0)))
    assert dv.lame(100, 0) == (50.0, 0.0) and dv.young_poisson(50.0, 0.0) == (100.0, 0.0)
    mu, lam = dv.lame(1.0, -0.5)
    assert lam < 0 < mu + lam


def test_inverse_of_each_other_with_gradients() -> None:
    young = torch.tensor([[1e3], [1e7]], dtype=torch.float64, requires_grad=True)
    poisson = torch.tensor([-0.9, 0.0, 0.2, 0.49], dtype=torch.float64, requires_grad=True)
    mu, lam = dv.lame(young, poisson)
    assert mu.shape == lam.shape == (2, 4)
    back = dv.young_poisson(mu, lam)
    assert relative_error(back[0], young.expand(2, 4)) <= tolerance("formula")
    assert (back[1] - poisson).abs().max() <= tolerance("formula")
    soft = (torch.rand(4, dtype=torch.float64) + 0.5).requires_grad_()  # gradcheck perturbs by 1e-6
    assert torch.autograd.gradcheck(dv.lame, (soft, poisson))
    assert torch.autograd.gradcheck(dv.young_poisson, (soft, 2 * soft.detach().requires_grad_()))
    slopes = torch.autograd.grad(back[0].sum(), (young, poisson))
    assert relative_error(slopes[0], torch.full_like(young, 4.0)) <= tolerance("sum")
    assert slopes[1].abs().max() <= tolerance("sum") * 1e7


BAD: list[tuple[Any, Any, str]] = [
    (-1.0, NU, "young: expected finite numbers >= 0 Pa, got -1"),
    (float("nan"), NU, "young: .* got nan"),
    (10**400, NU, "young: .*1329 bits"),
    (E, 0.5, "poisson: expected numbers above -1 and below 0.5, got 0.5"),
    (E, -1.0, "poisson: .* got -1"),
    (E, scalar(0.6), "poisson: .* got 0.6 at"),
    (torch.tensor([1.0, -2.0], dtype=torch.float64), NU, r"young: .* got -2 at \[1\]"),
    (torch.tensor([1, 2]), NU, "young: .*floating point, got torch.int64"),
    (torch.ones(3).to_sparse(), NU, "young: .*to_dense"),
    ("soft", NU, "young: .* got str"),
    (True, NU, "young: .* got bool"),
    (E, None, "poisson: .* got None"),
    (torch.ones(2), torch.zeros(3), r"poisson: .* broadcasts with \[2\], that of young, got shape \[3\]"),
]


@pytest.mark.parametrize(("young", "poisson", "message"), BAD, ids=lambda a: str(a)[:20].replace("\n", " "))
def test_bad_values(young: Any, poisson: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        dv.lame(young, poisson)


@pytest.mark.parametrize(
    ("mu", "lam", "message"),
    [(-1.0, 5.0, "mu: .* got -1"), (0.0, 0.0, "lam: .* got 0"), (1.0, -2.0, "lam: .* got -1"),
     (1.0, "a", "lam: .* str"), (torch.ones(3), torch.ones(2), r"lam: .* \[3\], that of mu, got shape \[2\]")],
)  # fmt: skip
def test_bad_lame_parameters(mu: Any, lam: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        dv.young_poisson(mu, lam)


@pytest.mark.parametrize("lead", [(), (3,)])
@pytest.mark.parametrize("numbers", [True, False])
def test_a_step_takes_either_pair(device: str, lead: tuple[int, ...], numbers: bool) -> None:
    model, x, v = scene(device, lead)
    young, poisson = (E, NU) if numbers else (scalar(E, device), scalar(NU, device))
    mu, lam = dv.lame(young, poisson)
    expected = dv.step(model, x, v, mu=mu, lam=lam, **STEP)
    found = dv.step(model, x, v, young=young, poisson=poisson, **STEP)
    assert torch.equal(found[0], expected[0]) and torch.equal(found[1], expected[1])
    mixed = dv.step(model, x, v, young=scalar(E, device), poisson=NU, **STEP)
    assert relative_error(mixed[0], expected[0]) <= tolerance("formula")
    end = dv.solve(model, x, v, young=young, poisson=poisson, **STEP).x
    assert torch.equal(end, dv.solve(model, x, v, mu=mu, lam=lam, **STEP).x)
    figures = dv.diagnose(model, x, young=young, poisson=poisson, warn=False, **STEP)
    assert figures.courant == dv.diagnose(model, x, mu=mu, lam=lam, warn=False, **STEP).courant


def test_rollouts_take_values_per_step_and_functions(device: str) -> None:
    model, x, v = scene(device)
    young = torch.linspace(1e5, 2e5, 3, dtype=torch.float64, device=device).requires_grad_()
    calls: list[int] = []

    def poisson(k: int, x: Tensor, v: Tensor) -> float:
        calls.append(k)
        return 0.1 * k

    options = {"steps": 3, **STEP}
    found = dv.rollout(model, x, v, young=dv.per_step(young), poisson=poisson, checkpoint_every=None, **options).x
    assert calls == [0, 1, 2]
    pairs = [dv.lame(young[k], scalar(0.1 * k, device)) for k in range(3)]
    mu, lam = (dv.per_step(torch.stack([pair[i] for pair in pairs])) for i in (0, 1))
    expected = dv.rollout(model, x, v, mu=mu, lam=lam, **options).x
    assert relative_error(found, expected) <= tolerance("formula")
    slopes = [torch.autograd.grad(x[-1].sum(), young, retain_graph=True)[0] for x in (found, expected)]
    assert relative_error(*slopes) <= tolerance("schedules") and (slopes[0] != 0).all()
    constant = dv.rollout(model, x, v, young=E, poisson=NU, **options).x
    assert torch.equal(constant, dv.rollout(model, x, v, mu=dv.lame(E, NU)[0], lam=dv.lame(E, NU)[1], **options).x)


def test_step_forward_differentiates_by_their_names(device: str) -> None:
    model, x, v = scene(device)
    end, _, tape = dv.step_forward(model, x, v, young=E, poisson=scalar(NU, device), wrt=("young", "poisson"), **STEP)
    grads = dv.step_backward(tape, end)
    leaves = [scalar(E, device, requires_grad=True), scalar(NU, device, requires_grad=True)]
    out = dv.step(model, x, v, young=leaves[0], poisson=leaves[1], **STEP)[0]
    for name, expected in zip(("young", "poisson"), torch.autograd.grad(out, leaves, end), strict=True):
        assert torch.equal(grads[name], expected) and grads[name] != 0


@pytest.mark.parametrize(
    ("given", "message"),
    [({}, "mu: expected a number or a tensor .*got None"), ({"mu": 1.0}, "lam: .*got None"),
     ({"young": E}, "poisson: .* together.*got None"), ({"poisson": NU}, "young: .* together.*got None"),
     ({"mu": MU, "young": E, "poisson": NU}, "mu: expected mu and lam, or young and poisson"),
     ({"lam": LAM, "young": E, "poisson": NU}, "lam: expected mu and lam, or young and poisson"),
     ({"mu": MU, "poisson": NU}, "mu: expected mu and lam, or young and poisson"),
     ({"young": torch.ones(5).double(), "poisson": NU}, r"young: .*broadcasts to \[48\], got shape \[5\]"),
     ({"young": E, "poisson": torch.ones(())}, "poisson: expected dtype torch.float64"),
     ({"young": -1.0, "poisson": NU}, "young: .*>= 0 Pa, got -1"),
     ({"young": E, "poisson": scalar(0.5)}, "poisson: .*got 0.5")],
    ids=lambda a: str(a)[:40] if isinstance(a, dict) else "",
)  # fmt: skip
def test_exactly_one_pair(given: dict[str, Any], message: str) -> None:
    model, x, v = scene("cpu")
    for run in (
        lambda: dv.step(model, x, v, **given, **STEP),
        lambda: dv.rollout(model, x, v, steps=2, **given, **STEP),
        lambda: dv.solve(model, x, v, **given, **STEP),
        lambda: dv.diagnose(model, x, **given),
        lambda: dv.step_forward(model, x, v, **given, **STEP),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            run()
