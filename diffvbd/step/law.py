"""Inputs of a law of one's own: its parameters and fibres, as the scalars of the rest shape that its kernels read."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from .._common.checks import fail, name_value
from .._common.context import looks_at
from ..laws.law import FIBRE, check_fibre
from ..model.material import shape_gradients
from ..model.system import System

LEAST = 1e-6  # of the moduli: what rounding may make of 0
ScenesFirst = Callable[[str, Any, tuple[int, ...]], Tensor]  # name, value, own shape -> [1 | B, ...]


class LawInputs(NamedTuple):
    """Of a step, scenes first."""

    values: list[Tensor]  # of the law's parameters in their order, [1 | B, 1 | T]
    a0: Tensor | None  # unit directions of fibres at rest, [1 | B, 1 | T, 3]
    mu: Tensor  # of the law at rest [Pa], [1 | B, 1 | T]; differentiable
    lam: Tensor


def law_inputs(model: System, given: dict[str, Any], scenes_first: ScenesFirst) -> LawInputs:
    """given: inputs by name; those of the law that are not there are its own values."""
    law = model.law
    assert law is not None
    own = model.derived("law_values", lambda: {k: v.to(model._mass) for k, v in law.values.items()})
    values = [scenes_first(name, given.get(name, own[name]), (model.num_tets,)) for name in law.density.parameters]
    for name, value in zip(law.density.parameters, values, strict=True):
        if looks_at(value):
            name_value(name, "finite values", value.detach(), torch.isfinite(value), ("scene", "tet"))
    a0, fibres = None, law.a0
    if fibres is not None:
        a0 = given.get(FIBRE)
        a0 = model.derived("law_fibres", lambda: fibres.to(model._mass)) if a0 is None else a0
        a0 = scenes_first(FIBRE, a0, (model.num_tets, 3))
        if looks_at(a0):
            check_fibre(a0)
        a0 = a0 / a0.square().sum(-1, keepdim=True).sqrt()
    mu, lam, _ = (m.reshape(1, 1) if m.dim() == 0 else m for m in law.at_rest(values))
    if looks_at(mu):
        law.check_finite(values)
        size = LEAST * (mu.abs() + lam.abs()).detach()
        for name, modulus in (("shear", mu.detach()), ("bulk", (lam + 2 / 3 * mu).detach())):
            what = f"parameters with a {name} modulus at rest >= 0 Pa"
            name_value("law", what, modulus, modulus >= -size, ("scene", "tet"))
    _refuse_concave(model, values)
    return LawInputs(values, a0, mu, lam)


def _refuse_concave(model: System, values: list[Tensor]) -> None:
    """Raises where a law that is quadratic in one vertex is concave there: no sweep would find its least energy."""
    law = model.law
    assert law is not None
    if not law.density.quadratic or not all(map(looks_at, values)):
        return
    with torch.no_grad():
        one = torch.ones_like(values[0]) if values else model._mass.new_ones(1, 1)
        given = [3 * one, 3 * one, one, one], values
        slopes, bend = law.density.slopes(*given), law.density.curvatures(*given)[7]
        for name, value in (("I1", slopes[0]), ("I2", slopes[1]), ("I4", slopes[3]), ("J", bend)):
            if bool((value < 0).any()):
                what = "second derivative" if name == "J" else "derivative"
                fail("law", f"parameters that make the {what} of {law.expression!r} by {name} >= 0",
                     f"{float(value.min()):g} Pa")  # fmt: skip


def law_rest(model: System, inputs: LawInputs, metric: Tensor, corners: Tensor | None) -> Tensor:
    """Scalars of the rest shape [1 | B, T, n]: metric [1 | B, T, 7], with fibres a0 . grad N of the four corners, and
    the parameters. corners: of the tets at rest [B, T, 4, 3]; None: the Model's."""
    parts = [metric]
    if inputs.a0 is not None:
        if corners is None:
            gradients = model.derived("law_gradients", lambda: shape_gradients(
                model._rest_points[model._topology[0]][None])[0])  # fmt: skip
        else:
            gradients = shape_gradients(corners)[0]
        scenes = max(len(gradients), len(inputs.a0))
        a0 = ops.broadcast(inputs.a0[:, :, None], (scenes, model.num_tets, 4, 3))
        parts.append((ops.broadcast(gradients, a0.shape) * a0).sum(-1))
    parts += [value[..., None] for value in inputs.values]
    scenes = max(map(len, parts)) if all(map(len, parts)) else 0
    return torch.cat([ops.broadcast(p, (scenes, model.num_tets, p.shape[-1])) for p in parts], -1)


def in_scenes(value: Tensor, lead: tuple[int, ...]) -> Tensor:
    """[1 | B, n] -> [*lead, n] or [n]."""
    return value[0] if len(value) == 1 and math.prod(lead) != 1 or not lead else value.reshape(*lead, value.shape[-1])
