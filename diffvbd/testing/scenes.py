"""Scenes, tolerances and comparisons shared by the tests and the benchmarks.

Every array here is a deterministic function of its arguments. Nothing here imports compiled code; a scene builds its
`Model` only when asked.
"""

import itertools
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffvbd import reference
from diffvbd.model.system import system_of
from diffvbd.testing.tolerances import tolerance

KINDS = ("structured", "delaunay", "random")
SIZES = ("small", "medium", "large")
_CELLS = {"small": (2, 2, 2), "medium": (4, 4, 4), "large": (6, 8, 9)}
_LATTICE = {"small": (2, 18), "medium": (4, 59), "large": (8, 335)}  # boundary points per axis, interior points


def generator(*key: Any) -> np.random.Generator:
    """A random generator that depends on `key` only, on every machine and in every process."""
    return np.random.default_rng(zlib.crc32(repr(key).encode()))


def structured(cells: Sequence[int] = (2, 2, 2), size: Sequence[float] = (1.0, 1.0, 1.0)
               ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Box from the origin cut into six Kuhn tets per cell: points [V, 3] in [m], tets [T, 4]."""
    shape = np.asarray(cells) + 1
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    corner = grid[(grid < np.asarray(cells)).all(1)]
    tets = []
    for axes in itertools.permutations(range(3)):
        path = [corner]
        for axis in axes:
            path.append(path[-1] + np.eye(3, dtype=np.int64)[axis])
        tets.append(np.stack([np.ravel_multi_index(tuple(p.T), tuple(shape)) for p in path], -1))
    points = grid / np.asarray(cells) * np.asarray(size, dtype=np.float64)
    return points, _positive(points, np.concatenate(tets))


def delaunay(size: str = "small") -> tuple[np.ndarray, np.ndarray]:
    """Delaunay mesh of the unit cube (26, 115 or 631 vertices): lattice on the boundary, random points inside.

    Flat tets (volume below 1e-3 of a regular tet of the same mean edge) are dropped. Needs scipy.
    """
    from scipy.spatial import Delaunay

    per_axis, inside = _LATTICE[size]
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, per_axis)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = grid[((grid == 0) | (grid == 1)).any(1)]
    rng = generator("delaunay", size)
    # Best-candidate sampling keeps the points apart, and with them the tets away from slivers.
    for _ in range(inside):
        candidates = rng.uniform(0.08, 0.92, (30, 3))
        distance = np.linalg.norm(candidates[:, None] - points[None], axis=-1).min(1)
        points = np.concatenate((points, candidates[[distance.argmax()]]))
    tets = _positive(points, Delaunay(points).simplices.astype(np.int64))
    edges = points[tets][:, [1, 2, 3, 2, 3, 3]] - points[tets][:, [0, 0, 0, 1, 1, 2]]
    regular = np.linalg.norm(edges, axis=-1).mean(1) ** 3 / (6 * np.sqrt(2))
    return points, tets[volumes(points, tets) > 1e-3 * regular]


def shuffled(size: str = "small") -> tuple[np.ndarray, np.ndarray]:
    """The structured mesh with jittered points, shuffled vertex numbers and tets, and corners in any even order."""
    points, tets = structured(_CELLS[size])
    rng = generator("shuffled", size)
    points = points + rng.uniform(-0.15, 0.15, points.shape) / np.asarray(_CELLS[size])
    rank = rng.permutation(len(points))
    tets = rank[tets][rng.permutation(len(tets))]
    even = np.array([[0, 1, 2, 3], [1, 2, 0, 3], [1, 0, 3, 2], [3, 0, 2, 1], [2, 3, 0, 1], [0, 2, 3, 1]])
    tets = np.take_along_axis(tets, even[rng.integers(len(even), size=len(tets))], 1)
    return points[np.argsort(rank)], tets


def build_mesh(kind: str, size: str) -> tuple[np.ndarray, np.ndarray]:
    """Points [V, 3] in [m] and tets [T, 4] of the unit cube; kind in KINDS, size in SIZES (26, 115 or 631 vertices)."""
    if kind == "structured":
        return structured(_CELLS[size])
    return {"delaunay": delaunay, "random": shuffled}[kind](size)


def volumes(points: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Signed volume of each tet [m^3], [T]."""
    a, b, c, d = points[tets].swapaxes(0, 1)
    return np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) / 6


