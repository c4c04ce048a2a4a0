"""Arguments of a step: checked, and in the shapes of the operator. Everything here happens before any work."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops, reference
from .._common.checks import (
    NUMBERS,
    check_broadcast,
    check_kind,
    check_readable,
    check_square,
    check_tensor,
    fail,
    input_name,
    kind_of,
    name_value,
    to_float,
    where_it_is,
)
from .._common.constants import ELASTIC
from .._common.context import checking, looks_at, refuse_forward_mode, transformed
from .._contact.barrier import Friction, PairBarrier
from .._contact.colliders import MOST_LENGTH, Plane
from ..adjoint.routes import Adjoint, GlobalAdjoint, ReverseSweep, Unrolled
from ..couplings import COUPLINGS, Coupling
from ..energies import VERTEX_ENERGIES
from ..model.inputs import VISCOSITIES, inputs_of, parameters_of
from ..model.material import deformed, determinant, moduli_of, rest_metric
from ..model.model import Model
from ..model.patches import Averaged, uniform
from ..model.solver import SDIRK2, Integrator
from ..model.system import System
from .coarse import CoarseParts, coarse_parts, fibre_stiffness
from .law import law_inputs, law_rest

GRAVITY = (0.0, -9.81, 0.0)  # [m/s^2]
MODULI = ("mu", "lam", "young", "poisson")
OF_TETS = (*MODULI, "density", *VISCOSITIES)  # a value for each tet
OF_ELASTIC = (*MODULI, "stress_free", *VISCOSITIES)  # inputs of a Model with an elastic law
MATERIAL = (*MODULI, "rest_points", "density", "stress_free", *VISCOSITIES, "drag")
LOADS = ("force", "gravity", "prescribed")
COLLIDERS = ("colliders", "colliders_before")
STAGED = ("prescribed", "colliders")  # where motion is given: at the end of a step, or of each of its solves

SCENE_TET = ("scene", "tet")  # what the dimensions of values of tets count
LOOKBACK = 1.0  # of implicit Euler, whose velocities are (x - x_prev) / h


class Given(NamedTuple):
    """Inputs of a call, sorted."""

    material: dict[str, Any]  # those of MATERIAL; None: not given
    parameters: dict[str, Any]  # of energies
    loads: dict[str, Any]  # force, gravity, prescribed, colliders, colliders_before; those not given are None


class Damping(NamedTuple):
    """Viscosities of tets and drag of vertices, None where not given."""

    viscosity: Tensor | None  # [1 | B, 1 | T] [Pa s]
    volume_viscosity: Tensor | None
    drag: Tensor | None  # [1 | B, 1 | V] [1/s]
    corners: Tensor | None  # of the tets' rest shapes [B, T, 4, 3]; None: the Model's
    moduli: tuple[Tensor, Tensor]  # mu and lam without viscosity [Pa], differentiable


class Drag(NamedTuple):
    """Drag as begin() takes it: a velocity v becomes factor v + shift."""

    factor: Tensor  # [1 | B, 1 | V, 1] [-]
    shift: Tensor | None  # [B, V, 3] [m/s]


class Prepared(NamedTuple):
    """Arguments of a step that do not depend on x and v, in the shapes of the operator (scenes first)."""

    mu: Tensor  # [1 | B, 1 | T]
    lam: Tensor  # [1 | B, 1 | T]
    mass: Tensor  # [1 | B, V]
    rest: Tensor | None  # [1 | B, T, 7]; None: the Model's
    parameters: dict[str, Tensor]  # differentiable energy parameters, [1 | B, ...]
    settings: ops.SweepSettings
    coarse: CoarseParts | None = None  # what the coarse corrections of all steps have in common
    # of a time step, sweeps and a lookback ratio, the reference's step, where autograd unrolls it
    unrolled: Callable[[float, int, float], Callable[..., tuple[Tensor, Tensor]]] | None = None
    lookback: float = LOOKBACK  # over h v; see csrc/sweep/extrapolation.h
    euler: Tensor | None = None  # bool [B, V]: vertices that take implicit Euler in a step of another scheme
    damping: Damping | None = None  # of the material, and drag; damped() has put them into the rest
    drag: Drag | None = None
    averaged: Averaged | None = None  # of a Model with patches: its law at rest, without viscosity

    @property
    def time_step_and_sweeps(self) -> tuple[float, int]:
        return self.settings.numbers.time_step, self.settings.sweeps


def check_state(model: Model, x: Tensor, v: Tensor) -> tuple[int, ...]:
    """Raises where x or v does not fit the Model; returns the leading (scene) shape."""
    check_kind("model", model, Model)
    for name, value in (("x", x), ("v", v)):
        if not isinstance(value, Tensor):
            raise TypeError(f"{name}: expected a tensor of shape [..., {model.num_vertices}, 3], got {kind_of(value)}")
        check_tensor(name, value, model._mass)
        if value.dim() < 2 or value.shape[-2:] != (model.num_vertices, 3):
            fail(name, f"shape [..., {model.num_vertices}, 3]", f"shape {list(value.shape)}")
    if v.shape != x.shape:
        fail("v", f"x's shape {list(x.shape)}", f"shape {list(v.shape)}")
    return tuple(x.shape[:-2])


def _scenes_first(name: str, value: Any, like: Tensor, lead: tuple[int, ...], own: tuple[int, ...]) -> Tensor:
    """A value that broadcasts to lead + own, as [1 | B, ...] with as many further dimensions as own."""
    value = check_broadcast(name, check_tensor(name, value, like), lead + own, len(lead))
    shape = (1,) * (len(lead) + len(own) - value.dim()) + tuple(value.shape)
    scenes, rest = shape[: len(lead)], shape[len(lead) :]
    if math.prod(scenes) == 1:
        return value.reshape(1, *rest)
    return ops.broadcast(value.reshape(shape), (*lead, *rest)).reshape(-1, *rest)


def given_of(model: Model, inputs: dict[str, Any]) -> Given:
    """The keywords of a call by what they are, with the default gravity. TypeError: the Model has no such input."""
    loads: dict[str, Any] = {"force": None, "gravity": GRAVITY, "prescribed": None, "colliders": None,
                             "colliders_before": None}  # fmt: skip
    material: dict[str, Any] = dict.fromkeys(MATERIAL)
    parameters: dict[str, Any] = {}
    elastic = bool(model.energy_mask & ELASTIC)
    own = () if model.law is None else model.law.inputs
    known: dict[str, Any] | None = None
    for name, value in inputs.items():
        if name in loads:
            loads[name] = GRAVITY if name == "gravity" and value is None else value
        elif name in own:
            if value is not None:
                parameters[name] = value
        elif name in material and (name not in OF_ELASTIC or (elastic and not own) or name not in MODULI and own):
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
        input_name(kind, key): kind
        for kind in (*VERTEX_ENERGIES, *COUPLINGS, PairBarrier, Friction)
        for key in kind.parameters
    }
    if name in OF_ELASTIC:
        law = "StableNeoHookean" if model.law is not None else "elastic law"
        return f", which has no {law} among its energies"
    if name in kinds:
        return f", which has no {kinds[name].__name__} among its energies"
    return where_it_is(name, (*inputs_of(model), *kinds))


def material_of(**material: Any) -> Given:
    """Moduli, rest_points and the like as inputs."""
    return Given({**dict.fromkeys(MATERIAL), **material}, {}, {})


def step_settings(model: System, lead: tuple[int, ...], time_step: float, sweeps: int) -> ops.SweepSettings:
    """Settings of the kernels for scenes of shape ``lead``, the regime on CUDA included."""
    return model.settings(check_square(time_step, model.dtype), sweeps, math.prod(lead))


def prepare(
    model: System,
    lead: tuple[int, ...],
    given_inputs: Given,
    *,
    time_step: float,
    sweeps: int,
    adjoint: Adjoint | None = None,
    settings: ops.SweepSettings | None = None,
) -> Prepared:
    """Checks and shapes everything of a step that does not depend on the state. ``settings``: chosen before."""
    material = given_inputs.material
    mu, lam, young, poisson, rest_points, density, stress_free, viscosity, bulk, drag = material.values()
    parameters = given_inputs.parameters
    refuse_forward_mode()
    if isinstance(adjoint, GlobalAdjoint) and transformed():
        raise NotImplementedError("adjoint: expected ReverseSweep inside torch.func transforms, got GlobalAdjoint, "
                                  "whose solve looks at values")  # fmt: skip
    like, tets = model._mass, (model.num_tets,)
    if settings is None:
        settings = step_settings(model, lead, time_step, sweeps)
    law, of_law = None, {}
    if model.law is not None:
        of_law = {name: parameters[name] for name in model.law.inputs if name in parameters}
        parameters = {name: value for name, value in parameters.items() if name not in of_law}
        law = law_inputs(model, of_law, lambda name, value, shape: _scenes_first(name, value, like, lead, shape))
        mu = lam = None
    elif not model.energy_mask & ELASTIC:
        mu = lam = 0.0
    elif mu is None or lam is None or young is not None or poisson is not None:
        mu, lam = moduli_of(model, lead, mu, lam, young, poisson)
    rest, corners, mass, given_density = None, None, model._mass[None], density
    if density is not None:
        density = _scenes_first("density", density, like, lead, tets)
    if stress_free is not None:
        stress_free = check_tensor("stress_free", stress_free, like)
        if stress_free.shape[-2:] != (3, 3):
            fail("stress_free", f"shape [..., {model.num_tets}, 3, 3]", f"shape {list(stress_free.shape)}")
        stress_free = _scenes_first("stress_free", stress_free, like, lead, (*tets, 3, 3))
    if rest_points is not None or density is not None or stress_free is not None:
        points = model._rest_points if rest_points is None else rest_points
        points = _scenes_first("rest_points", points, like, lead, (model.num_vertices, 3))
        points = ops.broadcast(points, (points.shape[0], model.num_vertices, 3))
        gathered = ops.tet_gather(points, *model._topology)
        metric, volume = rest_metric(gathered)
        rest, corners = (None, None) if rest_points is None else (metric, gathered)
        if stress_free is not None:
            corners, rest = _stress_free(stress_free, gathered)
        if density is None:
            density = model._density[None]
        shape = (max(density.shape[0], volume.shape[0]), model.num_tets)
        if checking() and model.device.type == "cuda":  # where star_sum does not look
            name_value("density", "finite numbers > 0 kg/m^3", density, density > 0, SCENE_TET)
            name_value("rest_points", "tets of positive volume [m^3]", volume, volume > 0, SCENE_TET)
        try:
            mass = model.mass_of(ops.broadcast(density, shape), ops.broadcast(volume, shape))
        except ValueError:
            name_value("density", "finite numbers > 0 kg/m^3", density, density > 0, SCENE_TET)
            name_value("rest_points", "tets of positive volume [m^3]", volume, volume > 0, SCENE_TET)
            raise
    if law is not None:
        metric = model.rest_scalars if rest is None else rest
        rest = law_rest(model, law, metric, corners)
    given: dict[str, Tensor] = {}
    known = parameters_of(model) if parameters else {}
    for name, value in parameters.items():
        energy, key, own = known[name]
        shape = tuple(model.constants(energy)[key].shape)[:own]
        given[name] = _scenes_first(name, value, like, lead, shape)
        if energy is model.friction and own:  # rows of a matrix are looked up, so each must be there
            given[name] = ops.broadcast(given[name], (given[name].shape[0], *shape))
        if energy in (model.contact, model.friction) and not transformed() and (checking() or not like.is_cuda):
            name_value(name, "finite numbers >= 0", given[name], given[name] >= 0)
        if isinstance(energy, Coupling) and looks_at(given[name]):
            least = energy.least(key)
            wanted = f"finite numbers >= {least:g}" if least > -math.inf else "finite numbers"
            name_value(name, wanted, given[name], given[name] >= least)
    if law is not None:
        materials = [law.mu, law.lam]
    else:
        materials = [_scenes_first(name, value, like, lead, tets) for name, value in (("mu", mu), ("lam", lam))]
    if model.touches and not isinstance(adjoint, ReverseSweep | None):
        raise NotImplementedError(f"adjoint: contact is differentiated by ReverseSweep, got {type(adjoint).__name__}")
    if model.rigid_bodies is not None and isinstance(adjoint, GlobalAdjoint):
        raise NotImplementedError("adjoint: expected ReverseSweep or Unrolled with rigid bodies, got GlobalAdjoint")
    averaged = None
    if model.patches is not None:
        if model.block == "paper":
            fail("solver", 'block="exact" with patches', 'block="paper"')
        averaged = uniform(model.patches, materials[1], model.rest_scalars if rest is None else rest)
        materials[1] = averaged.lam
    unrolled = None
    if isinstance(adjoint, Unrolled):
        layout = model.derived("layout", lambda: reference.build_layout(model))
        both = parameters if law is None else {**parameters, **of_law}
        unrolled = partial(_unrolled, model, like, mu, lam, rest_points, given_density, both, layout,
                           material)  # fmt: skip
    coarse = None
    if model.coarse is not None and model.coarse_geometry.bodies:
        given_mass = None if given_density is None and rest_points is None else mass
        fibres = None if law is None else fibre_stiffness(model, law, corners)
        coarse = coarse_parts(model, materials[0], materials[1], given_mass, rest, corners, fibres)
    damping = None
    if viscosity is not None or bulk is not None or drag is not None:
        damping = _damping(model, like, lead, material, corners, (materials[0], materials[1]))
    return Prepared(
        mu=materials[0] if law is None else materials[0].detach(),
        lam=materials[1] if law is None else materials[1].detach(),
        mass=mass,
        rest=rest,
        parameters=given,
        settings=settings,
        coarse=coarse,
        unrolled=unrolled,
        damping=damping,
        averaged=averaged,
    )


def _stress_free(given: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Corners of tets whose rest shape is deformed, and their rest metric; given [1 | B, 1 | T, 3, 3]."""
    if looks_at(given):
        size = determinant(given.detach())
        name_value("stress_free", "deformations of positive determinant", size, size > 0, SCENE_TET)
    scenes = max(len(given), len(corners))
    corners = ops.broadcast(corners, (scenes, *corners.shape[1:]))
    corners = deformed(corners, ops.broadcast(given, (scenes, corners.shape[1], 3, 3)))
    return corners, rest_metric(corners)[0]


