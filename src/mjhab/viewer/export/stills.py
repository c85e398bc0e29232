"""Pictures of an episode for its page: by the camera of films, by the rasterizer or the path tracer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjhab.evaluation.shots.shoot import Studio
from mjhab.evaluation.shots.spec import ShotSpec
from mjhab.evaluation.shots.takes import open_take

STILL_SIZE_PX = (640, 360)


class Still(NamedTuple):
    """A picture (height, width, 3) uint8 of a control step."""

    step: int
    image: np.ndarray


def stills_of(
    shard: Path, episode: int, count: int, drawn: Mapping[str, Any]
) -> list[Still]:
    """Pictures of evenly spaced control steps, the first and the last among them.

    Args:
        shard: has the episode.
        episode: its index.
        count: how many; fewer of a shorter episode.
        drawn: how, the fields ``shader``, ``shading`` and ``threads`` of `EnvConfig`.

    Raises:
        UsageError: the episode cannot be drawn so, or its index is that of several in the shard.
    """
    spec = ShotSpec.of(place=shard, episode=episode, **drawn)
    take = open_take(spec)
    try:
        studio = Studio(spec, take)
        return [
            Still(step, image)
            for step, image, _ in studio.stills(0, count, STILL_SIZE_PX)
        ]
    finally:
        take.env.close()
