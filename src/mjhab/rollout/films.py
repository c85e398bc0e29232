"""Films of some episodes, recorded while they run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView

FILM_FPS = 20
FILM_EVERY = 2
"""A frame every 2nd control step of 20 Hz, played at 20 frames/s: films run at twice the speed of life."""


class Film(Protocol):
    """An open film file; it appears under its name when it is closed, and not at all when it is aborted."""

    def add(self, frame: np.ndarray) -> None:
        """Append a frame (H, W, 3) uint8."""
        ...

    def close(self) -> None:
        """Finish the file."""
        ...

    def abort(self) -> None:
        """Remove the unfinished file."""
        ...


class Crew(Protocol):
    """Shoots the frames of films; it may remember what it shot before."""

    def begin(self, world: int) -> None:
        """A new film begins in a world."""
        ...

    def shoot(
        self, env: Any, worlds: Sequence[int], info: Mapping[str, Any]
    ) -> Sequence[np.ndarray]:
        """Frames (n, H, W, 3) uint8 of the present states of n worlds."""
        ...


class HumanView:
    """The crew that shows what ``env.render_worlds`` shows.

    Args:
        width, height: of the frames [px].
    """

    def __init__(self, width: int = 480, height: int = 360) -> None:
        self._size = (width, height)

    def begin(self, world: int) -> None:
        """It remembers nothing."""

    def shoot(
        self, env: RolloutEnv, worlds: Sequence[int], info: Mapping[str, Any]
    ) -> Sequence[np.ndarray]:
        """Frames (n, H, W, 3) uint8."""
        width, height = self._size
        return [*env.render_worlds(worlds, width=width, height=height)]


class FilmSink(Sink[RolloutEnv]):
    """Films the episodes in ``indices``.

    A renderer or encoder that fails stops the films, not the evaluation: ``problem`` then says why.

    Args:
        indices: episodes to film.
        path_of: where the film of an episode goes.
        open_film: opens a film file (from ``render.film``, which this package may not import), given path and frames/s.
        crew: shoots the frames; None for `HumanView`.
        every: control steps between frames.
    """

    def __init__(
        self,
        indices: Collection[int],
        path_of: Callable[[int], Path],
        open_film: Callable[[Path, int], Film],
        *,
        crew: Crew | None = None,
        every: int = FILM_EVERY,
    ) -> None:
        self.problem: str | None = None
        self._indices = frozenset(indices)
        self._path_of = path_of
        self._open_film = open_film
        self._every = every
        self._crew = crew or HumanView()
        self._films: dict[int, Film] = {}

    def on_reset(
        self, env: RolloutEnv, info: Mapping[str, Any], mask: np.ndarray
    ) -> None:
        """Open films of wanted episodes; their first frame shows the start state."""
        begun = []
        for world in np.flatnonzero(mask):
            index = int(info["episode_spec"][world]["index"])
            if index in self._indices and self.problem is None:
                self._films[int(world)] = self._open_film(self._path_of(index), FILM_FPS)
                self._crew.begin(int(world))
                begun.append(int(world))
        self._shoot(env, begun, info)

    def on_step(self, env: RolloutEnv, step: StepView) -> None:
        """Shoot every ``every``-th step of the filmed worlds."""
        # By the step of the episode, so that a film does not depend on when the world was reset.
        due = [w for w in self._films if step.steps[w] % self._every == 0]
        self._shoot(env, due, step.info)

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        """Finish the film."""
        # First out of the list, so that `_give_up` does not abort it once more.
        film = self._films.pop(world, None)
        if film is not None:
            try:
                film.close()
            # Encoders and renderers are libraries with errors of all kinds; none of them may end an evaluation.
            except Exception as error:
                self._give_up(error)

    def close(self) -> None:
        """Drop the films of unfinished episodes."""
        for film in self._films.values():
            film.abort()
        self._films.clear()

    def _shoot(self, env: RolloutEnv, worlds: list[int], info: Mapping[str, Any]) -> None:
        """Append a frame to the films of some worlds, which are drawn together."""
        if not worlds:
            return
        try:
            frames = self._crew.shoot(env, worlds, info)
            for world, frame in zip(worlds, frames, strict=True):
                self._films[world].add(frame)
        except Exception as error:
            self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        self.problem = f"{type(error).__name__}: {error}"
        self.close()
