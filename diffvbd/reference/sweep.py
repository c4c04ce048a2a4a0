"""One step and a rollout: predictor, colored block descent, velocity (paper, algorithm of the forward step)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .coarse import HALVINGS, REFUSALS, ROUNDING, Coarse
from .couplings import Bounds, energies_of_sweeps
from .energies import FloorFriction, Law, StableNeoHookean, Viscosity, build_energies, floor_friction, rates
from .rigid import Correction
from .scene import Layout, Scene, build_layout, build_scene, dot, put, solve6, take

MATERIAL = ("stress_free", "viscosity", "volume_viscosity", "drag")  # inputs of the scene among the keywords
SATURATION_EPS = 1e-12  # [m] keeps s finite at a zero step
SOFT = 0.02  # h^2 times a tet's stiffness over the mass of its corners, below which it hardly acts within a step


class Trajectory(NamedTuple):
    """Frames of a rollout, the initial state first. x [m], v [m/s], each [steps + 1, ..., V, 3]."""

    x: Tensor
    v: Tensor


def executed(model: Any, solver: Any) -> Any:
    """The model with the attributes that the solver decides; what is no Model has them already."""
    return model._executed_by(solver) if hasattr(model, "_executed_by") else model


def step(
    model: Any,
    x: Tensor,
    v: Tensor,
    solver: Any,
    *,
    mu: Any = None,
    lam: Any = None,
    force: Tensor | None = None,
    gravity: Any = (0.0, -9.81, 0.0),
    prescribed: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: Any = None,
    tet_order: Tensor | None = None,
    coarse_steps: Tensor | None = None,
    record: list[Tensor] | None = None,
    **parameters: Any,
) -> tuple[Tensor, Tensor]:
    """One time step of a model by a solver (`diffvbd.VBD`); every tensor argument is differentiable by autograd.

    x, v: positions [m] and velocities [m/s], [..., V, 3]; leading dimensions are scenes. mu, lam [Pa] broadcast to
    x.shape[:-2] + (T,); None: those of a law of one's own, else 0. force [N], gravity [m/s^2], prescribed, rest_points
    [m] broadcast to x's shape; density [kg/m^3] to [..., T]. tet_order: permutation [T] of the tets that changes only
    the order of summation. coarse_steps: lengths of a model.coarse's corrections [corrections, ..., bodies], which are
    searched for if not given; record: a list, to which the step appends the lengths that it took.
    parameters: of energies, as `floor_kappa`, and those of MATERIAL. Raises ValueError when an unpinned vertex starts
    below a floor plane. Returns (x', v').
    """
    system = executed(model, solver)
    layout = build_layout(system, tet_order)
    numbers = solver.time_step, solver.sweeps
    more = {name: parameters.pop(name) for name in MATERIAL if name in parameters}
    advance = stepper(system, x, mu, lam, *numbers, rest_points, density, parameters, layout, **more)
    return advance(x, v, force, gravity, prescribed, coarse_steps, record)


def rollout(
    model: Any,
    x: Tensor,
    v: Tensor,
    solver: Any,
    *,
    steps: int,
    mu: Any = None,
    lam: Any = None,
    force: Tensor | None = None,
    gravity: Any = (0.0, -9.81, 0.0),
    prescribed: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: Any = None,
    tet_order: Tensor | None = None,
    force_per_step: Tensor | Sequence[Tensor] | None = None,
    prescribed_per_step: Tensor | Sequence[Tensor] | None = None,
    coarse_steps: Tensor | Sequence[Tensor] | None = None,
    record: list[Tensor] | None = None,
    **parameters: Any,
) -> Trajectory:
    """`steps` steps with everything constant in time, except `force_per_step` and `prescribed_per_step`, whose first
    dimension is the step and which replace `force` and `prescribed`; so it is that of `coarse_steps`, and
    `record` gets an entry for each step. Other arguments as in `step`."""
    system = executed(model, solver)
    layout = build_layout(system, tet_order)
    numbers = solver.time_step, solver.sweeps
    more = {name: parameters.pop(name) for name in MATERIAL if name in parameters}
    advance = stepper(system, x, mu, lam, *numbers, rest_points, density, parameters, layout, **more)
    xs, vs = [x], [v]
    for n in range(steps):
        f = force if force_per_step is None else force_per_step[n]
        held = prescribed if prescribed_per_step is None else prescribed_per_step[n]
        given = None if coarse_steps is None else coarse_steps[n]
        x, v = advance(x, v, f, gravity, held, given, record)
        xs.append(x)
        vs.append(v)
    return Trajectory(torch.stack(xs), torch.stack(vs))


def stepper(
    model: Any,
    like: Tensor,
    mu: Any,
    lam: Any,
    time_step: float,
    sweeps: int,
    rest_points: Tensor | None,
    density: Any,
    parameters: dict[str, Any] | None,
    layout: Layout,
    lookback: float = 1.0,
    **more: Any,
) -> Callable[..., tuple[Tensor, Tensor]]:
    """Do what is common to all steps of a run, and return the function
    (x, v, force, gravity, prescribed, given=(None, None), record=None) -> (x', v') that makes one.
    Arguments as in `step`; like decides dtype and device; layout is the model's `build_layout`; lookback: distance back
    along h v at which a vertex counts as having been, over h v, 1 where v = (x - x_prev) / h."""
    scene = build_scene(
        model,
        layout,
        like,
        mu=mu,
        lam=lam,
        time_step=time_step,
        rest_points=rest_points,
        density=density,
        parameters=parameters,
        **more,
    )
    energies, bound = energies_of_sweeps(scene, elsewhere=("friction",))
    renew = bound.renew if bound is not None else lambda state: None
    energies += floor_friction(scene, energies)
    masses = color_masses(scene)
    correct, rigid = Correction(scene, energies), getattr(model, "rigid_bodies", None)
    shear, bulk = rates(scene)
    stiffer = replace(scene, mu=scene.mu + shear, lam=scene.lam + bulk)
    couplings = bound.couplings if bound is not None else None
    coarse = None
    if getattr(model, "coarse", None) is not None:  # which has the couplings themselves, not their bound
        coarse = Coarse(stiffer, [e for e in energies if e is not couplings],
                        couplings=() if couplings is None else couplings.energies)  # fmt: skip
    last = min(model.relaxation, 1.0) if correct.bodies or coarse is not None else model.relaxation

    def advance(
        x: Tensor,
        v: Tensor,
        force: Any,
        gravity: Any,
        prescribed: Any,
        coarse_steps: Tensor | None = None,
        record: list[Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        y = predictor(scene, x, v, force, gravity, prescribed)
        inertial = torch.where(model.pinned[:, None], y, x + time_step * _slowed(scene, v))
        x_prev, y, inertial = (a.transpose(-1, -2).contiguous() for a in (x, y, inertial))
        for energy in energies:
            if isinstance(energy, Viscosity):
                energy.begin(x_prev)
        check_start(energies, x_prev)
        renew(y)
        begun = _start(scene, energies, x_prev, inertial if model.starts_from == "inertia" else y)
        if model.starts_from == "auto":
            begun = _lower(scene, energies, begun, _start(scene, energies, x_prev, inertial), y, x_prev, correct.others)
        held = []
        for body in correct.bodies:
            extrapolated, fraction = correct.extrapolation(body, take(x_prev, body), take(inertial - x_prev, body),
                                                           lookback)  # fmt: skip
            if rigid is not None and bool(rigid.mask[body[0]]):
                extrapolated, fraction = take(x_prev, body), torch.ones_like(fraction)
            begun, held = put(begun, body, extrapolated), [*held, fraction < 1]
        state = correct(begun, y, x_prev)
        if sweeps * min(model.relaxation, 1.0) >= 2 and any(bool(h.any()) for h in held):
            state = _apart(scene, energies, state, _start(scene, energies, x_prev, y), y, x_prev, correct.bodies, held)

        # with couplings free bodies are corrected before each sweep but the first, unless coarsely
        begun_sweeps, between = [], couplings is not None and (coarse is None or rigid is not None)

        def swept(state: Tensor, count: int, ends: bool) -> Tensor:
            if bound is not None and count > 1:
                for n in range(count):
                    state = swept(state, 1, ends and n + 1 == count)
                return state
            if bound is not None and count:
                renew(state)
                state = correct(state, y, x_prev) if begun_sweeps and between else state
                begun_sweeps.append(True)
            renew(state)
            usual = max(count - 1, 0) if ends else count
            state = run_sweeps(scene, energies, masses, y, state, x_prev, usual)
            return run_sweeps(scene, energies, masses, y, state, x_prev, count - usual, relaxation=last)

        state, lengths = _in_cycles(coarse, swept, sweeps, state, y, x_prev, coarse_steps, bound)
        if record is not None:
            record.append(lengths)
        renew(state)
        state = correct(state, y, x_prev)
        x_new = state.transpose(-1, -2).contiguous()
        return x_new, (x_new - x) / time_step

    return advance


def _in_cycles(
    coarse: Coarse | None,
    swept: Callable[[Tensor, int, bool], Tensor],
    sweeps: int,
    state: Tensor,
    y: Tensor,
    x_prev: Tensor,
    steps: Tensor | None,
    bound: Bounds | None = None,
) -> tuple[Tensor, Tensor]:
    """All sweeps of a step. With corrections a sweep, then a correction and up to `every` sweeps, until all are done;
    or a correction alone.

    swept(state, count, ends): the state after so many sweeps, which end the step or do not. Returns the state and the
    lengths of the corrections [corrections, ..., bodies], which are `steps` if these are given.
    """
    cycles = [sweeps]
    lengths, matrix = [], y if coarse is None else coarse.begin(x_prev)
    refused = torch.zeros((), dtype=torch.int64, device=y.device)
    left = sweeps
    if coarse is not None:
        state, left = swept(state, min(sweeps, 1), sweeps == 1), sweeps - min(sweeps, 1)
        count = coarse.scene.model.coarse.corrections(sweeps)
        most = coarse.scene.model.coarse.every
        cycles = [min(most, left - n * most) for n in range(count)]
    for n, count in enumerate(cycles):
        if coarse is not None:
            given = None if steps is None else steps[n]
            if bound is not None:  # each is an operator of its own, which knows of no refusal before it
                bound.renew(state)
                refused = torch.zeros_like(refused)
            state, s = coarse.correct(state, y, x_prev, matrix, given, refused >= REFUSALS)
            refused = refused + (s == 0)
            lengths.append(s)
        left -= count
        state = swept(state, count, left == 0)
    return state, torch.stack(lengths) if lengths else y.new_zeros((0,))


def color_masses(scene: Scene) -> list[Tensor]:
    """Masses of the vertices of each color, [..., 1, n]."""
    return [scene.mass[..., color.vertices].unsqueeze(-2) for color in scene.layout.colors]


def predictor(scene: Scene, x: Tensor, v: Tensor, force: Any, gravity: Any, prescribed: Any) -> Tensor:
    h, pinned = scene.time_step, scene.model.pinned
    acceleration = _slowed(scene, scene.tensor(gravity))
    if force is not None:
        # A pinned vertex may have no mass; its predictor is overwritten below.
        mass = torch.where(pinned & (scene.mass == 0), 1.0, scene.mass)
        acceleration = acceleration + scene.tensor(force) / mass.unsqueeze(-1)
    y = x + h * _slowed(scene, v) + h**2 * acceleration
    return torch.where(pinned.unsqueeze(-1), x if prescribed is None else scene.tensor(prescribed), y)


def _slowed(scene: Scene, value: Tensor) -> Tensor:
    """Velocities and accelerations with drag."""
    return value if scene.slowing is None else scene.slowing * value


def check_start(energies: list[Any], x: Tensor) -> None:
    """Raises ValueError where a filter has no admissible step from x [..., 3, V]."""
    for energy in energies:
        if hasattr(energy, "check_start"):
            energy.check_start(x.detach())


def _start(scene: Scene, energies: list[Any], x: Tensor, y: Tensor) -> Tensor:
    """Start of the sweep: y, or with filters what they leave of the way from x to y."""
    if not any(hasattr(energy, "start") for energy in energies):
        return y
    return torch.where(scene.model.pinned, y, x + started(energies, x, y - x))


def _lower(scene: Scene, energies: list[Any], one: Tensor, two: Tensor, y: Tensor, x_prev: Tensor, bodies: list[Tensor]
           ) -> Tensor:  # fmt: skip
    """Of two states the one that has, for each body, the lower incremental potential; the first where they are equal.
    Bodies do not see each other, so the whole scene's potential with one body exchanged decides."""
    out = one
    for body in bodies:
        with torch.no_grad():
            lower = _increase(scene, energies, one, put(one, body, take(two, body)), y, x_prev) < 0
        out = torch.where(lower[..., None, None], put(out, body, take(two, body)), out)
    return out


