"""One implicit time step: predictor, sweeps, velocity. Only the sweeps are a custom operator; the rest is torch."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from . import ops
from .adjoints import ReverseSweep
from .checks import check_broadcast, check_count, check_positive, check_tensor, fail
from .memory import out_of_memory_named
from .metric import lumped_mass, rest_metric
from .model import Model
from .sweeps import fused_step, sweep

GRAVITY = (0.0, -9.81, 0.0)  # [m/s^2]

MAX_SWEEPS = 2**31 - 1

_debug = False  # a plain global: torch.compile guards it


@contextlib.contextmanager
def debug_checks(enabled: bool = True) -> Iterator[None]:
    """Inside, a position that is not finite raises RuntimeError naming step, sweep, color, vertex and scene.

    Off (the default) it costs nothing. On CUDA the CPU repeats each step to find out, and values that a step cannot
    work with raise only here, because looking at them waits for the device.
    """
    global _debug
    before, _debug = _debug, enabled
    try:
        yield
    finally:
        _debug = before


def check_adjoint(adjoint: Any) -> ReverseSweep:
    if adjoint is None:
        return ReverseSweep()
    if not isinstance(adjoint, ReverseSweep):
        raise TypeError(f"adjoint: expected a diffvbd.ReverseSweep, got {type(adjoint).__name__}")
    return adjoint


class Prepared(NamedTuple):
    """Arguments of a step that do not depend on x and v, in the shapes of the operator (scenes first)."""

    mu: Tensor  # [1 | B, 1 | T]
    lam: Tensor  # [1 | B, 1 | T]
    mass: Tensor  # [1 | B, V]
    rest: Tensor | None  # [1 | B, T, 7]; None: the Model's
    parameters: dict[str, Tensor]  # differentiable energy parameters, [1 | B, ...]
    settings: ops.SweepSettings


def step(
    model: Model,
    x: Tensor,
    v: Tensor,
    *,
    mu: float | Tensor,
    lam: float | Tensor,
    time_step: float,
    sweeps: int,
    force: Tensor | None = None,
    gravity: Sequence[float] | Tensor = GRAVITY,
    prescribed: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: float | Tensor | None = None,
    parameters: dict[str, Any] | None = None,
    adjoint: ReverseSweep | None = None,
) -> tuple[Tensor, Tensor]:
    """One implicit Euler step by Vertex Block Descent, differentiable by the exact reverse sweep.

    Args:
        model: The scene; x, v and the other tensors must have its dtype and device.
        x: Positions [m], shape [..., V, 3]; leading dimensions are scenes over one mesh, which never mix.
        v: Velocities [m/s], shape of x.
        mu: Shear modulus [Pa], broadcasts to x.shape[:-2] + (T,); a value per scene is [B, 1].
        lam: First Lame parameter [Pa], likewise. mu >= 0 and mu + lam >= 0 (lam >= 0 with block="paper").
        time_step: h [s] > 0.
        sweeps: K >= 0, the number of colored sweeps that are executed (and differentiated).
        force: External forces [N], broadcasts to x.shape.
        gravity: Acceleration [m/s^2], 3 numbers, or a tensor that broadcasts to x.shape.
        prescribed: Positions of pinned vertices at the end of the step [m], broadcasts to x.shape; read only where
            pinned. None holds them where x has them.
        rest_points: Rest positions [m], broadcasts to x.shape; None: the Model's. Enter through rest metric and mass.
        density: [kg/m^3], broadcasts to x.shape[:-2] + (T,); None: the Model's.
        parameters: Energy parameters by name, as {"floor_barrier.kappa": tensor}; each broadcasts to
            x.shape[:-2] + its own shape.
        adjoint: How the backward is computed; None: ReverseSweep().

    Returns:
        Positions and velocities after the step, shape of x. Inputs are untouched.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came, before any work.
        NotImplementedError: In the backward, for second derivatives and forward mode.

    Source: paper, eqs. 1-3 and section 3; docs/method.md.
    """
    lead = check_state(model, x, v)
    prepared = prepare(model, lead, mu=mu, lam=lam, time_step=time_step, sweeps=sweeps, rest_points=rest_points,
                       density=density, parameters=parameters)  # fmt: skip
    return advance(model, x, v, prepared, force=force, gravity=gravity, prescribed=prescribed, adjoint=adjoint)


def check_state(model: Model, x: Tensor, v: Tensor) -> tuple[int, ...]:
    """Raises where x or v does not fit the Model; returns the leading (scene) shape."""
    if not isinstance(model, Model):
        raise TypeError(f"model: expected a diffvbd.Model, got {type(model).__name__}")
    for name, value in (("x", x), ("v", v)):
        if not isinstance(value, Tensor):
            raise TypeError(
                f"{name}: expected a tensor of shape [..., {model.num_vertices}, 3], got {type(value).__name__}"
            )
        check_tensor(name, value, model.mass)
        if value.dim() < 2 or value.shape[-2:] != (model.num_vertices, 3):
            fail(name, f"shape [..., {model.num_vertices}, 3]", f"shape {list(value.shape)}")
    if v.shape != x.shape:
        fail("v", f"x's shape {list(x.shape)}", f"shape {list(v.shape)}")
    return tuple(x.shape[:-2])


def _scenes_first(name: str, value: Any, like: Tensor, lead: tuple[int, ...], own: tuple[int, ...]) -> Tensor:
    """A value that broadcasts to lead + own, as [1 | B, ...] with as many further dimensions as own."""
    value = check_broadcast(name, check_tensor(name, value, like), lead + own)
    shape = (1,) * (len(lead) + len(own) - value.dim()) + tuple(value.shape)
    scenes, rest = shape[: len(lead)], shape[len(lead) :]
    value = value.reshape(shape)
    if math.prod(scenes) == 1:
        return value.reshape(1, *rest)
    return ops.broadcast(value, (*lead, *rest)).reshape(-1, *rest)


def step_settings(model: Model, lead: tuple[int, ...], time_step: Any, sweeps: Any) -> ops.SweepSettings:
    """What is executed for scenes of shape ``lead``, the regime on CUDA included."""
    if isinstance(time_step, Tensor) and time_step.requires_grad:
        raise TypeError("time_step: expected a number, got a tensor that requires grad: it is not differentiable")
    return model.settings(
        check_positive("time_step", time_step, "s"),
        check_count("sweeps", sweeps, maximum=MAX_SWEEPS),
        math.prod(lead),
    )


def prepare(
    model: Model,
    lead: tuple[int, ...],
    *,
    mu: float | Tensor,
    lam: float | Tensor,
    time_step: float,
    sweeps: int,
    rest_points: Tensor | None,
    density: float | Tensor | None,
    parameters: dict[str, Any] | None,
    settings: ops.SweepSettings | None = None,
) -> Prepared:
    """Checks and shapes everything of a step that does not depend on the state. ``settings``: chosen before."""
    like, tets = model.mass, (model.num_tets,)
    if settings is None:
        settings = step_settings(model, lead, time_step, sweeps)
    rest, mass = None, model.mass[None]
    if density is not None:
        density = _scenes_first("density", density, like, lead, tets)
    if rest_points is not None or density is not None:
        points = model.rest_points if rest_points is None else rest_points
        points = _scenes_first("rest_points", points, like, lead, (model.num_vertices, 3))
        points = ops.broadcast(points, (points.shape[0], model.num_vertices, 3))
        metric, volume = rest_metric(ops.tet_gather(points, *model._topology))
        rest = None if rest_points is None else metric
        if density is None:
            density = model.density[None]
        shape = (max(density.shape[0], volume.shape[0]), model.num_tets)
        if _debug and model.device.type == "cuda":  # where star_sum does not look
            _name_value("density", "finite numbers > 0 kg/m^3", density, density > 0)
            _name_value("rest_points", "tets of positive volume [m^3]", volume, volume > 0)
        try:
            mass = lumped_mass(ops.broadcast(density, shape), ops.broadcast(volume, shape), *model._topology)
        except ValueError:
            _name_value("density", "finite numbers > 0 kg/m^3", density, density > 0)
            _name_value("rest_points", "tets of positive volume [m^3]", volume, volume > 0)
            raise
    given: dict[str, Tensor] = {}
    if parameters is not None and not isinstance(parameters, dict):
        raise TypeError(f"parameters: expected a dict of tensors by name, got {type(parameters).__name__}")
    known = {}
    if parameters:
        known = {f"{e.name}.{k}": (e, k, own) for e in model.vertex_energies for k, own in e.parameters.items()}
    for name, value in (parameters or {}).items():
        if name not in known:
            fail("parameters", f"names among {sorted(known)}", repr(name))
        energy, key, own = known[name]
        shape = tuple(model.constants(energy)[key].shape)[:own]
        given[name] = _scenes_first(name, value, like, lead, shape)
    return Prepared(
        mu=_scenes_first("mu", mu, like, lead, tets),
        lam=_scenes_first("lam", lam, like, lead, tets),
        mass=mass,
        rest=rest,
        parameters=given,
        settings=settings,
    )


def _energy_data(model: Model, prepared: Prepared, origin: Tensor | None) -> Tensor:
    """The energies' data [1 | B, n]: the Model's constants unless a parameter or an origin changes them."""
    if not prepared.parameters and origin is None:
        return model._energy_data
    packed = []
    for energy in model.vertex_energies:
        values = {k: v[None] for k, v in model.constants(energy).items()}
        values.update({k: prepared.parameters[f"{energy.name}.{k}"] for k in values
                       if f"{energy.name}.{k}" in prepared.parameters})  # fmt: skip
        packed.append(energy.pack(values, origin))
    if not packed:
        return model._energy_data
    scenes = max([p.shape[0] for p in packed])
    return torch.cat([ops.broadcast(p, (scenes, p.shape[1])) for p in packed], -1)


def advance(
    model: Model,
    x: Tensor,
    v: Tensor,
    prepared: Prepared,
    *,
    force: Tensor | None,
    gravity: Sequence[float] | Tensor,
    prescribed: Tensor | None,
    adjoint: ReverseSweep | None,
    index: int = 0,
) -> tuple[Tensor, Tensor]:
    """The step itself; ``index`` is its number in a rollout, for debug_checks()."""
    h = prepared.settings.numbers[0]
    shape, flat = x.shape, (math.prod(x.shape[:-2]), *x.shape[-2:])
    if not isinstance(gravity, Tensor):
        gravity = _three_numbers("gravity", gravity, x)
    gravity = _broadcastable("gravity", gravity, x)
    start, velocity = x.reshape(flat), v.reshape(flat)
    adjoint = check_adjoint(adjoint)
    if x.is_cuda and _fuses(model, force, gravity):
        held = None if prescribed is None else _broadcastable("prescribed", prescribed, x)
        return _fused(model, start, velocity, gravity, held, prepared, adjoint, shape)
    acceleration = ops.broadcast(gravity, shape).reshape(flat)
    if force is not None:
        total = ops.broadcast(_broadcastable("force", force, x), shape).reshape(flat)
        # A pinned vertex is moved by no force, whatever stands there.
        total = torch.where(model.pinned[:, None], torch.zeros_like(total), total)
        weight = ops.broadcast(prepared.mass, (flat[0], flat[1]))[..., None]
        # A vertex without mass is isolated and pinned: no force moves it.
        acceleration = acceleration + total / torch.where(weight > 0, weight, torch.ones_like(weight))
    # float32 computes about a point of each body, where positions are small and their spacing fine
    origin = None
    if model.dtype == torch.float32 and model.num_vertices:
        origin = start.detach()[:, model._first_of_body]
        start = start - origin
    y = start + h * velocity + (h * h) * acceleration
    held = start
    if prescribed is not None:
        held = ops.broadcast(_broadcastable("prescribed", prescribed, x), shape).reshape(flat)
        held = held if origin is None else held - origin
    y = torch.where(model.pinned[:, None], held, y)
    data = _energy_data(model, prepared, origin)
    x_start = y
    if model.floor is not None:
        count = model.floor.count()
        filtered = model.floor.filter(start, y - start, data[:, :count], origin)
        x_start = torch.where(model.pinned[:, None], y, filtered)

    differentiable = (x_start, start, y, prepared.mu, prepared.lam, prepared.mass, prepared.rest, data)
    policy = _tape_policy(model, differentiable, prepared.settings, adjoint)
    tensors = (*differentiable, x.new_empty((0,)) if origin is None else origin)
    try:
        if _debug and x.is_cuda:
            _check_on_cpu(model, tensors, prepared.settings, index)
        with out_of_memory_named(model, x_start, prepared.settings, policy):
            end = sweep(*tensors, model._packed_rest, model._plan, prepared.settings, tape_policy=policy,
                        debug_step=index if _debug else -1)  # fmt: skip
    except ValueError as error:
        _name_argument(error, {"x": x, "v": v, "force": force, "gravity": gravity, "prescribed": prescribed})
        raise
    velocity = (end - start) / h
    if origin is not None:
        end = end + origin
    return end.reshape(shape), velocity.reshape(shape)


def _fuses(model: Model, force: Tensor | None, gravity: Tensor) -> bool:
    """Whether one operator can do the whole step on CUDA. Forces, vertex energies, float32's local origin, function
    transforms and checks take the parts."""
    simple = force is None and not model.vertex_energies and model.dtype == torch.float64
    if not simple or _debug or torch.compiler.is_compiling() or gravity.dim() > 1:
        return False
    return torch._C._functorch.peek_interpreter_stack() is None  # pyright: ignore[reportAttributeAccessIssue]


def _fused(
    model: Model,
    x: Tensor,
    v: Tensor,
    gravity: Tensor,
    held: Tensor | None,
    prepared: Prepared,
    adjoint: ReverseSweep,
    shape: torch.Size,
) -> tuple[Tensor, Tensor]:
    held = x.new_empty((0,)) if held is None else ops.broadcast(held, shape).reshape(x.shape)
    acceleration = ops.broadcast(gravity, (1, 1, 3))
    tensors = (x, v, acceleration, held, prepared.mu, prepared.lam, prepared.mass, prepared.rest)
    policy = _tape_policy(model, tensors, prepared.settings, adjoint)
    with out_of_memory_named(model, x, prepared.settings, policy):
        x_end, v_end = fused_step(*tensors, model._packed_rest, model._plan, prepared.settings, tape_policy=policy)
    return x_end.reshape(shape), v_end.reshape(shape)


def _tape_policy(
    model: Model, tensors: Sequence[Tensor | None], settings: ops.SweepSettings, adjoint: ReverseSweep
) -> int:
    if not (torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)):
        return ops.NO_TAPE
    x = tensors[0]
    assert x is not None
    return adjoint.policy(x.shape[0] * settings.sweeps * model.num_active, x.element_size(), model.energy_mask)


def _check_on_cpu(model: Model, tensors: Sequence[Any], settings: ops.SweepSettings, index: int) -> None:
    """debug_checks() on CUDA: the CPU repeats the step and names what is wrong with it."""
    twin = model._on_cpu()
    settings = settings._replace(sizes=twin._sizes, launch=())
    with torch.no_grad():
        here: list[Any] = [t if t is None else t.detach().cpu() for t in tensors]
        repeated: Any = sweep
        repeated(*here, twin._packed_rest, twin._plan, settings, tape_policy=ops.NO_TAPE, debug_step=index)


def _name_argument(error: ValueError, arguments: dict[str, Any]) -> None:
    """Raises an error that names the argument, where the operator could name only what was made of several."""
    if not str(error).startswith(("predictor", "start")):
        return
    for name, value in arguments.items():
        if isinstance(value, Tensor):
            _name_value(name, "finite values", value, torch.isfinite(value))


def _name_value(name: str, expected: str, value: Tensor, good: Tensor) -> None:
    good = good & torch.isfinite(value)
    if not bool(good.all()):
        where = (~good).nonzero()[0].tolist()
        raise ValueError(f"{name}: expected {expected}, got {float(value[tuple(where)]):g} at {where}") from None


def _three_numbers(name: str, value: Any, like: Tensor) -> Tensor:
    if not isinstance(value, (tuple, list)) or not all(isinstance(a, (int, float)) for a in value):
        raise TypeError(f"{name}: expected 3 numbers or a tensor, got {value!r}")
    if len(value) != 3:
        fail(name, "3 numbers or a tensor", f"{len(value)} numbers")
    if like.is_cuda:  # kernels fill it: a copy from the host would wait for the device and break a graph's capture
        return torch.stack([torch.full((), float(a), dtype=like.dtype, device=like.device) for a in value])
    return torch.tensor([float(a) for a in value], dtype=like.dtype, device=like.device)


def _broadcastable(name: str, value: Any, x: Tensor) -> Tensor:
    return check_broadcast(name, check_tensor(name, value, x), tuple(x.shape))