def _not_negative(value: Tensor, name: str, axes: tuple[str, ...]) -> Tensor:
    rows = value.detach().flatten(0, -2)  # inside vmap with the batch
    name_value(name, "finite numbers >= 0", rows, rows >= 0, axes)
    return value


_looked_at = ops.Linear(_not_negative, lambda bar, shape, *_: bar, 3, lambda info, *args: _looked_at(*args))


def _damping(model: System, like: Tensor, lead: tuple[int, ...], given: dict[str, Any], corners: Tensor | None,
             moduli: tuple[Tensor, Tensor]) -> Damping:  # fmt: skip
    """corners: of the tets' rest shapes [B, T, 4, 3] where a step is given those."""
    out: dict[str, Tensor | None] = {}
    for name in (*VISCOSITIES, "drag"):
        value, own = given[name], (model.num_vertices if name == "drag" else model.num_tets,)
        if value is not None:
            value = _scenes_first(name, value, like, lead, own)
            if checking() or not like.is_cuda:
                axes = ("scene", "vertex") if name == "drag" else SCENE_TET
                # inside vmap values can be looked at by functions with a rule for it alone
                value = _looked_at(value, name, axes) if transformed() else _not_negative(value, name, axes)
            if model.block == "paper" and name != "drag":
                fail(name, 'a solver with block="exact"', 'one with block="paper"')
        out[name] = value
    return Damping(**out, corners=corners, moduli=moduli)


