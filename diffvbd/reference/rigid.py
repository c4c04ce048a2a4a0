"""The rigid correction of every free body, in plain torch: the same executed steps, differentiated by autograd.

For each body the rigid motion of least  1/2 sum m |R r + c - y|^2 + energies of single vertices.  Where no such energy
acts at the polar fit of x to y, that fit is it; else at most ITERATIONS Newton steps (Gauss-Newton block, exact
exponential), each halved until the potential does not rise and no vertex loses more of a gap than an update may take.
"""

from typing import Any

import torch
from torch import Tensor

from .energies import StableNeoHookean
from .scene import Scene, dot

ITERATIONS, HALVINGS = 8, 30
ETA = 0.9  # largest fraction of the way to where a barrier begins that a start may close
MOST_TURN = 0.7  # [rad] in a step, which the start leaves out
# lookback ratios of displacements that are tangents of a rotation, of implicit Euler's, and of BDF2's after a step from
# tangents
BETTER = (0.01, 1.0, -0.74)
FITS = 0.25  # of the squares that one ratio leaves: a better one leaves at most so much
TURNS = 0.15  # of the squares of all displacements: a wrong ratio may leave so much of a rotation
STRETCH = 1e-8  # squared stretch of a step below which all ratios agree
LEAST_FRACTION = 0.1  # of its gap that a vertex keeps in one step
DAMPING = 1e-9  # of the inertia
ARRIVED = 1e-24  # squared step over squared radius of gyration from which on two more steps are taken
ARRIVALS = 2
ROUNDING = 1e-13  # relative increase of the energies that is rounding
FAR = 0.25  # squared angle of a Newton step to the nearest rotation, beyond which steps are shortened
DEFINITE = 1e-10  # least eigenvalue of a turning stiffness over its trace
GUARD = 8  # ulps of the gap's own terms below which a gap counts as closed


def connected_bodies(model: Any, order: Tensor | None = None) -> list[Tensor]:
    """Vertices of each connected set of tets; ``order`` [T] of the tets makes another one of the vertices."""
    parent = list(range(model.rest_points.shape[-2]))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    tets = model.tets.tolist()
    for tet in tets:
        for other in tet[1:]:
            parent[root(other)] = root(tet[0])
    members: dict[int, list[int]] = {}
    listed = sorted({i for tet in tets for i in tet})
    if order is not None:
        listed = list(dict.fromkeys(i for n in order.tolist() for i in tets[n]))
    for i in listed:
        members.setdefault(root(i), []).append(i)
    return [torch.tensor(m, device=model.pinned.device) for m in members.values()]