def _positive(points: np.ndarray, tets: np.ndarray) -> np.ndarray:
    return np.where((volumes(points, tets) < 0)[:, None], tets[:, [0, 2, 1, 3]], tets)


@dataclass(frozen=True)
class Case:
    """A scene without its mesh. Ranges are log-uniform per tet; the body is a cube of edge `size`, y upwards."""

    size: float = 1.0  # [m]; jitter, speed and fall grow with it
    mu: tuple[float, float] = (8e3, 1.2e4)
    lam: tuple[float, float] = (2e4, 3e4)
    density: tuple[float, float] = (900.0, 1100.0)
    time_step: float = 1 / 60
    jitter: float = 0.01  # noise on the start positions
    speed: float = 0.1  # [1/s] noise on the start velocities
    fall: float = 0.0  # [1/s] common downward velocity
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)
    force: float = 1.0  # [N] noise
    pinned: bool = True  # the face x = 0, moved by `jitter`
    batch: tuple[int, ...] = ()
    block: str = "exact"
    floor: dict[str, Any] | None = None
    anchor: float | None = None
    saturation: float | None = None
    regularization: float = 0.0
    relaxation: float = 1.0
    stress_free: float | None = None  # noise on the stress-free deformation of tets
    viscosity: tuple[float, float] | None = None  # of shear and volume
    drag: tuple[float, float] | None = None  # per vertex


_NEAR = {"height": -0.06, "kappa": 2e4, "dhat": 0.1}  # the lowest vertices start inside dhat
_CORNER = {"height": (-0.06, -0.7, -0.32), "normal": ((0.0, 1.0, 0.0), (-0.6, 0.8, 0.0), (0.3, 0.9, -0.3)),
           "kappa": 2e4, "dhat": 0.15}  # fmt: skip