def _unrolled(model: System, like: Tensor, mu: Any, lam: Any, rest_points: Any, density: Any, parameters: Any,
              layout: Any, material: dict[str, Any], time_step: float, sweeps: int, lookback: float
              ) -> Callable[..., tuple[Tensor, Tensor]]:  # fmt: skip
    more = {name: material[name] for name in ("stress_free", *VISCOSITIES, "drag")}
    return reference.stepper(model, like, mu, lam, time_step, sweeps, rest_points, density, parameters, layout,
                             lookback, **more)  # fmt: skip


def check_staged(integrator: Integrator, given: dict[str, Any]) -> None:
    """Raises where motion is given for other solves than those of a step."""
    for name in STAGED:
        value = given[name]
        if isinstance(value, tuple) and not (isinstance(integrator, SDIRK2) and len(value) == 2):
            fail(name, "a tensor, or with SDIRK2() one for each of its two solves",
                 f"{len(value)} with {integrator}")  # fmt: skip


def check_prescribed(model: Model, prescribed: Any, x: Tensor, *others: Tensor) -> None:
    """Raises where ``prescribed`` would move a vertex that is not pinned: a row that is not read and is neither x,
    nor one of the ``others``, nor the Model's rest position, nor NaN."""
    if prescribed is None or model.num_moving == 0:
        return
    value = broadcastable("prescribed", prescribed, x).detach()
    if value.dim() < 2 or value.shape[-2] != model.num_vertices or not looks_at(value):
        return  # one position for all that are pinned
    ignored = ~model._pinned[:, None] & ~torch.isnan(value)
    for known in (x, *others, model._rest_points):
        ignored = ignored & (value != known.detach())
    if bool(ignored.any()):
        *scene, vertex, _ = ignored.nonzero()[0].tolist()
        where = f"vertex {vertex}" + (f" of scene {scene}" if scene else "")
        fail(
            "prescribed",
            "positions for pinned vertices (elsewhere x, the Model's rest_points or NaN)",
            f"another position for {where}, which is not pinned: Model(pinned=...) says which vertices follow",
        )


