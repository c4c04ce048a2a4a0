"""Residual of a step: the forces that it leaves unbalanced, contact included."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.context import replaced
from .._common.messages import page
from ..adjoint.contact import ContactPotential, StepContact
from ..adjoint.potential import IncrementalPotential
from ..model.material import shape_gradients
from ..model.model import Model
from ..model.moving import moving_vertices
from ..model.system import System
from ..ops.sums import Rows, segment_sum
from ..ops.sweep import sweep
from .arguments import Prepared, acceleration_of, collider_state
from .coarse import COARSE_FIELDS, lengths_of, with_corrections
from .contact import outcomes
from .couplings import Coupled
from .integrators import Solve
from .predict import Begun, begin

ROUNDINGS = 0.25  # of block times position, below which a residual counts as zero: sweeps stall at 0.03 to 0.08, a
# corrected start in free fall at 0.15
UNBALANCED = 0.01  # left-over force over the forces of the step; at 0.014 a hanging bar rests 1.5 to 11 % off
UNBALANCED_FRICTION = 0.05  # of the most that friction can bear

Norm = Callable[[Tensor], Tensor]  # [B, V, n] -> [B, groups]


def contact_of_step(
    model: System, begun: Begun, prepared: Prepared, where: tuple[Tensor, Tensor] | None
) -> StepContact | None:
    """Contact of a step that has begun; where: collider points at its start and at its end, None without contact."""
    if where is None:
        return None
    (before, colliders), numbers = where, prepared.settings.numbers
    return StepContact(model, begun.data, prepared.parameters, colliders, before, begun.x_prev, begun.origin,
                       numbers.time_step, numbers.friction_eps)  # fmt: skip


def potential_of_step(
    model: System, x: Tensor, begun: Begun, prepared: Prepared, contact: StepContact | None
) -> IncrementalPotential:
    """The potential of a step that has begun, at x [B, V, 3], relative to the step's origin where there is one."""
    fields = begun.at(x).fields(model, prepared)
    if contact is None:
        return IncrementalPotential(model, x, fields, prepared.settings.numbers.time_step, prepared.averaged)
    return ContactPotential(model, x, fields, contact, prepared.averaged)


def of_scenes(values: Tensor) -> Tensor:
    """2-norms over a scene, [B, V, n] -> [B, 1]."""
    return ops.sum_to(values.square(), (len(values), 1, 1))[..., 0].sqrt()


def of_bodies(model: System) -> Norm:
    """2-norms over each body, [B, V, n] -> [B, bodies], bodies as in ``model.body``."""
    labels = model.derived("labels", lambda: model.body)
    count = model.derived("labelled", lambda: int(labels.max()) + 1 if labels.numel() else 0)

    def norm(values: Tensor) -> Tensor:
        squares = values.square().sum(-1)
        return squares.new_zeros(len(squares), count).index_add(1, labels, squares).sqrt()

    return norm


def moving(at: IncrementalPotential, forces: Tensor) -> Tensor:
    """Forces [B, V, 3] on what moves: none on pinned vertices, on a rigid body what moves it as a whole."""
    rigid, forces = at.model.rigid_bodies, at.free * forces
    return forces if rigid is None else rigid.balanced(at.x, at.mass[..., 0], forces)


def left_over(at: IncrementalPotential, norm: Norm) -> tuple[Tensor, Tensor]:
    """Left-over force, |M (x - y) + h^2 dE/dx|, and its scale, |M (x - y)| + |h^2 dE/dx| [kg m], over
    the vertices that are not pinned; both [B, groups]."""
    inertia, forces = moving(at, at.inertia()), moving(at, at.forces())
    return norm(inertia + forces), norm(inertia) + norm(forces)


