"""One body with one uniform material: what `simulate` runs and `identify` fits, and the .npz file between them.

The fit is L-BFGS on log mu and log lam. Most motions show Young's modulus far better than lam / mu: the loss is a
narrow curved valley, in which Adam creeps and a quasi-Newton method does not.
"""

import hashlib
import math
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffvbd as dv
from diffvbd import losses, viz
from diffvbd.results import Trajectory
from diffvbd.tasks.folder import read_archive
from diffvbd.tasks.optimizer import lbfgs
from diffvbd.tasks.problem import Problem, Row, Settings, Stage
from diffvbd.viz.motion import save_arrays

# Line searches try wild steps: the material stays within this factor of the first guess, or its inverse.
RANGE = 1e4
MOST_STEPS = 10**7  # beyond, a typing error is likelier than patience

Array = NDArray[np.float64]


SUBSPACES: dict[str, Any] = {"rigid": "rigid", "coarse": "coarse", "none": None}
INTEGRATORS = {"implicit-euler": dv.ImplicitEuler, "sdirk2": dv.SDIRK2, "bdf2": dv.BDF2}


@dataclass(frozen=True)
class Scene:
    """A mesh and everything else that a simulation needs, except the material."""

    mesh: dv.TetMesh
    x0: Array  # initial positions [m] [V, 3]
    v0: Array  # initial velocities [m/s] [V, 3]
    pinned: NDArray[np.bool_]  # [V]
    time_step: float = 1 / 60  # [s]
    sweeps: int = 20  # of a step
    density: float = 1000.0  # [kg/m^3]
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)  # [m/s^2]
    floor: float | None = None  # height of a floor with normal +y [m]
    kappa: float = 400.0  # stiffness of the floor's barrier
    dhat: float = 0.02  # distance at which the barrier begins [m]
    friction: float | None = None  # coefficient of friction on the floor
    relaxation: float = 1.0  # multiplies every update, as in `diffvbd.VBD`
    integrator: str = "implicit-euler"  # one of INTEGRATORS
    subspace: str = "rigid"  # one of SUBSPACES: corrections between the sweeps

    def model(self, device: str = "cpu") -> dv.Model:
        energies: tuple[Any, ...] = (dv.StableNeoHookean(),)
        if self.floor is not None:
            energies += (dv.FloorBarrier(height=self.floor, kappa=self.kappa, dhat=self.dhat),)
        if self.friction is not None:
            energies += (dv.Friction(self.friction),)
        pinned = self.pinned if self.pinned.any() else None
        return dv.Model(self.mesh, self.density, pinned, energies).to(device)

    @property
    def solver(self) -> dv.VBD:
        subspace, integrator = SUBSPACES[self.subspace], INTEGRATORS[self.integrator]()
        return dv.VBD(self.time_step, self.sweeps, relaxation=self.relaxation, subspace=subspace, integrator=integrator)

    def simulate(
        self, model: dv.Model, mu: Tensor | float, lam: Tensor | float, steps: int, **options: Any
    ) -> Trajectory:
        """Roll out from (x0, v0); mu and lam in [Pa]; options as in `diffvbd.rollout`."""
        x, v = (torch.tensor(a, dtype=model.dtype, device=model.device) for a in (self.x0, self.v0))
        return dv.rollout(model, x, v, self.solver, steps=steps, mu=mu, lam=lam, gravity=self.gravity, **options)


KEYS = """keys of TARGET.npz (only x is required; an option given here replaces the file's value):
  x          observed positions [m], shape [N, V, 3], or [V, 3] for one final shape
  steps      time steps after which each was observed, shape [N]; default 0, 1, 2, ...; where the file has a time_step,
             another --time-step keeps the times
  x0, v0     initial positions [m] and velocities [m/s], shape [V, 3]; default: the mesh, at rest
  pinned     vertices that are held, bool, shape [V]; default none
  time_step [s], sweeps, density [kg/m^3], gravity [m/s^2], floor [m], kappa, dhat [m], friction, relaxation,
             integrator, subspace
  mu, lam    the true material [Pa], if known: only used to report the error
`diffvbd simulate --save-target TARGET.npz` writes such a file.
"""
DEFAULTS = {field.name: field.default for field in fields(Scene) if field.default is not MISSING}
FIELDS = tuple(DEFAULTS)  # of a Scene that options and files may give