def collider_state(model: Model, x: Tensor, end: Any, start: Any) -> tuple[Tensor, Tensor] | None:
    """Corner points of the colliders at the start and at the end of a step [B, Vc, 3]; one tensor where they rest. None
    for a Model without contact."""
    if end is None and start is None and not model.touches:
        return None
    count, lead = model.collider_points.shape[0], tuple(x.shape[:-2])
    flat = (math.prod(lead), count, 3)
    given = {}
    for name, value in (("colliders", end), ("colliders_before", start)):
        if value is None:
            continue
        if count == 0:
            fail(name, "a Model with colliders", "one without")
        value = check_broadcast(name, check_tensor(name, value, x), (*lead, count, 3), len(lead))
        if looks_at(value):
            far = torch.isfinite(value) & (value.abs() > MOST_LENGTH)
            name_value(name, f"coordinates of at most {MOST_LENGTH:g} m", torch.where(far, value, 0.0), ~far)
            _refuse_lines(model, name, value.detach())
        given[name] = ops.broadcast(value, (*lead, count, 3)).reshape(flat)
    if not model.touches:
        return None
    after = given.get("colliders", model.collider_points.expand(flat).contiguous())
    return given.get("colliders_before", after), after


def _refuse_lines(model: Model, name: str, points: Tensor) -> None:
    """Raises for a Plane whose three corner points lie on one line: it has no normal."""
    points = points.expand(*points.shape[:-2], model.collider_points.shape[0], 3)  # perhaps one place for all
    for number, (thing, rows) in enumerate(zip(model.colliders, model.collider_rows, strict=True)):
        if isinstance(thing, Plane):
            corners = points[..., rows, :].double()
            one, two = (corners[..., k, :] - corners[..., 0, :] for k in (1, 2))
            size = torch.finfo(points.dtype).eps * one.norm(dim=-1) * two.norm(dim=-1)
            if bool((torch.linalg.cross(one, two).norm(dim=-1) <= size).any()):
                fail(name, "three corner points of each Plane that span it", f"those of collider {number} on a line")