def left_of_solve(model: System, before: tuple[Tensor, Tensor], end: Tensor, prepared: Prepared, given: dict[str, Any]
                  ) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The same of a solve that was executed, 0 left where that is no more than rounding leaves: of each scene, with
    contact of each body.

    Args:
        before: State (x, v) [..., V, 3] before it.  end: Positions after it.  given: Its arguments, as of advance().
    """
    with torch.no_grad(), torch.autocast(end.device.type, enabled=False):
        x, v = (t.detach() for t in before)
        acceleration = acceleration_of(given["gravity"], x)
        begun = begin(model, x, v, prepared, given["force"], acceleration, given["prescribed"]).detached()
        where = collider_state(model, x, given["colliders"], given["colliders_before"])
        end = end.detach().reshape(begun.y.shape)
        end = end if begun.origin is None else end - begun.origin
        at = potential_of_step(model, end, begun, prepared, contact_of_step(model, begun, prepared, where))
        norm = of_scenes if where is None else of_bodies(model)
        left, whole = left_over(at, norm)
        return torch.where(left <= rounding(at, norm), 0, left), whole


def rounding(at: IncrementalPotential, norm: Norm, eps: float | None = None) -> Tensor:
    """Share of it that rounding alone may leave [kg m], [B, groups]: a block times what rounds a position."""
    eps = torch.finfo(at.x.dtype).eps if eps is None else eps
    largest = at.x.abs().amax((-2, -1)) if at.x.shape[-2] else at.x.new_zeros(len(at.x))
    return ROUNDINGS * eps * largest[:, None] * norm(at.free * at.stiffness())


def share(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole, 0 where there is no whole."""
    return part / torch.where(whole > 0, whole, torch.ones_like(whole))


def friction_left_over(at: IncrementalPotential) -> Tensor:
    """Friction that the step left unbalanced along the contact of each body, over the most that it can bear there [-],
    [B, bodies]; 0 where it can bear nothing.

    Of forces summed over the vertices on which friction acts: what they leave to one another moves no body.
    """
    labels, count = at.model.body, at.model.derived("labelled", lambda: int(at.model.body.max()) + 1)
    sums = at.x.new_zeros((len(at.x), count, 3), dtype=torch.float64)
    if not isinstance(at, ContactPotential):
        return sums[..., 0]
    normal, friction = at.contact.on_vertices()
    acts = ((friction != 0).any(-1, keepdim=True) * at.free).double()
    left = acts * moving(at, at.inertia() + at.forces()).double() / at.h**2
    size = normal.norm(dim=-1, keepdim=True)
    along = (left * normal).sum(-1, keepdim=True) / torch.where(size > 0, size.square(), 1.0)
    force = sums.index_add(1, labels, left - along * normal).norm(dim=-1)
    friction = at.step_contact._number("friction")  # of two bodies the largest
    most = friction.reshape(len(friction), -1).amax(1)[:, None] * (acts * size)[..., 0]
    return share(force, torch.zeros_like(force).index_add(1, labels, most))


# --- how far a step ends from where it would converge, in the smooth motion of a body, by one e -----------------------

DEPENDENT = 1e-9  # of the largest singular value: below it a polynomial is a combination of the others
NO_MATTER = 0.01  # of what forces did in the step: below it, it is not asked whether rounding left the error
CHUNK = 2000  # tets that are summed at once
MOST_JOINED = 64  # bodies that one solve takes; farther ones count as held


class Unsolved(NamedTuple):
    """Of the body that a step left least balanced, or of one joined with it; root mean squares over its mass [m]."""

    scene: int
    body: int
    error: float  # what the next step keeps of e
    forced: float  # x' - (x + h v): what all forces did in the step


class _Functions(NamedTuple):
    """Of a body with n vertices and t tets."""

    vertices: Tensor  # int64 [n]
    tets: Tensor  # int64 [t], rows of the Model's
    rest: np.ndarray  # [n, 3]
    values: np.ndarray  # [n, f], zero where pinned


