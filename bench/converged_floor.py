"""Converged steps of a body that meets a floor, by Newton's method with a line search: NumPy, apart from the package.

Stable Neo-Hookean tets, the log barrier and lagged friction are as docs/method.md states them, with dense matrices.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import diffvbd as dv
from diffvbd import results

Array = NDArray[np.float64]
TOLERANCE = 1e-9  # of the sums of the gradient's parts
ROUNDING = 1e-12  # of a body's size: a Newton step that moves nothing
MOST = 200  # Newton steps in a time step
SLIVER = 0.1  # quality below which a tet is left out of a ball


@dataclass
class Body:
    """A body above the plane y = 0 [SI units]; what no state changes is made once."""

    points: Array  # at rest [V, 3]
    tets: NDArray[np.int64]
    young: float
    poisson: float
    time_step: float
    kappa: float
    dhat: float
    density: float = 1000.0
    friction: float = 0.0
    eps_v: float = 1e-3
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pinned: NDArray[np.bool_] | None = None
    iterations: list[int] = field(default_factory=list)  # of each step

    def __post_init__(self) -> None:
        count, self.extent = len(self.points), float(np.ptp(self.points, axis=0).max())
        shape = self.points[self.tets[:, 1:]] - self.points[self.tets[:, :1]]  # rows are edges
        inverse = np.linalg.inv(shape)  # columns are the gradients of the last three shape functions
        self.grad = np.concatenate([-inverse.sum(2)[:, None], inverse.swapaxes(1, 2)], 1)  # [T, 4, 3]
        self.volume = np.linalg.det(shape) / 6
        self.mass = np.bincount(self.tets.ravel(), np.repeat(self.density * self.volume / 4, 4), count)
        self.mu = self.young / (2 * (1 + self.poisson))
        self.unit = self.time_step**2 * self.mu * float(self.volume.sum())  # the size of what the energy's terms cancel
        self.lb = self.mu + self.young * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))
        self.free = np.ones(count, bool) if self.pinned is None else ~self.pinned
        number = np.where(self.free, np.cumsum(self.free) - 1, -1)
        self.size = 3 * int(self.free.sum())
        rows = np.where(number[self.tets] >= 0, 3 * number[self.tets], -(10**9))[:, :, None] + np.arange(3)
        index = rows[:, :, None, :, None] * self.size + rows[:, None, :, None, :]
        both = np.broadcast_to((rows[:, :, None, :, None] >= 0) & (rows[:, None, :, None, :] >= 0), index.shape)
        self.where, self.kept = index[both], both
        self.crossed = np.cross(self.grad[:, :, None], self.grad[:, None])  # [T, 4, 4, 3]
        self.diagonal = (self.mu * self.volume)[:, None, None] * (self.grad @ self.grad.swapaxes(1, 2))

    def _strain(self, x: Array) -> tuple[Array, Array, Array]:
        """F [T, 3, 3], its cofactors and J - 1."""
        f = x[self.tets].swapaxes(1, 2) @ self.grad
        a, b, c = f[:, :, 0], f[:, :, 1], f[:, :, 2]
        cof = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 2)
        return f, cof, (a * cof[:, :, 0]).sum(1) - 1

    def elastic(self, x: Array) -> float:
        """Elastic energy [J]."""
        f, _, strain = self._strain(x)
        return float((self.volume * (self.mu * (((f * f).sum((1, 2)) - 3) / 2 - strain)
                                     + self.lb / 2 * strain**2)).sum())  # fmt: skip

    def barrier(self, x: Array) -> tuple[Array, Array, Array]:
        """b, b' and b'' of every free vertex; b is infinite on or below the plane."""
        gap = x[:, 1]
        d = np.where(self.free & (gap > 0) & (gap < self.dhat), gap, self.dhat)
        past, log = d - self.dhat, np.log(d / self.dhat)
        value = np.where(self.free & (gap <= 0), np.inf, -self.kappa * past**2 * log)
        return (value, -self.kappa * (2 * past * log + past**2 / d),
                -self.kappa * (2 * log + 4 * past / d - (past / d) ** 2))  # fmt: skip

    def floor_force(self, x: Array) -> float:
        """Force of the plane on the body [N]."""
        return float(-self.barrier(x)[1].sum())

    def _slip(self, x: Array, start: Array) -> tuple[Array, Array, Array]:
        """Slip [V, 2] since the start of the step, its length and the friction of full slip [N]."""
        slip = (x - start)[:, [0, 2]]
        return slip, np.linalg.norm(slip, axis=1), -self.friction * self.barrier(start)[1]

    def potential(self, x: Array, y: Array, start: Array) -> float:
        """G [kg m^2] of docs/method.md, section 1."""
        h, own = self.time_step, self.free
        rubbed = 0.0
        if self.friction:
            reach, (_, length, full) = h * self.eps_v, self._slip(x, start)
            slow = length**2 / reach - length**3 / (3 * reach**2) + reach / 3
            rubbed = (full * np.where(length < reach, slow, length)).sum()
        inertia = 0.5 * (self.mass[own] * ((x - y)[own] ** 2).sum(1)).sum()
        return inertia + h * h * (self.elastic(x) + self.barrier(x)[0].sum() + rubbed)

    def gradient(self, x: Array, y: Array, start: Array) -> tuple[Array, float]:
        """dG/dx at free vertices [n] and the size of the parts that it is the sum of."""
        f, cof, strain = self._strain(x)
        stress = self.mu * f + (self.lb * strain - self.mu)[:, None, None] * cof
        each = self.volume[:, None, None] * (self.grad @ stress.swapaxes(1, 2))  # [T, 4, 3]
        inner = np.stack([np.bincount(self.tets.ravel(), each[:, :, k].ravel(), len(x)) for k in range(3)], 1)
        h, floor = self.time_step, np.zeros_like(x)
        floor[:, 1] = self.barrier(x)[1]
        if self.friction:
            reach, (slip, length, full) = h * self.eps_v, self._slip(x, start)
            rate = np.where(length < reach, (2 - length / reach) / reach, 1 / np.maximum(length, reach))
            floor[:, [0, 2]] = (full * rate)[:, None] * slip
        parts = np.stack([self.mass[:, None] * (x - y), h * h * inner, h * h * floor])[:, self.free]
        return parts.sum(0).ravel(), float(np.linalg.norm(parts.reshape(3, -1), axis=1).sum())

    def hessian(self, x: Array, start: Array, convex: bool) -> Array:
        """d2G/dx2 [n, n]; convex: of the tets only what is positive semidefinite."""
        f, cof, strain = self._strain(x)
        q, weight = self.grad @ cof.swapaxes(1, 2), self.volume * (self.lb * strain - self.mu)
        w = (self.crossed @ f.swapaxes(1, 2)[:, None]) * -weight[:, None, None, None]
        block = np.zeros((*w.shape, 3))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # the matrix of w x
            block[..., i, j], block[..., j, i] = -w[..., k], w[..., k]
            block[..., i, i] = self.diagonal
        block += (self.lb * self.volume)[:, None, None, None, None] * q[:, :, None, :, None] * q[:, None, :, None, :]
        if convex:
            whole = block.swapaxes(2, 3).reshape(-1, 12, 12)
            value, vector = np.linalg.eigh((whole + whole.swapaxes(1, 2)) / 2)
            whole = (vector * np.maximum(value, 0)[:, None]) @ vector.swapaxes(1, 2)
            block = whole.reshape(-1, 4, 3, 4, 3).swapaxes(2, 3)
        h2 = self.time_step**2
        out: Any = h2 * np.bincount(self.where, block[self.kept], self.size**2).reshape(self.size, self.size)
        own = np.zeros((len(x), 3, 3))
        own[:, [0, 1, 2], [0, 1, 2]] = self.mass[:, None]
        own[:, 1, 1] += h2 * self.barrier(x)[2]
        if self.friction:
            reach, (slip, length, full) = self.time_step * self.eps_v, self._slip(x, start)
            slow = length < reach
            rate = np.where(slow, (2 - length / reach) / reach, 1 / np.maximum(length, reach))
            bend = np.where(slow, 2 * (1 - length / reach) / reach, 0.0) - rate
            along = slip / np.maximum(length, 1e-300)[:, None]
            across = rate[:, None, None] * np.eye(2) + bend[:, None, None] * along[:, :, None] * along[:, None]
            own[:, ::2, ::2] += h2 * full[:, None, None] * across
        each = np.arange(self.size).reshape(-1, 3)
        out[each[:, :, None], each[:, None]] += own[self.free]
        return out

    def _direction(self, x: Array, start: Array, g: Array) -> Array:
        from scipy.linalg import LinAlgError, cho_factor, cho_solve

        try:
            factor = cho_factor(self.hessian(x, start, False), lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError:
            factor = cho_factor(self.hessian(x, start, True), lower=True, overwrite_a=True, check_finite=False)
        return np.asarray(cho_solve(factor, -g, check_finite=False), dtype=np.float64)

    def step(self, x: Array, v: Array, prescribed: Array | None = None) -> tuple[Array, Array]:
        """One step of implicit Euler, to convergence: the new positions and velocities.

        Raises RuntimeError where it does not converge."""
        h, start = self.time_step, x
        y = x + h * v + h * h * np.array(self.gravity)
        y[~self.free] = (x if prescribed is None else prescribed)[~self.free]
        state = np.where(self.free[:, None], x + h * v, y)
        state[:, 1] = np.where(self.free, np.maximum(state[:, 1], np.minimum(x[:, 1], 0.5 * self.dhat)), state[:, 1])
        value, (g, size) = self.potential(state, y, start), self.gradient(state, y, start)
        for done in range(MOST):
            way = np.zeros_like(x)
            if np.linalg.norm(g) > TOLERANCE * size:
                way[self.free] = self._direction(state, start, g).reshape(-1, 3)
            if np.abs(way).max() <= ROUNDING * self.extent:
                self.iterations.append(done)
                return state, (state - x) / h
            slope, down = float(g @ way[self.free].ravel()), self.free & (way[:, 1] < 0)
            share = min(1.0, 0.95 * float((-state[down, 1] / way[down, 1]).min(initial=np.inf)))
            while share > 1e-12:
                trial = state + share * way
                now = self.potential(trial, y, start)
                if now <= value + 1e-4 * share * slope:
                    break
                if -share * slope < 1e-11 * (abs(value) + self.unit):  # rounding hides the decrease
                    if np.linalg.norm(self.gradient(trial, y, start)[0]) < np.linalg.norm(g):
                        break
                share /= 2
            else:
                break
            state, value = trial, now
            g, size = self.gradient(state, y, start)
        raise RuntimeError(f"Newton's method ended with a residual of {np.linalg.norm(g) / size:.1e}")

    def rollout(self, x: Array, v: Array, steps: int, prescribed: Any = None) -> tuple[Array, Array]:
        """Positions and velocities at the start and after each step [steps + 1, V, 3]; prescribed: of step n."""
        xs, vs = [x], [v]
        for n in range(steps):
            x, v = self.step(x, v, None if prescribed is None else prescribed[n])
            xs.append(x)
            vs.append(v)
        return np.stack(xs), np.stack(vs)


def apart(body: Body, motion: results.Trajectory, exact: tuple[Array, Array]) -> float:
    """Error of a rollout: of positions, rms at worst over the largest rms motion, or of the velocity of the center of
    mass at the end, over that at the start."""
    x, v = exact
    off = np.sqrt(((motion.x.numpy() - x) ** 2).sum(-1).mean(-1))
    moved = np.sqrt(((x - x[0]) ** 2).sum(-1).mean(-1)).max()
    mass = body.mass / body.mass.sum()
    speed = np.linalg.norm(mass @ (motion.v[-1].numpy() - v[-1])) / np.linalg.norm(mass @ v[0])
    error = max(float(off.max() / moved), float(speed))
    return error if np.isfinite(error) else np.inf


def ball(radius: float, spacing: float, seed: int = 0) -> dv.TetMesh:
    """Delaunay tets of points in a ball about the origin: even ones on its surface, random ones inside."""
    from scipy.spatial import Delaunay

    rng, golden = np.random.default_rng(seed), np.pi * (3 - 5**0.5)
    outside = round(4 * np.pi * (radius / spacing) ** 2 * 2 / 3**0.5)
    height = 1 - 2 * (np.arange(outside) + 0.5) / outside
    angle, ring = golden * np.arange(outside), np.sqrt(1 - height**2)
    points = radius * np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], 1)
    for inner in rng.uniform(-radius, radius, (4000, 3)):
        far = np.linalg.norm(points - inner, axis=1).min() > 0.85 * spacing
        if far and np.linalg.norm(inner) < radius - 0.5 * spacing:
            points = np.vstack([points, inner])
    tets = Delaunay(points).simplices
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    flat = np.abs(np.linalg.det(edges)) < 1e-3 * np.linalg.norm(edges, axis=2).mean(1) ** 3
    whole = dv.TetMesh(points, tets[~flat], orient=True)
    return dv.TetMesh(points, whole.tets[whole.quality > SLIVER])
