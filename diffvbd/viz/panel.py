"""The controls of the page: play, color, sliders of parameters, the course of an optimisation."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from .values import QUANTITIES

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
STEPS = 200  # of a slider of a parameter
ROWS = 500  # points of the loss's curve
Slider = tuple[float, float, float]  # lowest, highest, first value


class Panel:
    """Controls of a viser server. What the user does is told to functions; what is shown is set by methods.

    Args:
        server: The viser server.
        names: Of the motions.
        tell: Called as tell(what, value) with "play", "frame", "loop", "speed", "color", "motion" or "camera".
        sliders: Lowest, highest and first value of each parameter.
        moved: Called with all parameters once a slider has moved.
    """

    def __init__(
        self,
        server: Any,
        names: Sequence[str],
        color: str,
        tell: Callable[[str, Any], None],
        sliders: Mapping[str, Slider],
        moved: Callable[[dict[str, float]], None],
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
        """How the simulation behind the sliders stands."""
        if self.state is not None:
            self.state.content = text

    def say(self, error: str) -> None:
        """An error, or none ("")."""
        self.message.content = f"**{error}**" if error else ""
        self.message.visible = bool(error)

    def set(self, handle: Any, value: Any) -> None:
        """Sets a control without telling of it."""
        if handle.value != value:
            handle.value = value

    def show_frame(self, frame: int, frames: int, seconds: float | None, playing: bool) -> None:
        """The frame that is shown, of so many, and its time [s]."""
        self._last = max(1, frames - 1)
        if self.frame.max != self._last:
            self.frame.max = self._last
        self.set(self.frame, frame)
        when = "" if seconds is None else f", {seconds:.3f} s"
        text = f"frame {frame} of {frames - 1}{when}"
        if self.time.content != text:
            self.time.content = text
        label = "Pause" if playing and frames > 1 else "Play"
        if self.play.label != label:
            self.play.label = label

    def show_names(self, names: Sequence[str], chosen: str) -> None:
        """The motions that there are."""
        self._names = tuple(names)
        if tuple(self.motion.options) != self._names:
            self.motion.options = self._names
        self.set(self.motion, chosen)
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


def _within(value: float, low: float, high: float) -> float | None:
    """The nearest value of a slider; None for NaN."""
    return None if math.isnan(value) else min(max(value, low), high)


def _among(value: str, known: Collection[str]) -> str | None:
    return value if value in known else None