def named(model: Model, error: ValueError, arguments: dict[str, Any]) -> ValueError:
    """The error of an operator, or one that names the argument where it could name only what was made of several."""
    if str(error).startswith(("predictor", "start", "parameters")) or " in record " in str(error):
        try:
            refuse_non_finite(model, arguments)
            _refuse_record(str(error), arguments)
        except ValueError as found:
            return found
        except RuntimeError:  # under vmap values cannot be looked at
            pass
    return ValueError(*error.args) if type(error) is ValueError else error


def _refuse_record(message: str, given: dict[str, Any]) -> None:
    """Raises for the input of an energy that an operator refuses with all numbers of its plane or vertex."""
    name, _, rest = message.partition(": expected ")
    if name == "parameters" and "floor_normal" in given:  # finite as given, and not once its length has been made 1
        fail("floor_normal", "normals of finite length > 0", "one of length 0")
    if isinstance(value := given.get(name), Tensor):
        name_value(name, rest.partition(", got")[0], value, value >= 0 if rest.startswith(">=") else value > 0)


def refuse_non_finite(model: Model, arguments: dict[str, Any]) -> None:
    """Raises for the first tensor or number among arguments of a step that is, or holds, what is not finite."""
    for name, value in arguments.items():
        read = not name.startswith("prescribed") or model.num_active < model.num_vertices  # only where pinned
        if isinstance(value, NUMBERS) and read and not math.isfinite(to_float(name, value)):
            fail(name, "finite values", value)
        if isinstance(value, Tensor):
            check_readable(name, value)
            good = torch.isfinite(value)
            if name.startswith("prescribed"):  # read only where pinned
                value, good = torch.where(model._pinned[:, None], value, 0.0), good | ~model._pinned[:, None]
            name_value(name, "finite values", value, good)