def _functions(model: System, body: int) -> _Functions:
    labels = model.body
    vertices = (labels == body).nonzero()[:, 0]
    rest = model._rest_points[vertices].double().cpu().numpy()
    low, high = rest.min(0), rest.max(0)
    x, y, z = ((rest - (low + high) / 2) / max(float((high - low).max()), 1e-300)).T
    terms = np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], 1)
    terms *= ~model._pinned[vertices].cpu().numpy()[:, None]
    left, size, _ = np.linalg.svd(terms, full_matrices=False)
    tets = (labels[model._topology[0][:, 0]] == body).nonzero()[:, 0]
    return _Functions(vertices, tets, rest, left[:, size > DEPENDENT * size[0]])


def _stiffness(model: System, of: _Functions, mu: Tensor, lam: Tensor) -> np.ndarray:
    """Q^T K Q at rest [N/m], [3 f, 3 f], the component first; mu, lam [1 | t]."""
    count, device = of.values.shape[1], mu.device
    values = torch.zeros(model.num_vertices, count, dtype=torch.float64, device=device)
    values[of.vertices] = torch.from_numpy(of.values).to(device)
    shear, bulk = torch.zeros(2, 3 * count, 3 * count, dtype=torch.float64, device=device)
    for first in range(0, len(of.tets), CHUNK):
        tets = model._topology[0][of.tets[first : first + CHUNK]]
        gradients, volume = shape_gradients(model._rest_points[tets].double())
        slopes = (gradients.mT @ values[tets]).flatten(1)  # of each function along each axis, [t, 3 f]
        means = slopes
        if (patches := model.patches) is not None:  # whose volumes lam acts on
            own = torch.unique(patches.label[of.tets[first : first + CHUNK]], return_inverse=True)[1]
            rows = Rows.of(own, int(own.max()) + 1)
            means = rows.gather(rows.sum((slopes * volume[:, None])[None]) / rows.sum(volume[None, :, None]))[0]
        for total, modulus, slope in ((shear, mu, slopes), (bulk, lam, means)):
            part = modulus if len(modulus) == 1 else modulus[first : first + CHUNK]
            total += (slope * (volume * part)[:, None]).T @ slope
    sheared, pressed = (m.reshape(3, count, 3, count).cpu().numpy() for m in (shear, bulk))
    out = pressed + sheared.transpose(2, 1, 0, 3)
    for c in range(3):
        out[c, :, c] += np.einsum("cfcg->fg", sheared)
    return out.reshape(3 * count, 3 * count)


def unsolved(model: System, solve: Solve, x: Tensor, known: dict[tuple[int, int], np.ndarray]) -> Unsolved | None:
    """Of the solve that ended a step at x [..., V, 3]; None where no more is left than rounding leaves.

    known: Stiffness of bodies, of a Model and material; filled.
    """
    given, prepared = solve.given, solve.prepared
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        begun = begin(model, solve.x, solve.v, prepared, given["force"], acceleration_of(given["gravity"], solve.x),
                      given["prescribed"])  # fmt: skip
        end = x.reshape(begun.y.shape)
        end = end if begun.origin is None else end - begun.origin
        where = collider_state(model, solve.x, given["colliders"], given["colliders_before"])
        try:
            at = potential_of_step(model, end, begun, prepared, contact_of_step(model, begun, prepared, where))
            inertia, elastic = moving(at, at.inertia()), moving(at, at.elastic())
            forces = moving(at, at.forces()) if model.vertex_energies or where is not None else elastic
        except ValueError:  # surfaces that touch; the next step says where
            return None
        left, norm, scene, body = inertia + forces, of_bodies(model), 0, 0
        bodies = model.derived("labelled", lambda: int(model.body.max()) + 1)
        if len(end) * bodies > 1:
            ratio = share(norm(left), norm(inertia) + norm(forces))
            scene, body = divmod(int(ratio.argmax()), bodies)
        carried = prepared.settings.numbers.time_step * solve.v.reshape(end.shape)[scene]
        forced = end[scene] - begun.x_prev[scene] - carried
        members = model.derived(f"joined with body {body}", lambda: _joined_with(model, body))
        found = _of_bodies(model, at, prepared, begun.coupled, scene, members, left, forced,
                           bool((forces != elastic).any()), known)  # fmt: skip
        if found.error <= NO_MATTER * found.forced:
            return found
        return found if float(norm(left)[scene, body]) > float(rounding(at, norm)[scene, body]) else None