def _apart(scene: Scene, energies: list[Any], one: Tensor, two: Tensor, y: Tensor, x_prev: Tensor,
           bodies: list[Tensor], held: list[Tensor]) -> Tensor:  # fmt: skip
    """Two for each body that planes hold back, is soft within a step and has the lower potential there, else one."""
    elastic, out = [energy for energy in energies if isinstance(energy, StableNeoHookean)], one

    def of_tets(x: Tensor) -> Tensor:
        return sum(energy.of_tets(x) for energy in elastic)  # pyright: ignore[reportReturnType]

    for body, back in zip(bodies, held, strict=True):
        with torch.no_grad():
            exchanged = put(one, body, take(two, body))
            displacement, none = exchanged - one, torch.zeros_like(one[..., 0, 0])
            square = scene.mass * (displacement**2).sum(-2)
            inertia = torch.stack([square[..., corner] for corner in scene.layout.tets]).sum(0)
            size = weighed = none
            if elastic:
                # the energy at one, and its slope
                line = torch.func.jvp(of_tets, (one.detach(),), (displacement,))
                bend = 2 * (of_tets(exchanged) - line[0] - line[1])  # d . K d, K averaged over the way
                size = bend.abs().sum(-1)
                weighed = torch.where(inertia > 0, bend**2 / inertia, 0.0).sum(-1)
            parts = back & (weighed <= SOFT * size) & (_increase(scene, energies, one, exchanged, y, x_prev) < 0)
        out = torch.where(parts[..., None, None], put(out, body, take(two, body)), out)
    return out


