"""Which frame of a motion is shown at a time, and when a function runs again: no page, no drawing."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Runs a function in a thread of its own once its arguments have stood still for a while.

    Args:
        function: Called with the latest arguments; never twice at a time.
        done: Called with its result.
        failed: Called with the exception that it raised.
        delay: [s] without another request before it runs.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        done: Callable[[Any], object],
        failed: Callable[[Exception], object],
        delay: float = DELAY,
    ) -> None:
        self.function, self.done, self.failed, self.delay = function, done, failed, delay
        self.runs = 0
        self._asked: tuple[float, dict[str, Any]] | None = None
        self._stopped = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="diffvbd-rerun", daemon=True)
        self._thread.start()

    def request(self, **arguments: Any) -> None:
        """Asks for a run with these arguments, in place of what was asked for before and has not begun."""
        with self._changed:
            self._asked = (time.monotonic() + self.delay, arguments)
            self._changed.notify()

    def stop(self, wait: float = 2.0) -> None:
        """Ends the thread, after a run that is under way."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        if self._thread is not threading.current_thread():
            self._thread.join(wait)

    def _next(self) -> dict[str, Any] | None:
        with self._changed:
            while not self._stopped:
                if self._asked is None:
                    self._changed.wait()
                elif (left := self._asked[0] - time.monotonic()) > 0:
                    self._changed.wait(left)
                else:
                    arguments, self._asked = self._asked[1], None
                    return arguments
        return None

    def _work(self) -> None:
        while (arguments := self._next()) is not None:
            try:
                self.runs += 1
                self.done(self.function(**arguments))
            except Exception as error:  # a user's function may raise anything; the page shows it
                self.failed(error)
