"""The command line: `diffvbd` or `python -m diffvbd`."""

import argparse
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch

import diffvbd as dv
from diffvbd import cli_mesh, cli_scene, cli_view
from diffvbd.mesh.series import EXTENSIONS, check_extension
from diffvbd.rollout.search import ERROR, PATIENCE
from diffvbd.said import PAGES
from diffvbd.tasks import TASKS, Problem, Settings, identify, solve, table
from diffvbd.tasks.problem import Result, check_device
from diffvbd.tasks.progress import Row, versions
from diffvbd.tasks.ranks import joined
from diffvbd.tasks.scene import MOST_STEPS, Observation, Scene

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
                                                   time step, sweeps and the like that keep an error of 1 %

`diffvbd COMMAND --help` explains each command. Errors are one line, with exit status 2. `identify` ends with status 1
where it stalled, and warns wherever it did not converge; `advise` where the error cannot be had. An interrupted `run`
or `identify` continues where it stopped when the same command is given again.
"""
ADVISED = ("time_step", "sweeps", "relaxation", "integrator", "coarse")  # what advise chooses
TARGET_KEYS = """keys of TARGET.npz (only x is required; an option given here replaces the file's value):
  x          observed positions [m], shape [N, V, 3], or [V, 3] for one final shape
  steps      time steps after which each was observed, shape [N]; default 0, 1, 2, ...; where the file has a time_step,
             another --time-step keeps the times
  x0, v0     initial positions [m] and velocities [m/s], shape [V, 3]; default: the mesh, at rest
  pinned     vertices that are held, bool, shape [V]; default none
  time_step [s], sweeps, density [kg/m^3], gravity [m/s^2], floor [m], kappa, dhat [m], friction, relaxation,
             integrator, coarse (0 or 1)
  mu, lam    the true material [Pa], if known: only used to report the error
`diffvbd simulate --save-target TARGET.npz` writes such a file.
"""


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
    run.add_argument(
        "--quick",
        action="store_true",
        help="a small version that takes seconds and need not be as accurate",
    )
    _add_run_options(run, "runs/NAME, or runs/NAME-quick")
    for name, texts in sorted(_task_options().items()):
        run.add_argument(f"--{name}", help="; ".join(texts))
    run.add_argument("--view", action="store_true", help="show the run in the browser while it goes on; extra [viz]")
    cli_view.add_server(run)
    run.set_defaults(command=_run)

    listing = commands.add_parser("list", help="list the shipped inverse problems")
    listing.set_defaults(command=lambda options: print(_task_list()))

    cli_mesh.add(commands)
    cli_view.add(commands)

    simulate = commands.add_parser("simulate", help="simulate a mesh and write its motion")
    simulate.add_argument("mesh", type=Path, metavar="MESH", help="a file with tetrahedra (.msh, .vtu, .vtk, ...)")
    simulate.add_argument(
        "--out", type=Path, required=True, metavar="PART.pvd", help=f"{', '.join(EXTENSIONS)}; missing folders are made"
    )
    simulate.add_argument("--force", action="store_true", help="overwrite without asking")
    simulate.add_argument("--steps", type=int, default=100, help="time steps (default 100)")
    simulate.add_argument("--stride", type=int, default=1, help="write every n-th frame (default 1)")
    simulate.add_argument("--device", default="cpu", help="torch device (default cpu)")
    simulate.add_argument("--save-target", type=Path, metavar="FILE.npz", help="also write what `identify` reads")
    cli_scene.add_material(simulate)
    cli_scene.add_options(simulate)
    simulate.set_defaults(command=_simulate)

    advice = commands.add_parser("advise", help="find time step, sweeps and the like that keep a wanted error")
    advice.add_argument("mesh", type=Path, metavar="MESH", help="a file with tetrahedra")
    advice.add_argument("--duration", type=float, required=True, help="of the motion [s]")
    advice.add_argument("--error", type=float, default=ERROR, help=f"share of the motion, below 1 (default {ERROR:g})")
    advice.add_argument("--gradient", action="store_true", help="keep it for gradients, too")
    advice.add_argument("--patience", type=float, default=PATIENCE, help=f"pilots may run so long [s] ({PATIENCE:g})")
    advice.add_argument("--device", default="cpu", help="torch device (default cpu)")
    cli_scene.add_material(advice)
    cli_scene.add_options(advice, ADVISED)
    advice.set_defaults(command=_advise)

    identification = commands.add_parser(
        "identify", help="recover mu and lam from observed shapes", epilog=TARGET_KEYS, formatter_class=raw
    )
    identification.add_argument("mesh", type=Path, metavar="MESH", help="a file with tetrahedra")
    identification.add_argument("target", type=Path, metavar="TARGET.npz", help="the observation, see below")
    identification.add_argument(
        "--start",
        type=float,
        nargs=2,
        metavar=("MU", "LAM"),
        help=f"first guess [Pa] (default 1e5); the result stays within a factor {identify.RANGE:.0e} of it",
    )
    identification.add_argument("--start-young", type=float, help="the same as Young's modulus [Pa]")
    identification.add_argument("--start-poisson", type=float, help="and Poisson's ratio, above 0 and below 0.5")
    identification.add_argument("--fixed-lam", action="store_true", help="keep lam at its first guess")
    identification.add_argument("--iterations", type=int, default=100, help="at most so many (default 100)")
    identification.add_argument("--steps", type=int, help="time steps that led to the shape, if x is one shape")
    cli_scene.add_options(identification)
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
        with cli_view.watched(options.host, options.port) if options.view else nullcontext() as watch:
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
    check_device(options.device)
    mesh = _mesh(options)
    mu, lam = cli_scene.material(options)
    scene = cli_scene.scene(options, mesh)
    _make_place(options)
    with torch.no_grad():
        model, progress = scene.model(options.device), sys.stderr.isatty()
        said_below = False if options.stride == 1 else None
        motion = scene.simulate(model, mu, lam, options.steps, save=options.stride, progress=progress,
                                check_contact=said_below)  # fmt: skip
    frames, steps = motion.x.cpu().numpy(), np.asarray(motion.steps)
    dv.mesh.write_series(options.out, mesh, frames, steps * scene.time_step)
    count = int(scene.pinned.sum())
    print(f"wrote {options.out} ({len(steps)} frames of {mesh.num_vertices} vertices, {count} pinned)")
    if options.pin and count < 3:
        print(
            f"warning: --pin holds {count} vertices; a fraction takes more, for example --pin x-:0.05", file=sys.stderr
        )
    if len(steps) > 1 and options.stride == 1:
        previous = (motion.x[-2], motion.v[-2]) if scene.integrator == Scene.integrator else None
        found = dv.diagnose(model, motion.x[-1], mu=mu, lam=lam, time_step=scene.time_step, previous=previous,
                            gravity=scene.gravity, warn=False)  # fmt: skip
        for message in found.messages:
            print(f"warning: {message}", file=sys.stderr)
    if options.save_target:
        Observation(scene, frames, steps, {"mu": mu, "lam": lam}).save(options.save_target)
        print(f"wrote {options.save_target}")


def _advise(options: argparse.Namespace) -> int:
    for name in ADVISED:
        if getattr(options, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')}: expected none, since it is what advise chooses")
    check_device(options.device)
    mesh = _mesh(options)
    mu, lam = cli_scene.material(options)
    scene = cli_scene.scene(options, mesh)
    model = scene.model(options.device)
    x, v = (torch.tensor(a, dtype=model.dtype, device=model.device) for a in (scene.x0, scene.v0))
    settings = dv.advise(model, x, v, duration=options.duration, error=options.error, gradient=options.gradient,
                         patience=options.patience, mu=mu, lam=lam, gravity=scene.gravity)  # fmt: skip
    print(settings)
    print(f"\nin Python: settings=dv.Settings({_in_python(settings)})")
    return 0 if settings.predicted is not None and settings.predicted.reached else 1


def _in_python(settings: dv.Settings) -> str:
    """The arguments of dv.Settings that are not left at their defaults."""
    given = [f"{settings.time_step!r}, {settings.sweeps}, dv.{settings.integrator!r}"]
    given += [f"relaxation={settings.relaxation!r}"] if settings.relaxation != 1 else []
    given += [f"coarse={settings.coarse!r}"] if settings.coarse is not None else []
    return ", ".join(given)


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
    given = cli_scene.given(options, mesh) | {"steps": options.steps}
    observation = Observation.load(options.target, mesh, **given)
    settings = Settings(options.out or Path("runs/identify"), options.device, options.seed)
    problem = identify.problem(observation, settings, start, options.fixed_lam, options.iterations)
    result = _solve(problem, settings)
    young, poisson = dv.young_poisson(result.estimates["mu"], result.estimates["lam"])
    print(f"Young's modulus {young:.6g} Pa, Poisson's ratio {poisson:.4g}")
    if not result.converged:
        how = "stalled" if result.stalled else f"did not converge in {len(result.history)} evaluations"
        advice = "try another --start, more --iterations, or --fixed-lam"
        print(f"warning: identify {how}: mu and lam are the best seen and may be far off; {advice}", file=sys.stderr)
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
