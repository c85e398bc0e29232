"""Films of several episodes side by side, from their stored images."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.rollout.films import FILM_FPS, Film

OpenFilm = Callable[[Path, int], Film]
"""Opens a film file, given its path and frames per second."""
MOST = 9
"""Largest number of episodes in a mosaic."""
EVERY = 4
"""Control steps per frame. Control runs at 20 Hz and films at 20 frames/s, so films show four times real time."""
TILE = 160
"""Side of an episode's image [px]."""
HEAD_CAMERA = "_head"
"""Suffix of the name of a robot's head camera."""
_GAP = 4
_FAR = 4000.0
"""Depth shown as black [mm]."""


@dataclass(frozen=True)
class Mosaic:
    """A film (bytes of an mp4) with its width [px], its number of episodes, and its camera."""

    film: bytes
    width: int
    episodes: int
    camera: str


def mosaic(members: Sequence[tuple[Path, str]], open_film: OpenFilm) -> Mosaic | None:
    """A film of the first MOST episodes (shard, name) that have images; None if none has images."""
    with ExitStack() as stack:
        shown: list[tuple[RecordedEpisode, str, str]] = []
        for path, name in members:
            episode = stack.enter_context(open_shard(path)).episode(name)
            image = _best(episode)
            if image is not None:
                shown.append((episode, *image))
            if len(shown) == MOST:
                break
        if not shown:
            return None
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        film = open_film(folder / "mosaic.mp4", FILM_FPS)
        try:
            # One more than control steps, because the start is an image, too.
            for t in range(0, max(episode.steps for episode, _, _ in shown) + 1, EVERY):
                film.add(
                    _grid(
                        [
                            _tile(episode, camera, output, t)
                            for episode, camera, output in shown
                        ]
                    )
                )
            film.close()
        # An interrupt, too, must not leave an encoder running.
        except BaseException:
            film.abort()
            raise
        width = _columns(len(shown)) * (TILE + _GAP) - _GAP
        return Mosaic(
            (folder / "mosaic.mp4").read_bytes(),
            width,
            len(shown),
            f"{shown[0][1]} {shown[0][2]}",
        )


def _best(episode: RecordedEpisode) -> tuple[str, str] | None:
    """Camera and output to show: colour before depth; follow camera before head camera before hand camera."""
    shown = [image for image in episode.images if image[1] in ("rgb", "depth")]
    return min(
        shown,
        key=lambda image: (image[1] != "rgb", _place(image[0]), image),
        default=None,
    )


def _place(camera: str) -> int:
    """Rank of a camera: 0 follow camera, 1 head camera, 2 others."""
    return 0 if camera == "follow" else 1 if camera.endswith(HEAD_CAMERA) else 2


def _tile(episode: RecordedEpisode, camera: str, output: str, t: int) -> np.ndarray:
    """One image (TILE, TILE, 3); after its end an episode shows its last image."""
    image = episode.frame(camera, output, min(t, episode.steps))
    if output == "depth":
        # Depth 0 is nothing seen, which must not look near.
        near = np.where(image > 0, 1.0 - np.minimum(image / _FAR, 1.0), 0.0)
        image = np.repeat((255 * near).astype(np.uint8), 3, axis=2)
    side = min(image.shape[:2])
    top = (image.shape[0] - side) // 2
    left = (image.shape[1] - side) // 2
    # Cut to a square before scaling, so that nothing looks stretched.
    square = Image.fromarray(
        np.ascontiguousarray(image[top : top + side, left : left + side])
    )
    return np.asarray(square.resize((TILE, TILE), Image.Resampling.BILINEAR))


def _grid(tiles: Sequence[np.ndarray]) -> np.ndarray:
    columns = _columns(len(tiles))
    rows = math.ceil(len(tiles) / columns)
    pitch = TILE + _GAP
    grid = np.full((rows * pitch - _GAP, columns * pitch - _GAP, 3), 24, np.uint8)
    for number, tile in enumerate(tiles):
        top = number // columns * pitch
        left = number % columns * pitch
        grid[top : top + TILE, left : left + TILE] = tile
    return grid


def _columns(tiles: int) -> int:
    # Three columns would leave four pictures with a hole of two.
    return 2 if tiles == 4 else min(tiles, math.isqrt(MOST))
