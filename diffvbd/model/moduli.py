"""Young's modulus and Poisson's ratio in place of the Lame parameters."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from .. import ops
from ..checks import NUMBERS, check_broadcast, check_readable, check_tensor, fail, name_value, to_float
from ..scopes import looks_at
from .model import Model


def lame(young: float | Tensor, poisson: float | Tensor) -> tuple[Any, Any]:
    """Lame parameters of a linear isotropic material; near the rest shape it is what the bodies are made of.

        mu = E / (2 (1 + nu)),    lam = E nu / ((1 + nu) (1 - 2 nu))

    Args:
        young: Young's modulus E >= 0 [Pa], a number or a tensor of any shape.
        poisson: Poisson's ratio nu in (-1, 0.5) [-], likewise; the two broadcast together.

    Returns:
        mu and lam [Pa]: numbers where both arguments are, else tensors, differentiable by torch.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came. Values of tensors on CUDA are
            looked at only inside debug_checks().
    """
    young, poisson = _values(young=young, poisson=poisson)
    _check("young", young, "finite numbers >= 0 Pa", young >= 0)
    _check("poisson", poisson, "numbers above -1 and below 0.5", (poisson > -1) & (poisson < 0.5))
    young, poisson = _alike(young, poisson)
    mu = young / (2 * (1 + poisson))
    return mu, 2 * mu * poisson / (1 - 2 * poisson)


def young_poisson(mu: float | Tensor, lam: float | Tensor) -> tuple[Any, Any]:
    """Young's modulus E [Pa] and Poisson's ratio nu [-] of Lame parameters, the inverse of :func:`lame`.

        E = mu (3 lam + 2 mu) / (lam + mu),    nu = lam / (2 (lam + mu))

    Args:
        mu: Shear modulus >= 0 [Pa], a number or a tensor of any shape.
        lam: First Lame parameter [Pa], likewise; the two broadcast together, and mu + lam > 0.

    Returns:
        E and nu: numbers where both arguments are, else tensors, differentiable by torch.

    Raises:
        ValueError, TypeError: As :func:`lame`.
    """
    mu, lam = _values(mu=mu, lam=lam)
    _check("mu", mu, "finite numbers >= 0 Pa", mu >= 0)
    mu, lam = _alike(mu, lam)
    total = lam + mu
    _check("lam", total, "mu + lam > 0 Pa, finite", total > 0)
    return mu * (3 * lam + 2 * mu) / total, lam / (2 * total)


def moduli_of(model: Model, lead: tuple[int, ...], mu: Any, lam: Any, young: Any, poisson: Any) -> tuple[Any, Any]:
    """mu and lam of a step that was given either pair; ``lead``: shape of the scenes."""
    if young is None and poisson is None:
        for name, value in (("mu", mu), ("lam", lam)):
            if value is None:
                raise TypeError(f"{name}: expected a number or a tensor (mu and lam, or young and poisson), got None")
        return mu, lam
    for name, value in (("mu", mu), ("lam", lam)):
        if value is not None:
            raise TypeError(f"{name}: expected None beside young and poisson, got {type(value).__name__}")
    pair = {"young": young, "poisson": poisson}
    for name, value in pair.items():
        if value is None:
            raise TypeError(f"{name}: expected a number or a tensor (young and poisson together), got None")
        if isinstance(value, Tensor):
            check_tensor(name, value, model._mass)
            check_broadcast(name, value, (*lead, model.num_tets), len(lead))
    if isinstance(young, Tensor) != isinstance(poisson, Tensor):
        pair = {name: check_tensor(name, value, model._mass) for name, value in pair.items()}
    return lame(pair["young"], pair["poisson"])


def _values(**given: Any) -> list[Any]:
    """Two values that broadcast together."""
    values = [_value(name, value) for name, value in given.items()]
    if all(isinstance(value, Tensor) for value in values):
        try:
            torch.broadcast_shapes(*(value.shape for value in values))
        except RuntimeError:
            (first, one), (name, other) = zip(given, values, strict=True)
            fail(name, f"a shape that broadcasts with {list(one.shape)}, that of {first}", f"shape {list(other.shape)}")
    return values


def _alike(*values: Any) -> tuple[Any, ...]:
    """Tensors of one shape, whose gradients are summed in a fixed order; numbers as they are."""
    if not all(isinstance(value, Tensor) for value in values):
        return values
    shape = torch.broadcast_shapes(*(value.shape for value in values))
    return tuple(ops.broadcast(value, shape) for value in values)


def _value(name: str, value: Any) -> Any:
    """A number as a float, a tensor as it is."""
    if isinstance(value, Tensor):
        check_readable(name, value)
        if not value.is_floating_point():
            raise TypeError(f"{name}: expected a number or a tensor of floating point, got {value.dtype}")
        return value
    if isinstance(value, bool) or not isinstance(value, NUMBERS):
        raise TypeError(f"{name}: expected a number or a tensor, got {type(value).__name__}")
    return to_float(name, value)


def _check(name: str, value: Any, expected: str, good: Any) -> None:
    if not isinstance(value, Tensor):
        if not (good and math.isfinite(value)):
            fail(name, expected, f"{value:g}")
    elif looks_at(value):
        name_value(name, expected, value.detach(), good)