class Correction:
    """The correction of a run; ``energies``: the reference formulas, of which those of single vertices count."""

    def __init__(self, scene: Scene, energies: list[Any]) -> None:
        model, bodies = scene.model, connected_bodies(scene.model, scene.layout.order)
        self.scene = scene
        self.bodies = [b for b in bodies if model.rigid and not bool(model.pinned[b].any())]
        self.others = [b for b in bodies if not any(b is own for own in self.bodies)]
        self.energies = [e for e in energies if not isinstance(e, StableNeoHookean)]

    def __call__(self, x: Tensor, y: Tensor, x_prev: Tensor) -> Tensor:
        """The state after the correction; all [..., 3, V]."""
        for body in self.bodies:
            x = self._corrected(body, x, y, x_prev)
        return x

    def extrapolation(self, body: Tensor, x: Tensor, displacement: Tensor, lookback: float) -> tuple[Tensor, Tensor]:
        """Vertices of one body after their displacements from x [..., 3, n] without its rotation, by one fraction that
        all may take; and this fraction [...]."""
        own = bent(self.scene.mass[..., body].unsqueeze(-2), x, displacement, lookback)[0]
        to, fraction = self._toward(x, own)
        kept, kept_fraction = self._toward(x, displacement)  # where planes block the body
        blocked = fraction < 1
        return torch.where(blocked[..., None, None], kept, to), torch.where(blocked, kept_fraction, fraction)

    def _toward(self, x: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices after one fraction of their displacements that all may take, and this fraction."""
        fraction, good = torch.ones_like(x[..., :1, :1]), torch.ones_like(x[..., :1, :1], dtype=torch.bool)
        floors = [e for e in self.energies if hasattr(e, "gap")]
        slack = 8 * torch.finfo(x.dtype).eps * step.detach().norm(dim=-2).unsqueeze(-2)
        for energy in floors:
            allowance = ETA * (energy.gap(x) - energy.dhat).clamp(min=0)  # [..., planes, n]
            closing = -dot(energy.normal, step.unsqueeze(-3))
            bites = closing.detach() > allowance.detach() + slack
            own = torch.where(bites, allowance / torch.where(bites, closing, 1.0), 1.0)
            fraction = torch.minimum(fraction, own.amin(-2).amin(-1, keepdim=True).unsqueeze(-1))
        for energy in floors:
            moved = (x + fraction * step).detach()
            good = good & clear(energy, moved).all((-2, -1))[..., None, None]
        fraction = torch.where(good, fraction, 0.0)
        return x + fraction * step, fraction.detach()[..., 0, 0]

    def _load(self, state: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [..., 3, V] and block [..., V, 3, 3] of the vertex energies."""
        total = torch.zeros_like(state).repeat_interleave(3, -2)  # [..., 9, V]
        for k, color in enumerate(self.scene.layout.colors):
            for energy in self.energies:
                total = total.index_add(-1, color.vertices, energy.block(k, state, x_prev))
        g, (xx, xy, xz, yy, yz, zz) = total[..., :3, :], total[..., 3:, :].unbind(-2)
        rows = [torch.stack(row, -1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
        return g, torch.stack(rows, -2)

    def _value(self, state: Tensor, x_prev: Tensor) -> Tensor:
        return sum((e.energy(state, x_prev) for e in self.energies), torch.zeros_like(state[..., 0, 0]))

    def _corrected(self, body: Tensor, x: Tensor, y: Tensor, x_prev: Tensor) -> Tensor:
        mass = self.scene.mass[..., body].unsqueeze(-2)  # [..., 1, n]
        total = mass.sum(-1, keepdim=True)
        center, target = ((mass * a[..., body]).sum(-1, keepdim=True) / total for a in (x, y))
        r, eta = x[..., body] - center, y[..., body] - target
        y_x = (mass * eta) @ r.transpose(-1, -2)
        x_x = (mass * r) @ r.transpose(-1, -2)

        def placed(turn: Tensor, at: Tensor) -> Tensor:
            return x.index_copy(-1, body, (turn @ r + at).expand_as(x[..., body]))

        turn = _polar(y_x)
        closed = placed(turn, target)
        with torch.no_grad():
            g, block = self._load(closed, x_prev)
            acts = g[..., body].ne(0).any((-2, -1)) | block[..., body, :, :].ne(0).any((-3, -2, -1))
            acts = acts | ~admits(self.energies, closed, closed, body)
        if not bool(acts.any()):
            return closed

        points = self.scene.model.rest_points.to(x)[body]
        spread = (points - points.mean(0)).square().sum(-1).mean()
        turn, at = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape[:-2], 3, 3), center
        running, arrived = acts, torch.zeros_like(acts, dtype=torch.int64)
        for _ in range(ITERATIONS):
            state = placed(turn, at)
            g, block = self._load(state, x_prev)
            g, block, arm = g[..., body], block[..., body, :, :], turn @ r
            torque = -axial(y_x @ turn.transpose(-1, -2)) + torch.linalg.cross(arm, g, dim=-2).sum(-1)
            force = (total * (at - target)).squeeze(-1) + g.sum(-1)
            jacobian = torch.cat([-cross_matrix(arm.movedim(-2, -1)), _eye_like(block)], -1)  # [..., n, 3, 6]
            matrix = (jacobian.transpose(-1, -2) @ block @ jacobian).sum(-3)
            turning = turning_stiffness(turn @ x_x @ turn.transpose(-1, -2))
            damping = DAMPING * total * spread * torch.eye(3, dtype=x.dtype, device=x.device)
            inertia = torch.zeros_like(matrix)
            inertia[..., :3, :3] = turning + damping
            inertia[..., 3:, 3:] = total * torch.eye(3, dtype=x.dtype, device=x.device)
            gradient = torch.cat([torque, force], -1)
            step = -torch.linalg.solve(matrix + inertia, gradient)
            with torch.no_grad():
                decrease = -(gradient * step).sum(-1)
                # steps that arrive are taken as well, and whole: they carry the derivative of a body at rest
                arrives = ~(decrease > ARRIVED * (total * spread)[..., 0, 0])
                fraction = self._fraction(running, arrives, step, turn, at, state, total, target, y_x, placed, body,
                                          x_prev)  # fmt: skip
                fraction = torch.where(running, fraction, 0.0)
                arrived = arrived + arrives.to(arrived.dtype)
                running = running & (fraction > 0) & (arrived < ARRIVALS)
            fraction = fraction[..., None]
            turn = turn + _turned_by(fraction * step[..., :3]) @ turn
            at = at + (fraction * step[..., 3:]).unsqueeze(-1)
            if not bool(running.any()):
                break
        return torch.where(acts[..., None, None], placed(turn, at), closed)

    def _fraction(self, running: Tensor, arrives: Tensor, step: Tensor, turn: Tensor, at: Tensor, state: Tensor,
                  total: Tensor, target: Tensor, y_x: Tensor, placed: Any, body: Tensor, x_prev: Tensor
                  ) -> Tensor:  # fmt: skip
        """The largest of 1, 1/2, 1/4, ... that is admitted and, unless a step arrives, does not increase the potential;
        0: none."""
        fraction, found = torch.ones_like(running, dtype=state.dtype), torch.zeros_like(running)
        value = self._value(state, x_prev)
        for _ in range(HALVINGS):
            w, t = fraction[..., None] * step[..., :3], (fraction[..., None] * step[..., 3:]).unsqueeze(-1)
            turned = _turned_by(w) @ turn
            there = placed(turn + turned, at + t)
            increase = (total * dot(t, at - target + t / 2).unsqueeze(-1))[..., 0, 0] - (turned * y_x).sum((-2, -1))
            increase = increase + self._value(there, x_prev) - value
            good = admits(self.energies, there, state, body) & ((increase <= ROUNDING * value) | arrives)
            found = found | (good & running)
            if bool((found | ~running).all()):
                break
            fraction = torch.where(found, fraction, fraction / 2)
        return torch.where(found, fraction, 0.0)


def bent(mass: Tensor, x: Tensor, displacement: Tensor, lookback: float) -> tuple[Tensor, Tensor, Tensor]:
    """Displacements of the vertices of a body [..., 3, n] without its rotation; its new shape, and the ends of its
    displacements, both about the center of mass. mass: [..., 1, n]. Without a rotation they stay as they are."""
    total = mass.sum(-1, keepdim=True)
    center, mean = ((mass * a).sum(-1, keepdim=True) / total for a in (x, displacement))
    r, beside = x - center, displacement - mean
    change, left, turns = _straightened(mass, r, beside, lookback)
    size, all_displacements = ((mass * a * a).detach().sum((-2, -1), keepdim=True) for a in (r, beside))
    undecided = turns & (left > STRETCH * size) & (left < TURNS * all_displacements)
    for better in BETTER if lookback < 0 else BETTER[:2]:
        other, less, also = _straightened(mass, r, beside, better)
        fits = undecided & also & (less < FITS * left)
        change, undecided = torch.where(fits, other, change), undecided & ~fits
    return mean + change, r + change, r + beside


def _straightened(mass: Tensor, r: Tensor, beside: Tensor, lookback: float) -> tuple[Tensor, Tensor, Tensor]:
    """Displacements relative to the center without the rotation; their squares, by mass; whether the body rotates."""
    before = r - lookback * beside
    turn, turns = _turn_or_none((mass * r) @ before.transpose(-1, -2), lookback)
    change = torch.where(turns, (r - turn @ before) / lookback, beside)
    return change, (mass * change * change).detach().sum((-2, -1), keepdim=True), turns


def _turn_or_none(b: Tensor, lookback: float) -> tuple[Tensor, Tensor]:
    """The rotation closest to b, and whether a step may rotate by so much over the lookback ratio."""
    turn, turns = _polar_or_none(b)
    square = (turn - torch.eye(3, dtype=b.dtype, device=b.device)).detach().square().sum((-2, -1))
    return turn, turns & (square < 2 * (MOST_TURN * lookback) ** 2)[..., None, None]


def clear(energy: Any, x: Tensor) -> Tensor:
    """Mask [..., planes, n] of gaps above rounding."""
    size = (energy.normal * x.unsqueeze(-3)).abs().sum(-2) + energy.height.abs()
    return energy.gap(x) > GUARD * torch.finfo(x.dtype).eps * size


def admits(energies: list[Any], state: Tensor, before: Tensor, body: Tensor) -> Tensor:
    """True [...] if all vertices of a body keep LEAST_SHARE of their gaps before, and more than rounding, [...]."""
    out = torch.ones_like(state[..., 0, 0], dtype=torch.bool)
    for energy in energies:
        if hasattr(energy, "gap"):
            x = state[..., body]
            kept = energy.gap(x) >= LEAST_FRACTION * energy.gap(before[..., body])
            out = out & (clear(energy, x) & kept).all((-2, -1))
    return out


def _eye_like(block: Tensor) -> Tensor:
    return torch.eye(3, dtype=block.dtype, device=block.device).expand_as(block)


def cross_matrix(w: Tensor) -> Tensor:
    """[w] with [w] r = w x r; [..., 3] -> [..., 3, 3]."""
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([torch.stack(row, -1) for row in ((o, -z, y), (z, o, -x), (-y, x, o))], -2)


def axial(a: Tensor) -> Tensor:
    """(a_zy - a_yz, a_xz - a_zx, a_yx - a_xy) of [..., 3, 3]."""
    b = a - a.transpose(-1, -2)
    return torch.stack([b[..., 2, 1], b[..., 0, 2], b[..., 1, 0]], -1)


def turning_stiffness(a: Tensor) -> Tensor:
    """tr(a) 1 - (a + a^T) / 2 of [..., 3, 3]: what a turn [w] of a rotation is axial(a) for."""
    trace = a.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    return trace * torch.eye(3, dtype=a.dtype, device=a.device) - (a + a.transpose(-1, -2)) / 2


def _turned_by(w: Tensor) -> Tensor:
    """exp [w] - 1; the angle's square is kept from 0, where the root has no derivative."""
    square = (w * w).sum(-1)
    small = square < 1e-8
    angle = torch.where(small, 1.0, square).sqrt()
    a = torch.where(small, 1 - square / 6 + square**2 / 120, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - square / 24 + square**2 / 720, 2 * (torch.sin(angle / 2) / angle) ** 2)
    k = cross_matrix(w)
    return a[..., None, None] * k + b[..., None, None] * (k @ k)


def _polar(b: Tensor) -> Tensor:
    return _polar_or_none(b)[0]


def _definite(stiffness: Tensor) -> Tensor:
    trace = stiffness.diagonal(dim1=-2, dim2=-1).sum(-1)
    return (torch.linalg.eigvalsh(stiffness)[..., 0] > DEFINITE * trace)[..., None, None]


def _polar_or_none(b: Tensor) -> tuple[Tensor, Tensor]:
    """The rotation closest to b [..., 3, 3]: by Newton steps from the identity, the last of which carries
    the derivative. The identity where b determines none, or one that is too far; and where it does not
    [..., 1, 1]."""
    one = torch.eye(3, dtype=b.dtype, device=b.device)
    with torch.no_grad():
        found, good = one.expand_as(b), torch.ones_like(b[..., :1, :1], dtype=torch.bool)
        # of a slender body, far from its rotation, the stiffness need not be definite
        proper, shift = torch.linalg.det(b) > 0, torch.linalg.matrix_norm(b)[..., None, None] * one
        for _ in range(40):
            m = found.transpose(-1, -2) @ b
            stiffness = turning_stiffness(m)
            definite = _definite(stiffness)
            w = torch.linalg.solve(torch.where(definite, stiffness, one), axial(m))
            near = definite[..., 0, 0] & ((w * w).sum(-1) < FAR)
            shifted = torch.where(proper[..., None, None], stiffness + shift, one)
            w = torch.where(near[..., None], w, torch.linalg.solve(shifted, axial(m)))
            good = good & ((near | proper) & ((w * w).sum(-1) < 1))[..., None, None]
            found = found + torch.where(good, found @ _turned_by(w), 0.0)
        good = good & _definite(turning_stiffness(found.transpose(-1, -2) @ b))
    m = found.transpose(-1, -2) @ b
    stiffness = torch.where(good, turning_stiffness(m), torch.eye(3, dtype=b.dtype, device=b.device))
    w = torch.linalg.solve(stiffness, torch.where(good[..., 0], axial(m), 0.0))
    return torch.where(good, found + found @ _turned_by(w), torch.eye(3, dtype=b.dtype, device=b.device)), good
