"""A page that shows motions while a program runs: the server, and the thread that draws."""

from __future__ import annotations

import contextlib
import html
import io
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from ..checks import check_count, fail, is_word
from ..rollout.trajectory import Trajectory
from ..scopes import record_to
from .clock import DELAY, Clock, Rerun
from .drawing import Scenery
from .motion import Mesh, Motion, motions_of
from .panel import Panel, Slider
from .server import open_server
from .stage import Stage
from .values import QUANTITIES, Values, legend

TICK = 1 / 30  # [s] between two looks at the clock
PAUSE = 0.1  # [s] at least between two shapes of an optimisation


class Viewer:
    """A local page with a motion. Made by :func:`live`; also a context manager that stops it at its end.

    Attributes:
        url: Address of the page.
        motions: What can be shown, by name.
    """

    def __init__(
        self,
        motions: dict[str, Motion],
        mesh: Mesh | None,
        values: Values,
        *,
        color: str,
        time_step: float | None,
        scenery: tuple[Scenery, ...],
        sliders: Mapping[str, Slider],
        simulate: Callable[..., Any] | None,
        host: str,
        port: int,
        delay: float = DELAY,
    ) -> None:
        self.motions, self.mesh, self.values, self._time_step = motions, mesh, values, time_step
        self._name, self._color, self._scenery = next(iter(motions)), color, scenery
        values.colors(color, motions[self._name])  # raises what is wrong with it
        self._losses: list[float] = []
        self._parameters: dict[str, float] = {}
        self._pending: Any = None  # positions that have not been drawn
        self._copied = 0.0
        self._heard: list[Any] = []
        self._things: Any = None
        self._dirty, self._stopped, self._reframe, self._error = True, False, True, ""
        self._followed = False  # whether a shape of an optimisation has been shown
        self._changed = threading.Condition(threading.RLock())
        first = motions[self._name]
        self.clock = Clock(first.times, len(first))
        self._server = open_server(host, port)
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"
        self._stage = Stage(self._server)
        self._rerun = None if simulate is None else Rerun(simulate, self._simulated, self._failed, delay)
        self._panel = Panel(self._server, [*motions], color, self._told, sliders, self._moved)
        for event in (self._server.on_client_connect, self._server.on_client_disconnect):
            event(lambda _: self._wake())
        self._thread = threading.Thread(target=self._work, name="diffvbd-viewer", daemon=True)
        self._thread.start()

    # --- what a program does ---

    @property
    def frame(self) -> int:
        """The frame that is shown; may be set."""
        return self.clock.frame

    @frame.setter
    def frame(self, k: int) -> None:
        check_count("frame", k, 0, len(self.motions[self._name]) - 1)
        self._told("frame", k)

    @property
    def color(self) -> str:
        """By what triangles are colored; may be set."""
        return self._color

    @color.setter
    def color(self, name: str) -> None:
        if not is_word(name, *QUANTITIES):
            fail("color", f"one of {', '.join(QUANTITIES)}", repr(name))
        self._told("color", name)

    @property
    def watched(self) -> bool:
        """Whether a browser shows the page."""
        return bool(self._server.get_clients())

    def play(self) -> None:
        """Lets the motion run."""
        with self._changed:
            self.clock.play()
        self._wake()

    def pause(self) -> None:
        """Stops at the present frame."""
        with self._changed:
            self.clock.playing = False
        self._wake()

    def update(self, x: Any = None, loss: Any = None, **parameters: Any) -> None:
        """Shows an iteration of an optimisation: its shape or motion, its loss, its parameters.

        It changes nothing and waits for nothing. Positions on a CPU are kept as they are and read when they are drawn;
        those on a CUDA device are copied at most every 0.1 s, every 2 s when no browser shows the page.

        Args:
            x: Positions [m], shape [V, 3], [N, V, 3] or [N, B, V, 3], or a dv.Trajectory; None: those of the latest
                rollout inside :meth:`listening`, or as before.
            loss: A number or a tensor of one.
            parameters: Numbers or tensors of one to list.

        Raises:
            TypeError: a loss or a parameter that is no number.
        """
        if loss is not None:
            self._losses.append(_number("loss", loss))
        if parameters:
            self._parameters = {name: _number(name, value) for name, value in parameters.items()}
        heard = self._heard[-1:]
        self._heard.clear()
        if x is None and heard:
            self.mesh, x = heard[0]
        if x is not None:
            now, cuda = time.monotonic(), getattr(getattr(x, "x", x), "is_cuda", False)
            if not cuda or now - self._copied >= (PAUSE if self.watched else 20 * PAUSE):
                self._copied = now
                self._pending = _kept(x)
        self._wake()

    def show_course(self, losses: Sequence[float], parameters: Mapping[str, float]) -> None:
        """Shows the losses of an optimisation that has ended, and its last parameters, in place of those so far."""
        self._losses, self._parameters = [*losses], dict(parameters)
        self._wake()

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Inside, :meth:`update` without positions shows the latest rollout of this thread."""
        with record_to(self._heard, "rollout"):
            yield

    def update_model(self, mesh: Mesh) -> None:
        """The dv.Model or dv.TetMesh of the positions that :meth:`update` gets from now on."""
        self.mesh = mesh

    def wait(self, unwatched: bool = True) -> None:
        """Returns when the viewer is stopped, or, if not `unwatched`, when no browser shows it; Ctrl+C leaves it."""
        while not self._stopped and (unwatched or self.watched):
            time.sleep(0.2)

    def stop(self) -> None:
        """Ends server and threads; may be called twice."""
        with self._changed:
            if self._stopped:
                return
            self._stopped = True
            self._changed.notify_all()
        if self._rerun is not None:
            self._rerun.stop()
        self._thread.join(5.0)
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _repr_html_(self) -> str:
        """The page inside a notebook."""
        return f"<iframe src='{html.escape(self.url)}' width='100%' height='520' style='border:0'></iframe>"

    def __repr__(self) -> str:
        return f"Viewer({self.url})"

    # --- what the page does ---

    def _wake(self) -> None:
        with self._changed:
            self._dirty = True
            self._changed.notify_all()

    def _told(self, what: str, value: Any) -> None:
        with self._changed:
            if what == "play" and self.clock.playing:
                self.clock.playing = False
            elif what == "play":
                self.clock.play()
            elif what == "frame":
                self.clock.playing, self.clock.frame = False, int(value)
            elif what in ("loop", "speed"):
                setattr(self.clock, what, value)
            elif what == "color":
                self._color = value
            elif what == "motion" and value in self.motions:
                self._choose(value)
            elif what == "camera":
                self._reframe = True
        self._wake()

    def _choose(self, name: str) -> None:
        motion = self.motions[name]
        self._name = name
        self.clock.set_times(motion.times, len(motion))

    def _moved(self, values: dict[str, float]) -> None:
        assert self._rerun is not None
        self._panel.say_state("simulating ...")
        self._rerun.request(**values)

    def _simulated(self, result: Any) -> None:
        found = motions_of(result, self.mesh, self._time_step)
        with self._changed:
            self.motions = found
            self._choose(self._name if self._name in found else next(iter(found)))
        self._panel.say_state("up to date")
        self._wake()

    def _failed(self, error: Exception) -> None:
        self._panel.say_state(f"**{type(error).__name__}: {error}** The motion is that of the last run that ended.")

    # --- drawing ---

    def _work(self) -> None:
        before = time.monotonic()
        while not self._stopped:
            with self._changed:
                if not self._dirty and not (self.clock.playing and self.watched):
                    self._changed.wait(0.5)
                now = time.monotonic()
                frame = self.clock.frame
                if self.watched:
                    self.clock.advance(min(now - before, 3 * TICK))
                redraw, self._dirty = self._dirty or frame != self.clock.frame, False
                before = now
            if redraw and not self._stopped:
                try:
                    self._draw()
                except Exception as error:  # whatever goes wrong with a picture must not end the thread
                    self._panel.say(f"{type(error).__name__}: {error}")
            time.sleep(TICK)

    def _draw(self) -> None:
        self._take_pending()
        with self._changed:
            motion, name, frame = self.motions[self._name], self._color, self.clock.frame
            reframe, self._reframe = self._reframe, False
        error = self._error
        try:
            colors = self.values.colors(name, motion)
        except (ValueError, TypeError) as failure:
            error, colors = f"{failure}", self.values.colors("body", motion)
        things = (*self._scenery, *motion.scenery)
        if [*map(id, things)] != [*map(id, self._things or ())] or self._things is None:
            self._stage.set_scenery(things)
            self._things = things
        if reframe:
            self._stage.look_at(*motion.bounds)
        self._stage.show(motion, colors, frame)
        seconds = None if motion.times is None else float(motion.times[frame])
        bodies = 1 if motion.body is None else len(set(motion.body.tolist()))
        text = legend(colors, bodies)
        if self._panel.legend.content != text:
            self._panel.legend.content = text
        self._panel.show_names([*self.motions], self._name)
        self._panel.set(self._panel.color, name)
        self._panel.show_frame(frame, len(motion), seconds, self.clock.playing)
        self._panel.show_course(self._losses, self._parameters)
        self._panel.say(error)

    def _take_pending(self) -> None:
        x, self._pending = self._pending, None
        if x is None or not (self.watched or self._stage.empty):
            self._pending = x
            return
        try:
            found = motions_of(x, self.mesh, self._time_step)
        except (ValueError, TypeError) as failure:
            self._error = f"{failure}"
            return
        self._error = ""
        with self._changed:
            self._reframe |= not self._followed
            self._followed = True
            self.motions = found
            self._choose(self._name if self._name in found else next(iter(found)))


def _kept(x: Any) -> Any:
    """Positions without their graph, on the CPU."""
    if isinstance(x, Trajectory):
        return Trajectory(_kept(x.x), _kept(x.v), x.steps)
    return x.detach().cpu() if hasattr(x, "detach") else x


def _number(name: str, value: Any) -> float:
    try:
        return float(value.detach() if hasattr(value, "detach") else value)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{name}: expected a number or a tensor of one, got {type(value).__name__}") from None