def _joined_with(model: System, body: int) -> list[int]:
    """A body and those that couplings join with it, nearest ones first, at most MOST_JOINED."""
    found = [body]
    if model.couplings:
        pairs = model.body.cpu()[torch.cat([energy.joins()[0] for energy in model.couplings])].unique(dim=0).numpy()
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        for one in found:  # which grows
            found += sorted(set(pairs[pairs[:, 0] == one, 1].tolist()) - set(found))
            if len(found) >= MOST_JOINED:
                break
    return found[:MOST_JOINED]


def _stiffness_of(model: System, of: _Functions, body: int, mu: Tensor, lam: Tensor) -> np.ndarray:
    """As _stiffness(), from moduli of a scene [1 | T]."""
    if len(mu) == len(lam) == 1:
        one, none = torch.ones_like(mu), torch.zeros_like(mu)
        of_mu, of_lam = model.derived(f"unit stiffness of body {body}", lambda: (
            _stiffness(model, of, one, none), _stiffness(model, of, none, one)))  # fmt: skip
        return float(mu) * of_mu + float(lam) * of_lam
    return _stiffness(model, of, *(m if len(m) == 1 else m[of.tets] for m in (mu, lam)))


def _of_bodies(model: System, at: IncrementalPotential, prepared: Prepared, coupled: Coupled | None, scene: int,
               members: list[int], left: Tensor, forced: Tensor, pushed: bool,
               known: dict[tuple[int, int], np.ndarray]) -> Unsolved:  # fmt: skip
    """What one linear solve says of bodies that couplings join, and of them the one that is farthest off."""
    functions = [model.derived(f"smooth functions of body {body}", lambda body=body: _functions(model, body))
                 for body in members]  # fmt: skip
    vertices = torch.cat([of.vertices for of in functions])
    ends = np.cumsum([[len(of.vertices), of.values.shape[1]] for of in functions], 0)
    parts = [(slice(*r), slice(*f)) for r, f in np.stack([ends - np.diff(ends, axis=0, prepend=0), ends], -1)]
    count = int(ends[-1, 1])

    def own(value: Tensor) -> Tensor:
        return value[min(scene, len(value) - 1)]

    def array(value: Tensor) -> np.ndarray:
        return own(value)[vertices].double().cpu().numpy()

    weight, now, residual, moved = (array(t) for t in (at.mass, at.x, -left, forced[None]))
    mass = weight * array(at.free[None])
    added: list[np.ndarray] = []
    if pushed:
        data = at.data if coupled is None else coupled.data  # couplings by themselves, below
        energies = at._vertex_energies(data)
        added = [array(energy.blocks(at.x, at.x_prev, part, at.h, at.origin)) for energy, part in energies]
        if isinstance(at, ContactPotential):  # as stiff along a surface as across it
            trace = at.h**2 * at.step_contact.stiffness(at.contact)
            added.append(array(trace[..., None, None] * torch.eye(3, dtype=trace.dtype, device=trace.device)))
    # functions in the frame of each body, the component first
    elastic, gram, force = np.zeros((3, count, 3, count)), np.zeros((count, count)), np.zeros((3, count))
    blocks, shapes, turns = np.zeros_like(elastic), np.zeros((len(now), count)), np.zeros((len(now), 3, 3))
    for body, of, (rows, part) in zip(members, functions, parts, strict=True):
        q, m = of.values, weight[rows]
        if (scene, body) not in known:
            known[scene, body] = _stiffness_of(model, of, body, own(prepared.mu).double(), own(prepared.lam).double())
        elastic[:, part, :, part] += at.h**2 * known[scene, body].reshape(3, q.shape[1], 3, q.shape[1])
        gram[part, part] = q.T @ (mass[rows] * q)
        arms = [a - (m * a).sum(0) / m.sum() for a in (now[rows], of.rest)]
        u, _, vt = np.linalg.svd(arms[0].T @ (m * arms[1]))
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        force[:, part] = (q.T @ (residual[rows] @ turn)).T
        shapes[rows, part], turns[rows] = q, turn
        for block in added:
            acts = block[rows].any((1, 2)) & (mass[rows, 0] > 0)
            if acts.any():
                turned = turn.T @ block[rows][acts] @ turn
                blocks[:, part, :, part] += np.einsum("nf,ncd,ng->cfdg", q[acts], turned, q[acts], optimize=True)
    for c in range(3):
        elastic[c, :, c] += gram
    if coupled is not None:
        place = np.full(model.num_vertices, len(now))
        place[vertices.cpu().numpy()] = np.arange(len(now))
        of_vertices = (np.concatenate([t, np.zeros_like(t[:1])]) for t in (shapes, turns))  # the last: of other bodies
        elastic += at.h**2 * _stiffness_of_couplings(model, at, coupled, scene, place, *of_vertices)
    displacement = np.linalg.solve((elastic + blocks).reshape(3 * count, -1), force.reshape(-1)).reshape(3, count)
    kept = np.linalg.solve(elastic.reshape(3 * count, -1), (displacement @ gram).reshape(-1)).reshape(3, count)

    def rms(square: float, rows: slice) -> float:
        return (max(square, 0.0) / max(float(mass[rows].sum()), 1e-300)) ** 0.5

    errors = [rms(float((kept[:, f] @ gram[f, f] * kept[:, f]).sum()), rows) for rows, f in parts]
    worst = int(np.argmax(errors))
    rows, _ = parts[worst]
    return Unsolved(scene, members[worst], errors[worst], rms(float((mass[rows] * moved[rows] ** 2).sum()), rows))