@dataclass(frozen=True)
class Observation:
    """Observed shapes, and the scene that they were observed in."""

    scene: Scene
    x: Array  # positions [m] [N, V, 3]
    steps: NDArray[np.int64]  # number of steps after which each was observed [N], increasing
    truth: dict[str, float]  # {"mu": [Pa], "lam": [Pa]} where known, else empty

    def save(self, path: str | Path) -> None:
        """Write the .npz file that `load` reads."""
        values: dict[str, Any] = {"x": self.x, "steps": self.steps}
        always = ["x0", "v0", "pinned", "time_step", "sweeps", "density", "gravity"]
        always += [] if self.scene.floor is None else ["floor", "kappa", "dhat"]
        values |= {name: getattr(self.scene, name) for name in always}
        others = ("friction", "relaxation", "integrator", "subspace")
        changed = {name: getattr(self.scene, name) for name in others}
        values |= {name: value for name, value in changed.items() if value != DEFAULTS[name]} | self.truth
        save_arrays(path, values)

    @classmethod
    def load(cls, path: str | Path, mesh: dv.TetMesh, **overrides: Any) -> "Observation":
        """Read an .npz file with the keys that `diffvbd identify --help` lists (KEYS); only x is required.

        Args:
            path: The file.
            mesh: The body; its vertices are those of x.
            overrides: Values that replace the file's, by key; None means not given. Another time_step than the
                file's keeps the times of the observations, of which it must be a divisor.

        Raises:
            OSError: the file cannot be opened.
            ValueError: not an .npz file, unknown or missing keys, wrong shapes; positions that are not in metres, by
                their size; a time_step that does not meet the times of the observations.
        """
        values = read_archive(path, "an .npz file with the key x")
        given = {key: value for key, value in overrides.items() if value is not None}
        recorded = None if {"time_step", "steps"} <= set(given) else values.get("time_step")
        values |= given
        numbers = {*FIELDS} - {"sweeps", "gravity", "integrator", "subspace"}
        known = {"x", "steps", "x0", "v0", "pinned", "mu", "lam", *FIELDS}
        unknown = sorted(set(values) - known)
        if unknown or "x" not in values:
            wrong = f"unknown keys {unknown}" if unknown else "the key x is missing"
            raise ValueError(f"{path}: {wrong}: expected x and any of {', '.join(sorted(known - {'x'}))}")

        shape = (mesh.num_vertices, 3)
        x = _checked(path, "x", values["x"], shape, leading="N, ")
        if x.ndim == 2 and "steps" not in values:
            raise ValueError(f"{path}: x is one shape, so steps must say how many steps led to it (key or --steps)")
        x = x.reshape(-1, *shape)
        if len(x) == 0:
            raise ValueError(f"{path}: x: expected at least one observed shape, got none")
        steps = _steps(path, values.get("steps", np.arange(len(x))), len(x))
        chosen: dict[str, Any] = {key: _number(path, key, values[key]) for key in sorted(numbers & set(values))}
        if recorded is not None and chosen["time_step"] > 0:
            steps = _at_the_same_times(path, steps, _number(path, "time_step", recorded), chosen["time_step"])
        if "sweeps" in values:
            chosen["sweeps"] = int(_number(path, "sweeps", values["sweeps"], whole=True))
        if "gravity" in values:
            gravity = np.asarray(values["gravity"])
            if gravity.shape != (3,) or gravity.dtype.kind not in "iuf" or not np.isfinite(gravity).all():
                raise ValueError(f"{path}: gravity: expected finite numbers of shape [3], got {_shown(gravity)}")
            chosen["gravity"] = tuple(gravity.astype(np.float64).tolist())
        for key, words in (("integrator", INTEGRATORS), ("subspace", SUBSPACES)):
            if key in values:
                chosen[key] = str(np.asarray(values[key]))
                if chosen[key] not in words:
                    raise ValueError(f"{path}: {key}: expected one of {[*words]}, got {chosen[key]!r}")
        _check_size(path, x[0], mesh)
        scene = Scene(mesh=mesh, x0=_checked(path, "x0", values.get("x0", mesh.points), shape),
                      v0=_checked(path, "v0", values.get("v0", np.zeros(shape)), shape),
                      pinned=_mask(path, values.get("pinned", np.zeros(shape[0], bool)), shape[0]),
                      **chosen)  # fmt: skip
        truth = {key: _number(path, key, values[key]) for key in ("mu", "lam") if key in values}
        return cls(scene, x, steps, truth)


