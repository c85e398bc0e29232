"""Pictures and films under the names of ``mani_skill.utils.visualization.misc``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from mjhab.compat.mshab.tools.trees import to_numpy
from mjhab.render.film import FilmWriter

_LINE_PX = 12


def film_path(output_dir: str | Path, video_name: str) -> Path:
    """Path of a film, with underscores for blanks in its name."""
    name = video_name.replace(" ", "_").replace("\n", "_")
    return Path(output_dir) / f"{name}.mp4"


def images_to_video(
    images: Sequence[Any],
    output_dir: str | Path,
    video_name: str,
    fps: float = 10,
    quality: float | None = 5,
    verbose: bool = True,
    **_: Any,
) -> None:
    """Write pictures (H, W, 3) uint8 as ``output_dir/video_name.mp4``."""
    with FilmWriter(film_path(output_dir, video_name), float(fps)) as film:
        for image in images:
            film.add(np.asarray(to_numpy(image), dtype=np.uint8))


def tile_images(images: Any, nrows: int = 1) -> np.ndarray:
    """Pictures (n, H, W, 3) of one size as one, in ``nrows`` rows, filled row by row; missing ones are black."""
    tiles = np.asarray(to_numpy(images))
    if tiles.ndim == 3:
        return tiles
    count, height, width = tiles.shape[:3]
    rows = max(int(nrows), 1)
    columns = -(-count // rows)
    whole = np.zeros((rows * columns, *tiles.shape[1:]), tiles.dtype)
    whole[:count] = tiles
    grid = whole.reshape(rows, columns, height, width, -1)
    return grid.transpose(0, 2, 1, 3, 4).reshape(rows * height, columns * width, -1)


def put_info_on_image(
    image: Any, info: Mapping[str, Any], extras: Sequence[str] | None = None, **_: Any
) -> np.ndarray:
    """A copy of a picture (H, W, 3) uint8 with a line for every number of ``info``, and the lines of ``extras``."""
    lines = [f"{name}: {_shown(value)}" for name, value in info.items()]
    return put_text_on_image(image, [*lines, *(extras or ())])


def put_text_on_image(image: Any, lines: Sequence[str]) -> np.ndarray:
    """A copy of a picture (H, W, 3) uint8 with lines of text."""
    picture = Image.fromarray(np.asarray(to_numpy(image), dtype=np.uint8))
    draw = ImageDraw.Draw(picture)
    for number, line in enumerate(lines):
        place = (4, 4 + _LINE_PX * number)
        draw.text(place, line, fill=(0, 255, 0), stroke_width=1, stroke_fill=(0, 0, 0))
    return np.asarray(picture)


def _shown(value: Any) -> str:
    number = np.asarray(to_numpy(value))
    return (
        f"{number:.3f}" if number.dtype.kind == "f" and number.ndim == 0 else f"{number}"
    )
