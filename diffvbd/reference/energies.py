"""Reference formulas, one class per energy, and the registry `ENERGIES` that names them.

An energy class is built once per run from (its dataclass, Scene) and offers

* `block(k, x, x_prev)` -> [..., 9, n]: h^2 times gradient (3 rows) and Hessian block (xx, xy, xz, yy, yz, zz) of the n
  vertices of color k, at the state x [..., 3, V], lagged terms at x_prev;
* `energy(x, x_prev)` -> [...]: the matching h^2-scaled energy of the whole body (unpinned vertices only);
* `terms(x, x_prev)` -> [..., n], [n]: the terms that add up to it, but for a constant, and a vertex of each;
* optionally `limit(x, step)` -> [..., n]: the largest admissible fraction of `step` [..., 3, n] from x [..., 3, n],
  and with it `start(x, step)` -> [..., 3, n]: what the start of a step may take of it.

Vertex energies take what is per vertex from the full vectors by color.
"""

import re
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from .distance import log_barrier
from .scene import Color, Scene, add_at, cross, dot, law_values, outer6, patch_means, shape_functions, take

ETA = 0.9  # a filtered step closes at most this fraction of a gap
GUARD = 8  # ulps of the gap's own terms below which a gap counts as closed
FADE = 0.1  # of kappa dhat: the normal force from which a contact has half of its damping
PARALLEL = 1e-6  # squared sine below which a plane counts as parallel to those that bind