def _steps(path: str | Path, given: Any, count: int) -> NDArray[np.int64]:
    steps = np.atleast_1d(given)
    expected = f"{path}: steps: expected {count} increasing integers from 0 to {MOST_STEPS}, the last >= 1"
    if steps.shape != (count,) or steps.dtype.kind not in "iu":
        raise ValueError(f"{expected}, got {_shown(steps)}")
    if int(steps.min()) < 0 or int(steps.max()) > MOST_STEPS:
        raise ValueError(f"{expected}, got {steps.min()} to {steps.max()}")
    steps = steps.astype(np.int64)  # differences of unsigned integers would wrap around
    if (np.diff(steps) <= 0).any() or steps[-1] < 1:
        raise ValueError(f"{expected}, got {_shown(steps)}")
    return steps


def _at_the_same_times(path: str | Path, steps: NDArray[np.int64], before: float, after: float) -> NDArray[np.int64]:
    """Steps of ``after`` seconds that take as long as these of ``before`` seconds."""
    if before == after:
        return steps
    exact = steps * (before / after)
    whole = np.rint(exact)
    if (np.abs(exact - whole) > 1e-6 * np.maximum(exact, 1.0)).any():
        every = np.gcd.reduce(steps) * before
        raise ValueError(
            f"{path}: time_step: expected {every:g} s, or that over an integer, so that steps meet the observed times, "
            f"got {after:g}"
        )
    return _steps(path, whole.astype(np.int64), len(steps))


def _check_size(path: str | Path, x: Array, mesh: dv.TetMesh) -> None:
    """Raises for positions in another unit than the mesh."""
    seen, body = (float(np.ptp(points, axis=0).max()) for points in (x, mesh.points))
    if not 0.01 * body <= seen <= 100.0 * body:
        raise ValueError(
            f"{path}: x: expected shapes about as large as the mesh, {body:.4g} m, got {seen:.4g} m: both are in metres"
        )


def _number(path: str | Path, name: str, given: Any, whole: bool = False) -> float:
    values = np.asarray(given)
    good = values.size == 1 and values.dtype.kind in ("iu" if whole else "iuf")
    if not good or not np.isfinite(values).all():
        kind = "an integer" if whole else "a finite number"
        raise ValueError(f"{path}: {name}: expected {kind}, got {_shown(values)}")
    return values.reshape(-1)[0].item()


def _mask(path: str | Path, given: Any, count: int) -> NDArray[np.bool_]:
    values = np.asarray(given)
    if values.shape != (count,) or values.dtype != bool:
        raise ValueError(f"{path}: pinned: expected bool of shape [{count}], got {_shown(values)}")
    return values


def _shown(values: np.ndarray) -> str:
    return str(values.tolist()) if values.size <= 6 else f"{values.dtype} of shape {list(values.shape)}"


def _checked(path: str | Path, name: str, values: Any, shape: tuple[int, int], leading: str = "") -> Array:
    values = np.asarray(values)
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{path}: {name}: expected numbers, got dtype {values.dtype}")
    values = values.astype(np.float64)
    if values.shape[-2:] != shape or values.ndim > (3 if leading else 2):
        expected = f"[{leading}{shape[0]}, {shape[1]}]"
        raise ValueError(f"{path}: {name}: expected shape {expected}, got {list(values.shape)}")
    if not np.isfinite(values).all():
        at = tuple(np.argwhere(~np.isfinite(values))[0].tolist())
        raise ValueError(f"{path}: {name}: expected finite values, got {values[at]:g} at {list(at)}")
    return values