CASES: dict[str, Case] = {
    "plain": Case(),
    "paper": Case(mu=(700, 900), lam=(300, 500), block="paper", saturation=0.1, regularization=1e-6),
    "paper_unsaturated": Case(block="paper"),
    "saturated": Case(saturation=1e-3, relaxation=1.6, regularization=1e-3),
    "relaxed": Case(relaxation=1.6),
    "soft": Case(mu=(1, 10), lam=(1, 10)),
    "stiff": Case(mu=(1e7, 1e8), lam=(1e7, 1e8)),
    "contrast": Case(mu=(1e2, 1e8), lam=(1e2, 1e8)),
    "no_shear": Case(mu=(0, 0)),
    "inverted": Case(jitter=0.3, speed=5),
    "inverted_paper": Case(jitter=0.3, speed=5, block="paper", saturation=0.1, regularization=1e-6, relaxation=1.6),
    "tiny": Case(size=1e-6, jitter=1e-3, speed=1e5, force=1e-11, time_step=1e-8),  # updates of 1e-9 m
    "huge": Case(size=1e4, jitter=0.1, speed=6, force=1e19, mu=(1e12, 2e12), lam=(2e12, 3e12)),  # updates of 1e3 m
    "violent": Case(speed=60),  # neighbors fly apart by an edge length and more: nearly every tet inverts
    # The next three are limited by conditioning on purpose: rounding decides many digits, and spread says how many.
    "tiny_strain": Case(jitter=1e-9, speed=1e-8, gravity=(0.0, 0.0, 0.0), force=0.0),
    "huge_strain": Case(speed=2e3),
    "huge_saturated": Case(speed=2e3, saturation=0.1),
    "floor_inactive": Case(floor={"height": -10.0}),
    "floor_active": Case(floor=_NEAR, pinned=False),
    "floor_damped": Case(floor=_NEAR | {"damping": 50.0}, pinned=False, fall=0.5),
    "floor_filtered": Case(floor=_NEAR | {"damping": 50.0}, pinned=False, fall=20.0, relaxation=1.6),
    "floor_corner": Case(floor=_CORNER | {"damping": 50.0}, fall=10.0, block="paper", saturation=0.05),
    "anchored": Case(anchor=2e3, floor=_NEAR, fall=1.0),
    "free": Case(pinned=False),
    "free_relaxed": Case(pinned=False, relaxation=1.6),
    "free_anchored": Case(pinned=False, anchor=2e3, floor=_NEAR, fall=1.0),
    "free_corner": Case(pinned=False, floor=_CORNER | {"height": (-0.1, -0.75, -0.4), "damping": 50.0}, fall=10.0),
    "free_batch": Case(pinned=False, batch=(3,), floor=_NEAR | {"damping": 50.0}, fall=2.0),
    "batch": Case(batch=(3,), floor=_NEAR | {"damping": 50.0}, fall=2.0),
    "viscous_inverted": Case(jitter=0.3, speed=5, viscosity=(50, 200)),
    "damped_batch": Case(pinned=False, batch=(3,), floor=_NEAR, fall=2.0, stress_free=0.1, viscosity=(5, 500),
                         drag=(1, 10)),
}  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """One mesh under one `Case`. Arrays are numpy float64: x, v, force, prescribed [..., V, 3]; mu, lam, density [T]
    (mu, lam [..., T] in a batch)."""

    name: str
    case: Case
    points: np.ndarray
    tets: np.ndarray
    pinned: np.ndarray
    arrays: dict[str, np.ndarray] = field(repr=False)

    def energies(self) -> tuple[Any, ...]:
        """The case's energies as the package's dataclasses."""
        from diffvbd.energies import Anchor, FloorBarrier, StableNeoHookean

        floor = () if self.case.floor is None else (FloorBarrier(**self.case.floor),)
        return (StableNeoHookean(), *floor, *(() if self.case.anchor is None else (Anchor(self.case.anchor),)))

    def model(self, device: str = "cpu", **options: Any) -> Any:
        """A `diffvbd.Model` of the scene, float64; options of it in addition."""
        from diffvbd.mesh import TetMesh
        from diffvbd.model.model import Model

        pinned = torch.from_numpy(self.pinned) if self.pinned.any() else None
        return Model(TetMesh(self.points, self.tets), density=torch.from_numpy(self.arrays["density"]), pinned=pinned,
                     energies=self.energies(), device=device, **options)  # fmt: skip

    def solver(self, sweeps: int, **options: Any) -> Any:
        """A `diffvbd.VBD` of the case; options of it in addition."""
        from ..model.solver import VBD

        names = ("saturation", "regularization", "relaxation", "block")
        return VBD(self.case.time_step, sweeps, **{name: getattr(self.case, name) for name in names} | options)

    def inputs(self, dtype: torch.dtype = torch.float64, device: str = "cpu") -> dict[str, Any]:
        """Fresh tensors for x, v and every differentiable input of `step`."""
        tensors: dict[str, Any] = {name: torch.tensor(a, dtype=dtype) for name, a in self.arrays.items()}
        if self.case.floor is not None:
            floor = {"normal": (0.0, 1.0, 0.0), "kappa": 400.0, "dhat": 0.02} | self.case.floor
            floor["height"] = np.atleast_1d(floor["height"])
            floor["normal"] = np.atleast_2d(floor["normal"])
            tensors |= {f"floor_{k}": torch.as_tensor(value, dtype=dtype) for k, value in floor.items()}
        if self.case.anchor is not None:
            tensors["anchor_stiffness"] = torch.full((len(self.points),), self.case.anchor, dtype=dtype)
            tensors["anchor_points"] = torch.tensor(self.points, dtype=dtype)
        return on_device(tensors, device)