def _increase(scene: Scene, energies: list[Any], one: Tensor, two: Tensor, y: Tensor, x_prev: Tensor) -> Tensor:
    """By how much the incremental potential of the state two lies above that of one, [...]."""

    def potential(x: Tensor) -> Tensor:
        total = (scene.mass / 2 * ((x - y) ** 2).sum(-2)).sum(-1)
        return total + sum(energy.energy(x, x_prev) for energy in energies)

    return potential(two) - potential(one)


def started(energies: list[Any], x: Tensor, step: Tensor) -> Tensor:
    """Admissible part of a step [..., 3, n] from x [..., 3, n] at the start."""
    for energy in energies:
        if hasattr(energy, "start"):
            step = energy.start(x, step)
    return step


def filtered(energies: list[Any], x: Tensor, step: Tensor) -> Tensor:
    """As much of a step [..., 3, n] from x [..., 3, n] as every filter allows."""
    limits = [energy.limit(x, step) for energy in energies if hasattr(energy, "limit")]
    if not limits:
        return step
    least = torch.stack(torch.broadcast_tensors(*limits)).min(0).values if len(limits) > 1 else limits[0]
    return step * least.unsqueeze(-2)


def run_sweeps(
    scene: Scene,
    energies: list[Any],
    masses: list[Tensor],
    y: Tensor,
    state: Tensor,
    x_prev: Tensor,
    sweeps: int,
    limits: Tensor | None = None,
    relaxation: float | None = None,
) -> Tensor:
    """The state [..., 3, V] after `sweeps` sweeps of all colors toward the predictor y [..., 3, V].

    masses: `color_masses`. x_prev: start of the step, for lagged terms. limits [sweeps, ..., 1, V]: what is let through
    of each update. relaxation: None for the Model's.
    """
    targets = [take(y, color.vertices) for color in scene.layout.colors]
    for n in range(sweeps):
        limit = None if limits is None else limits[n]
        for k, color in enumerate(scene.layout.colors[: scene.layout.swept]):
            if color.vertices.numel():
                state = _update_color(scene, energies, k, masses[k], targets[k], state, x_prev, limit, relaxation)
    return state