class StableNeoHookean:
    """psi = mu/2 (|F|^2 - 3) - mu (J - 1) + lb/2 (J - 1)^2, lb = mu + lam: P = mu F + (lb (J - 1) - mu) cof F.

    The usual form lb/2 (J - 1 - mu/lb)^2 differs by the constant mu^2 / (2 lb), which does not exist at lb = 0.

    With patches lam/2 (J - a)^2 takes the place of lam/2 (J - 1)^2, a = 1 + J - J_P at the state of the last `renew`
    with J_P the mean of J over a patch: but for constants, the energy of patches there and a bound of it elsewhere.
    """

    shift: Any = 0.0  # a - 1 of each tet [..., T]

    def __init__(self, energy: Any, scene: Scene) -> None:
        self.scene = scene
        self.exact = exact = getattr(scene.model, "block", "exact") == "exact"
        weight = scene.time_step**2 * scene.volume
        lb = scene.mu + scene.lam
        per_tet = torch.stack(torch.broadcast_tensors(weight * scene.mu, weight * lb, weight * scene.lam), -2)
        self.colors = [self._pairs(color, scene.shape_gradients, per_tet, exact) for color in scene.layout.colors]

    @staticmethod
    def _pairs(color: Color, gradients: Tensor, per_tet: Tensor, exact: bool) -> tuple:
        """Constants of a color's pairs: columns of Dm^-1 as rows of length P, grad N of the vertex, weights, and the
        part mu |grad N|^2 I of the block, which no state changes."""
        inverse = gradients[..., 1:, :, :][..., color.tet]
        own = gradients.movedim(-3, -1)[..., color.tet, color.local]
        w_mu, w_lb, w_lam = (w.unsqueeze(-2) for w in per_tet[..., color.tet].unbind(-2))
        diagonal = w_mu * dot(own, own).unsqueeze(-2)
        no = torch.zeros_like(diagonal)
        constant = torch.cat((no, no, no, diagonal, no, no, diagonal, no, diagonal), -2)
        constant = add_at(constant.new_zeros(9, color.vertices.numel()), color.owner, constant)
        rows = [row.split(1, -2) for row in inverse.unbind(-3)]
        return rows, own.split(1, -2), w_mu, w_lb, w_lb if exact else w_lam, constant

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        color = self.scene.layout.colors[k]
        (rb, rc, rd), own, w_mu, w_lb, w_lh, constant = self.colors[k]
        a, b, c, d = take(x, color.corners).unflatten(-1, (4, -1)).unbind(-2)
        f = _columns((b - a, c - a, d - a), (rb, rc, rd))
        cof = cross(f[1], f[2]), cross(f[2], f[0]), cross(f[0], f[1])
        det = dot(f[0], cof[0]).unsqueeze(-2)
        q = _combine(cof, own)
        stress = w_lb * (det - 1) - w_mu
        if isinstance(self.shift, Tensor):
            weight = self.scene.time_step**2 * self.scene.volume * self.scene.lam * self.shift
            stress = stress - weight[..., color.tet].unsqueeze(-2)
        gradient = w_mu * _combine(f, own) + stress * q
        return add_at(constant, color.owner, torch.cat((gradient, w_lh * outer6(q)), -2))

    def _measures(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """|F|^2 and J - 1 of each tet, [..., T]."""
        s = self.scene
        a, b, c, d = (x[..., corner] for corner in s.layout.tets)
        f = _columns((b - a, c - a, d - a), [g.split(1, -2) for g in s.shape_gradients.unbind(-3)[1:]])
        norm = dot(f[0], f[0]) + dot(f[1], f[1]) + dot(f[2], f[2])
        return norm, dot(f[0], cross(f[1], f[2])) - 1

    def renew(self, x: Tensor) -> None:
        """Take the bound about x [..., 3, V]; differentiable in x."""
        if self.scene.patches is not None:
            strain = self._measures(x)[1]
            self.shift = strain - patch_means(self.scene.patches, strain, self.scene.volume)

    def of_tets(self, x: Tensor) -> Tensor:
        """The energy of each tet, h^2-scaled, [..., T]."""
        s = self.scene
        norm, strain = self._measures(x)
        psi = s.mu * ((norm - 3) / 2 - strain) + (s.mu + s.lam) / 2 * strain**2 - s.lam * self.shift * strain
        return s.time_step**2 * (s.volume * psi)

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        return self.of_tets(x).sum(-1)

    def terms(self, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        s = self.scene
        norm, strain = self._measures(x)
        weight = s.time_step**2 * s.volume
        split = (s.mu / 2 * norm, -(s.mu + s.lam * self.shift) * strain, (s.mu + s.lam) / 2 * strain**2)
        return torch.cat([weight * term for term in split], -1), s.layout.tets[0].repeat(3)


class Viscosity(StableNeoHookean):
    """A second law with the moduli viscosity / h and volume_viscosity / h, at rest where the step starts, times J^2
    there; tets that start inside out have none."""

    def __init__(self, scene: Scene) -> None:
        self.of = scene

    def begin(self, x_prev: Tensor) -> None:
        s = self.of
        gradients, volume = shape_functions(x_prev, s.layout.tets)
        upright = volume > 0
        share = torch.where(upright, volume / s.volume, 0.0)
        shear, bulk = rates(s)
        at_start = replace(s, mu=shear, lam=bulk, patches=None, volume=s.volume * share**2,
                           shape_gradients=torch.where(upright[..., None, None, :], gradients, 0.0))  # fmt: skip
        super().__init__(None, at_start)


def rates(scene: Scene) -> tuple[Tensor, Tensor]:
    """Moduli of the viscosity [Pa], [..., T]."""
    none = torch.zeros_like(scene.mu)
    shear, bulk = (none if r is None else r / scene.time_step for r in (scene.viscosity, scene.volume_viscosity))
    return shear, bulk


def _combine(vectors: Any, weights: Any) -> Tensor:
    """v0 w0 + v1 w1 + v2 w2 with vectors [..., 3, P] and weights [..., 1, P]."""
    total = torch.addcmul(vectors[0] * weights[0], vectors[1], weights[1])
    return torch.addcmul(total, vectors[2], weights[2])


def _columns(edges: Any, rows: Any) -> list[Tensor]:
    """Columns of F = Ds Dm^-1 from the columns of Ds and the rows of Dm^-1."""
    return [_combine(edges, [row[c] for row in rows]) for c in range(3)]


class Law(StableNeoHookean):
    """A law from its energy density, by autograd: gradient and block of a vertex are derivatives of the energy of its
    tets by its own position, and what is differentiated then is these."""

    def __init__(self, energy: Any, scene: Scene) -> None:
        self.scene, self.density, self.exact = scene, energy.density, True
        self.values = law_values(energy, scene.parameters, scene.per_tet)
        self.fibres = torch.zeros_like(scene.shape_gradients[..., 0, :, :])
        if energy.a0 is not None:
            a0 = scene.tensor(scene.parameters.get("a0", energy.a0))
            a0 = (a0 if a0.dim() > 1 else a0[None]).transpose(-1, -2)
            self.fibres = scene.per_tet(a0 / a0.square().sum(-2, keepdim=True).sqrt())

    def _of(self, corners: Any, tets: Any = slice(None)) -> Tensor:
        """h^2 V psi of tets with these corners, four of [..., 3, P]."""
        s = self.scene
        a, b, c, d = corners
        rows = [g[..., tets].split(1, -2) for g in s.shape_gradients.unbind(-3)[1:]]
        f = _columns((b - a, c - a, d - a), rows)
        cof = cross(f[1], f[2]), cross(f[2], f[0]), cross(f[0], f[1])
        along = _combine(f, self.fibres[..., tets].split(1, -2))
        norms = [sum(dot(v, v) for v in vectors) for vectors in (f, cof)]
        invariants = [norms[0], norms[1], dot(f[0], cof[0]), dot(along, along)]
        values, scale = [v[..., tets] for v in self.values], s.time_step**2 * s.volume[..., tets]
        self.sizes = invariants, values, scale  # of the latest call
        return scale * self.density.value(invariants, values)[0]

    def fibre_modulus(self) -> Tensor:
        """4 d2psi/dI4^2 at F = I [Pa], where it is positive."""
        differentiated = torch.is_grad_enabled()
        with torch.enable_grad():
            one = torch.ones_like(self.scene.volume)
            fourth = one.clone().requires_grad_()
            total = self.density.value([3 * one, 3 * one, one, fourth], self.values)[0]
            for _ in range(2):  # psi may be linear in I4
                total = total.sum() + 0 * fourth.square().sum()
                (total,) = torch.autograd.grad(total, fourth, create_graph=True)
        return 4 * (total if differentiated else total.detach()).clamp(min=0)

    def _of_pairs(self, k: int, x: Tensor, own: Tensor) -> Tensor:
        """The same of the pairs of color k, whose vertices are at own [..., 3, P]."""
        color = self.scene.layout.colors[k]
        corners = take(x, color.corners).unflatten(-1, (4, -1)).unbind(-2)
        return self._of([torch.where(color.local == a, own, corner) for a, corner in enumerate(corners)], color.tet)

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        color, differentiated = self.scene.layout.colors[k], torch.is_grad_enabled()
        with torch.enable_grad():
            own = take(x, color.vertices)[..., color.owner]
            own = own if own.requires_grad else own.detach().requires_grad_()
            total = self._of_pairs(k, x, own).sum()
            (gradient,) = torch.autograd.grad(total, own, create_graph=True)
            columns = [torch.autograd.grad(gradient[..., c, :].sum(), own, create_graph=True)[0] for c in range(3)]
            pairs = torch.cat((gradient, *(columns[i][..., i:, :] for i in range(3))), -2)
        pairs = pairs if differentiated else pairs.detach()
        none = pairs.new_zeros(9, color.vertices.numel())
        return add_at(none, color.owner, pairs)

    def of_tets(self, x: Tensor) -> Tensor:
        return self._of([x[..., corner] for corner in self.scene.layout.tets])

    def terms(self, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        return self.of_tets(x), self.scene.layout.tets[0]

    def change(self, k: int, x: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """By how much the energy of the tets of each vertex of color k changes along a step [..., 3, n], and the sizes
        of what is compared."""
        color = self.scene.layout.colors[k]
        own = take(x, color.vertices)[..., color.owner]
        one = self._of_pairs(k, x, own)
        invariants, values, scale = self.sizes
        slopes = self.density.slopes(invariants, values)
        rounded = scale * sum((w * i).abs() for w, i in zip(slopes, invariants, strict=True))
        two = self._of_pairs(k, x, own + step[..., color.owner])
        both = torch.stack((two - one, one.abs() + two.abs() + rounded), -2)
        summed = add_at(both.new_zeros(2, color.vertices.numel()), color.owner, both)
        return summed[..., 0, :], summed[..., 1, :]


class FloorBarrier:
    """b(d) = -kappa (d - dhat)^2 log(d / dhat) for 0 < d < dhat, per plane d = n.x - height; damping of approach."""

    def __init__(self, energy: Any, scene: Scene) -> None:
        self.scene = scene
        kappa, dhat, damping, height, normal = (
            scene.parameter(energy, name) for name in ("kappa", "dhat", "damping", "height", "normal")
        )
        # Shapes against gaps [..., planes, n]; a scene dimension of a parameter stays in front.
        self.kappa, self.dhat, self.damping = (p[..., None, None] for p in (kappa, dhat, damping))
        self.height = torch.atleast_1d(height)[..., None]
        normal = torch.atleast_2d(normal)
        self.normal = (normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True))[..., None]
        self.outer = outer6(self.normal)
        self.damped = "floor_damping" in scene.parameters or bool((damping != 0).any())

    def gap(self, x: Tensor) -> Tensor:
        return dot(self.normal, x.unsqueeze(-3)) - self.height

    def _approach(self, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        """Approach since x_prev, at most 0, and the rate of its damping, h c q [kg], both [..., planes, n]."""
        force = -log_barrier(self.gap(x_prev), torch.ones_like(self.dhat), self.dhat)[1]  # kappa cancels
        share = torch.where(self.kappa > 0, force / (force + FADE * self.dhat), 0.0)
        travel = dot(self.normal, (x - x_prev).unsqueeze(-3))
        return torch.where(travel < 0, travel, 0.0), self.damping * self.scene.time_step * share

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        vertices = self.scene.layout.colors[k].vertices
        x = take(x, vertices)
        h = self.scene.time_step
        gap = self.gap(x)
        active = (gap > 0) & (gap < self.dhat)
        d = torch.where(active, gap, 1.0)  # the unused branch must stay finite for autograd
        log, past = torch.log(d / self.dhat), d - self.dhat
        first = torch.where(active, -self.kappa * (2 * past * log + past**2 / d), 0.0)
        second = torch.where(active, -self.kappa * (2 * log + 4 * past / d - (past / d) ** 2), 0.0)
        first, second = h**2 * first, h**2 * second
        if self.damped:
            approach, rate = self._approach(x, take(x_prev, vertices))
            first, second = first + rate * approach, second + rate
        gradient = (first.unsqueeze(-2) * self.normal).sum(-3)
        return torch.cat((gradient, (second.unsqueeze(-2) * self.outer).sum(-3)), -2)

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        return self.terms(x, x_prev)[0].sum(-1)

    def terms(self, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        free = ~self.scene.model.pinned
        total = self._barrier(self.gap(x[..., free]))
        if self.damped:
            approach, rate = self._approach(x[..., free], x_prev[..., free])
            total = total + rate / 2 * approach**2
        return total.flatten(-2), free.nonzero()[:, 0].repeat(total.shape[-2])

    def _barrier(self, gap: Tensor) -> Tensor:
        active = gap < self.dhat
        d = torch.where(active, gap, 1.0)
        total = torch.where(active, -self.kappa * (d - self.dhat) ** 2 * torch.log(d / self.dhat), 0.0)
        return self.scene.time_step**2 * torch.where(gap > 0, total, torch.inf)

    def change(self, x: Tensor, step: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        """By how much more the energy of each vertex changes along a step from x, all [..., 3, n], than its part of
        block() says, and the sizes of the terms."""
        h, gap, move = self.scene.time_step, self.gap(x), dot(self.normal, step.unsqueeze(-3))
        one, two = self._barrier(gap), self._barrier(gap + move)
        _, first, second = log_barrier(gap, self.kappa, self.dhat)
        there = log_barrier(gap + move, self.kappa, self.dhat)[1]
        first, second = h**2 * first, h**2 * second
        change, size = two - one, one + two - h**2 * there * (gap + move)
        if self.damped:
            (before, rate), (after, _) = self._approach(x, x_prev), self._approach(x + step, x_prev)
            first, second = first + rate * before, second + rate
            change = change + rate / 2 * (after**2 - before**2)
            size = size + rate / 2 * (after**2 + before**2)
        first, second = first * move, second / 2 * move**2
        return (change - first - second).sum(-2), (size + first.abs() + second).sum(-2)

    def limit(self, x: Tensor, step: Tensor) -> Tensor:
        gap, travel = self.gap(x), dot(self.normal, step.unsqueeze(-3))
        bites = (travel < 0) & (ETA * gap < -travel)
        fraction = torch.where(bites, ETA * gap / torch.where(bites, -travel, 1.0), 1.0)
        fraction = fraction.min(-2).values
        return torch.where(self._closes(x, fraction.unsqueeze(-2) * step), 0.0, fraction)

    def _closes(self, x: Tensor, step: Tensor) -> Tensor:
        """Mask [..., n] of vertices at which rounding may still close a gap of few ulps; they stay where they are."""
        with torch.no_grad():
            size = (self.normal * x.unsqueeze(-3)).abs().sum(-2) + self.height.abs()
            return (self.gap(x + step) <= GUARD * torch.finfo(x.dtype).eps * size).any(-2)

    def start(self, x: Tensor, step: Tensor) -> Tensor:
        """The step projected on n.s = -room of the planes that bind, room = ETA max(0, gap - dhat); the one exceeded
        most joins them until none is exceeded. Where that fails, the step shortened as a whole."""
        gap = self.gap(x)
        room = (ETA * (gap - self.dhat).clamp(min=0)).movedim(-2, -1)  # [..., n, planes]
        step = step.movedim(-2, -1)
        normals = self.normal.movedim(-1, -3).expand(*room.shape, 3)

        def excess(s: Tensor) -> Tensor:
            return -(normals * s.unsqueeze(-2)).sum(-1) - room

        def solve(binding: Tensor, right: Tensor) -> Tensor:
            """sum_p c_p n_p over binding planes with n_q . sum = right_q at each of them; right [..., n, planes]."""
            rows = torch.where(binding.unsqueeze(-1), normals, 0.0)
            system = rows @ rows.mT + torch.diag_embed((~binding).to(rows))
            return (rows.mT @ torch.linalg.solve(system, torch.where(binding, right, 0.0).unsqueeze(-1))).squeeze(-1)

        slack = 8 * torch.finfo(x.dtype).eps * step.detach().norm(dim=-1, keepdim=True)
        binding = torch.zeros_like(room, dtype=torch.bool)
        with torch.no_grad():
            over, stuck = excess(step), torch.zeros_like(slack, dtype=torch.bool)
            for _ in range(min(3, room.shape[-1])):
                open_ = torch.where(binding, -torch.inf, over)
                worst = torch.zeros_like(binding).scatter(-1, open_.argmax(-1, keepdim=True), True)
                worst = worst & (open_ > slack)
                own = (torch.where(worst.unsqueeze(-1), normals, 0.0)).sum(-2)
                rest = own - solve(binding, (normals * own.unsqueeze(-2)).sum(-1))
                parallel = worst.any(-1, keepdim=True) & ((rest * rest).sum(-1, keepdim=True) <= PARALLEL)
                stuck, binding = stuck | parallel, binding | (worst & ~parallel)
                over = excess(step + solve(binding, excess(step)))
            stuck = stuck | (torch.where(binding, -torch.inf, over) > slack).any(-1, keepdim=True)
        moved = step + solve(binding, excess(step))
        stuck = stuck | ((moved**2).sum(-1, keepdim=True) > (1 + 1e-6) * (step**2).sum(-1, keepdim=True))
        bites = excess(step) > 0
        along = torch.where(bites, (normals * step.unsqueeze(-2)).sum(-1), -1.0)
        alpha = torch.where(bites, -room / along, 1.0).min(-1, keepdim=True).values
        moved = torch.where(stuck, alpha * step, moved).movedim(-1, -2)
        return torch.where(self._closes(x, moved).unsqueeze(-2), 0.0, moved)

    def check_start(self, x: Tensor) -> None:
        below = ((self.gap(x) <= 0).any(-2) & ~self.scene.model.pinned).nonzero()
        if below.numel():
            raise ValueError(f"x: expected every unpinned vertex above the floor, got a gap <= 0 at {below.tolist()}")


class Anchor:
    """k/2 |x_i - point_i|^2 on chosen vertices."""

    def __init__(self, energy: Any, scene: Scene) -> None:
        self.scene = scene
        stiffness = scene.parameter(energy, "stiffness")
        count = scene.rest_points.shape[-1]
        chosen = torch.ones(count, dtype=torch.bool, device=scene.like.device)
        if energy.vertices is not None:
            index = torch.as_tensor(energy.vertices, device=scene.like.device)
            chosen = torch.zeros_like(chosen)
            chosen[index] = True
        chosen = chosen & ~scene.model.pinned
        self.stiffness = torch.where(chosen, stiffness, 0.0)  # [..., V]
        points = scene.parameters.get("anchor_points", energy.points)
        # Without points a vertex hangs on its constant rest position: a differentiated rest shape does not move it.
        points = scene.model.rest_points if points is None else points
        self.points = scene.tensor(points).transpose(-1, -2)

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        vertices = self.scene.layout.colors[k].vertices
        offset = x[..., vertices] - self.points[..., vertices]
        diagonal = self.scene.time_step**2 * self.stiffness[..., vertices].unsqueeze(-2)
        gradient = diagonal * offset
        diagonal = diagonal.expand_as(gradient[..., :1, :])
        no = torch.zeros_like(diagonal)
        return torch.cat((gradient, diagonal, no, no, diagonal, no, diagonal), -2)

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        return self.terms(x, x_prev)[0].sum(-1)

    def terms(self, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        offset = x - self.points
        each = self.scene.time_step**2 / 2 * self.stiffness * dot(offset, offset)
        return each, torch.arange(x.shape[-1], device=x.device)


ENERGIES: dict[str, type] = {
    "stable_neo_hookean": StableNeoHookean,
    "law": Law,
    "floor": FloorBarrier,
    "anchor": Anchor,
}


def build_energies(scene: Scene, elsewhere: tuple[str, ...] = ()) -> list[Any]:
    """The reference formulas of a model's energies, looked up by `energy.name` or the snake-case class name; those
    named in `elsewhere` are the caller's."""
    built = []
    for energy in scene.model.energies:
        if getattr(energy, "name", None) in elsewhere:
            continue
        kind = getattr(energy, "name", None) or re.sub(r"(?<!^)(?=[A-Z])", "_", type(energy).__name__).lower()
        if kind not in ENERGIES:
            raise ValueError(f"energies: no reference formula for {kind!r}; known are {sorted(ENERGIES)}")
        built.append(ENERGIES[kind](energy, scene))
    if scene.viscosity is not None or scene.volume_viscosity is not None:
        built.append(Viscosity(scene))
    return built


RESTING = 1e-6  # of the motion below which friction is smoothed


def smoothed(slip: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """f0(|u|) [m] of slips u [..., 3, n], f = f0'(|u|) / |u| [1/m] and f'(|u|) / |u|: below `reach` quadratic, above it
    Coulomb's |u|."""
    square = dot(slip, slip)
    moves = square > (RESTING * reach) ** 2
    # |u| has a kink at 0: where only rounding moves, its derivative is taken as 0
    length = torch.where(moves, torch.where(moves, square, 1.0).sqrt(), square.detach().sqrt())
    slow = length < reach
    potential = torch.where(slow, length**2 / reach - length**3 / (3 * reach**2) + reach / 3, length)
    rate = torch.where(slow, (2 - length / reach) / reach, 1 / torch.where(slow, 1.0, length))
    slope = torch.where(slow, -1 / reach**2, -rate * rate)
    return potential, rate, torch.where(moves, slope / torch.where(moves, length, 1.0), 0.0)


def tangential6(normal: Tensor) -> Tensor:
    """Upper triangle of I - n n^T: [..., 3, n] -> [..., 6, n]."""
    return normal.new_tensor([1, 0, 0, 1, 0, 1])[:, None] - outer6(normal)


class FloorFriction:
    """mu_f lambda f0(|u|) per plane: lambda the barrier's force at x_prev, u the slip since x_prev."""

    def __init__(self, scene: Scene, floor: FloorBarrier) -> None:
        friction = scene.model.friction
        self.scene, self.floor = scene, floor
        given = scene.parameter(friction, "coefficient")
        if isinstance(friction.coefficient, Tensor):  # of each two bodies; the floor is the last
            given = ((given + given.mT) / 2)[..., -1, scene.model.body]
        else:
            given = given[..., None].expand(*given.shape, len(scene.model.body))
        self.coefficient = given[..., None, :]
        self.reach = scene.time_step * friction.velocity

    def _full(self, x: Tensor, x_prev: Tensor, vertices: Any = slice(None)) -> tuple[Tensor, Tensor]:
        """h^2 times the friction that full slip meets [..., planes, n], and the slip [..., planes, 3, n], of some
        vertices."""
        floor, x, x_prev = self.floor, x[..., vertices], x_prev[..., vertices].unsqueeze(-3)
        gap = dot(floor.normal, x_prev) - floor.height
        _, first, _ = log_barrier(gap, floor.kappa, floor.dhat)
        travel = x.unsqueeze(-3) - x_prev
        slip = travel - floor.normal * dot(floor.normal, travel).unsqueeze(-2)
        return -(self.scene.time_step**2) * self.coefficient[..., vertices] * first, slip

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        vertices = self.scene.layout.colors[k].vertices
        weight, slip = self._full(x, x_prev, vertices)
        weight = (weight * smoothed(slip, self.reach)[1]).unsqueeze(-2)
        across = tangential6(self.floor.normal)
        return torch.cat(((weight * slip).sum(-3), (weight * across).sum(-3)), -2)

    def on_vertices(
        self, x: Tensor, x_prev: Tensor, vertices: Any = slice(None), bend: bool = True
    ) -> tuple[Tensor, Tensor]:
        """Gradient [..., 3, V] and its exact derivative [..., 6, V], of some vertices; without ``bend`` as block()."""
        weight, slip = self._full(x, x_prev, vertices)
        _, rate, curvature = smoothed(slip, self.reach)
        across, along = tangential6(self.floor.normal), outer6(slip)
        rate, more = (weight * rate).unsqueeze(-2), (weight * curvature).unsqueeze(-2)
        return (rate * slip).sum(-3), (rate * across + (more * along if bend else 0)).sum(-3)

    def exact_block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        """As block, with that derivative, which corrections take."""
        vertices = self.scene.layout.colors[k].vertices
        return torch.cat(self.on_vertices(x, x_prev, vertices), -2)

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        return self.terms(x, x_prev)[0].sum(-1)

    def terms(self, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        free = ~self.scene.model.pinned
        weight, slip = self._full(x, x_prev, free)
        total = weight * smoothed(slip, self.reach)[0]
        return total.flatten(-2), free.nonzero()[:, 0].repeat(total.shape[-2])


def floor_friction(scene: Scene, energies: list[Any]) -> list[FloorFriction]:
    """The friction of the floor among `energies`, where the model has both."""
    if getattr(scene.model, "friction", None) is None:
        return []
    return [FloorFriction(scene, energy) for energy in energies if isinstance(energy, FloorBarrier)]