def build_scene(case: str, kind: str = "structured", size: str = "small") -> Scene:
    """The scene of one entry of `CASES` on one mesh."""
    c = CASES[case]
    points, tets = build_mesh(kind, size)
    points = c.size * points
    rng = generator(case, kind, size)
    pinned = (points[:, 0] < points[:, 0].min() + 0.2 * c.size) if c.pinned else np.zeros(len(points), dtype=bool)
    full = (*c.batch, len(points), 3)

    def per_tet(bounds: tuple[float, float], batch: tuple[int, ...] = ()) -> np.ndarray:
        low, high = bounds
        return low * (high / low) ** rng.uniform(size=(*batch, len(tets))) if low else np.zeros((*batch, len(tets)))

    x = points + c.size * c.jitter * rng.uniform(-1, 1, full)
    arrays = {
        "x": x,
        "v": c.size * (c.speed * rng.uniform(-1, 1, full) - c.fall * np.array([0.0, 1.0, 0.0])),
        "mu": per_tet(c.mu, c.batch),
        "lam": per_tet(c.lam, c.batch),
        "density": per_tet(c.density),
        "force": c.force * rng.uniform(-1, 1, full),
        "gravity": np.asarray(c.gravity),
        "prescribed": np.where(pinned[:, None], x + c.size * c.jitter * rng.uniform(-1, 1, full), np.nan),
        "rest_points": points,
    }
    if c.stress_free is not None:
        arrays["stress_free"] = np.eye(3) + c.stress_free * rng.uniform(-1, 1, (*c.batch, len(tets), 3, 3))
    if c.viscosity is not None:
        arrays |= {name: per_tet(c.viscosity, c.batch) for name in ("viscosity", "volume_viscosity")}
    if c.drag is not None:
        arrays["drag"] = c.drag[0] + (c.drag[1] - c.drag[0]) * rng.uniform(size=(*c.batch, len(points)))
    return Scene(f"{case}-{kind}-{size}", c, points, tets, pinned, arrays)


def scenes(cases: Sequence[str] | None = None, kinds: Sequence[str] = KINDS, sizes: Sequence[str] = ("small",)
           ) -> Iterator[Scene]:  # fmt: skip
    """Scenes of the product of cases (default: all), mesh kinds and sizes; kind "delaunay" needs scipy."""
    for case, kind, size in itertools.product(cases or CASES, kinds, sizes):
        yield build_scene(case, kind, size)


def on_device(values: Any, device: torch.device | str) -> Any:
    """Every tensor of a nested dict on another device; what is there already is not copied."""
    if isinstance(values, dict):
        return {name: on_device(value, device) for name, value in values.items()}
    return values.to(device) if isinstance(values, Tensor) else values


def relative_error(value: Tensor | np.ndarray, expected: Tensor | np.ndarray) -> float:
    """max |value - expected| / max |expected|; 0 for two zeros, inf for a non-zero against zero, nan passes through.

    Compared on the CPU, wherever the two are.
    """
    value, expected = (torch.as_tensor(a).detach().to("cpu", torch.float64) for a in (value, expected))
    if value.shape != expected.shape:
        raise ValueError(f"value: expected shape {tuple(expected.shape)}, got {tuple(value.shape)}")
    if expected.numel() == 0:
        return 0.0
    error, scale = float((value - expected).abs().max()), float(expected.abs().max())
    return error / scale if scale else (0.0 if error == 0 else float("inf"))


