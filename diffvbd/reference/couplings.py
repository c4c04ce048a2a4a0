"""Springs, tendons and pressure: energies of several vertices, and the bound that stands for them within a sweep.

Each energy offers `own(x)` -> [..., N], the energies of its N springs, tendons or cavities in a state [..., 3, V], and
`bound(x)` -> [..., V], the stiffness s_i of a vertex for which

    E(x0) + sum_i g_i . (x_i - x0_i) + s_i / 2 |x_i - x0_i|^2

bounds E. Coarse corrections take `curvature(x)` -> [..., 3 V, 3 V], the second derivative without what of it may be
negative, and `acts_on` [N, V]. Points are dense matrices here, one column a vertex.
"""

from typing import Any

import torch
from torch import Tensor

from .energies import ENERGIES, Anchor, StableNeoHookean, build_energies
from .scene import Scene, cross, dot


def _dense(embedding: Any, scene: Scene) -> Tensor:
    """Weights of points as a matrix [P, V]."""
    rows = torch.arange(len(embedding))[:, None].expand(embedding.vertices.shape)
    out = torch.zeros(len(embedding), scene.rest_points.shape[-1], dtype=torch.float64)
    return scene.tensor(out.index_put((rows, embedding.vertices), embedding.weights, accumulate=True))


def _rows_of_products(weights: Tensor, scene: Scene) -> Tensor:
    """|w_i| sum_j |w_j|, j over the vertices that move, of weights [..., V]."""
    moving = (~scene.model.pinned).to(weights)
    return weights.abs() * (weights.abs() * moving).sum(-1, keepdim=True)


def _norm(d: Tensor) -> Tensor:
    """|d| of [..., 3, n], with a derivative of 0 at 0."""
    square = dot(d, d)
    return torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)


class Coupling:
    scene: Scene

    def own(self, x: Tensor) -> Tensor:
        raise NotImplementedError

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        return self.scene.time_step**2 * self.own(x).sum(-1)

    def gradient(self, x: Tensor) -> Tensor:
        """Of energy() [..., 3, V]; differentiable in x."""
        with torch.enable_grad():
            at = x if x.requires_grad else x.detach().requires_grad_()
            (out,) = torch.autograd.grad(self.energy(at, at).sum(), at, create_graph=True)
        return out if torch.is_grad_enabled() else out.detach()


def _along(rate: Tensor, slope: Tensor) -> Tensor:
    """sum of rate s s^T of N slopes [..., N, V, 3]."""
    flat = slope.flatten(-2)
    return torch.einsum("...n,...ni,...nj->...ij", rate, flat, flat)


def _across(force: Tensor, normal: Tensor, weights: Tensor) -> Tensor:
    """sum of w w^T force (1 - n n^T) of vectors [..., 3, M] with weights [M, V]."""
    eye = torch.eye(3, dtype=normal.dtype, device=normal.device)
    block = force * (eye[..., None] - normal[..., :, None, :] * normal[..., None, :, :])
    return torch.einsum("...ijm,mv,mu->...viuj", block, weights, weights).flatten(-4, -3).flatten(-2)


class Springs(Coupling):
    """k / 2 (|d|^2 - 2 L |d| + L^2), d = p - q; with tension_only k / 2 max(0, |d| - L)^2."""

    def __init__(self, energy: Any, scene: Scene) -> None:
        self.scene, self.tension_only = scene, energy.tension_only
        self.weights = _dense(energy.first, scene)
        self.places = None
        if hasattr(energy.second, "weights"):
            self.weights = self.weights - _dense(energy.second, scene)
        else:
            self.places = scene.parameter(energy, "points").transpose(-1, -2)
        self.k, self.rest = (scene.parameter(energy, key) for key in ("stiffness", "rest_length"))

    def _vectors(self, x: Tensor) -> Tensor:
        d = x @ self.weights.mT
        return d if self.places is None else d - self.places

    def own(self, x: Tensor) -> Tensor:
        d = self._vectors(x)
        length = _norm(d)
        own = dot(d, d) - 2 * self.rest * length + self.rest**2
        if self.tension_only:
            own = (length - self.rest).clamp(min=0) ** 2
        return self.k / 2 * own

    def curvature(self, x: Tensor) -> Tensor:
        d = self._vectors(x)
        length = _norm(d)
        some = torch.where(length > 0, length, 1.0)
        normal, stretch = d / some.unsqueeze(-2), torch.where(length > 0, 1 - self.rest / some, 1.0)
        k = self.k * (length >= self.rest) if self.tension_only else self.k.expand_as(length)
        along = torch.einsum("...in,nv->...nvi", normal, self.weights)
        return _along(k, along) + _across(k * stretch.clamp(min=0), normal, self.weights)

    @property
    def acts_on(self) -> Tensor:
        return self.weights != 0

    def bound(self, x: Tensor) -> Tensor:
        k = self.k.expand(*self.k.shape[:-1], len(self.weights)) if self.k.dim() else self.k.expand(len(self.weights))
        return k @ _rows_of_products(self.weights, self.scene)


