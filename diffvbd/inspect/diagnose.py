"""Checks of a state, and of the step that led to it, against the limits of docs/numerics.md. Plain torch; sweeps only
where the error of the step is asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.linalg import cross

from .._common.checks import check_bool, check_broadcast, check_tensor, name_value
from .._common.constants import ELASTIC
from .._common.messages import percent
from .._common.messages import warn as say
from ..model.material import moduli_of
from ..model.model import Model
from ..model.solver import VBD, ImplicitEuler
from ..model.system import System, system_of
from ..step.arguments import (
    LOADS,
    MODULI,
    Given,
    acceleration_of,
    check_prescribed,
    check_state,
    given_of,
    prepare,
    refuse_non_finite,
)
from ..step.damping import damped
from ..step.law import in_scenes
from ..step.predict import begin
from ..step.residual import (
    UNBALANCED,
    UNBALANCED_FRICTION,
    ErrorEstimate,
    Norm,
    contact_of_step,
    error_of,
    friction_left_over,
    left_over,
    of_bodies,
    of_scenes,
    potential_of_step,
    rounding,
    share,
)
from ..step.warnings import HEAVY_REGULARIZATION, STABLE_RELAXATION
from .forces import check_previous, wide, widen

# Limits with their measurements in docs/numerics.md
SATURATION_TOO_LARGE = 1.0  # c over the mean edge: one update may then turn a tet inside out
SATURATION_TOO_SMALL = 0.01  # c over the mean edge: 20 sweeps no longer reach a large deformation
RESOLUTION = 1e-5  # rounding of a position over the shortest edge; a gradient's error is 6 to 22 times that
LARGE_STRAIN = 100.0  # Green strain; a gradient keeps 11 digits there and loses them with a power of the strain
INACCURATE = 0.01  # estimated error of a body over its motion in the step
NEGLIGIBLE = 1e-5  # error over the mean edge, below which it is none: a body at rest has motions as small as its errors


@dataclass(frozen=True)
class Diagnosis:
    """Result of :func:`diffvbd.diagnose`. Numbers are the worst over scenes; None where an argument was not given.

    Attributes:
        messages: What crosses a limit, one sentence each; empty when nothing does.
        collapsing: Tets inside the F = 0 well, bool, shape [..., T].
        inverted: Tets with J <= 0, bool, shape [..., T].
        nonfinite: Vertices whose position is NaN or Inf, bool, shape [..., V].
        smallest_volume_ratio: min J [-].
        largest_strain: max Frobenius norm of the Green strain (F^T F - I) / 2 [-].
        collapse_margin: min |F| / (sqrt(3) s*) [-]; a tet is lost below 1.
        resolution: Spacing of the Model's numbers at the largest coordinate over the shortest edge [-]. float32
            computes about a point of each body, but stores positions as they are given.
        courant: Largest number of elements that a pressure wave crosses in one step [-].
        stiffness: Largest ratio of the elastic to the inertial part of a vertex block [-].
        unbalanced: Left-over force of the step, |dG/dx| / h^2, over its inertial and all other forces (2-norms) [-];
            zero where no more is left than rounding leaves.
        residuals: The same for each body of ``model.body``, shape [..., bodies].
        friction_residuals: Of a Model with Friction, what is left over along the contact of each body, over the most
            that friction can bear there [-], shape [..., bodies]; of forces summed where friction acts.
        errors: Estimate for each body, shapes [..., bodies], of a step without contact and friction.
        relative_error: The largest estimated error over motion [-], of bodies whose error is no rounding; NaN where a
            step has too few sweeps to tell.
    """

    messages: list[str]
    collapsing: Tensor = field(repr=False)
    inverted: Tensor = field(repr=False)
    nonfinite: Tensor = field(repr=False)
    smallest_volume_ratio: float
    largest_strain: float
    collapse_margin: float
    resolution: float
    courant: float | None
    stiffness: float | None
    unbalanced: float | None
    residuals: Tensor | None = field(default=None, repr=False)
    friction_residuals: Tensor | None = field(default=None, repr=False)
    errors: ErrorEstimate | None = field(default=None, repr=False)
    relative_error: float | None = None

    @property
    def ok(self) -> bool:
        return not self.messages

    def __str__(self) -> str:
        rows = [
            ("collapsing tets", int(self.collapsing.sum())),
            ("inverted tets", int(self.inverted.sum())),
            ("smallest J", self.smallest_volume_ratio),
            ("largest Green strain", self.largest_strain),
            ("|F| over the collapse radius", self.collapse_margin),
            ("rounding over shortest edge", self.resolution),
            ("elements a wave crosses per step", self.courant),
            ("elastic over inertial block", self.stiffness),
            ("left-over force of the step", self.unbalanced),
            ("left-over force of the worst body", _worst(self.residuals)),
            ("left-over share of friction", _worst(self.friction_residuals)),
            ("error over motion, worst body", self.relative_error),
        ]
        lines = [f"{name:<34}{value:.4g}" for name, value in rows if value is not None]
        return "\n".join(lines + [f"warning: {message}" for message in self.messages])


def diagnose(
    model: Model,
    x: Tensor,
    solver: VBD | None = None,
    *,
    previous: tuple[Tensor, Tensor] | None = None,
    warn: bool = True,
    **inputs: Any,
) -> Diagnosis:
    """What makes a result unreliable: collapsed or inverted tets, lost digits, safeguards out of scale, too few
    sweeps. Not differentiable; call it on a first and a last frame, not in every step.

    Args:
        model: The scene.
        x: Positions [m], shape [..., V, 3].
        solver: Of the scene, or of the step that led to ``x``; needed for the Courant number, the stiffness and what
            follows from ``previous``.
        previous: State (x, v) from which one step led to ``x``; needed for the left-over force and, without contact and
            friction, for an estimate of the step's error, for which it is swept again.
        inputs: As in :func:`diffvbd.step`, those of that step.
        warn: Also emit each message as a UserWarning.

    Returns:
        A :class:`diffvbd.results.Diagnosis`; print it for a table.

    Raises:
        ValueError, TypeError: As :func:`diffvbd.step`; also for ``previous`` without a solver.

    The F = 0 well: with s* the root of s^3 + s^2 + s = mu / (mu + lam), the elastic stress pulls every F with
    |F| < sqrt(3) s* towards 0 when lam >= 0 (docs/numerics.md, with the proof).
    """
    lead = check_state(model, x, x)
    check_bool("warn", warn)
    system = system_of(model, VBD(1.0, 0) if solver is None else solver)
    given = given_of(model, inputs)
    mu, lam, young, poisson = (given.material[name] for name in MODULI)
    if model.law is not None:  # its moduli at rest
        prepared = prepare(system, lead, given, time_step=1.0, sweeps=0)
        mu, lam = (in_scenes(m, lead) for m in (prepared.mu, prepared.lam))
    else:
        mu, lam = moduli_of(model, lead, mu, lam, young, poisson) if model.energy_mask & ELASTIC else (0.0, 0.0)
    for name, value in (("mu", mu), ("lam", lam)):
        value = check_broadcast(name, check_tensor(name, value, model._mass), (*lead, model.num_tets), len(lead))
        name_value(name, "finite values", value, torch.isfinite(value))
    check_previous(model, previous, x, solver)
    errors = unbalanced = residuals = friction = None
    if previous is not None and solver is not None:
        check_prescribed(system, given.loads["prescribed"], previous[0])
        loads = {name: given.loads[name] for name in LOADS}
        refuse_non_finite(system, loads)
        unbalanced, residuals, friction = _balance(model, x, previous, solver, given)
        estimable = not (model.touches or model._renews)
        if estimable and solver.sweeps and isinstance(solver.integrator, ImplicitEuler):
            prepared = prepare(system, lead, given, time_step=solver.time_step, sweeps=solver.sweeps)
            prepared = damped(system, prepared, previous[0])
            errors = error_of(system, *previous, prepared, **loads)
    state = x.detach().to(torch.float64)
    mu, lam = (_as(a, state) for a in (mu, lam))
    points = torch.from_numpy(model.mesh.points.copy()).to(state)
    nonfinite = ~torch.isfinite(state).all(-1)
    gradients, volume = _shape_gradients(points[model.tets])
    edges = state[..., model.tets[:, 1:], :] - state[..., model.tets[:, :1], :]  # [..., T, 3, 3], rows are edges
    f = (edges[..., :, :, None] * gradients[:, 1:, None, :]).sum(-3)  # F_ij = sum_a e_ai (grad N_a)_j
    norm = f.square().sum((-2, -1)).sqrt()
    det = (cross(f[..., 0, :], f[..., 1, :]) * f[..., 2, :]).sum(-1)
    green = 0.5 * ((f[..., :, :, None] * f[..., :, None, :]).sum(-3) - torch.eye(3, dtype=f.dtype, device=f.device))
    critical = collapse_stretch(mu, lam) if model.law is None else torch.zeros_like(mu)  # a well of StableNeoHookean
    margin = norm / (3**0.5 * critical)
    edge = _edge_lengths(points, model.tets)
    courant = stiffness = None
    if solver is not None:
        h = solver.time_step
        stiffness = _largest(h * h * _block_ratio(model, gradients, volume, mu, lam))
        speed = ((lam + 2 * mu) / model.density.to(state)).clamp(min=0).sqrt()
        height = 1 / gradients.square().sum(-1).amax(-1).sqrt()  # the shortest of a tet's four
        courant = _largest(h * speed / height)
    spacing = torch.finfo(model.dtype).eps * _largest(state.abs())
    result = Diagnosis(
        messages=[],
        collapsing=margin < 1,
        inverted=det <= 0,
        nonfinite=nonfinite,
        smallest_volume_ratio=-_largest(-det) if det.numel() else 1.0,
        largest_strain=_largest(green.square().sum((-2, -1)).sqrt()),
        collapse_margin=-_largest(-margin) if margin.numel() else float("inf"),
        resolution=spacing / float(edge.min()) if edge.numel() else 0.0,
        courant=courant,
        stiffness=stiffness,
        unbalanced=unbalanced,
        residuals=residuals,
        friction_residuals=friction,
        errors=errors,
        relative_error=None if errors is None else _largest(_relative(errors, edge)),
    )
    result.messages.extend(_state_messages(system, result) + _error_messages(system, result, edge))
    result.messages.extend(_setting_messages(system, mu, lam, edge))
    if warn:
        for message in result.messages:
            say(f"diffvbd: {message}")
    return result


def collapse_stretch(mu: Tensor, lam: Tensor) -> Tensor:
    """s*, the uniform stretch below which a tet collapses to a point: the root of s^3 + s^2 + s = mu / (mu + lam).

    Args:
        mu, lam: [Pa], broadcast together.

    Returns:
        s* [-] of that shape: 0 at mu = 0, 0.343 at mu = lam, 0.544 at lam = 0.
    """
    total = mu + lam
    ratio = torch.where(total > 0, mu / torch.where(total > 0, total, torch.ones_like(total)), torch.zeros_like(total))
    s = ratio / (1 + ratio)  # Newton on a convex increasing cubic converges from any s >= 0
    for _ in range(60):
        s = s - (((s + 1) * s + 1) * s - ratio) / ((3 * s + 2) * s + 1)
    return s


def _shape_gradients(corners: Tensor) -> tuple[Tensor, Tensor]:
    """grad N_a [1/m] of each tet, [T, 4, 3], and volumes [m^3]."""
    e1, e2, e3 = (corners[:, a] - corners[:, 0] for a in (1, 2, 3))
    n1, n2, n3 = cross(e2, e3), cross(e3, e1), cross(e1, e2)
    six = (e1 * n1).sum(-1)
    return torch.stack([-(n1 + n2 + n3), n1, n2, n3], 1) / six[:, None, None], six / 6


def _edge_lengths(points: Tensor, tets: Tensor) -> Tensor:
    edges = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    return torch.stack([(points[tets[:, a]] - points[tets[:, b]]).norm(dim=-1) for a, b in edges], -1)


def _block_ratio(model: Model, gradients: Tensor, volume: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Largest eigenvalue bound of each active vertex's elastic block at rest over its mass [1/s^2], [..., V]."""
    stiffness = (volume * (2 * mu + lam))[..., None] * gradients.square().sum(-1)  # [..., T, 4]
    shape = (*stiffness.shape[:-2], model.num_vertices)
    total = stiffness.new_zeros(shape).index_add(-1, model.tets.reshape(-1), stiffness.flatten(-2))
    return total[..., model.color_vertices] / model.mass.to(total)[model.color_vertices]


