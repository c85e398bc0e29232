"""One owner of randomness: every stream is named by a seed and a path of keys."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class EpisodeId:
    """The seed and the index of an episode, of which all that happens in it is a function."""

    seed: int
    index: int


def stream(seed: int, *keys: int | str) -> np.random.Generator:
    """Return the random stream named by ``seed`` and ``keys``.

    The same name gives the same numbers on every machine, whatever was drawn elsewhere, so an
    episode does not depend on the other worlds, on their number, or on the order of resets.

    Args:
        seed: non-negative run seed.
        keys: path of the stream, e.g. ``("episode", 12, "spawn", 3)``.
    """
    words = [int(seed)]
    for key in keys:
        # Python's own hash of texts differs in every process.
        words.append(zlib.crc32(key.encode()) if isinstance(key, str) else int(key))
    # PCG64 by its name: numpy may change what ``default_rng`` is.
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))
