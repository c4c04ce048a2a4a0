"""Claim: a rollout says of a body that starts inside out, as mirrored positions do, which one it is; of a start in
which some tets of a body are inverted it says nothing."""

import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv

CUBE = dv.mesh.cube(3)
GIVEN: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "time_step": 0.01, "sweeps": 2, "gravity": (0.0, 0.0, 0.0)}


def said(model: dv.Model, x: Tensor, **more: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        dv.rollout(model, x, torch.zeros_like(x), steps=1, **GIVEN, **more)
    return [str(w.message) for w in found if "inverted" in str(w.message)]


def two_cubes(**options: Any) -> tuple[dv.Model, Tensor]:
    model = dv.Model(dv.mesh.join([CUBE, CUBE.translate((3.0, 0.0, 0.0))]), **options)
    return model, model.rest_points.clone()


def mirrored(model: dv.Model, x: Tensor, body: int) -> Tensor:
    out, own = x.clone(), model.body == body
    out[..., own, 1] = -out[..., own, 1]
    return out


@pytest.mark.parametrize("body", (0, 1))
def test_a_mirrored_body_is_named(body: int) -> None:
    model, x = two_cubes()
    (message,) = said(model, mirrored(model, x, body))
    assert f"body {body} in scene 0 are inverted" in message and "mirrored" in message


def test_some_inverted_tets_are_no_mistake() -> None:
    model, x = two_cubes()
    pushed = x.clone()
    pushed[0] = x[model.body == 0].mean(0) + (x[model.body == 0].mean(0) - x[0])  # one corner through its body
    assert dv.diagnose(model, pushed, mu=1e4, lam=1e4).inverted.any()
    assert said(model, pushed) == [] and said(model, x) == []


def test_nothing_is_said_where_nobody_asks() -> None:
    model, x = two_cubes()
    other = mirrored(model, x, 0)
    assert said(model, other, check_start=False) == []
    with pytest.warns(UserWarning, match="no StableNeoHookean"):
        loose, x = two_cubes(energies=())
    assert said(loose, mirrored(loose, x, 0)) == []