def _update_color(
    scene: Scene,
    energies: list[Any],
    k: int,
    mass: Tensor,
    y: Tensor,
    state: Tensor,
    x_prev: Tensor,
    limit: Tensor | None,
    relaxation: float | None,
) -> Tensor:
    """Newton update of all vertices of color k: H d = -g, saturate, relax, filter, limit, write."""
    model, vertices = scene.model, scene.layout.colors[k].vertices
    x = take(state, vertices)
    diagonal = (mass + model.regularization).expand_as(x[..., :1, :])
    no = torch.zeros_like(diagonal)
    system = torch.cat((mass * (x - y), diagonal, no, no, diagonal, no, diagonal), -2)
    for energy in energies:
        system = system + energy.block(k, state, x_prev)
    gradient, hessian = system.split((3, 6), -2)
    law = next((e for e in energies if isinstance(e, Law) and not e.density.quadratic), None)
    if law is not None or any(getattr(e, "counts_negative", False) for e in energies):
        hessian = (
            hessian + _shift(hessian, mass + model.regularization) * hessian.new_tensor([1, 0, 0, 1, 0, 1])[:, None]
        )
    update = raw = -solve6(hessian, gradient)
    if model.saturation is not None:
        update = update * _saturation(update, model.saturation).unsqueeze(-2)
    factor = model.relaxation if relaxation is None else relaxation
    if factor != 1.0:
        update = factor * update
    update = filtered(energies, x, update)
    if law is not None:
        update = _lowering(energies, law, k, mass, y, state, x_prev, update).unsqueeze(-2) * update
    elif all(getattr(e, "exact", True) for e in energies) and any(hasattr(e, "limit") for e in energies):
        fraction = _descending(energies, hessian, raw, update, x, take(x_prev, vertices), model.regularization)
        update = fraction.unsqueeze(-2) * update
    if limit is not None:
        update = take(limit, vertices) * update
    return put(state, vertices, x + update)


