"""Page of a motion: playback, sliders, colors and the course of an optimisation, drawn by viser."""

from __future__ import annotations

import contextlib
import html
import io
import math
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._common.checks import check_count, fail, is_word
from .._common.context import record_to
from ..rollout.trajectory import Trajectory
from .motion import Mesh, Motion, motions_of, smooth_parts
from .scenery import Scenery, as_array
from .server import open_server
from .values import QUANTITIES, Colors, Values, legend, rgb

RATE = 24.0  # frames a second of a motion without times
DELAY = 0.2  # [s] without a change before a function runs again


class Clock:
    """Plays a motion: a position in time that advances, and the frame that it falls on.

    Attributes:
        playing, loop, speed: Whether it advances, begins again at the end, and how much faster than time it is.
    """

    def __init__(self, times: NDArray[np.float64] | None, frames: int) -> None:
        self.playing, self.loop, self.speed = False, True, 1.0
        self._now = 0.0
        self.set_times(times, frames)

    def set_times(self, times: NDArray[np.float64] | None, frames: int) -> None:
        """Another motion: the position stays where that has it."""
        self.times = np.arange(frames) / RATE if times is None else np.asarray(times) - times[0]
        self._now = min(self._now, self.end)

    @property
    def end(self) -> float:
        return float(self.times[-1])

    @property
    def frame(self) -> int:
        return max(0, int(np.searchsorted(self.times, self._now + 1e-9 * (1 + self.end), side="right")) - 1)

    @frame.setter
    def frame(self, k: int) -> None:
        self._now = float(self.times[int(np.clip(k, 0, len(self.times) - 1))])

    def play(self) -> None:
        """Begins at the start if it stands at the end."""
        if not self.loop and self._now >= self.end:
            self._now = 0.0
        self.playing = True

    def advance(self, seconds: float) -> int:
        """Moves on by so many seconds of the viewer; returns the frame."""
        if self.playing and self.end > 0:
            self._now += self.speed * seconds
            if self._now > self.end:
                # the last frame stays as long as the one before it
                period = self.end * len(self.times) / (len(self.times) - 1)
                if self.loop:
                    self._now %= period
                else:
                    self._now, self.playing = self.end, False
        return self.frame


class Rerun:
    """Runs a function in another thread once its arguments have stood still for a while."""

    def __init__(
        self,
        function: Callable[..., Any],  # gets the latest arguments; never called twice at a time
        done: Callable[[Any], object],  # gets its result
        failed: Callable[[Exception], object],  # gets the exception that it raised
        delay: float = DELAY,  # [s] without another request before it runs
    ) -> None:
        self.function, self.done, self.failed, self.delay = function, done, failed, delay
        self.runs = 0
        self._latest: threading.Timer | None = None
        self._changing, self._running = threading.Lock(), threading.RLock()

    def request(self, **arguments: Any) -> None:
        """Asks for a run with these arguments, in place of what was asked for before and has not begun."""
        timer = threading.Timer(self.delay, self._run, (arguments,))
        timer.daemon = True
        self._replace(timer)
        timer.start()

    def stop(self, wait: float = 2.0) -> None:
        """No more runs; returns after one that is under way."""
        self._replace(None)
        if self._running.acquire(timeout=wait):
            self._running.release()

    def _replace(self, timer: threading.Timer | None) -> None:
        with self._changing:
            if self._latest is not None:
                self._latest.cancel()
            self._latest = timer

    def _run(self, arguments: dict[str, Any]) -> None:
        with self._running:
            if self._latest is not threading.current_thread():  # asked for again meanwhile
                return
            try:
                self.runs += 1
                self.done(self.function(**arguments))
            except Exception as error:  # a user's function may raise anything; the page shows it
                self.failed(error)


EYE = np.array([0.55, 0.4, 1.0])  # direction from the scene to the camera
ROOM = 1.15  # around the scene, in its radii
VIEW_ANGLE = 0.7  # [rad] from the lowest to the highest that the camera sees


