"""Bodies that meet a floor: rollouts of 20 sweeps, plain and with coarse corrections, against converged steps.

The converged steps are of Newton's method with a line search, in NumPy, apart from the package: stable Neo-Hookean
tets, the log barrier and lagged friction as docs/method.md states them, with dense matrices. Errors are of positions
(rms over the largest rms motion, at the end and at worst), and of the velocity of the center of mass at the end, over
that at the start.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import diffvbd as dv
from bench.measure import Card
from bench.tables import Table, count, median, most
from diffvbd import mesh, results

Array = NDArray[np.float64]
TOLERANCE = 1e-9  # of the sums of the gradient's parts
ROUNDING = 1e-12  # of a body's size: a Newton step that moves nothing
MOST = 200  # Newton steps in a time step


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


SEED = 61
SLIVER = 0.1  # quality below which a tet is left out of a ball


@dataclass(frozen=True)
class Scene:
    """A body above the plane y = 0; ``body`` has all of its numbers [SI units]."""

    name: str
    mesh: dv.TetMesh
    body: Body
    v: Array  # [V, 3] [m/s]
    steps: int

    @property
    def spacing(self) -> float:
        """Mean distance of vertices [m]."""
        return float(self.mesh.volume.sum() / self.mesh.num_vertices) ** (1 / 3)

    @property
    def stiffness(self) -> float:
        """How many vertices a wave passes in a step."""
        return self.body.time_step * (self.body.young / self.body.density) ** 0.5 / self.spacing

    def energies(self) -> tuple[Any, ...]:
        b = self.body
        rubs = (dv.Friction(b.friction, velocity=b.eps_v),) if b.friction else ()
        return (dv.StableNeoHookean(), dv.FloorBarrier(kappa=b.kappa, dhat=b.dhat), *rubs)

    def executed(self, sweeps: int, **options: Any) -> tuple[results.Trajectory, dv.Model, list[str]]:
        """Its rollout by a solver of these options, the Model, and what was said of either."""
        b = self.body
        with warnings.catch_warnings(record=True) as said, torch.no_grad():
            warnings.simplefilter("always")
            model = dv.Model(self.mesh, b.density, b.pinned, self.energies())
            solver = dv.VBD(b.time_step, sweeps, **options)
            motion = dv.rollout(model, model.rest_points, torch.from_numpy(self.v), solver, steps=self.steps,
                                young=b.young, poisson=b.poisson, gravity=b.gravity)  # fmt: skip
        return motion, model, [str(w.message) for w in said]


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


def _shape(rng: np.random.Generator) -> tuple[str, dv.TetMesh]:
    from scipy.spatial.transform import Rotation

    kind, size = ("ball", "cube", "taper")[rng.integers(3)], float(rng.uniform(0.05, 0.3))
    if kind == "ball":
        return kind, ball(size / 2, size * float(rng.uniform(0.19, 0.3)), int(rng.integers(1000)))
    if kind == "cube":
        shape = mesh.cube(int(rng.integers(4, 7)), size, split=("kuhn", "five")[rng.integers(2)])
    else:
        n = int(rng.integers(3, 5))
        shape = mesh.box((n, int(rng.integers(5, 10)), n), (0.5 * size, size, 0.5 * size))
        points, narrow = shape.points.copy(), float(rng.uniform(0.3, 0.8))
        points[:, ::2] *= 1 - narrow * points[:, 1:2] / size
        shape = dv.TetMesh(points, shape.tets)
    if rng.integers(2):  # on a corner or an edge; else flat, a taper on its wide end or its tip
        turn = Rotation.random(rng=rng)
    else:
        turn = Rotation.from_euler("x", float(180 * rng.integers(2)), degrees=True)
    return kind, dv.TetMesh(turn.apply(shape.points.copy()), shape.tets)


def drawn(number: int) -> Scene:
    """Scene `number` of the seed: half of them with gravity, every fourth with friction and some speed along the floor.

    A barrier is 0.3 to 100 times as stiff as the body is at a vertex, or as it takes to stop one.
    """
    rng = np.random.default_rng((SEED, number))
    kind, shape = _shape(rng)
    size = float(np.ptp(shape.points, axis=0).max())
    young, poisson, speed = (
        float(10 ** rng.uniform(4.477, 7)),
        float(rng.uniform(0.2, 0.45)),
        float(rng.uniform(0.5, 5)),
    )
    h, dhat = 1e-3 * float(rng.uniform(1, 5)), size * float(rng.uniform(0.01, 0.05))
    spacing = (float(np.abs(shape.volume).sum()) / shape.num_vertices) ** (1 / 3)
    least = max(young * spacing, 0.5 * 1000 * spacing**3 * speed**2 / dhat**2)
    kappa = least * float(10 ** rng.uniform(-0.5, 2))
    shape = shape.translate((0, dhat + speed * h * float(rng.uniform(0, 3)) - shape.points[:, 1].min(), 0))
    friction = float(rng.uniform(0.1, 0.8)) if number % 4 == 3 else 0.0
    gravity = (0.0, -9.81 if number % 2 else 0.0, 0.0)
    body = Body(shape.points, shape.tets, young, poisson, h, kappa, dhat, friction=friction, gravity=gravity)
    v = np.zeros_like(shape.points)
    v[:, 1] = -speed
    if friction:
        v[:, 0] = float(rng.uniform(-0.5, 0.5)) * speed
    name = f"{number}: {kind}, {shape.num_vertices} vertices"
    return Scene(name, shape, body, v, int(rng.integers(20, 61)))


COUNT, QUICK_COUNT = 300, 30
SWEEPS, OFF = 20, 0.05
MORE = (40, 80, 160, 320, 640, 1280)
KINDS: dict[str, dict[str, Any]] = {"plain": {}, "coarse": {"subspace": "coarse"}}


def rollouts(numbers: Iterable[int]) -> list[dict[str, Any]]:
    """Error of each drawn scene, plain and with corrections: of positions (rms over the largest rms motion, at the end
    and at worst), and of the velocity of the center of mass at the end, over that at the start."""
    out = []
    for number in numbers:
        scene = drawn(number)
        b = scene.body
        exact = b.rollout(scene.mesh.points, scene.v, scene.steps)
        for kind, options in KINDS.items():
            motion, _, said = scene.executed(SWEEPS, **options)
            errors = apart(scene, motion, exact)
            row = {"scene": scene.name, "young": b.young, "poisson": b.poisson, "speed": -float(scene.v[0, 1]),
                   "time_step": b.time_step, "steps": scene.steps, "kappa": b.kappa, "dhat": b.dhat,
                   "friction": b.friction, "gravity": b.gravity[1], "stiffness": scene.stiffness,
                   "corrections": kind, **errors, "off": max(errors.values()) > OFF, "said": _short(said)}  # fmt: skip
            if row["off"]:
                enough = (k for k in MORE if max(apart(scene, scene.executed(k, **options)[0], exact).values()) < OFF)
                row["needs"] = next(enough, None)
            out.append(row)
    return out


def apart(scene: Scene, motion: results.Trajectory, exact: tuple[Array, Array]) -> dict[str, float]:
    x, v = exact
    off = np.sqrt(((motion.x.numpy() - x) ** 2).sum(-1).mean(-1))
    moved = np.sqrt(((x - x[0]) ** 2).sum(-1).mean(-1)).max()
    mass = scene.body.mass / scene.body.mass.sum()
    speed = np.linalg.norm(mass @ (motion.v[-1].numpy() - v[-1])) / np.linalg.norm(mass @ v[0])
    errors = {"end": off[-1] / moved, "worst": off.max() / moved, "velocity": speed}
    return {name: float(value) if np.isfinite(value) else np.inf for name, value in errors.items()}


def _short(said: list[str]) -> str:
    """Which arguments the warnings are about."""
    return ", ".join(dict.fromkeys(text.split(":")[0] for text in said))


THREADS = 1
GROUPS: dict[str, Callable[[Card], list[dict[str, Any]]]] = {
    "rollouts": lambda card: rollouts(range(QUICK_COUNT if card.quick else COUNT)),
}
TABLES = (
    Table(f"Bodies thrown on a floor, K = {SWEEPS}", "rollouts",
          {"rollouts": count(), f"off by more than {OFF:.0%}": count("off"),
           "of them silent": count(lambda row: row["off"] and not row["said"]), "median error": median("worst"),
           "largest error": most("worst"), "of the velocity": most("velocity")}, by="corrections"),
    Table("The farthest off", "rollouts",
          ("scene", "corrections", "young", "speed", "time_step", "steps", "kappa", "dhat", "friction", "stiffness",
           "end", "worst", "velocity", "needs", "said"), only=lambda row: row["off"], most=lambda row: row["worst"]),
)  # fmt: skip
