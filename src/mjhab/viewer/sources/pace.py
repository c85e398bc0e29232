"""When the next control step of a running world is due: play, pause, single steps, slow motion."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from mjhab.core.timing import STEP_SECONDS

WAKE_SECONDS = 0.2
"""How often a paused run looks whether there is something else to do."""


class Pace:
    """Shared by the page, which sets it, and the run, which waits for it.

    speed: simulated seconds per second; infinite runs as fast as it can.
    """

    def __init__(self, *, playing: bool = True, speed: float = 1.0) -> None:
        self._changed = threading.Condition()
        self._playing = playing
        self._speed = speed
        self._single = 0
        self._due = time.perf_counter()

    @property
    def playing(self) -> bool:
        """Whether steps follow each other."""
        return self._playing

    @property
    def speed(self) -> float:
        """Simulated seconds per second."""
        return self._speed

    def play(self, playing: bool) -> None:
        """Run or pause."""
        with self._changed:
            self._playing = playing
            self._single = 0
            self._due = time.perf_counter()
            self._changed.notify_all()

    def set_speed(self, speed: float) -> None:
        """Change how fast it runs."""
        with self._changed:
            self._speed = speed
            self._due = time.perf_counter()
            self._changed.notify_all()

    def step_once(self) -> None:
        """Pause, and let one control step be taken."""
        with self._changed:
            self._playing = False
            self._single += 1
            self._changed.notify_all()

    def wake(self) -> None:
        """Let a waiting run look around now."""
        with self._changed:
            self._changed.notify_all()

    def wait(self, meanwhile: Callable[[], object]) -> None:
        """Return when the next control step is due; ``meanwhile`` is called before, and may raise to end the run."""
        while True:
            meanwhile()
            with self._changed:
                if self._single:
                    self._single -= 1
                    return
                left = self._due - time.perf_counter()
                if self._playing and left <= 0.0:
                    # A run that falls behind does not hurry to catch up.
                    self._due += max(STEP_SECONDS / self._speed, -left)
                    return
                self._changed.wait(min(left, WAKE_SECONDS) if self._playing else WAKE_SECONDS)
