"""Inputs: the keywords that steps and rollouts take of a Model, declared by what the Model has."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from .._common.checks import input_name
from .._common.constants import ELASTIC

VISCOSITIES = ("viscosity", "volume_viscosity")  # of an elastic law


class Input(NamedTuple):
    """An input of a step.

    Attributes:
        name: The keyword.
        shape: What it broadcasts to; ... are the leading dimensions of x.
        unit: Its unit.
        default: What holds where it is not given.
        source: The energy that declares it, or "Model".
    """

    name: str
    shape: str
    unit: str
    default: str
    source: str


class Inputs(dict[str, Input]):
    """The inputs of a Model by name; printed as a table."""

    def __str__(self) -> str:
        rows = [Input._fields, *self.values()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)

    __repr__ = __str__


def inputs_of(model: Any) -> Inputs:
    """The table of a Model's inputs."""
    rows = [
        Input("force", "[..., V, 3]", "N", "0", "Model"),
        Input("gravity", "[3] or [..., V, 3]", "m/s^2", "(0, -9.81, 0)", "Model"),
        Input("prescribed", "[..., V, 3]", "m", "x: pinned vertices rest", "Model"),
        Input("colliders", "[..., Vc, 3]", "m", "model.collider_points", "Model"),
        Input("colliders_before", "[..., Vc, 3]", "m", "colliders: they rest", "Model"),
        Input("rest_points", "[..., V, 3]", "m", "model.rest_points", "Model"),
        Input("density", "[..., T]", "kg/m^3", "model.density", "Model"),
        Input("drag", "[..., V]", "1/s", "0", "Model"),
    ]
    if model.law is not None:
        rows += [Input(name, "[..., T]", "", f"{float(value):g}" if value.numel() == 1 else f"law({name}=)", "law")
                 for name, value in model.law.values.items()]  # fmt: skip
        rows += [] if model.law.a0 is None else [Input("a0", "[..., T, 3]", "-", "law(a0=)", "law")]
        rows += [Input("stress_free", "[..., T, 3, 3]", "-", "identity", "law")]
        rows += [Input(name, "[..., T]", "Pa s", "0", "law") for name in VISCOSITIES]
    elif model.energy_mask & ELASTIC:
        pairs = (("mu", "Pa"), ("lam", "Pa"), ("young", "Pa"), ("poisson", "-"))
        defaults = ("or young, poisson", "or young, poisson", "or mu, lam", "or mu, lam")
        rows += [Input(name, "[..., T]", unit, given, "StableNeoHookean")
                 for (name, unit), given in zip(pairs, defaults, strict=True)]  # fmt: skip
        rows += [Input("stress_free", "[..., T, 3, 3]", "-", "identity", "StableNeoHookean")]
        rows += [Input(name, "[..., T]", "Pa s", "0", "StableNeoHookean") for name in VISCOSITIES]
    for name, (energy, key, own) in parameters_of(model).items():
        value = model.constants(energy)[key]
        shape = "".join(f", {n}" for n in value.shape[:own])
        default = f"{float(value):g}" if value.numel() == 1 else f"{type(energy).__name__}({key}=)"
        rows.append(Input(name, f"[...{shape}]", energy.units.get(key, ""), default, type(energy).__name__))
    return Inputs({row.name: row for row in rows})


def parameters_of(model: Any) -> dict[str, tuple[Any, str, int]]:
    """Inputs that are parameters of energies: the energy, its key and its own dimensions."""
    return model.derived("parameters", lambda: {
        input_name(e, key): (e, key, own) for e in model.parametric_energies for key, own in e.parameters.items()
    })  # fmt: skip


def parameter_of(model: Any, given: dict[str, Tensor], name: str) -> Tensor | None:
    """An input of an energy [1 | B, ...]: the given one, else the Model's constant; None where its energy is absent."""
    if name in given:
        return given[name]
    known = parameters_of(model).get(name)
    return None if known is None else model.constants(known[0])[known[1]][None]