@torch.no_grad()
def _descending(energies: list[Any], hessian: Tensor, raw: Tensor, update: Tensor, x: Tensor, x_prev: Tensor, tau: float
                ) -> Tensor:  # fmt: skip
    """The largest of 1, 1/2, ... 1/128, or 0, for which no update of a color raises its vertex's own potential; 1 where
    no barrier acts, [..., n]. The update is t raw, which solves H raw = -g: what has no barrier is quadratic in one
    vertex. x, x_prev: of the color."""
    barriers = [energy for energy in energies if hasattr(energy, "limit")]
    whole, square = _square(hessian, raw), dot(raw, raw)
    own, ratio = whole - tau * square, dot(raw, update) / torch.where(square > 0, square, 1.0)
    near: Any = sum(((b.gap(x) < b.dhat) | (b.gap(x + update) < b.dhat)).any(-2) for b in barriers) > 0
    fraction, found = torch.ones_like(near + whole), torch.zeros_like(near + whole, dtype=torch.bool)
    for _ in range(HALVINGS):
        t, step = fraction * ratio, fraction.unsqueeze(-2) * update
        increase, size = t**2 / 2 * own - t * whole, t**2 / 2 * own + t * whole
        for barrier in barriers:
            change, of_terms = barrier.change(x, step, x_prev)
            increase, size = increase + change, size + of_terms
        found = found | ~(increase > ROUNDING * torch.finfo(x.dtype).eps * size)
        fraction = torch.where(found, fraction, fraction / 2)
    return torch.where(near, torch.where(found, fraction, 0.0), 1.0)


@torch.no_grad()
def _lowering(energies: list[Any], law: Law, k: int, mass: Tensor, y: Tensor, state: Tensor, x_prev: Tensor,
              update: Tensor) -> Tensor:  # fmt: skip
    """The same for a law that is not quadratic in one vertex, from the whole potential of each vertex of color k; that
    of pairs, friction and viscosity by their gradients and blocks."""
    vertices = law.scene.layout.colors[k].vertices
    x = take(state, vertices)
    others = [e for e in energies if e is not law]
    modelled = [e for e in others if isinstance(e, FloorFriction | Viscosity) or not hasattr(e, "terms")]
    blocks = [e.block(k, state, x_prev).split((3, 6), -2) for e in modelled]

    def of_vertices(at: Tensor) -> list[Tensor]:
        parts = [e.terms(at, x_prev) for e in others if e not in modelled]
        return [at.new_zeros(*at.shape[:-2], at.shape[-1]).index_add(-1, vertex, terms)[..., vertices]
                for terms, vertex in parts]  # fmt: skip

    before, found = of_vertices(state), torch.zeros_like(x[..., 0, :], dtype=torch.bool)
    fraction = torch.ones_like(x[..., 0, :])
    for _ in range(HALVINGS):
        step = fraction.unsqueeze(-2) * update
        slope, bend = mass[..., 0, :] * dot(step, x - y), mass[..., 0, :] / 2 * dot(step, step)
        of_tets, size = law.change(k, state, step)
        increase, size = of_tets + slope + bend, size + slope.abs() + bend
        for one, two in zip(before, of_vertices(put(state, vertices, x + step)), strict=True):
            increase, size = increase + two - one, size + one.abs() + two.abs()
        for gradient, hessian in blocks:
            down, up = dot(gradient, step), _square(hessian, step) / 2
            increase, size = increase + down + up, size + down.abs() + up.abs()
        found = found | (increase <= ROUNDING * torch.finfo(x.dtype).eps * size) & torch.isfinite(size)
        fraction = torch.where(found, fraction, fraction / 2)
    return torch.where(found, fraction, 0.0)