def side(points: Array, text: str) -> np.ndarray:
    """Mask [V] of the vertices at a side of the bounding box, written as in --pin."""
    side, _, fraction = text.partition(":")
    try:
        share = float(fraction or "0.001")
    except ValueError:
        share = -1.0
    if len(side) != 2 or side[0] not in "xyz" or side[1] not in "-+" or not 0.0 <= share <= 1.0:
        raise ValueError(f"--pin: expected x-, x+, y-, y+, z- or z+, with or without :FRACTION in 0..1, got {text!r}")
    along = points[:, "xyz".index(side[0])]
    low, high = along.min(), along.max()
    # The relative position decides, so rounding cannot leave out vertices that lie exactly in the side.
    position = (along - low) / (high - low) if side[1] == "-" else (high - along) / (high - low)
    return position <= share


def problem(
    observation: Observation,
    settings: Settings,
    start: tuple[float, float],
    fixed_lam: bool = False,
    iterations: int = 100,
) -> Problem:
    """The inverse problem: mean squared distance from the observed shapes over their own from the initial shape.

    Args:
        observation: What was seen, and the scene it was seen in.
        settings: Device, seed, directory.
        start: First guess of mu and lam [Pa]; the result is within a factor RANGE of it.
        fixed_lam: Keep lam at its start value.
        iterations: Most evaluations of the loss.

    Raises:
        ValueError: a start value is not positive, or nothing moves.
    """
    if not all(0 < value < math.inf for value in start):
        raise ValueError(f"start: expected positive mu and lam, got {start}")
    scene = observation.scene
    model = scene.model(settings.device)
    target = torch.tensor(observation.x, dtype=model.dtype, device=model.device)
    observed = observation.steps.tolist()
    first = torch.tensor(start, dtype=model.dtype, device=model.device)
    free = 1 if fixed_lam else 2
    exponents = first.new_zeros(free, requires_grad=True)
    still = torch.tensor(scene.x0, dtype=model.dtype, device=model.device)
    scale = losses.vertex_distance(target, still).item()
    if scale == 0.0:
        raise ValueError("observation: expected shapes that differ from the initial one, got none")

    def material() -> Tensor:
        limit = math.log(RANGE)
        factors = (limit * (exponents / limit).tanh()).exp()
        return torch.cat([factors * first[:free], first[free:]])

    def simulate(mu: Tensor, lam: Tensor) -> Tensor:
        return scene.simulate(model, mu, lam, observed[-1]).x[observed]

    def picture(path: Path, history: list[Row]) -> None:
        with torch.no_grad():
            initial, recovered = simulate(*first), simulate(*material())
        chosen = sorted({len(observed) // 4, len(observed) // 2, len(observed) - 1})
        motions = {"initial": initial[chosen], "target": target[chosen], "recovered": recovered[chosen]}
        times = [observed[k] * scene.time_step for k in chosen]
        viz.comparison(path, scene.mesh.surface, motions, times, history, observation.truth)

    return Problem(
        name="identify",
        parameters={"exponents": exponents},
        stages=[
            Stage(loss=lambda: losses.vertex_distance(simulate(*material()), target) / scale, iterations=iterations,
                  tolerance=1e-12, gradient_tolerance=1e-7, optimizer=lbfgs)
        ],
        estimates=lambda: dict(zip(("mu", "lam"), material().tolist(), strict=True)),
        truth=observation.truth,
        protocol={"start": list(start), "fixed_lam": fixed_lam, "iterations": iterations, "range": RANGE,
                  "steps": observed, "observation": hashlib.sha256(observation.x.tobytes()).hexdigest()},
        picture=picture,
    )  # fmt: skip
