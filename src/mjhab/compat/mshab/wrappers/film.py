"""A film that grows while worlds are stepped, and gets its name when it is finished."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mjhab.compat.mshab.tools.pictures import film_path
from mjhab.render.film import FilmWriter


class RecordedFilm:
    """Films in a folder, one after the other. Pictures go to the encoder at once and take no memory.

    Attributes:
        frames: pictures of the present film; the first is the state before the first control step.

    Args:
        folder: where they go.
        fps: pictures per second.
        most_steps: control steps of a film; None for no end.
        keeps_old: numbers of films that exist are skipped.
    """

    def __init__(
        self, folder: Path, fps: float, most_steps: int | None, keeps_old: bool
    ) -> None:
        self._folder = folder
        self._fps = fps
        self._most = most_steps
        self._keeps_old = keeps_old
        self._number = -1
        self._writer: FilmWriter | None = None
        self.frames = 0

    @property
    def is_full(self) -> bool:
        """Whether the film has its full length."""
        return self._most is not None and self.frames > self._most

    def add(self, picture: np.ndarray) -> None:
        """Append a picture (H, W, 3) uint8."""
        if self._writer is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            # The name is known only when the film is finished.
            self._writer = FilmWriter(self._folder / "unfinished.mp4", float(self._fps))
        self._writer.add(picture)
        self.frames += 1

    def flush(self, name: str | None, suffix: str, save: bool) -> None:
        """Finish the film: ``<name>.mp4``, or the next number with ``suffix``; a film without a step is dropped."""
        writer = self._writer
        if writer is None:
            return
        # The first frame is the start, so one alone is a film without a step.
        if save and self.frames > 1:
            writer.path = self._path(name, suffix)
            writer.close()
        else:
            writer.abort()
        self._writer = None
        self.frames = 0

    def _path(self, name: str | None, suffix: str) -> Path:
        if name is not None:
            return film_path(self._folder, name)
        while True:
            self._number += 1
            path = film_path(
                self._folder, "_".join(filter(None, (str(self._number), suffix)))
            )
            if not (self._keeps_old and path.exists()):
                return path
