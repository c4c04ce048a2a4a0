"""One step of a tiny scene in 120 digits, its gradient, and what an ulp in the inputs does to both.

A reference in double precision loses the digits of a stiff direction as the code under test may; this one has digits to
spare. It states the step of docs/method.md, sections 1, 2 and 6, by `decimal` on numpy arrays, whose one axis holds
variants of the scene. Gradients are differences between variants 1e-45 apart, good to some 30 digits.

Not here: scenes in a batch, saturation, anchors, friction, prescribed positions, a start of the sweeps other than y.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, localcontext
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

DIGITS = 120
APART = Decimal("1e-45")  # of two variants, relative to an input's largest entry
ETA = 0.9  # a filtered move closes at most this fraction of a gap
ULP = 2.0**-52
Vector = np.ndarray  # [3, variants]


class Exact(NamedTuple):
    """Entries as those of `testing.evaluate`: "x" and "grad_<name>". sensitivity: the largest change of an entry over
    three moves of every input by an ulp, relative to its largest entry."""

    values: dict[str, np.ndarray]
    sensitivity: dict[str, float]


def exact_step(model: Any, inputs: dict[str, Any], sweeps: int, weights: Sequence[Tensor],
               names: Sequence[str] = ("x", "v", "mu", "lam"), block: str = "exact") -> Exact:  # fmt: skip
    """The step of one scene and the gradient of weights[0] . x' + h weights[1] . v'.

    inputs: x, v [V, 3], mu, lam [T] or scalars, time_step, gravity [3], and those of a floor. names: the inputs
    to differentiate. A scene that starts below its floor gives nonsense.
    """
    flat = {k: np.asarray(v, dtype=np.float64) for k, v in inputs.items() if isinstance(v, Tensor)}
    flat.setdefault("gravity", np.array([0.0, -9.81, 0.0]))
    flat["rest_points"] = np.asarray(model.rest_points, dtype=np.float64)
    rng = np.random.default_rng(0)
    scenes = [flat] + [{k: v * (1 + ULP * rng.choice((-1, 1), v.shape)) for k, v in flat.items()} for _ in range(3)]
    with localcontext() as context:
        context.prec = DIGITS
        variants: dict[str, list[np.ndarray]] = {k: [] for k in flat}
        entries = [(name, i) for name in names for i in range(flat[name].size)]
        for scene in scenes:
            for name, i in [(None, 0), *entries]:
                for k, value in scene.items():
                    exact = _decimal(value)
                    if k == name:
                        exact.reshape(-1)[i] += APART * _scale(value)
                    variants[k].append(exact)
        stacked = {k: np.stack(v, -1) for k, v in variants.items()}  # the variants last
        h = Decimal(float(inputs["time_step"]))
        x, loss = _step(model, stacked, h, sweeps, [_decimal(w) for w in weights], block)
        each = 1 + len(entries)
        results = []
        for s, scene in enumerate(scenes):
            at = s * each
            result = {"x": x[..., at].astype(np.float64)}
            exact_gradient: dict[str, list] = {name: [] for name in names}
            for j, (name, _) in enumerate(entries):
                change = loss[at + 1 + j] - loss[at]
                exact_gradient[name].append(float(change / (APART * _scale(scene[name]))))
            result |= {f"grad_{k}": np.array(v).reshape(flat[k].shape) for k, v in exact_gradient.items()}
            results.append(result)
    first = results[0]
    moved = {
        k: max(float(np.abs(r[k] - v).max() / max(np.abs(v).max(), 1e-300)) for r in results[1:])
        for k, v in first.items()
    }
    return Exact(first, moved)


def _decimal(value: Any) -> np.ndarray:
    value = np.asarray(value, dtype=np.float64)
    return np.array([Decimal(float(a)) for a in value.reshape(-1)], dtype=object).reshape(value.shape)


def _scale(value: np.ndarray) -> Decimal:
    return Decimal(float(np.abs(value).max()) or 1.0)


def _cross(a: Vector, b: Vector) -> Vector:
    return np.cross(a, b, axis=0)


def _dot(a: Vector, b: Vector) -> np.ndarray:
    return (a * b).sum(0)


_log = np.frompyfunc(lambda a: a.ln(), 1, 1)
_root = np.frompyfunc(lambda a: a.sqrt(), 1, 1)


def _step(model: Any, inputs: dict[str, np.ndarray], h: Decimal, sweeps: int, weights: list[np.ndarray], block: str
          ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Positions after the step and the loss, each with the variants as its last axis."""
    points, x = inputs["rest_points"], inputs["x"]  # [V, 3, variants]
    tets, pinned = model.tets.tolist(), model.pinned.tolist()
    density = np.broadcast_to(np.asarray(model.density, dtype=np.float64), (len(tets),))
    zero, diagonal = points[0, 0] * 0, np.eye(3, dtype=object)[..., None]
    mass = [zero for _ in points]
    rest = []
    for t, corners in enumerate(tets):
        e = points[corners[1:]] - points[corners[0]]
        areas = [_cross(e[1], e[2]), _cross(e[2], e[0]), _cross(e[0], e[1])]
        six_volumes = _dot(e[0], areas[0])
        # V grad N_a . grad N_b = area_a . area_b / (36 V)
        rest.append(([-(areas[0] + areas[1] + areas[2]), *areas], six_volumes))
        for c in corners:
            mass[c] = mass[c] + Decimal(float(density[t])) * six_volumes / 24
    stars: list[list[tuple[int, list[int]]]] = [[] for _ in points]
    order = [(1, 3, 2), (0, 2, 3), (1, 0, 3), (2, 0, 1)]  # makes (j, i, k, l) an even permutation of the tet
    for t in range(len(tets)):
        for a in range(4):
            stars[tets[t][a]].append((t, [a, *order[a]]))

    def material(name: str, t: int) -> Any:
        value = inputs[name]
        return value if value.ndim == 1 else value[t if value.shape[0] > 1 else 0]

    y = np.where(np.array(pinned)[:, None, None], x, x + h * inputs["v"] + h * h * inputs["gravity"])
    floor = _Floor(inputs, h) if "floor_height" in inputs else None
    now = y.copy()
    if floor is not None:
        now = np.stack([y[i] if pinned[i] else floor.started(x[i], y[i] - x[i]) for i in range(len(x))])
    tau, omega = Decimal(float(model.regularization)), Decimal(float(model.relaxation))
    for _ in range(sweeps):
        for i in model.color_vertices.tolist():  # vertices of one color do not see each other
            g, H = mass[i] * (now[i] - y[i]), diagonal * (mass[i] + tau)
            for t, (a, *others) in stars[i]:
                mu, lam = material("mu", t), material("lam", t)
                own, six_volumes = rest[t]
                xj, xk, xl = (now[tets[t][b]] for b in others)
                n, c6 = _cross(xk - xj, xl - xj), 1 / six_volumes
                strain = c6 * _dot(n, now[i] - xj) - 1
                g = g + h * h * ((mu + lam) * strain - mu) / 6 * n
                for b in others:
                    k = _dot(own[a], own[b]) / (6 * six_volumes)
                    g = g + h * h * mu * k * (now[tets[t][b]] - now[i])
                    H = H - diagonal * (h * h * mu * k)
                H = H + h * h * (mu + lam if block == "exact" else lam) * c6 / 6 * n[:, None] * n
            if floor is not None:
                for n, slope, curvature in floor.terms(now[i], x[i]):
                    g, H = g + slope * n, H + curvature * n[:, None] * n
            move = -omega * _solve(H, g)
            now[i] = now[i] + move if floor is None else floor.filtered(now[i], move)
    by_position, by_velocity = (w[..., None] for w in weights)
    return now, (by_position * now + by_velocity * (now - x)).sum((0, 1))