class Stage:
    """Draws frames of a motion into a viser server; viser has one color a mesh, so each color is a mesh."""

    def __init__(self, server: Any) -> None:
        self.server = server
        server.scene.set_up_direction("+y")
        self._layers: list[tuple[Any, NDArray[np.int64]]] = []  # meshes of constant color: handle, their vertices
        self._bins: list[Any] = []  # meshes of the levels of a quantity
        self._things: list[tuple[Any, NDArray[np.float64]]] = []  # what moves of the scenery, and where it is
        self._scenery: list[Any] = []
        self._shown: tuple[Any, Any] | None = None

    @property
    def empty(self) -> bool:
        """True until something has been drawn."""
        return self._shown is None

    def look_at(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Puts the camera where it sees all between two corners [m]."""
        middle, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-6)
        eye = middle + EYE / np.linalg.norm(EYE) * ROOM * radius / np.sin(0.5 * VIEW_ANGLE)
        cameras = [self.server.initial_camera, *(c.camera for c in self.server.get_clients().values())]
        for camera in cameras:
            camera.fov, camera.near, camera.far = VIEW_ANGLE, radius / 100, radius * 100
            camera.position, camera.look_at = tuple(eye), tuple(middle)

    def set_scenery(self, things: tuple[Scenery, ...]) -> None:
        """Scenery around the bodies."""
        for handle in self._scenery:
            handle.remove()
        self._scenery, self._things = [], []
        for k, thing in enumerate(things):
            points = as_array(thing.points)
            handle = self.server.scene.add_mesh_simple(
                f"/scenery/{k}",
                points if points.ndim == 2 else points[0],
                np.asarray(thing.triangles),
                color=rgb(thing.color),
                side="double",
                flat_shading=len(thing.triangles) <= 12,
                receive_shadow=len(thing.triangles) > 2,  # the map of viser's light ends on a large plane
            )
            self._scenery.append(handle)
            if points.ndim == 3:
                self._things.append((handle, points))

    def show(self, motion: Motion, colors: Colors, frame: int) -> None:
        """Draws a frame."""
        with self.server.atomic():
            if self._shown is None or self._shown[0] is not motion.triangles or self._shown[1] is not colors:
                self._begin(motion, colors)
            points = motion.points[frame].astype(np.float32)
            if self._bins:
                self._show_levels(points[motion.triangles], colors.at(frame))
            for handle, vertices in self._layers:
                handle.vertices = points[vertices]
            for handle, places in self._things:
                handle.vertices = places[min(frame, len(places) - 1)].astype(np.float32)

    def _begin(self, motion: Motion, colors: Colors) -> None:
        for handle in (*self._bins, *(handle for handle, _ in self._layers)):
            handle.remove()
        self._bins, self._layers, self._shown = [], [], (motion.triangles, colors)
        start, none = motion.points[0], (np.zeros((3, 3), np.float32), np.array([[0, 1, 2]]))
        part, add = smooth_parts(start, motion.triangles)[:, None], self.server.scene.add_mesh_simple
        for k, color in enumerate(colors.palette):
            tint = tuple(int(c) for c in color)
            if colors.unit:
                self._bins.append(
                    add(f"/level/{k}", *none, color=tint, flat_shading=True, side="double", visible=False)
                )
                continue
            rows = colors.levels == k
            if not rows.any():
                continue
            # a vertex on a sharp edge is one for each side, lest it be shaded as if it were round
            of_parts, faces = np.unique(part[rows] * len(start) + motion.triangles[rows], return_inverse=True)
            vertices = of_parts % len(start)
            handle = add(f"/body/{k}", start[vertices], faces.reshape(-1, 3), color=tint, side="double")
            self._layers.append((handle, vertices))

    def _show_levels(self, corners: NDArray[np.float32], levels: NDArray[np.int64]) -> None:
        """Triangles [F, 3, 3] in the mesh of their level."""
        order = np.argsort(levels, kind="stable")
        ends = np.searchsorted(levels[order], np.arange(len(self._bins) + 1))
        for k, handle in enumerate(self._bins):
            mine = corners[order[ends[k] : ends[k + 1]]].reshape(-1, 3)
            _set(handle, "visible", bool(len(mine)))
            if not len(mine):
                continue
            # a mesh may never have faces beyond its vertices, not even between two messages
            faces = np.arange(len(mine)).reshape(-1, 3)
            if len(mine) >= len(handle.vertices):
                handle.vertices, handle.faces = mine, faces
            else:
                handle.faces, handle.vertices = faces, mine


SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
STEPS = 200  # of a slider of a parameter
ROWS = 500  # points of the loss's curve
Slider = tuple[float, float, float]  # lowest, highest, first value


class Panel:
    """Controls of a viser server. What the user does is told to functions; what is shown is set by methods."""

    def __init__(
        self,
        server: Any,
        names: Sequence[str],  # of the motions
        color: str,
        tell: Callable[[str, Any], None],  # what ("play", "frame", "loop", "speed", "color", "motion", "camera"), value
        sliders: Mapping[str, Slider],
        moved: Callable[[dict[str, float]], None],  # gets all parameters once a slider has moved
    ) -> None:
        self.gui = server.gui
        self.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(47, 111, 159))
        self.gui.main_panel.dock_right()
        self._names, self._last = tuple(names), 1  # motions that there are; the last frame
        with self.gui.add_folder("Motion"):
            self.motion = self.gui.add_dropdown("show", tuple(names), initial_value=names[0], visible=len(names) > 1)
            self.play = self.gui.add_button("Play")
            self.frame = self.gui.add_slider("frame", 0, 1, 1, 0)
            self.time = self.gui.add_markdown("")
            self.speed = self.gui.add_dropdown("playback", SPEEDS, initial_value="1")
            self.loop = self.gui.add_checkbox("loop", True)
            camera = self.gui.add_button("Frame the scene")
        with self.gui.add_folder("Color"):
            self.color = self.gui.add_dropdown("by", tuple(QUANTITIES), initial_value=color)
            self.legend = self.gui.add_html("")
        self.message = self.gui.add_markdown("", visible=False)
        self._listen(self.motion, lambda name: _among(name, self._names), lambda name: tell("motion", name))
        self._listen(self.frame, lambda k: _within(k, 0, self._last), lambda k: tell("frame", int(k)))
        self._listen(self.color, lambda name: _among(name, QUANTITIES), lambda name: tell("color", name))
        self._listen(self.loop, bool, lambda loop: tell("loop", loop))
        self._listen(self.speed, lambda speed: _among(speed, SPEEDS), lambda speed: tell("speed", float(speed)))
        self.play.on_click(lambda _: tell("play", None))
        camera.on_click(lambda _: tell("camera", None))
        self._values = {name: first for name, (_, _, first) in sliders.items()}
        self._moved = moved
        self.state: Any = None
        if sliders:
            self._add_sliders(sliders)
        self._chart: Any = None
        self._label = "loss"
        self._table: Any = None

    def _listen(self, handle: Any, accept: Callable[[Any], Any], tell: Callable[[Any], None]) -> None:
        """Tells of values that users set, as `accept` takes them; None: not at all, and the control goes back.

        The page keeps to the limits of its controls, but whoever reaches the server can send anything.
        """
        last = handle.value

        def told(event: Any) -> None:
            nonlocal last
            if event.client is None:  # the program has set it
                last = handle.value
                return
            given = handle.value
            value = accept(given)
            last = last if value is None else value
            if value != given:
                handle.value = last
            if value is not None:
                tell(value)

        handle.on_update(told)

    def _add_sliders(self, sliders: Mapping[str, Slider]) -> None:
        with self.gui.add_folder("Parameters"):
            for name, (low, high, first) in sliders.items():
                handle = self.gui.add_slider(name, low, high, (high - low) / STEPS, first)
                self._listen(handle, partial(_within, low=low, high=high), partial(self._move, name))
            self.state = self.gui.add_markdown("up to date")

    def _move(self, name: str, value: float) -> None:
        self._values[name] = float(value)
        self._moved(dict(self._values))

    def say_state(self, text: str) -> None:
        """State of the simulation behind the sliders."""
        if self.state is not None:
            self.state.content = text

    def say(self, error: str) -> None:
        """An error, or none ("")."""
        self.message.content = f"**{error}**" if error else ""
        self.message.visible = bool(error)

    def show_colors(self, name: str, legend: str) -> None:
        """The quantity that is shown, and its legend as HTML."""
        _set(self.color, "value", name)
        _set(self.legend, "content", legend)

    def show_frame(self, frame: int, frames: int, seconds: float | None, playing: bool) -> None:
        """The frame that is shown, of so many, and its time [s]."""
        self._last = max(1, frames - 1)
        _set(self.frame, "max", self._last)
        _set(self.frame, "value", frame)
        when = "" if seconds is None else f", {seconds:.3f} s"
        _set(self.time, "content", f"frame {frame} of {frames - 1}{when}")
        _set(self.play, "label", "Pause" if playing and frames > 1 else "Play")

    def show_names(self, names: Sequence[str], chosen: str) -> None:
        """The motions that there are."""
        self._names = tuple(names)
        if tuple(self.motion.options) != self._names:
            self.motion.options = self._names
        _set(self.motion, "value", chosen)
        self.motion.visible = len(names) > 1

    def show_course(self, losses: Sequence[float], parameters: Mapping[str, float]) -> None:
        """The losses so far, and the parameters of the latest iteration."""
        if not losses and not parameters:
            return
        if self._table is None:
            with self.gui.add_folder("Optimisation", order=0):
                self._table = self.gui.add_html("")
        every = -(-max(1, len(losses)) // ROWS)
        iterations = np.arange(len(losses), dtype=np.float64)[::every]
        shown = np.asarray(losses, dtype=np.float64)[::every]
        if len(shown) > 1:
            self._show_curve(iterations, shown)
        rows = {"iteration": f"{max(0, len(losses) - 1)}"} | ({"loss": f"{losses[-1]:.6g}"} if losses else {})
        rows |= {name: f"{value:.6g}" for name, value in parameters.items()}
        cells = "".join(f"<tr><td>{html.escape(n)}</td><td align='right'>{v}</td></tr>" for n, v in rows.items())
        self._table.content = f"<table style='width:100%;padding:4px 12px;font-size:13px'>{cells}</table>"

    def _show_curve(self, iterations: np.ndarray, losses: np.ndarray) -> None:
        if self._chart is None:
            self._label = "log10 of the loss" if (losses > 0).all() else "loss"
        if self._label != "loss":
            losses = np.log10(np.maximum(losses, 1e-300))
        if self._chart is not None:
            self._chart.data = (iterations, losses)
            return
        from viser import uplot

        series = (uplot.Series(label="iteration"), uplot.Series(label=self._label, stroke="#2f6f9f", width=2))
        scales = {"x": uplot.Scale(time=False)}
        with self.gui.add_folder("Loss", order=0):
            self._chart = self.gui.add_uplot((iterations, losses), series, scales=scales, aspect=1.6)


def _set(handle: Any, name: str, value: Any) -> None:
    """An attribute of a control, sent to the page only where it changes."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _within(value: float, low: float, high: float) -> float | None:
    """The nearest value of a slider; None for NaN."""
    return None if math.isnan(value) else min(max(value, low), high)


def _among(value: str, known: Collection[str]) -> str | None:
    return value if value in known else None


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
        """True while a browser shows the page."""
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
            x: Positions [m], shape [V, 3], [N, V, 3] or [N, B, V, 3], or a Trajectory; None: those of the latest
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

    def _take(self, found: dict[str, Motion]) -> None:
        """Other motions in place of those shown."""
        with self._changed:
            self.motions = found
            self._choose(self._name if self._name in found else next(iter(found)))

    def _moved(self, values: dict[str, float]) -> None:
        assert self._rerun is not None
        self._panel.say_state("simulating ...")
        self._rerun.request(**values)

    def _simulated(self, result: Any) -> None:
        self._take(motions_of(result, self.mesh, self._time_step))
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
        self._panel.show_colors(name, legend(colors, bodies))
        self._panel.show_names([*self.motions], self._name)
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
            self._take(found)


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