def evaluate(run: Callable[..., tuple[Tensor, Tensor]], inputs: dict[str, Any], time_step: float) -> dict[str, Tensor]:
    """Final state and gradients of a fixed random linear loss of x and time_step times v.

    `run(**inputs)` returns the final (x, v). The result holds "x", "v" and a "grad_<name>" for every tensor in inputs
    (None becomes zeros: an input that does not matter has gradient zero).
    """
    flat = {name: value for name, value in inputs.items() if isinstance(value, Tensor)}
    leaves = {name: value.detach().clone().requires_grad_() for name, value in flat.items()}
    x, v = run(**{name: leaves.get(name, value) for name, value in inputs.items()})
    rng = generator("loss")
    weights = [torch.as_tensor(rng.standard_normal(tuple(x.shape)), dtype=x.dtype, device=x.device) for _ in range(2)]
    loss = (weights[0] * x).sum() + time_step * (weights[1] * v).sum()
    gradients = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    result = {"x": x.detach(), "v": v.detach()}
    for (name, leaf), gradient in zip(leaves.items(), gradients, strict=True):
        result[f"grad_{name}"] = torch.zeros_like(leaf) if gradient is None else gradient
    return result


def reference_result(model: Any, inputs: dict[str, Any], solver: Any, steps: int = 1,
                     tet_order: Tensor | None = None, coarse_steps: Any = None) -> dict[str, Tensor]:  # fmt: skip
    """`evaluate` of the reference rollout; coarse_steps: recorded lengths of coarse corrections, one entry a step."""

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        trajectory = reference.rollout(model, solver=solver, steps=steps, tet_order=tet_order,
                                       coarse_steps=coarse_steps, **options)  # fmt: skip
        return trajectory.x[-1], trajectory.v[-1]

    return evaluate(run, inputs, solver.time_step)


def _turned(model: Any, solver: Any) -> Any:
    """Attributes of a model that the reference reads, each tet listed from another corner (an even permutation)."""
    names = ("rest_points", "density", "pinned", "color_ptr", "color_vertices", "energies", "saturation", "rigid",
             "regularization", "relaxation", "block", "starts_from", "coarse", "coarse_geometry")  # fmt: skip
    model = system_of(model, solver)
    return SimpleNamespace(tets=model.tets[:, [3, 2, 1, 0]], **{name: getattr(model, name, None) for name in names})


def spread(model: Any, inputs: dict[str, Any], solver: Any, steps: int = 1,
           expected: dict[str, Tensor] | None = None, coarse_steps: Any = None) -> dict[str, float]:  # fmt: skip
    """Disagreement of two references with permuted tets, per entry of `evaluate`: the effect of rounding alone.

    The order of the tets changes the sums over a star and over a body, that of a tet's corners the rounding inside it.
    `expected`: the unpermuted `reference_result`, when it is at hand.
    """
    order = torch.from_numpy(generator("order").permutation(model.tets.shape[0]))
    permuted = reference_result(_turned(model, solver), inputs, solver, steps, order, coarse_steps)
    if expected is None:
        expected = reference_result(model, inputs, solver, steps, coarse_steps=coarse_steps)
    return {name: relative_error(permuted[name], expected[name]) for name in expected}


def sensitivity(model: Any, inputs: dict[str, Any], solver: Any, steps: int = 1,
                expected: dict[str, Tensor] | None = None, coarse_steps: Any = None) -> dict[str, float]:  # fmt: skip
    """Change of the reference, per entry of `evaluate`, when every input moves by an ulp (the worst of three random
    moves): no algorithm can be asked for less. A barrier feels it in a small gap, which the order of the tets hides."""
    if expected is None:
        expected = reference_result(model, inputs, solver, steps, coarse_steps=coarse_steps)
    rng = generator("sensitivity")

    def nudged(a: Any) -> Any:
        if not isinstance(a, Tensor):
            return a
        return a * torch.as_tensor(1 + rng.choice((-1, 1), tuple(a.shape)) * 2.0**-52, device=a.device)

    tries = [{name: nudged(value) for name, value in inputs.items()} for _ in range(3)]
    moved = [reference_result(model, given, solver, steps, coarse_steps=coarse_steps) for given in tries]
    return {name: max(relative_error(m[name], expected[name]) for m in moved) for name in expected}


def bar(spread_value: float) -> float:
    """Largest admissible error of a gradient whose spread is `spread_value`."""
    return max(tolerance("adjoint"), tolerance("spread_factor") * spread_value)