def _solve(H: np.ndarray, g: Vector) -> Vector:
    """H^-1 g by the adjugate: digits are plentiful."""
    a, b, c = H
    bc, ca, ab = _cross(b, c), _cross(c, a), _cross(a, b)
    return (bc * g[0] + ca * g[1] + ab * g[2]) / _dot(a, bc)


class _Floor:
    """The planes of a floor barrier: terms of the block, and the step filter."""

    def __init__(self, inputs: dict[str, np.ndarray], h: Decimal) -> None:
        def parameter(name: str) -> np.ndarray:
            return inputs[f"floor_{name}"]

        self.h = h
        self.kappa, self.dhat = parameter("kappa"), parameter("dhat")
        self.damping = parameter("damping") if "floor_damping" in inputs else 0 * self.kappa
        self.planes = []
        for normal, height in zip(parameter("normal"), parameter("height"), strict=True):
            self.planes.append((normal / _root(_dot(normal, normal)), height))

    def terms(self, x: Vector, x_prev: Vector) -> list[tuple[Vector, np.ndarray, np.ndarray]]:
        """Of each plane: normal, h^2 b' and h^2 b'', damping included."""
        out = []
        for n, height in self.planes:
            d, travel = _dot(n, x) - height, _dot(n, x - x_prev)
            active = d < self.dhat
            safe = np.where(active, d, self.dhat)
            log, past = _log(safe / self.dhat), safe - self.dhat
            first = -self.kappa * (2 * past * log + past * past / safe)
            second = -self.kappa * (2 * log + 4 * past / safe - (past / safe) * (past / safe))
            c = self.damping * self.h * self._share(_dot(n, x_prev) - height)
            approach = np.where(travel < 0, travel, 0 * travel)
            out.append((n, self.h * self.h * first + c * approach, self.h * self.h * second + c))
        return out

    def _share(self, before: np.ndarray) -> np.ndarray:
        """Of its damping that a vertex has which began the step at this gap."""
        d = np.where(before < self.dhat, before, self.dhat)
        past = d - self.dhat
        force = self.kappa * (2 * past * _log(d / self.dhat) + past * past / d)
        return force / (force + self.kappa * self.dhat / 10)

    def started(self, x: Vector, move: Vector) -> Vector:
        """Where a step starts: the motion less what approaches a plane too closely, of at most two planes the one that
        is exceeded most first (csrc/energies/floor_start.h)."""
        slack = Decimal(8 * 2.0**-52) * _root(_dot(move, move) + Decimal("1e-200"))
        limits = []
        for n, height in self.planes:
            away = _dot(n, x) - height - self.dhat
            limits.append((n, Decimal(ETA) * np.where(away > 0, away, 0 * away)))
        if len(limits) == 2:
            (n, a), (m, b) = limits
            swap = -_dot(m, move) - b > -_dot(n, move) - a
            limits = [(np.where(swap, m, n), np.where(swap, b, a)), (np.where(swap, n, m), np.where(swap, a, b))]
        taken: list[tuple[Vector, np.ndarray]] = []
        for n, room in limits:
            excess, w = -_dot(n, move) - room, n
            binds = excess > slack
            for other_w, square in taken:
                w = w - _dot(n, other_w) / square * other_w
            w = np.where(binds, w, 0 * w)
            square = np.where(binds, _dot(w, w), 1 + 0 * excess)
            move = move + np.where(binds, excess, 0 * excess) / square * w
            taken.append((w, square))
        return x + move

    def filtered(self, x: Vector, move: Vector) -> Vector:
        alpha = 0 * x[0] + 1
        for n, height in self.planes:
            d, change = _dot(n, x) - height, _dot(n, move)
            closing = change < 0
            fraction = np.where(closing, Decimal(ETA) * d / np.where(closing, -change, 1 + 0 * d), alpha)
            alpha = np.where(fraction < alpha, fraction, alpha)
        return x + alpha * move