LEAST_CURVATURE, SHIFTS = 1 / 64, 8  # of the mass; twins in csrc/sweep/vertex.h


@torch.no_grad()
def _shift(hessian: Tensor, mass: Tensor) -> Tensor:
    """The least of some powers of two [kg] that makes each block positive definite, [..., 1, n]; mostly 0."""
    xx, xy, xz, yy, yz, zz = hessian.split(1, -2)
    least = LEAST_CURVATURE * mass

    def is_definite(shift: Tensor) -> Tensor:
        a, b, c, rounding = xx + shift, yy + shift, zz + shift, 16 * torch.finfo(xx.dtype).eps
        first = torch.where(a > 0, a, 1.0)
        second, t = b - xy * xy / first, yz - xy * xz / first
        third = c - xz * xz / first - t * t / torch.where(second > 0, second, 1.0)
        return (a > 0) & (second + rounding * yy.abs() > 0) & (third + rounding * zz.abs() > 0)

    size = (xx.abs() + yy.abs() + zz.abs()) + 2 * (xy.abs() + xz.abs() + yz.abs())
    shift, trial = torch.zeros_like(xx), 0.0625 * torch.exp2(torch.floor(torch.log2(size)))
    if bool(is_definite(-least).all()):
        return shift
    for n in range(SHIFTS):
        shift = torch.where(is_definite(shift - least), shift, trial * 2**n)
    return shift


def _square(hessian: Tensor, d: Tensor) -> Tensor:
    """d . H d, H as xx, xy, xz, yy, yz, zz [..., 6, n]."""
    xx, xy, xz, yy, yz, zz = hessian.unbind(-2)
    rows = [torch.stack(row, -2) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
    return sum(d[..., i, :] * dot(rows[i], d) for i in range(3))  # pyright: ignore[reportReturnType]


def _saturation(update: Tensor, limit: float) -> Tensor:
    """s = c / (|d| + c + eps); the derivative of |d| at 0 is taken as 0."""
    square = dot(update, update)
    moves = square > 0
    length = torch.where(moves, torch.where(moves, square, 1.0).sqrt(), 0.0)
    return limit / (length + limit + SATURATION_EPS)


def incremental_potential(
    model: Any,
    x: Tensor,
    y: Tensor,
    mu: Any,
    lam: Any,
    time_step: float,
    x_prev: Tensor | None = None,
    *,
    rest_points: Tensor | None = None,
    density: Any = None,
    parameters: dict[str, Any] | None = None,
) -> Tensor:
    """G(x) = 1/2 sum m |x - y|^2 + h^2 E(x), h^2-scaled [kg m^2], shape x.shape[:-2].

    x, y: positions and predictor [m], [..., V, 3]; mu, lam [Pa] as in `step`. E is elastic energy (zero at rest) plus
    barriers (inf at a gap <= 0 of an unpinned vertex) and anchors. x_prev: state at the start of the step, for the
    lagged damping of a floor; None stands for x itself, where the damping vanishes.
    """
    scene = build_scene(
        model,
        build_layout(model),
        x,
        mu=mu,
        lam=lam,
        time_step=time_step,
        rest_points=rest_points,
        density=density,
        parameters=parameters,
    )
    rows = x.transpose(-1, -2)
    lagged = rows if x_prev is None else x_prev.transpose(-1, -2)
    total = (scene.mass / 2 * ((x - y) ** 2).sum(-1)).sum(-1)
    for energy in build_energies(scene):
        total = total + energy.energy(rows, lagged)
    return total


def residual(
    model: Any, x: Tensor, y: Tensor, mu: Any, lam: Any, time_step: float, *args: Any, **options: Any
) -> Tensor:
    """dG/dx [kg m], [..., V, 3], by autograd, detached; arguments as in `incremental_potential`. Zero at unpinned
    vertices of a converged step; at a pinned vertex it is h^2 times the force that holds it (for y = x there)."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        total = incremental_potential(model, x, y, mu, lam, time_step, *args, **options)
        (gradient,) = torch.autograd.grad(total.sum(), x)
    return gradient