class Tendons(Coupling):
    """k / 2 max(0, l - L)^2, l the length of a route."""

    def __init__(self, energy: Any, scene: Scene) -> None:
        points, count = _dense(energy.points, scene), len(energy.routes)
        self.scene = scene
        self.routes = [points[list(route[1:])] - points[list(route[:-1])] for route in energy.routes]
        keys = ("stiffness", "rest_length")
        values = [scene.parameter(energy, key) for key in keys]
        self.k, self.rest = (v.expand(*v.shape[:-1], count) if v.dim() else v.expand(count) for v in values)

    def own(self, x: Tensor) -> Tensor:
        lengths = torch.stack([_norm(x @ route.mT).sum(-1) for route in self.routes], -1)
        return self.k / 2 * (lengths - self.rest).clamp(min=0) ** 2

    def curvature(self, x: Tensor) -> Tensor:
        total = x.new_zeros(())
        for n, route in enumerate(self.routes):
            d = x @ route.mT
            lengths = _norm(d)
            normal, longer = d / lengths.unsqueeze(-2), lengths.sum(-1, keepdim=True) - self.rest[..., n, None]
            rate = self.k[..., n, None] * (longer > 0)
            slope = (normal @ route).transpose(-1, -2).unsqueeze(-3)
            total = total + _along(rate, slope) + _across(rate * longer / lengths, normal, route)
        return total

    @property
    def acts_on(self) -> Tensor:
        return torch.stack([(route != 0).any(0) for route in self.routes])

    def bound(self, x: Tensor) -> Tensor:
        total, moving = torch.zeros_like(x[..., 0, :]), (~self.scene.model.pinned).to(x)
        for n, route in enumerate(self.routes):
            d = x @ route.mT
            lengths, k = _norm(d), self.k[..., n, None]
            slope = (d / lengths.unsqueeze(-2)) @ route
            slope = (dot(slope, slope) + STRAIGHT**2).sqrt() * (route != 0).any(0)  # |dl / dx_i|
            tension = k * (lengths.sum(-1, keepdim=True) - self.rest[..., n, None]).clamp(min=0)
            total = total + k * slope * (slope * moving).sum(-1, keepdim=True)
            total = total + (tension / lengths) @ _rows_of_products(route, self.scene)
        return total


