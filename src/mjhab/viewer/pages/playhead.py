"""Which state of which episode is shown, and how it moves on."""

from __future__ import annotations

import math
from collections.abc import Callable

from mjhab.core.timing import STEP_SECONDS
from mjhab.viewer.sources.source import Source
from mjhab.viewer.sources.track import Track

MAX_LAG_STEPS = 2.0
"""A page that follows a running world is no farther behind it than so many control steps."""


class Playhead:
    """A place in the episode that a source shows; the callbacks of the panels move it.

    now: place [control steps]; between two states while it moves. following: whether it stays at the newest state of a
    running world. playing: whether it moves.
    """

    def __init__(self, source: Source) -> None:
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
        """The state that is shown, or was passed last."""
        last = self._track.last if self._track is not None else 0
        return min(math.floor(self.now), max(last, 0))

    @property
    def playing(self) -> bool:
        """Whether time passes."""
        return self._source.pace.playing if self.following else self._playing

    def advance(self, seconds: float) -> None:
        """Move on by ``seconds`` of real time."""
        track = self._source.track
        if track is not self._track:
            # Another recorded episode begins by itself, also after one that was played to its end.
            self._playing = self._playing or self._track is not None
            self._track = track
            self.now = 0.0
            self.following = self._source.is_live
        if track is None:
            return
        moved = seconds * self._source.pace.speed / STEP_SECONDS
        if self.following:
            newest = float(max(track.last, 0))
            self.now = min(max(self.now + moved, newest - MAX_LAG_STEPS), newest)
        elif self._playing:
            self.now = min(self.now + moved, float(track.last))
            if self.now >= track.last:
                self._playing = False

    def scrub(self, step: int) -> None:
        """Show a state; what runs is paused, and stays where it is."""
        if self._source.is_live:
            self._source.pace.play(False)
        self.following = False
        self._playing = False
        self.now = float(step)

    def play(self, playing: bool) -> None:
        """Let time pass, or not. A recorded episode that is at its end begins again."""
        if self.following:
            self._source.pace.play(playing)
            return
        if playing and self._track is not None and self.now >= self._track.last:
            self.now = 0.0
        self._playing = playing

    def step_once(self) -> None:
        """Go on by one control step, and stop."""
        if self.following:
            self._source.pace.step_once()
        else:
            self._playing = False
            self.now = float(self.step + 1)
            if self._track is not None:
                self.now = min(self.now, float(self._track.last))

    def go_live(self) -> None:
        """Follow the running world again, and let it run."""
        self.following = self._source.is_live
        self.play(True)

    def callbacks(self) -> dict[str, Callable[..., None]]:
        """What the panels call."""
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
            "finish": source.finish_episode,
        }
