"""Timing of the control steps of running worlds: play, pause, single steps, speed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from mjhab.core.timing import STEP_SECONDS

WAKE_SECONDS = 0.2
"""Interval at which a waiting run calls ``meanwhile`` [s]."""


class RealTimeClock:
    """Real-time clock of a run; the page sets it in one thread while the run waits on it in another.

    Args:
        playing: whether control steps are due one after the other.
        speed: simulated seconds per second of real time; infinite makes every step due at once.
    """

    def __init__(self, *, playing: bool = True, speed: float = 1.0) -> None:
        self._changed = threading.Condition()
        self._playing = playing
        self._speed = speed
        self._single = 0
        self._due = time.perf_counter()

    @property
    def playing(self) -> bool:
        """Whether control steps are due one after the other, rather than paused."""
        return self._playing

    @property
    def speed(self) -> float:
        """Simulated seconds per second of real time."""
        return self._speed

    def play(self, playing: bool) -> None:
        """Resume or pause; single steps that are still due are dropped."""
        with self._changed:
            self._playing = playing
            self._single = 0
            self._due = time.perf_counter()
            self._changed.notify_all()

    def set_speed(self, speed: float) -> None:
        """Set the simulated seconds per second of real time."""
        with self._changed:
            self._speed = speed
            # Without it a long pause would be made up for in a rush.
            self._due = time.perf_counter()
            self._changed.notify_all()

    def step_once(self) -> None:
        """Pause, and make one more control step due now."""
        with self._changed:
            self._playing = False
            self._single += 1
            self._changed.notify_all()

    def wake(self) -> None:
        """Make a waiting run call ``meanwhile`` now."""
        with self._changed:
            self._changed.notify_all()

    def wait(self, meanwhile: Callable[[], object]) -> None:
        """Block until the next control step is due.

        Args:
            meanwhile: called at least once and every `WAKE_SECONDS`; its exceptions are passed on and end the wait.
        """
        while True:
            meanwhile()
            with self._changed:
                if self._single:
                    self._single -= 1
                    return
                left = self._due - time.perf_counter()
                if self._playing and left <= 0.0:
                    # A run that is late does not shorten the next intervals to catch up.
                    self._due += max(STEP_SECONDS / self._speed, -left)
                    return
                self._changed.wait(
                    min(left, WAKE_SECONDS) if self._playing else WAKE_SECONDS
                )