def _balance(
    model: Model, x: Tensor, previous: tuple[Tensor, Tensor], solver: VBD, inputs: Given
) -> tuple[float, Tensor, Tensor | None]:
    """``unbalanced``, ``residuals`` and ``friction_residuals`` of a :class:`diffvbd.results.Diagnosis`."""
    given = widen(model, x, solver, inputs)
    double, prepared = given.model, given.prepared
    norm, lead = of_bodies(double), x.shape[:-2]
    if not all(bool(torch.isfinite(t).all()) for t in (x, *previous)):
        unknown = norm(x.reshape(lead.numel(), *x.shape[-2:])).double().fill_(torch.nan)
        unknown = unknown.reshape(*lead, *unknown.shape[1:])
        return float("nan"), unknown, None
    with torch.no_grad():
        x0, v0 = (t.detach().double() for t in previous)
        force, gravity, prescribed = (wide(inputs.loads[name]) for name in LOADS)
        prepared = damped(double, prepared, x0)
        begun = begin(double, x0, v0, prepared, force, acceleration_of(gravity, x0), prescribed)
        contact = contact_of_step(double, begun, prepared, (given.before, given.colliders) if model.touches else None)
        at = potential_of_step(double, x.detach().double().reshape(begun.y.shape), begun, prepared, contact)
        eps = torch.finfo(model.dtype).eps

        def left_of(norm: Norm) -> Tensor:
            left, whole = left_over(at, norm)
            return share(torch.where(left <= rounding(at, norm, eps), 0, left), whole)

        bodies = left_of(norm)
        shape = (*lead, *bodies.shape[1:])
        friction = None if model.friction is None else friction_left_over(at).reshape(shape)
        return _largest(left_of(of_scenes)), bodies.reshape(shape), friction


