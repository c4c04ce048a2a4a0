"""The controls of the page: play, color, sliders of parameters, the course of an optimisation."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
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
        self._tell, self._setting = tell, False
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
        for handle, what in ((self.motion, "motion"), (self.frame, "frame"), (self.color, "color"),
                             (self.loop, "loop")):  # fmt: skip
            handle.on_update(lambda event, what=what: self._say(what, event.target.value))
        self.speed.on_update(lambda event: self._say("speed", float(event.target.value)))
        self.play.on_click(lambda _: self._say("play", None))
        camera.on_click(lambda _: self._say("camera", None))
        self._values = {name: first for name, (_, _, first) in sliders.items()}
        self._moved = moved
        self.state: Any = None
        if sliders:
            self._add_sliders(sliders)
        self._chart: Any = None
        self._label = "loss"
        self._table: Any = None

    def _say(self, what: str, value: Any) -> None:
        if not self._setting:  # viser tells of values that the program sets, too
            self._tell(what, value)

    def _add_sliders(self, sliders: Mapping[str, Slider]) -> None:
        with self.gui.add_folder("Parameters"):
            for name, (low, high, first) in sliders.items():
                handle = self.gui.add_slider(name, low, high, (high - low) / STEPS, first)
                handle.on_update(lambda event, name=name: self._move(name, event.target.value))
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
            self._setting = True
            try:
                handle.value = value
            finally:
                self._setting = False

    def show_frame(self, frame: int, frames: int, seconds: float | None, playing: bool) -> None:
        """The frame that is shown, of so many, and its time [s]."""
        last = max(1, frames - 1)
        if self.frame.max != last:
            self.frame.max = last
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
        if tuple(self.motion.options) != tuple(names):
            self._setting = True
            try:
                self.motion.options = tuple(names)
            finally:
                self._setting = False
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