def acceleration_of(gravity: Any, like: Tensor) -> Tensor:
    """The argument ``gravity`` as a tensor."""
    if not isinstance(gravity, Tensor):
        gravity = _three_numbers("gravity", gravity, like)
    return broadcastable("gravity", gravity, like)


def _three_numbers(name: str, value: Any, like: Tensor) -> Tensor:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, (tuple, list)):
        raise TypeError(f"{name}: expected 3 numbers or a tensor, got {value!r}")
    floats = []
    for a in value:
        if not isinstance(a, NUMBERS) or isinstance(a, bool):
            raise TypeError(f"{name}: expected 3 numbers or a tensor, got {value!r}")
        floats.append(a if type(a) is float else to_float(name, a))
    if len(value) != 3:
        fail(name, "3 numbers or a tensor", f"{len(value)} numbers")
    if like.is_cuda:  # kernels fill it: a copy from the host would wait for the device and break a graph's capture
        return torch.stack([torch.full((), a, dtype=like.dtype, device=like.device) for a in floats])
    return torch.tensor(floats, dtype=like.dtype, device=like.device)


def broadcastable(name: str, value: Any, x: Tensor) -> Tensor:
    return check_broadcast(name, check_tensor(name, value, x), tuple(x.shape), x.dim() - 2)
