"""`diffvbd view`: a motion in the browser, and the live view of a run."""

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import diffvbd as dv
from diffvbd.scopes import record_to
from diffvbd.viz.server import require_viser
from diffvbd.viz.values import QUANTITIES

PORT = 8080


def add(commands: Any) -> None:
    """Add the command to those of `diffvbd`."""
    parser = commands.add_parser("view", help="show a motion, a mesh or a run in the browser; needs the extra [viz]")
    parser.add_argument(
        "path", type=Path, metavar="FILE|RUN", help="a .pvd, a mesh with tets, or the folder of a `diffvbd run`"
    )
    parser.add_argument("--color", choices=[*QUANTITIES], default="body", help="of the triangles (default body)")
    parser.add_argument("--time-step", type=float, help="between frames [s] (default: what the file says)")
    for name, text in (("mu", "shear modulus [Pa]"), ("lam", "first Lame parameter [Pa]")):
        parser.add_argument(f"--{name}", type=float, help=f"{text}, for stress and stiffness")
    add_server(parser)
    parser.add_argument("--open", action="store_true", help="open the page in the system's browser")
    parser.set_defaults(command=run)


def add_server(parser: argparse.ArgumentParser) -> None:
    """Options of the server."""
    parser.add_argument("--host", default="127.0.0.1", help="network interface of the page (default 127.0.0.1)")
    parser.add_argument("--port", type=int, default=PORT, help=f"of the page; the next free one is taken ({PORT})")


def run(options: argparse.Namespace) -> None:
    """Show a file until Ctrl+C."""
    viewer = dv.viz.live(options.path, color=options.color, time_step=options.time_step, mu=options.mu, lam=options.lam,
                         host=options.host, port=options.port, browser=options.open)  # fmt: skip
    with viewer:
        print(f"{options.path} at {viewer.url}; Ctrl+C ends", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            viewer.wait()


@contextlib.contextmanager
def watched(host: str, port: int) -> Iterator[Callable[[dict[str, float]], None]]:
    """A function that shows a row of a run's history with the latest rollout of this thread; what opens at the first.

    The page stays after the run for as long as a browser shows it.
    """
    require_viser()
    heard: list[Any] = []
    viewer: dv.viz.Viewer | None = None

    def show(row: dict[str, float]) -> None:
        nonlocal viewer
        if viewer is None:
            if not heard:
                return
            viewer = dv.viz.live(heard[0][0], host=host, port=port)
            print(f"live view at {viewer.url}", file=sys.stderr, flush=True)
        if heard:
            viewer.update_model(heard[0][0])
        x = heard[0][1] if heard else None
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
