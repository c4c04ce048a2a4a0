"""Inputs: the keywords that steps and rollouts take of a Model, declared by what the Model has."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from .._common.checks import input_name, where_it_is
from .._common.constants import ELASTIC
from .._contact.barrier import Friction, PairBarrier
from ..energies import VERTEX_ENERGIES

MODULI = ("mu", "lam", "young", "poisson")
LOADS = ("force", "gravity", "prescribed")
COLLIDERS = ("colliders", "colliders_before")


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
    ]
    if model.energy_mask & ELASTIC:
        pairs = (("mu", "Pa"), ("lam", "Pa"), ("young", "Pa"), ("poisson", "-"))
        defaults = ("or young, poisson", "or young, poisson", "or mu, lam", "or mu, lam")
        rows += [Input(name, "[..., T]", unit, given, "StableNeoHookean")
                 for (name, unit), given in zip(pairs, defaults, strict=True)]  # fmt: skip
    for name, (energy, key, own) in parameters_of(model).items():
        value = model.constants(energy)[key]
        shape = "".join(f", {n}" for n in value.shape[:own])
        default = f"{float(value):g}" if value.numel() == 1 else f"{type(energy).__name__}({key}=)"
        rows.append(Input(name, f"[...{shape}]", energy.units.get(key, ""), default, type(energy).__name__))
    return Inputs({row.name: row for row in rows})


def parameters_of(model: Any) -> dict[str, tuple[Any, str, int]]:
    """Inputs that are parameters of energies: the energy, its key and its own dimensions."""
    return {input_name(e, key): (e, key, own) for e in model.parametric_energies for key, own in e.parameters.items()}


def parameter_of(model: Any, given: dict[str, Tensor], name: str) -> Tensor | None:
    """An input of an energy [1 | B, ...]: the given one, else the Model's constant; None where its energy is absent."""
    if name in given:
        return given[name]
    known = parameters_of(model).get(name)
    return None if known is None else model.constants(known[0])[known[1]][None]


class Given(NamedTuple):
    """Inputs of a call, sorted."""

    material: dict[str, Any]  # moduli, rest_points, density
    parameters: dict[str, Any]  # of energies
    loads: dict[str, Any]  # force, gravity, prescribed, colliders, colliders_before; those not given are None


def sorted_inputs(model: Any, inputs: dict[str, Any], gravity: Any = None) -> Given:
    """The keywords of a call by what they are; raises TypeError for one that the Model does not declare."""
    loads: dict[str, Any] = {"force": None, "gravity": gravity, "prescribed": None, "colliders": None,
                             "colliders_before": None}  # fmt: skip
    material: dict[str, Any] = dict.fromkeys((*MODULI, "rest_points", "density"))
    parameters: dict[str, Any] = {}
    elastic = bool(model.energy_mask & ELASTIC)
    known: dict[str, Any] | None = None
    for name, value in inputs.items():
        if name in loads:
            loads[name] = gravity if name == "gravity" and value is None else value
        elif name in material and (elastic or name not in MODULI):
            material[name] = value
        else:
            known = parameters_of(model) if known is None else known
            if name not in known:
                raise TypeError(f"{name}: expected an input of this Model ({', '.join(inputs_of(model))})"
                                f"{_meant(model, name)}")  # fmt: skip
            if value is not None:
                parameters[name] = value
    return Given(material, parameters, loads)


def _meant(model: Any, name: str) -> str:
    """The energy that would declare an input, the call that has it as an argument, or the nearest name."""
    kinds = {
        input_name(kind, key): kind for kind in (*VERTEX_ENERGIES, PairBarrier, Friction) for key in kind.parameters
    }
    if name in MODULI:
        return ", which has no elastic law among its energies"
    if name in kinds:
        return f", which has no {kinds[name].__name__} among its energies"
    return where_it_is(name, (*inputs_of(model), *kinds))