def _stiffness_of_couplings(model: System, at: IncrementalPotential, coupled: Coupled, scene: int, place: np.ndarray,
                            shapes: np.ndarray, turns: np.ndarray) -> np.ndarray:  # fmt: skip
    """Second derivative of couplings by functions [N/m], [3, f, 3, f]; functions [n, f] and frames [n, 3, 3] at the
    place of a vertex."""
    count = shapes.shape[1]
    out = np.zeros((3 * count, 3 * count))
    for energy, values in zip(model.couplings, coupled.values, strict=True):
        found = energy.curvature(coupled.place(at.x), values)
        if found is None:
            continue
        index, weights = energy.differences()
        at_vertex = place[index]
        some = np.flatnonzero((at_vertex < len(shapes) - 1).any((1, 2)))  # of these bodies
        at_vertex, weights = at_vertex[some], weights[some]
        rate, slope = (t[scene].double().cpu().numpy()[some] for t in (found.rate, found.slope))
        # of the vectors by the coefficients [N, M, 3, 3 f]
        rows = np.einsum("nmj,nmjde,nmjf->nmdef", weights, turns[at_vertex], shapes[at_vertex], optimize=True)
        rows = rows.reshape(*slope.shape, 3 * count)
        along = np.einsum("nmd,nmdk->nk", slope, rows)
        out += along.T @ (rate[:, None] * along)
        if found.across is not None:
            across, part = found.across[scene].double().cpu().numpy()[some], rows.reshape(-1, 3, 3 * count)
            turned = across.reshape(-1, 3, 3) @ part
            out += part.reshape(-1, 3 * count).T @ turned.reshape(-1, 3 * count)
    return out.reshape(3, count, 3, count)


# --- motion that pairs have held up -----------------------------------------------------------------------------------


def truncated_fraction(model: System) -> Tensor:
    """Share of the vertices that pairs held up in the Model's latest step [-], of the worst scene; a number on the
    Model's device, which is not waited for."""
    outcome = outcomes.get(model.model)
    if outcome is None or outcome.truncated.numel() == 0 or model.num_moving == 0:
        return torch.zeros((), device=model.device)
    return outcome.truncated.sum(-1).amax() / model.num_moving


