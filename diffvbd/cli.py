"""The command line: `diffvbd` or `python -m diffvbd`."""

import argparse
import contextlib
import inspect
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch

import diffvbd as dv
from diffvbd.mesh.motions import EXTENSIONS, check_extension
from diffvbd.tasks import TASKS, Problem, Settings, identify, solve, table
from diffvbd.tasks.folder import joined
from diffvbd.tasks.identify import FIELDS, INTEGRATORS, MOST_STEPS, SUBSPACES, Observation, Scene, side
from diffvbd.tasks.problem import Result, Row, check_device
from diffvbd.tasks.report import versions
from diffvbd.viz.scenery import optional
from diffvbd.viz.values import QUANTITIES

from ._common.context import record_to
from ._common.messages import PAGES

DESCRIPTION = "Differentiable soft-body simulation by Vertex Block Descent. Units: m, kg, s, Pa; y points up."
EXAMPLES = """examples:
  diffvbd run beam-mu                              identify a beam's shear modulus: log, table and picture in runs/
  diffvbd run beam-mu --quick                      the same on a small beam, in seconds
  diffvbd view runs/beam-mu                        its motions in the browser; also of part.pvd or a mesh
  diffvbd mesh scan.ply --size 0.2 --up z -o part.msh
                                                   repair a scan, make it 0.2 m large and fill it with tets
  diffvbd simulate part.msh --out part.pvd --pin x- --young 1e5 --poisson 0.3
                                                   hang a part by its left side and open part.pvd in ParaView
  diffvbd simulate part.msh --out drop.pvd --floor -0.5 --velocity 1 0 0
                                                   throw it on a floor
  diffvbd simulate part.msh --out part.pvd --pin x- --mu 4e4 --lam 6e4 --save-target target.npz
  diffvbd identify part.msh target.npz --start 1e4 1e4
                                                   recover (mu, lam) from the observed motion
  diffvbd advise part.msh --pin x- --duration 0.5 --error 0.01
                                                   solver (time step, sweeps, ...) that stays within an error of 1 %

`diffvbd COMMAND --help` explains each command. Errors are one line, with exit status 2. `identify` ends with status 1
where it stalled, and warns wherever it did not converge; `advise` where the error was not reached. An interrupted
`run` or `identify` continues where it stopped when the same command is given again.
"""
MODULI = {"mu": "shear modulus [Pa]", "lam": "first Lame parameter [Pa]"}
ADVISED = ("time_step", "sweeps", "relaxation", "integrator", "subspace")  # what advise chooses


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status: 0, 1 as EXAMPLES says, 2 after an error, 130 if interrupted."""
    options = _parser().parse_args(arguments)
    shown, warnings.formatwarning = warnings.formatwarning, _one_line
    try:
        return options.command(options) or 0
    except KeyboardInterrupt:
        print("\ninterrupted; `run` and `identify` continue when the same command is given again", file=sys.stderr)
        return 130
    except (ValueError, TypeError, OSError, ImportError, ArithmeticError, MemoryError, torch.OutOfMemoryError) as error:
        print(f"diffvbd: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    finally:
        warnings.formatwarning = shown


def _one_line(message: Warning | str, *where: Any, **line: Any) -> str:
    """A warning as the command line shows it: no line of a program is its cause."""
    return f"warning: {' '.join(str(message).split())}\n"


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("diffvbd", description=DESCRIPTION, epilog=EXAMPLES, formatter_class=raw)
    parser.add_argument("--version", action="version", version=f"diffvbd {dv.__version__}")
    parser.set_defaults(command=lambda options: parser.print_help() or 2)  # where no command is given
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")

    run = commands.add_parser("run", help="run one of the shipped inverse problems", description=_task_list())
    run.formatter_class = raw
    run.add_argument("name", choices=sorted(TASKS), metavar="NAME", help="a task that `diffvbd list` names")
    quick = "a small version that takes seconds and need not be as accurate"
    run.add_argument("--quick", action="store_true", help=quick)
    _add_run_options(run, "runs/NAME, or runs/NAME-quick")
    for name, texts in sorted(_task_options().items()):
        run.add_argument(f"--{name}", help="; ".join(texts))
    run.add_argument("--view", action="store_true", help="show the run in the browser while it goes on; extra [viz]")
    _add_server(run)
    run.set_defaults(command=_run)

    listing = commands.add_parser("list", help="list the shipped inverse problems")
    listing.set_defaults(command=lambda options: print(_task_list()))

    _add_mesh(commands)
    _add_view(commands)

    simulate = commands.add_parser("simulate", help="simulate a mesh and write its motion")
    simulate.add_argument("mesh", type=Path, metavar="MESH", help="a file with tetrahedra (.msh, .vtu, .vtk, ...)")
    kinds = f"{', '.join(EXTENSIONS)}; missing folders are made"
    simulate.add_argument("--out", type=Path, required=True, metavar="PART.pvd", help=kinds)
    simulate.add_argument("--force", action="store_true", help="overwrite without asking")
    simulate.add_argument("--steps", type=int, default=100, help="time steps (default 100)")
    simulate.add_argument("--stride", type=int, default=1, help="write every n-th frame (default 1)")
    simulate.add_argument("--device", default="cpu", help="torch device (default cpu)")
    simulate.add_argument("--save-target", type=Path, metavar="FILE.npz", help="also write what `identify` reads")
    _add_material(simulate)
    _add_scene(simulate)
    simulate.set_defaults(command=_simulate)

    advice = commands.add_parser("advise", help="find a solver that stays within a wanted error")
    advice.add_argument("mesh", type=Path, metavar="MESH", help="a file with tetrahedra")
    advice.add_argument("--duration", type=float, required=True, help="of the motion [s]")
    error, budget = (inspect.signature(dv.advise).parameters[name].default for name in ("error", "time_budget"))
    text = f"fraction of the motion, below 1 (default {error:g})"
    advice.add_argument("--error", type=float, default=error, help=text)
    advice.add_argument("--gradient", action="store_true", help="of gradients, too")
    advice.add_argument("--time-budget", type=float, default=budget, help=f"of trial runs [s] (default {budget:g})")
    advice.add_argument("--device", default="cpu", help="torch device (default cpu)")
    _add_material(advice)
    _add_scene(advice, ADVISED)
    advice.set_defaults(command=_advise)

    identification = commands.add_parser(
        "identify", help="recover mu and lam from observed shapes", epilog=identify.KEYS, formatter_class=raw
    )
    identification.add_argument("mesh", type=Path, metavar="MESH", help="a file with tetrahedra")
    identification.add_argument("target", type=Path, metavar="TARGET.npz", help="the observation, see below")
    text = f"first guess [Pa] (default 1e5); the result stays within a factor {identify.RANGE:.0e} of it"
    identification.add_argument("--start", type=float, nargs=2, metavar=("MU", "LAM"), help=text)
    identification.add_argument("--start-young", type=float, help="the same as Young's modulus [Pa]")
    identification.add_argument("--start-poisson", type=float, help="and Poisson's ratio, above 0 and below 0.5")
    identification.add_argument("--fixed-lam", action="store_true", help="keep lam at its first guess")
    identification.add_argument("--iterations", type=int, default=100, help="at most so many (default 100)")
    identification.add_argument("--steps", type=int, help="time steps that led to the shape, if x is one shape")
    _add_scene(identification)
    _add_run_options(identification, "runs/identify")
    identification.set_defaults(command=_identify)

    info = commands.add_parser("info", help="show versions, devices and the compiled libraries")
    info.set_defaults(command=_info)
    return parser


def _add_run_options(parser: argparse.ArgumentParser, directory: str) -> None:
    parser.add_argument("--device", default="cpu", help="torch device (default cpu)")
    parser.add_argument("--seed", type=int, default=0, help="seed of torch's generators (default 0)")
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"for log and picture (default {directory})")


def _run(options: argparse.Namespace) -> None:
    out = options.out or Path("runs") / (options.name + ("-quick" if options.quick else ""))
    settings, task = Settings(out, options.device, options.seed, options.quick), TASKS[options.name]
    chosen = {name: getattr(options, name.replace("-", "_")) for name in _task_options()}
    given = {name: value for name, value in chosen.items() if value is not None}
    given = task.chosen(given)
    with joined(options.device, task.splits):
        check_device(options.device)
        with _watched(options.host, options.port) if options.view else nullcontext() as watch:
            _solve(task.build(settings, **given), settings, watch)


def _solve(problem: Problem, settings: Settings, watch: Callable[[Row], None] | None = None) -> Result:
    result = solve(problem, settings, watch)
    print(table(problem, result))
    print("wrote " + ", ".join(str(path) for path in result.files))
    return result


def _mesh(options: argparse.Namespace) -> dv.TetMesh:
    mesh = dv.mesh.load(options.mesh)
    if not (np.isfinite(options.scale) and options.scale > 0):
        raise ValueError(f"--scale: expected a number > 0, got {options.scale}")
    return mesh if options.scale == 1 else mesh.transform(options.scale * np.eye(3))


def _simulate(options: argparse.Namespace) -> None:
    check_extension(options.out, "--out")
    if options.stride < 1:
        raise ValueError(f"--stride: expected at least 1, got {options.stride}")
    _check_steps(options.steps)
    scene, mu, lam = _scene(options)
    mesh = scene.mesh
    _make_place(options)
    with torch.no_grad():
        model, progress = scene.model(options.device), sys.stderr.isatty()
        checks = dv.Checks(contact=False if options.stride == 1 else None)  # which diagnose looks at below
        motion = scene.simulate(model, mu, lam, options.steps, save=options.stride, progress=progress, checks=checks)
    frames, steps = motion.x.cpu().numpy(), np.asarray(motion.steps)
    dv.mesh.write_series(options.out, mesh, frames, steps * scene.time_step)
    count = int(scene.pinned.sum())
    print(f"wrote {options.out} ({len(steps)} frames of {mesh.num_vertices} vertices, {count} pinned)")
    if options.pin and count < 3:
        _warn(f"--pin holds {count} vertices; a fraction takes more, for example --pin x-:0.05")
    if len(steps) > 1 and options.stride == 1:
        previous = (motion.x[-2], motion.v[-2]) if scene.integrator == Scene.integrator else None
        found = dv.diagnose(model, motion.x[-1], scene.solver, previous=previous, warn=False, mu=mu, lam=lam,
                            gravity=scene.gravity)  # fmt: skip
        for message in found.messages:
            _warn(message)
    if options.save_target:
        Observation(scene, frames, steps, {"mu": mu, "lam": lam}).save(options.save_target)
        print(f"wrote {options.save_target}")


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


def _advise(options: argparse.Namespace) -> int:
    for name in ADVISED:
        if getattr(options, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')}: expected none, since it is what advise chooses")
    scene, mu, lam = _scene(options)
    model = scene.model(options.device)
    x, v = (torch.tensor(a, dtype=model.dtype, device=model.device) for a in (scene.x0, scene.v0))
    solver = dv.advise(model, x, v, duration=options.duration, error=options.error, gradient=options.gradient,
                       time_budget=options.time_budget, mu=mu, lam=lam, gravity=scene.gravity)  # fmt: skip
    print(solver)
    print(f"\nin Python: dv.VBD({_in_python(solver)})")
    return 0 if solver.prediction is not None and solver.prediction.reached else 1


def _in_python(solver: dv.VBD) -> str:
    """Arguments of a dv.VBD that are not left at their defaults."""
    plain = dv.VBD(solver.time_step, solver.sweeps)
    names = ("relaxation", "integrator", "subspace")
    changed = {name: getattr(solver, name) for name in names if getattr(solver, name) != getattr(plain, name)}
    words = {name: f"dv.{value!r}" if name == "integrator" else repr(value) for name, value in changed.items()}
    if solver.coarse == dv.CoarseSpace():
        words["subspace"] = '"coarse"'
    return ", ".join([f"{solver.time_step!r}, {solver.sweeps}", *(f"{name}={word}" for name, word in words.items())])


def _make_place(options: argparse.Namespace) -> None:
    """Folders for the files of a simulation, and leave to write over those that are there; the mesh stays."""
    out, target = options.out, options.save_target
    series = out.suffix.lower() == ".pvd"
    frames = re.compile(re.escape(out.stem) + r"_\d+\.vtu" if series else "(?!)")  # which nothing matches
    mesh = options.mesh.resolve()
    if mesh.parent == out.parent.resolve() and frames.fullmatch(mesh.name):
        raise ValueError(f"--out: expected another name than {out}, whose frames would overwrite {options.mesh}")
    if target is not None and target.resolve() in (mesh, out.resolve()):
        raise ValueError(f"--save-target: expected a file of its own, got {target}")
    for folder in {out.parent, *([] if target is None else [target.parent])}:
        folder.mkdir(parents=True, exist_ok=True)
    there = [path for path in (out, target) if path is not None and path.exists()]
    there += [path for path in sorted(out.parent.iterdir()) if frames.fullmatch(path.name)]
    if not there or options.force:
        return
    what = f"{there[0]}" + (f" and {len(there) - 1} more" if len(there) > 1 else "")
    if not sys.stdin.isatty():
        raise ValueError(f"--out: {what} would be overwritten; give --force, or another name")
    if input(f"overwrite {what}? [y/N] ").strip().lower() not in ("y", "yes"):
        raise ValueError("--out: nothing was written")


def _check_steps(steps: int | None) -> None:
    if steps is not None and not 0 <= steps <= MOST_STEPS:
        raise ValueError(f"--steps: expected an integer from 0 to {MOST_STEPS}, got {steps}")


def _start(options: argparse.Namespace) -> tuple[float, float]:
    """First guess of mu and lam [Pa] from either pair of options."""
    young, poisson = options.start_young, options.start_poisson
    if young is None and poisson is None:
        mu, lam = options.start or (1e5, 1e5)
        return mu, lam
    if young is None or poisson is None or options.start is not None:
        raise ValueError("--start: expected --start MU LAM, or --start-young and --start-poisson")
    return dv.lame(young, poisson)


def _identify(options: argparse.Namespace) -> int:
    _check_steps(options.steps)
    start = _start(options)
    check_device(options.device)
    mesh = _mesh(options)
    given = _given(options, mesh) | {"steps": options.steps}
    observation = Observation.load(options.target, mesh, **given)
    settings = Settings(options.out or Path("runs/identify"), options.device, options.seed)
    problem = identify.problem(observation, settings, start, options.fixed_lam, options.iterations)
    result = _solve(problem, settings)
    young, poisson = dv.young_poisson(result.estimates["mu"], result.estimates["lam"])
    print(f"Young's modulus {young:.6g} Pa, Poisson's ratio {poisson:.4g}")
    if not result.converged:
        how = "stalled" if result.stalled else f"did not converge in {len(result.history)} evaluations"
        advice = "try another --start, more --iterations, or --fixed-lam"
        _warn(f"identify {how}: mu and lam are the best seen and may be far off; {advice}")
    return int(result.stalled)


def _info(options: argparse.Namespace) -> None:
    rows = versions()
    rows["cuda"] = torch.cuda.get_device_name() if torch.cuda.is_available() else "no device"
    package = Path(__file__).parent
    rows["compiled"] = ", ".join(sorted(path.name for path in package.glob("_C*"))) or "nothing"
    rows["package"] = str(package)
    rows["pages"] = str(PAGES)
    for name, value in rows.items():
        print(f"{name:10} {value}")


def _task_options() -> dict[str, list[str]]:
    """Options of single tasks, and what each task says about it."""
    found: dict[str, list[str]] = {}
    for task_name, task in sorted(TASKS.items()):
        for name, option in task.options.items():
            found.setdefault(name, []).append(f"{task_name}: {option.help}")
    return found


def _task_list() -> str:
    return "\n".join(f"{name:16} {task.summary}" for name, task in sorted(TASKS.items()))


def _add_material(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--velocity", type=float, nargs=3, metavar=("VX", "VY", "VZ"), help="initial velocity [m/s]")
    material = parser.add_argument_group("material (default: mu = lam = 1e5 Pa)")
    for name, text in MODULI.items():
        material.add_argument(f"--{name}", type=float, help=text)
    material.add_argument("--young", type=float, help="Young's modulus [Pa], together with --poisson")
    material.add_argument("--poisson", type=float, help="Poisson's ratio, below 0.5")


def _add_scene(parser: argparse.ArgumentParser, chosen: tuple[str, ...] = ()) -> None:
    """``chosen``: what the command chooses itself: such options are known, to say so, and not shown."""
    text = "metres per unit of the file, 0.001 for mm (default 1)"
    parser.add_argument("--scale", type=float, default=1.0, help=text)
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
    text = f"corrections between the sweeps (default {Scene.subspace}); coarse suits what is stiff, long or fine"
    scene.add_argument("--subspace", choices=[*SUBSPACES], help=shown("subspace", text))
    scene.add_argument("--integrator", choices=[*INTEGRATORS],
                       help=shown("integrator", f"of time (default {Scene.integrator})"))  # fmt: skip
    text = ("hold the vertices at a side of the bounding box: x-, x+, y-, y+, z- or z+; up to this fraction of its "
            "extent (default 0.001), for example y+:0.05 for a round body; may be repeated")  # fmt: skip
    scene.add_argument("--pin", action="append", metavar="SIDE[:FRACTION]", help=text)


def _material(options: argparse.Namespace) -> tuple[float, float]:
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


def _scene(options: argparse.Namespace) -> tuple[Scene, float, float]:
    """The scene that the options describe, mu and lam [Pa]."""
    check_device(options.device)
    mesh = _mesh(options)
    mu, lam = _material(options)
    v0 = np.broadcast_to(np.asarray(options.velocity or (0.0, 0.0, 0.0)), mesh.points.shape)
    values = _given(options, mesh)
    for name in ("kappa", "dhat", "friction"):
        if name in values and "floor" not in values:
            raise ValueError(f"--{name}: expected --floor with it, got none")
    pinned = values.pop("pinned", np.zeros(mesh.num_vertices, dtype=bool))
    return Scene(mesh, mesh.points, np.where(pinned[:, None], 0.0, v0), pinned, **values), mu, lam


def _given(options: argparse.Namespace, mesh: dv.TetMesh) -> dict[str, Any]:
    """Fields of a Scene that were given; `pinned` [V] of --pin."""
    values = {name: getattr(options, name) for name in FIELDS if getattr(options, name) is not None}
    for name, value in values.items():
        if not isinstance(value, (str, int)) and not np.isfinite(value).all():
            raise ValueError(f"--{name.replace('_', '-')}: expected finite numbers, got {value}")
    if options.pin:
        values["pinned"] = np.logical_or.reduce([side(mesh.points, text) for text in options.pin])
    return values


def _add_mesh(commands: Any) -> None:
    """Add the command to those of `diffvbd`."""
    text = "repair a surface (.ply, .stl, .obj, ...) and fill it with tets; needs the extra [mesh]"
    parser = commands.add_parser("mesh", help=text)
    parser.add_argument("surface", type=Path, metavar="SURFACE", help="a file with triangles")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="PART.msh", help="the file to write")
    parser.add_argument("--force", action="store_true", help="overwrite it if it is there")
    unit = parser.add_mutually_exclusive_group()
    unit.add_argument("--size", type=float, help="the largest extent that it shall have [m]")
    unit.add_argument("--scale", type=float, help="metres per unit of the file, 0.001 for mm (default 1)")
    text = "the file's axis that points up, for example z; --up=-z for a minus (default y)"
    parser.add_argument("--up", default="y", choices=["x", "y", "z", "-x", "-y", "-z"], help=text)
    parser.add_argument("--edge", type=float, help="wanted edge length [m] (default: 1/20 of the diagonal)")
    parser.add_argument("--epsilon", type=float, help="tets may miss the surface by so much [m] (default: edge / 20)")
    text = "larger surfaces are decimated to so many first (default 3000)"
    parser.add_argument("--max-triangles", type=int, default=3000, help=text)
    parser.set_defaults(command=_run_mesh)


def _run_mesh(options: argparse.Namespace) -> None:
    """Repair, fill, write, and show what each of them found."""
    out = options.out
    if out.exists() and out.resolve() == options.surface.resolve():
        raise ValueError(f"--out: expected another file than {options.surface}")
    if out.exists() and not options.force:
        raise ValueError(f"--out: {out} would be overwritten; give --force, or another name")
    if out.suffix.lower() not in WRITTEN:
        raise ValueError(f"--out: expected a name that ends in {', '.join(WRITTEN)}, got {out}")
    if not out.parent.is_dir():
        raise FileNotFoundError(f"directory {out.parent} does not exist")
    repaired = dv.mesh.repair(options.surface, options.size, options.scale, options.up)
    print(repaired)
    if len(repaired.triangles) > options.max_triangles:
        print(f"{'decimated':9} to {options.max_triangles} triangles; --max-triangles keeps more, and takes longer")
    start = time.perf_counter()
    mesh = dv.mesh.tetrahedralize(repaired.surface, options.edge, options.epsilon, options.max_triangles)
    print(mesh_report(mesh, repaired.volume, time.perf_counter() - start))
    mesh.save(out)
    print(f"wrote {out}")


# Formats of meshio that hold tets and need no further package.
WRITTEN = (".msh", ".vtu", ".vtk", ".mesh", ".inp")
POOR = 0.1  # a mean ratio below which a tet is stiffer than its material


def mesh_report(mesh: dv.mesh.TetMesh, enclosed: float, seconds: float) -> str:
    """Size, volume [m^3], also over that of the surface, and quality of tets, as rows of text."""
    quality, extent = mesh.quality, np.ptp(mesh.points, axis=0)
    volume = mesh.volume.sum()
    over = f" ({volume / enclosed - 1:+.2%} of the surface's)" if enclosed > 0 else ""
    shares = np.quantile(quality, [0.0, 0.05, 0.5])
    rows = {
        "mesh": f"{mesh.num_vertices} vertices, {mesh.num_tets} tets, in {seconds:.1f} s",
        "extent": " x ".join(f"{length:.4g}" for length in extent) + " m",
        "volume": f"{volume:.6g} m^3{over}",
        "quality": "mean ratio (1 is regular, 0 is flat): "
        + ", ".join(f"{name} {share:.3f}" for name, share in zip(("least", "5 %", "median"), shares, strict=True))
        + f"; {int((quality < POOR).sum())} tets below {POOR}",
    }
    return "\n".join(f"{name:9} {text}" for name, text in rows.items())


PORT = 8080


def _add_view(commands: Any) -> None:
    """Add the command to those of `diffvbd`."""
    parser = commands.add_parser("view", help="show a motion, a mesh or a run in the browser; needs the extra [viz]")
    text = "a .pvd, a mesh with tets, or the folder of a `diffvbd run`"
    parser.add_argument("path", type=Path, metavar="FILE|RUN", help=text)
    parser.add_argument("--color", choices=[*QUANTITIES], default="body", help="of the triangles (default body)")
    parser.add_argument("--time-step", type=float, help="between frames [s] (default: what the file says)")
    for name, text in MODULI.items():
        parser.add_argument(f"--{name}", type=float, help=f"{text}, for stress and stiffness")
    _add_server(parser)
    parser.add_argument("--open", action="store_true", help="open the page in the system's browser")
    parser.set_defaults(command=_view)


def _add_server(parser: argparse.ArgumentParser) -> None:
    """Options of the server."""
    parser.add_argument("--host", default="127.0.0.1", help="network interface of the page (default 127.0.0.1)")
    parser.add_argument("--port", type=int, default=PORT, help=f"of the page; the next free one is taken ({PORT})")


def _view(options: argparse.Namespace) -> None:
    """Show a file until Ctrl+C."""
    viewer = dv.viz.live(options.path, color=options.color, time_step=options.time_step, mu=options.mu, lam=options.lam,
                         host=options.host, port=options.port, browser=options.open)  # fmt: skip
    with viewer:
        print(f"{options.path} at {viewer.url}; Ctrl+C ends", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            viewer.wait()


@contextlib.contextmanager
def _watched(host: str, port: int) -> Iterator[Callable[[dict[str, float]], None]]:
    """A function that shows a row of a run's history with the latest rollout of this thread; what opens at the first.

    The page stays after the run for as long as a browser shows it.
    """
    optional("viser", "the viewer needs")
    heard: list[Any] = []
    viewer: dv.viz.Viewer | None = None

    def show(row: dict[str, float]) -> None:
        nonlocal viewer
        if viewer is None:
            if not heard:
                return
            viewer = dv.viz.live(heard[0][0], host=host, port=port)
            print(f"live view at {viewer.url}", file=sys.stderr, flush=True)
        x = None
        if heard:
            model, x = heard[0]
            viewer.update_model(model)
        heard.clear()
        others = {key: value for key, value in row.items() if key not in ("iteration", "loss", "seconds")}
        viewer.update(x, loss=row["loss"], **others)

    try:
        with record_to(heard, "rollout"):
            yield show
        if viewer is not None and viewer.watched:
            print(f"the run has ended; its view stays at {viewer.url} until the page is closed", file=sys.stderr)
            with contextlib.suppress(KeyboardInterrupt):
                viewer.wait(unwatched=False)
    finally:
        if viewer is not None:
            viewer.stop()
