"""The playhead: which state of the source's episode is shown, and how it advances."""

from __future__ import annotations

import math
from collections.abc import Callable

from mjhab.core.timing import STEP_SECONDS
from mjhab.viewer.sources.source import ViewSource
from mjhab.viewer.sources.track import Track

MAX_LAG_STEPS = 2.0
"""Largest lag of the shown state behind the newest one of a running world that is followed [control steps]."""


class Playhead:
    """Position in the episode of a source; the callbacks of the panels move it.

    Attributes:
        now: position [control steps]; fractions lie between two states.
        following: whether it follows the newest state of a running world.
    """

    def __init__(self, source: ViewSource) -> None:
        self.now = 0.0
        self.following = source.is_live
        self._source = source
        self._playing = True
        self._track: Track | None = None

    @property
    def track(self) -> Track | None:
        """The episode that is shown."""
        return self._track

    @property
    def step(self) -> int:
        """Index of the last state at or before the position."""
        last = self._track.last if self._track is not None else 0
        return min(math.floor(self.now), max(last, 0))

    @property
    def playing(self) -> bool:
        """Whether the position advances."""
        return self._source.pace.playing if self.following else self._playing

    def advance(self, seconds: float) -> None:
        """Advance by ``seconds`` of real time, or go to the start of a new episode of the source."""
        track = self._source.track
        if track is not self._track:
            # A newly chosen recorded episode starts playing, also if the one before had stopped at its end.
            self._playing = self._playing or self._track is not None
            self._track = track
            self.now = 0.0
            self.following = self._source.is_live
        if track is None:
            return
        moved = seconds * self._source.pace.speed / STEP_SECONDS
        if self.following:
            newest = float(max(track.last, 0))
            # Never ahead of the newest state, and never far behind: frames come at another rate than steps.
            self.now = min(max(self.now + moved, newest - MAX_LAG_STEPS), newest)
        elif self._playing:
            self.now = min(self.now + moved, float(track.last))
            if self.now >= track.last:
                self._playing = False

    def scrub(self, step: int) -> None:
        """Show a state; running worlds are paused, and no longer followed."""
        if self._source.is_live:
            self._source.pace.play(False)
        self.following = False
        self._playing = False
        self.now = float(step)

    def play(self, playing: bool) -> None:
        """Play or pause; at the end of an episode that is not followed, play from its first state."""
        if self.following:
            self._source.pace.play(playing)
            return
        if playing and self._track is not None and self.now >= self._track.last:
            self.now = 0.0
        self._playing = playing

    def step_once(self) -> None:
        """Advance by one control step and pause."""
        if self.following:
            self._source.pace.step_once()
        else:
            self._playing = False
            self.now = float(self.step + 1)
            if self._track is not None:
                self.now = min(self.now, float(self._track.last))

    def go_live(self) -> None:
        """Follow the newest state of the running world again, and play."""
        self.following = self._source.is_live
        self.play(True)

    def callbacks(self) -> dict[str, Callable[..., None]]:
        """Return the callbacks of `Panels`, by name."""
        source = self._source
        return {
            "choose": source.choose,
            "policy": source.set_policy,
            "play": self.play,
            "step": self.step_once,
            "speed": source.pace.set_speed,
            "scrub": self.scrub,
            "live": self.go_live,
            "restart": source.restart,
            "next": source.next_episode,
            "expert_plan": source.show_expert_plan,
            "hand": source.set_hand,
            "grip": source.grip,
            "finish": source.finish_episode,
        }