def what_helps(model: System) -> str:
    """Advice for a warning of motion that pairs truncated."""
    numbered = model.contact is not None and model.contact.detections is not None
    remedy = ", or leave out its number of detections" if numbered else ""
    return f"take a smaller time_step or a larger reach of the PairBarrier{remedy}; " + page("contact.md")


# --- how far from converged a step ends, estimated from the changes of its last iterates (docs/ -----------------------

LARGEST_RATIO = 0.98  # of two changes: what shrinks more slowly cannot be told from what does not shrink


class ErrorEstimate(NamedTuple):
    """Estimated distance of steps from convergence, of each connected body with a vertex to move, in the order of the
    bodies' first vertices. Detached; NaN where a step has too few sweeps to tell.

    An iterate of a step is a coarse correction with its sweeps, after the first sweep; without coarse corrections one
    sweep; each with the rigid correction that would end the step there. Norms are root mean squares over the vertices
    of the body that move.

    Attributes:
        change: d, between the last two iterates [m], shape [..., bodies].
        ratio: rho, d over the change before it, at most 0.98 [-], shape [..., bodies].
        error: d rho / (1 - rho): the estimated distance to the converged step [m], shape
            [..., bodies]. Often two thirds too small: take three times as much to be safe. Far too small for
            motions that sweeps hardly change.
        relative: ``error`` over the motion of the body in the step [-], shape [..., bodies].
        lengths: Of the coarse corrections of the step, 1 is a whole one and 0 one that was refused; shape
            [..., corrections, bodies], empty without them.

    Source: the remainder of a geometric series; docs/numerics.md, "How wrong a step is", where it fails.
    """

    change: Tensor
    ratio: Tensor
    error: Tensor
    relative: Tensor
    lengths: Tensor


def check_estimable(model: Model, name: str) -> None:
    """Raises where steps of the Model have no estimate; ``name``: of the argument that asks for one."""
    if model.touches or model._renews:
        others = "springs, tendons or pressure" if model.couplings else "patches"
        what = "contact or friction" if model.touches else others
        raise NotImplementedError(f"{name}: the error of a step with {what} is not estimated")


def error_of(model: System, x: Tensor, v: Tensor, prepared: Prepared, *, force: Any, gravity: Any, prescribed: Any
             ) -> ErrorEstimate:  # fmt: skip
    """Sweeps the step once more, without gradients. Arguments as of advance()."""
    lead = x.shape[:-2]
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        x, v = x.detach(), v.detach()
        begun = begin(model, x, v, prepared, force, acceleration_of(gravity, x), prescribed).detached()
        states, corrections = _iterates(model, begun, prepared)
        states = [begun.corrected(s, model, prepared) for s in states]
        bodies = _bodies_of(model)
        shape = len(begun.x_prev), bodies.size.shape[0]
        unknown = x.new_full(shape, torch.nan)
        changes = [bodies.rms(b - a) for a, b in zip(states[:-1], states[1:], strict=True)]
        change = changes[-1] if changes else unknown
        ratio = _quotient(change, changes[-2]).clamp(max=LARGEST_RATIO) if len(changes) > 1 else unknown
        error = change * ratio / (1 - ratio)
        relative = _quotient(error, bodies.rms(states[-1] - begun.x_prev))
        lengths = x.new_empty((shape[0], 0, shape[1]))
        if corrections:
            lengths = lengths_of(model, torch.cat(corrections, 1))[..., bodies.corrected]
        return ErrorEstimate(*(t.reshape(*lead, *t.shape[1:]) for t in (change, ratio, error, relative, lengths)))


def of_steps(estimates: list[ErrorEstimate], model: System, x: Tensor, sweeps: int) -> ErrorEstimate:
    """Those of several steps, [steps, ...]; x: the state [..., V, 3] before the first."""
    if estimates:
        return ErrorEstimate(*(torch.stack(tensors) for tensors in zip(*estimates, strict=True)))
    lead, bodies = x.shape[:-2], _bodies_of(model).size.shape[0]
    corrections = model.coarse.corrections(sweeps) if model.coarse is not None and model.coarse_geometry.bodies else 0
    none = x.new_empty((0, *lead, bodies))
    return ErrorEstimate(none, none, none, none, x.new_empty((0, *lead, corrections, bodies)))


