"""One body with one uniform material: what `simulate` runs and `identify` fits, and the .npz file between them."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffvbd as dv

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """A mesh and everything else that a simulation needs, except the material.

    Attributes:
        mesh: The body.
        x0: Initial positions [m], shape [V, 3].
        v0: Initial velocities [m/s], shape [V, 3].
        pinned: Vertices that are held, bool, shape [V].
        time_step: [s].
        sweeps: Sweeps per step.
        density: [kg/m^3].
        gravity: [m/s^2], shape [3].
        floor: Height of a floor with normal +y [m]; None: no floor.
        kappa: Stiffness of the floor's barrier.
        dhat: Distance at which the barrier begins [m].
    """

    mesh: dv.TetMesh
    x0: Array
    v0: Array
    pinned: NDArray[np.bool_]
    time_step: float = 1 / 60
    sweeps: int = 20
    density: float = 1000.0
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)
    floor: float | None = None
    kappa: float = 400.0
    dhat: float = 0.02

    def model(self, device: str = "cpu") -> dv.Model:
        energies: tuple[Any, ...] = (dv.StableNeoHookean(),)
        if self.floor is not None:
            energies += (dv.FloorBarrier(height=self.floor, kappa=self.kappa, dhat=self.dhat),)
        return dv.Model(self.mesh, density=self.density, pinned=self.pinned, energies=energies).to(device)

    def simulate(
        self, model: dv.Model, mu: Tensor | float, lam: Tensor | float, steps: int, **options: Any
    ) -> dv.Trajectory:
        """Roll out from (x0, v0); mu and lam in [Pa]; options as in `diffvbd.rollout`."""
        x, v = (torch.tensor(a, dtype=model.dtype, device=model.device) for a in (self.x0, self.v0))
        return dv.rollout(
            model,
            x,
            v,
            steps=steps,
            mu=mu,
            lam=lam,
            time_step=self.time_step,
            sweeps=self.sweeps,
            gravity=self.gravity,
            **options,
        )


@dataclass(frozen=True)
class Observation:
    """Observed shapes.

    Attributes:
        scene: The scene they were observed in.
        x: Positions [m], shape [N, V, 3].
        steps: Number of steps after which each was observed, shape [N], increasing.
        truth: {"mu": [Pa], "lam": [Pa]} where known, else empty.
    """

    scene: Scene
    x: Array
    steps: NDArray[np.int64]
    truth: dict[str, float]

    def save(self, path: str | Path) -> None:
        """Write the .npz file that `load` reads."""
        s = self.scene
        values: dict[str, Any] = {"x": self.x, "steps": self.steps, "x0": s.x0, "v0": s.v0, "pinned": s.pinned}
        values |= {"time_step": s.time_step, "sweeps": s.sweeps, "density": s.density, "gravity": s.gravity}
        if s.floor is not None:
            values |= {"floor": s.floor, "kappa": s.kappa, "dhat": s.dhat}
        values |= self.truth
        with open(path, "wb") as file:
            np.savez_compressed(file, **values)

    @classmethod
    def load(cls, path: str | Path, mesh: dv.TetMesh, **overrides: Any) -> "Observation":
        """Read an .npz file with these keys; only x is required.

        * x: observed positions [m], shape [N, V, 3], or [V, 3] for one shape;
        * steps: steps after which each was observed, shape [N] (default 0, 1, ...; required for one shape);
        * x0, v0: initial positions [m] and velocities [m/s], shape [V, 3] (default: the mesh, at rest);
        * pinned: bool [V]; time_step [s]; sweeps; density [kg/m^3]; gravity [3]; floor, kappa, dhat: as in `Scene`;
        * mu, lam: the true material [Pa], only to report the error.

        Args:
            path: The file.
            mesh: The body; its vertices are those of x.
            overrides: Values that replace the file's, by key; None means not given.

        Raises:
            OSError: the file cannot be opened.
            ValueError: not an .npz file, unknown or missing keys, wrong shapes.
        """
        try:
            with np.load(path, allow_pickle=False) as content:
                values = dict(content)
        except (zipfile.BadZipFile, EOFError, ValueError, AttributeError, TypeError):
            raise ValueError(f"{path}: expected an .npz file with the key x") from None
        values |= {key: value for key, value in overrides.items() if value is not None}
        known = {"x", "steps", "x0", "v0", "pinned", "mu", "lam"}
        numbers = {"time_step", "density", "floor", "kappa", "dhat"}
        unknown = sorted(set(values) - known - numbers - {"sweeps", "gravity"})
        if unknown or "x" not in values:
            raise ValueError(f"{path}: {f'unknown keys {unknown}' if unknown else 'the key x is missing'}")

        shape = (mesh.num_vertices, 3)
        x = _checked(path, "x", values["x"], shape, leading="N, ")
        if x.ndim == 2 and "steps" not in values:
            raise ValueError(f"{path}: x is one shape, so steps must say how many steps led to it (key or --steps)")
        x = x.reshape(-1, *shape)
        steps = np.atleast_1d(values.get("steps", np.arange(len(x))))
        if steps.shape != (len(x),) or steps.dtype.kind not in "iu" or (np.diff(steps) <= 0).any() or steps[-1] < 1:
            raise ValueError(f"{path}: steps: expected {len(x)} increasing integers, the last >= 1, got {steps}")
        fields: dict[str, Any] = {key: float(values[key]) for key in numbers & set(values)}
        if "sweeps" in values:
            fields["sweeps"] = int(values["sweeps"])
        if "gravity" in values:
            fields["gravity"] = tuple(float(c) for c in values["gravity"])
        scene = Scene(
            mesh=mesh,
            x0=_checked(path, "x0", values.get("x0", mesh.points), shape),
            v0=_checked(path, "v0", values.get("v0", np.zeros(shape)), shape),
            pinned=np.asarray(values.get("pinned", np.zeros(shape[0], bool)), dtype=bool),
            **fields,
        )
        return cls(scene, x, steps.astype(np.int64), {k: float(values[k]) for k in ("mu", "lam") if k in values})


def _checked(path: str | Path, name: str, values: Any, shape: tuple[int, int], leading: str = "") -> Array:
    values = np.asarray(values, dtype=np.float64)
    if values.shape[-2:] != shape or values.ndim > (3 if leading else 2) or not np.isfinite(values).all():
        expected = f"[{leading}{shape[0]}, {shape[1]}]"
        raise ValueError(f"{path}: {name}: expected finite values of shape {expected}, got shape {list(values.shape)}")
    return values