def _as(value: Any, like: Tensor) -> Tensor:
    """Numbers or a tensor in like's dtype; python numbers do not pass through float32."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).detach()


def _largest(values: Tensor) -> float:
    return float(values.max()) if values.numel() else 0.0


def _worst(values: Tensor | None) -> float | None:
    return None if values is None else _largest(values)


def _place(values: Tensor) -> str:
    """The body of the largest of values [..., bodies]."""
    *scene, body = (torch.isnan(values) | (values == values.max())).nonzero()[0].tolist()
    return f"body {body}" + (f" of scene {scene}" if scene else "")


def _state_messages(model: System, result: Diagnosis) -> list[str]:
    out = []
    if bool(result.nonfinite.any()):
        first = result.nonfinite.nonzero()[0].tolist()
        out.append(f"{int(result.nonfinite.sum())} positions are NaN or Inf, the first at {first}; run again inside "
                   "diffvbd.testing.debug_checks() to learn where they appear")  # fmt: skip
    if bool(result.collapsing.any()):
        first = result.collapsing.nonzero()[0].tolist()
        out.append(f"{int(result.collapsing.sum())} tets are inside the F = 0 well (|F| < sqrt(3) s*), the first at "
                   f"{first}: the material pulls them to a point and nothing brings them back")  # fmt: skip
    if bool(result.inverted.any()):
        out.append(
            f"{int(result.inverted.sum())} tets are inverted (J <= 0), smallest J {result.smallest_volume_ratio:.3g}"
        )
    if result.largest_strain > LARGE_STRAIN:
        out.append(f"the largest Green strain is {result.largest_strain:.3g}: gradients lose digits beyond "
                   f"{LARGE_STRAIN:g}")  # fmt: skip
    if result.resolution > RESOLUTION:
        out.append(f"positions are rounded to {result.resolution:.1e} of the shortest edge: move the scene to the "
                   "origin, or use float64")  # fmt: skip
    # beside contact one body may be far from converged while the forces of others hide it
    body = result.residuals if model.touches else None
    worst = result.unbalanced if body is None else _largest(body)
    if worst is not None and not worst <= UNBALANCED:
        faster = ", or relaxation between 1.5 and 1.7" if model.relaxation < 1.5 and model.friction is None else ""
        of = "its forces" if body is None else f"the forces of {_place(body)}"
        out.append(f"the step left {percent(worst)} of {of} unbalanced: take more sweeps or a "
                   f"smaller time step{faster}")  # fmt: skip
    slip = result.friction_residuals
    if slip is not None and not _largest(slip) <= UNBALANCED_FRICTION:
        faster = ', subspace="coarse"' if model.coarse is None else ""
        out.append(f"friction has not converged: {percent(_largest(slip))} of what it can bear on {_place(slip)} is "
                   f"not balanced; take more sweeps, a smaller time step{faster} or a larger "
                   "Friction(velocity=)")  # fmt: skip
    return out


def _relative(errors: ErrorEstimate, edge: Tensor) -> Tensor:
    """Error over motion of each body, 0 where the error is none to speak of."""
    least = NEGLIGIBLE * float(edge.mean()) if edge.numel() else 0.0
    return torch.where(errors.error <= least, 0, errors.relative)


def _error_messages(model: System, result: Diagnosis, edge: Tensor) -> list[str]:
    if result.errors is None:
        return []
    relative = _relative(result.errors, edge)
    wrong = torch.where(relative > INACCURATE, relative, 0)  # without those that are NaN
    if not _largest(wrong):
        return []
    coarse = ', or subspace="coarse"' if model.coarse is None else ""
    return [f"the step ends about {percent(_largest(wrong))} of its motion from where it would converge, in "
            f"{_place(wrong)}; often three times as much: take more sweeps{coarse}"]  # fmt: skip


def _setting_messages(model: System, mu: Tensor, lam: Tensor, edge: Tensor) -> list[str]:
    unlimited = model.block == "paper" and model.saturation is None
    found = {
        "lam < -2/3 mu: the bulk modulus is negative and the rest state unstable": bool((3 * lam + 2 * mu < 0).any()),
        'block="paper" with lam < mu and no saturation: an update may raise the potential':
            unlimited and bool((lam < mu).any()),
        'block="paper" with relaxation above 1 and no saturation diverges on many scenes':
            unlimited and model.relaxation > 1,
        f"relaxation {model.relaxation:g} is above {STABLE_RELAXATION:g}: each step descends, but rollouts may grow":
            model.relaxation > STABLE_RELAXATION,
    }  # fmt: skip
    if edge.numel() and model.num_active:
        if model.saturation is not None:
            ratio = model.saturation / float(edge.mean())
            size = f"saturation {model.saturation:g} m is {ratio:.3g} mean edges"
            found[f"{size}: it never limits an update of this mesh"] = ratio > SATURATION_TOO_LARGE
            found[f"{size}: sweeps move by that little"] = ratio < SATURATION_TOO_SMALL
        lightest = float(model.mass[model.color_vertices].min())
        if model.regularization > HEAVY_REGULARIZATION * lightest:
            size = f"regularization {model.regularization:g} kg is {model.regularization / lightest:.3g} of the"
            found[f"{size} lightest vertex: it slows every update"] = True
    return [message for message, applies in found.items() if applies]