def _quotient(a: Tensor, b: Tensor) -> Tensor:
    """a / b, and 0 / 0 = 0: what rests has no error."""
    return torch.where((a == 0) & (b == 0), 0, a / b)


def _iterates(model: System, begun: Begun, prepared: Prepared) -> tuple[list[Tensor], list[Tensor]]:
    """The last iterates of the step [B, V, 3], at most three, the end of the sweeps last; and what coarse corrections
    did, as sweep() returns it."""
    fields, settings = begun.fields(model, prepared), prepared.settings
    if prepared.coarse is not None:
        fields = with_corrections(model, prepared.coarse, fields, settings.numbers.time_step)
    coarse = settings.coarse if prepared.coarse is not None else ()
    before, parts = _parts(settings.sweeps, coarse.every if coarse else None)
    over = replaced(settings, numbers=replaced(settings.numbers, last_relaxation=settings.numbers.relaxation))
    x, corrections, states = fields.x_start, [], []

    def run(fields: ops.SweepFields, settings: ops.SweepSettings) -> Tensor:
        # values are looked at once
        end, _, done = sweep(fields, model._packed_rest, model._plan, settings, tape_policy=ops.NO_TAPE,
                             checked=fields.x_start is begun.x_start)  # fmt: skip
        corrections.extend([done] if done.numel() else [])
        return end

    if before == 1 and parts and coarse:  # a sweep alone would be corrected
        x = run(replaced(fields, **dict.fromkeys(COARSE_FIELDS)), replaced(over, sweeps=1, coarse=()))
    elif before or not parts:
        x = run(fields, replaced(over if parts else settings, sweeps=before))
    if coarse:
        on = replaced(coarse, begun=1)
        settings, over = replaced(settings, coarse=on), replaced(over, coarse=on)
    states.append(x)
    for n, count in enumerate(parts):
        # the relaxation of the step's last sweep is its own
        now = settings if n + 1 == len(parts) else over
        x = run(replaced(fields, x_start=x), replaced(now, sweeps=count))
        states.append(x)
    return states, corrections


def _parts(sweeps: int, every: int | None) -> tuple[int, list[int]]:
    """Sweeps before the last iterates, and those of each of these, at most two."""
    if every is None:
        last = [1] * min(sweeps, 2)
    else:
        last = [min(every, sweeps - 1 - begun) for begun in range(0, sweeps - 1, every)][-2:]
    return sweeps - sum(last), last


class _Bodies(NamedTuple):
    """The connected bodies with a vertex to move."""

    order: Tensor  # int32 [active], their vertices that move
    ptr: Tensor  # int32 [bodies + 1]
    size: Tensor  # [bodies], how many
    corrected: Tensor  # int64 [bodies], which body of the coarse space each is

    def rms(self, displacement: Tensor) -> Tensor:
        """[B, V, 3] -> [B, bodies]"""
        squares = displacement.square().sum(-1, keepdim=True)
        return (segment_sum(squares, self.order, self.ptr)[..., 0] / self.size).sqrt()


def _bodies_of(model: System) -> _Bodies:
    return model.derived("bodies_that_move", lambda: _find_bodies(model))


def _find_bodies(model: System) -> _Bodies:
    of = moving_vertices(model.tets.cpu(), model._pinned.cpu())
    count = of.ptr.diff()
    corrected = torch.arange(len(count))
    if model.coarse is not None and model.coarse_geometry.bodies:
        space = model.coarse_geometry
        first = torch.from_numpy(space.function_ptr)
        body = torch.searchsorted(first, torch.from_numpy(space.function), right=True) - 1
        corrected[of.of[torch.from_numpy(space.vertex)]] = body
    device = model.device
    return _Bodies(of.order.int().to(device), of.ptr.int().to(device), count.to(device, model.dtype),
                   corrected.to(device))  # fmt: skip
