"""The options of a scene: its material, its start, and what `diffvbd.tasks.scene.Scene` has."""

import argparse
from typing import Any

import numpy as np

import diffvbd as dv
from diffvbd.tasks.scene import INTEGRATORS, Scene, side


def add_material(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--velocity", type=float, nargs=3, metavar=("VX", "VY", "VZ"), help="initial velocity [m/s]")
    material = parser.add_argument_group("material (default: mu = lam = 1e5 Pa)")
    for name, text in (("mu", "shear modulus [Pa]"), ("lam", "first Lame parameter [Pa]")):
        material.add_argument(f"--{name}", type=float, help=text)
    material.add_argument("--young", type=float, help="Young's modulus [Pa], together with --poisson")
    material.add_argument("--poisson", type=float, help="Poisson's ratio, below 0.5")


def add_options(parser: argparse.ArgumentParser, chosen: tuple[str, ...] = ()) -> None:
    """``chosen``: what the command chooses itself: such options are known, to say so, and not shown."""
    parser.add_argument(
        "--scale", type=float, default=1.0, help="metres per unit of the file, 0.001 for mm (default 1)"
    )
    # No defaults: identify must know which options were given, and Scene has the defaults.
    scene = parser.add_argument_group("scene")

    def shown(name: str, text: str) -> str:
        return argparse.SUPPRESS if name in chosen else text

    scene.add_argument("--time-step", type=float, help=shown("time_step", f"[s] (default {Scene.time_step:.4g})"))
    scene.add_argument("--sweeps", type=int, help=shown("sweeps", f"sweeps per step (default {Scene.sweeps})"))
    scene.add_argument("--density", type=float, help=f"[kg/m^3] (default {Scene.density:g})")
    scene.add_argument("--gravity", type=float, nargs=3, metavar=("GX", "GY", "GZ"), help="[m/s^2] (default 0 -9.81 0)")
    scene.add_argument("--floor", type=float, metavar="HEIGHT", help="height of a floor [m] (default: none)")
    scene.add_argument("--kappa", type=float, help=f"stiffness of the floor's barrier (default {Scene.kappa:g})")
    scene.add_argument("--dhat", type=float, help=f"distance where the barrier begins [m] (default {Scene.dhat:g})")
    scene.add_argument("--friction", type=float, help="coefficient of friction on the floor (default: none)")
    text = "1.5 to 1.7 needs fewer sweeps (default 1; not with friction)"
    scene.add_argument("--relaxation", type=float, help=shown("relaxation", text))
    scene.add_argument("--coarse", action="store_const", const=True, help=shown(
        "coarse", "coarse corrections between the sweeps, for what is stiff, long, thin or finely meshed"))  # fmt: skip
    scene.add_argument("--integrator", choices=[*INTEGRATORS],
                       help=shown("integrator", f"of time (default {Scene.integrator})"))  # fmt: skip
    scene.add_argument(
        "--pin",
        action="append",
        metavar="SIDE[:FRACTION]",
        help="hold the vertices at a side of the bounding box: x-, x+, y-, y+, z- or z+; up to this fraction of its "
        "extent (default 0.001), for example y+:0.05 for a round body; may be repeated",
    )


def material(options: argparse.Namespace) -> tuple[float, float]:
    """mu and lam [Pa] from either pair of options."""
    young, poisson = options.young, options.poisson
    if young is None and poisson is None:
        return (1e5 if options.mu is None else options.mu), (1e5 if options.lam is None else options.lam)
    if young is None or poisson is None or options.mu is not None or options.lam is not None:
        raise ValueError("material: give --mu and --lam, or --young and --poisson")
    try:
        return dv.lame(young, poisson)
    except ValueError as error:
        raise ValueError(f"--{error}") from None


def scene(options: argparse.Namespace, mesh: dv.TetMesh) -> Scene:
    """The scene of a mesh that the options describe."""
    v0 = np.broadcast_to(np.asarray(options.velocity or (0.0, 0.0, 0.0)), mesh.points.shape)
    values = given(options, mesh)
    for name in ("kappa", "dhat", "friction"):
        if name in values and "floor" not in values:
            raise ValueError(f"--{name}: expected --floor beside it, got none")
    pinned = values.pop("pinned", np.zeros(mesh.num_vertices, dtype=bool))
    return Scene(mesh, mesh.points, np.where(pinned[:, None], 0.0, v0), pinned, **values)


def given(options: argparse.Namespace, mesh: dv.TetMesh) -> dict[str, Any]:
    """What was given of a Scene, the others have defaults; `pinned` [V] of --pin."""
    names = ("time_step", "sweeps", "density", "gravity", "floor", "kappa", "dhat", "friction", "relaxation",
             "integrator", "coarse")  # fmt: skip
    values = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    for name, value in values.items():
        if not isinstance(value, (str, int)) and not np.isfinite(value).all():
            raise ValueError(f"--{name.replace('_', '-')}: expected finite numbers, got {value}")
    if options.pin:
        values["pinned"] = np.logical_or.reduce([side(mesh.points, text) for text in options.pin])
    return values