class Pressure(Coupling):
    """-p V of closed surfaces, or that of an amount of gas at constant temperature."""

    def __init__(self, energy: Any, scene: Scene) -> None:
        self.scene, self.gas, self.ambient = scene, energy.gas, energy.ambient
        rest, surfaces = scene.tensor(scene.model.rest_points).T, []
        for given in energy.surfaces:
            triangles = torch.as_tensor(given.copy())
            volume = self._volume(rest, triangles)
            surfaces.append(triangles if volume > 0 else triangles[:, [0, 2, 1]])
        self.surfaces, self.rest = surfaces, torch.stack([self._volume(rest, t) for t in surfaces])
        p = scene.parameter(energy, "pressure")
        self.pressure = p.expand(*p.shape[:-1], len(surfaces)) if p.dim() else p.expand(len(surfaces))

    @staticmethod
    def _volume(x: Tensor, triangles: Tensor) -> Tensor:
        a, b, c = (x[..., corner] for corner in triangles.T)
        return dot(a, cross(b, c)).sum(-1) / 6

    def own(self, x: Tensor) -> Tensor:
        volume = torch.stack([self._volume(x, t) for t in self.surfaces], -1)
        if not self.gas:
            return -self.pressure * volume
        return self.ambient * volume - (self.pressure + self.ambient) * self.rest * torch.log(volume / self.rest)

    def curvature(self, x: Tensor) -> Tensor:
        """Of gas what is of rank one; of a given pressure nothing."""
        total = x.new_zeros((*x.shape[:-2], 3 * x.shape[-1], 3 * x.shape[-1]))
        for n, triangles in enumerate(self.surfaces):
            if not self.gas:
                break
            a, b, c = (x[..., corner] for corner in triangles.T)
            normal = cross(b - a, c - a) / 6
            slope = sum(torch.zeros_like(x).index_add(-1, corner, normal) for corner in triangles.T)
            assert isinstance(slope, Tensor)
            rate = (self.pressure[..., n] + self.ambient) * self.rest[n] / self._volume(x, triangles) ** 2
            total = total + _along(rate[..., None], slope.transpose(-1, -2).unsqueeze(-3))
        return total

    @property
    def acts_on(self) -> Tensor:
        vertices = torch.arange(self.scene.rest_points.shape[-1])
        return torch.stack([torch.isin(vertices, triangles) for triangles in self.surfaces])

    def bound(self, x: Tensor) -> Tensor:
        count, moving = x.shape[-1], (~self.scene.model.pinned).to(x)
        total = torch.zeros_like(x[..., 0, :])
        for n, triangles in enumerate(self.surfaces):
            p, size = self.pressure[..., n, None], torch.zeros_like(total)
            # d2V / dx_i dx_j is the cross product with a vector [..., 3, V, V]
            axis = x.new_zeros(*x.shape, count)
            for i, j, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                a, b, opposite = triangles[:, i], triangles[:, j], x[..., triangles[:, c]] / 6
                flat = axis.flatten(-2).index_add(-1, a * count + b, opposite)
                axis = flat.index_add(-1, b * count + a, -opposite).unflatten(-1, (count, count))
            a, b, c = (x[..., corner] for corner in triangles.T)
            areas = _norm(cross(b - a, c - a)) / 6
            for corner in triangles.T:
                size = size.index_add(-1, corner, areas)
            volume = self._volume(x, triangles)[..., None]
            if self.gas:
                absolute = (p + self.ambient) * self.rest[n] / volume
                total = total + absolute / volume * size * size.sum(-1, keepdim=True)
                p = absolute - self.ambient
            rows = _norm(axis.flatten(-2)).unflatten(-1, (count, count))
            total = total + p.abs() * (rows * moving).sum(-1)
        return total


STRAIGHT = 1e-3  # smooths |dl / dx_i| where it is 0
ENERGIES |= {"spring": Springs, "tendon": Tendons, "pressure": Pressure}


class Bound(Anchor):
    """The bound of all energies of a scene about the state of the last `renew`, as an energy of single vertices."""

    def __init__(self, scene: Scene, energies: list[Any]) -> None:
        self.scene, self.energies = scene, energies

    def renew(self, x: Tensor) -> None:
        """Take the bound about x [..., 3, V]; differentiable in x."""
        gradient = torch.stack([energy.gradient(x) for energy in self.energies]).sum(0) / self.scene.time_step**2
        self.stiffness = torch.stack([energy.bound(x).expand_as(x[..., 0, :]) for energy in self.energies]).sum(0)
        some = (self.stiffness > 0).unsqueeze(-2)
        step = gradient / torch.where(some, self.stiffness.unsqueeze(-2), 1.0)
        self.points = x - torch.where(some, step, 0.0)


class Bounds:
    """What a scene's sweeps begin with anew: the bound of its couplings, if any, and those of its patches."""

    def __init__(self, couplings: Bound | None, laws: list[Any]) -> None:
        self.couplings, self.laws = couplings, laws

    def renew(self, x: Tensor) -> None:
        for bound in (*self.laws, *([] if self.couplings is None else [self.couplings])):
            bound.renew(x)


def energies_of_sweeps(scene: Scene, elsewhere: tuple[str, ...]) -> tuple[list[Any], Bounds | None]:
    """The energies of a scene as sweeps see them, and the bounds that stand for some among them."""
    built = build_energies(scene, elsewhere)
    couplings = [energy for energy in built if hasattr(energy, "bound")]
    bound = Bound(scene, couplings) if couplings else None
    if bound is not None:
        built = [*(energy for energy in built if not hasattr(energy, "bound")), bound]
    laws = [e for e in built if type(e) is StableNeoHookean and scene.patches is not None]
    return built, Bounds(bound, laws) if couplings or laws else None
