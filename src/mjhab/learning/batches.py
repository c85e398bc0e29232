"""Batches of training samples, drawn from demonstrations in memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjhab.core.arrays import Array, as_like, count, namespace
from mjhab.core.seeding import stream
from mjhab.learning.configs import InputConfig
from mjhab.learning.demos import Demonstrations
from mjhab.learning.observation.depth import BYTE
from mjhab.learning.observation.parts import image_channels


@dataclass(frozen=True, eq=False)
class Chunks:
    """B training samples.

    vector (B, history * D), images (B, history * C, H, W) uint8, actions (B, chunk, A), valid (B, chunk) bool: False
    after the end of the demonstration. Arrays of the library and device of the demonstrations.
    """

    vector: Array
    images: Array
    actions: Array
    valid: Array


def take_chunks(
    data: Demonstrations, rows: np.ndarray, chunk: int, history: int = 1
) -> Chunks:
    """The samples that start at the given rows (B,)."""
    xp = namespace(data.first)
    rows = as_like(rows, data.first)
    first = data.first[rows][:, None]
    last = data.last[rows][:, None]
    # Before the first step of an episode the first observation stands in, as it does when acting.
    seen = xp.maximum(rows[:, None] + (count(history, rows) - (history - 1)), first)
    ahead = rows[:, None] + count(chunk, rows)
    # Told before the clip, which hides where an episode ended.
    valid = ahead <= last
    ahead = xp.minimum(ahead, last)
    images = data.images[seen]
    # Not -1: a student without cameras has images of size 0.
    channels = history * images.shape[2]
    return Chunks(
        data.vector[seen].reshape(len(rows), -1),
        images.reshape(len(rows), channels, *images.shape[3:]),
        data.actions[ahead],
        valid,
    )


class BatchSampler:
    """Draws batches: a fixed fraction from the newest data, the rest from all older data.

    Batch k is a function of (seed, k).

    Args:
        sources: data sets, the newest last. batch: number of samples.
        new_share: fraction of a batch that comes from the newest data set, if there are several.
    """

    def __init__(
        self, sources: Sequence[Demonstrations], batch: int, new_share: float, seed: int
    ) -> None:
        self._sources = list(sources)
        self._batch = batch
        self._seed = seed
        # With a single source all of it is new.
        self._new = round(new_share * batch) if len(self._sources) > 1 else batch

    def rows(self, step: int) -> list[tuple[Demonstrations, np.ndarray]]:
        """Rows of batch ``step``, by source."""
        # Named by the step, so that a resumed training draws the same batches.
        random = stream(self._seed, "batch", step)
        newest = self._sources[-1]
        drawn = [(newest, random.choice(newest.usable, self._new))]
        old = self._sources[:-1]
        if old:
            ends = np.cumsum([len(source.usable) for source in old])
            # Over all older rows together, so that rounds count by their size.
            places = random.integers(0, ends[-1], self._batch - self._new)
            which = np.searchsorted(ends, places, side="right")
            for number, source in enumerate(old):
                mine = places[which == number] - (ends[number] - len(source.usable))
                drawn.append((source, source.usable[mine]))
        return [(source, rows) for source, rows in drawn if len(rows)]

    def batch(self, step: int, chunk: int, inputs: InputConfig) -> Chunks:
        """Batch ``step``, with images that are changed randomly as the inputs of the student say."""
        parts = [
            take_chunks(source, rows, chunk, inputs.history)
            for source, rows in self.rows(step)
        ]
        xp = namespace(parts[0].vector)
        images = xp.concat([part.images for part in parts])
        seen = math.prod(images.shape)
        if inputs.shift and seen:
            images = shift_images(images, inputs.shift, stream(self._seed, "shift", step))
        if inputs.colour_shift and seen:
            random = stream(self._seed, "colours", step)
            images = shift_colours(images, inputs, random)
        return Chunks(
            xp.concat([part.vector for part in parts]),
            images,
            xp.concat([part.actions for part in parts]),
            xp.concat([part.valid for part in parts]),
        )


def shift_images(images: Array, most: int, random: np.random.Generator) -> Array:
    """Shift each image of (B, C, H, W) by a random offset of up to ``most`` pixels; border pixels are repeated."""
    # One offset for all channels of a sample: cameras and history move together, as with a real jitter.
    offsets = random.integers(-most, most + 1, (2, len(images), 1))
    # The draws above are shared, so that both ways give the same images.
    if isinstance(images, np.ndarray):
        return _shift_on_host(images, most, offsets)
    batch, channels, height, width = images.shape
    xp = namespace(images)
    offsets = as_like(offsets, images, xp.int64)
    rows = xp.clip(count(height, images) + offsets[0], 0, height - 1)
    columns = xp.clip(count(width, images) + offsets[1], 0, width - 1)
    return images[
        count(batch, images)[:, None, None, None],
        count(channels, images)[None, :, None, None],
        rows[:, None, :, None],
        columns[:, None, None, :],
    ]


def shift_colours(
    images: Array, inputs: InputConfig, random: np.random.Generator
) -> Array:
    """Images (B, history * C, H, W) with other colours, the same change in all images of a sample.

    Light changes so: its brightness, and its colour. What else the images show, as depth, stays.
    """
    most = inputs.colour_shift
    brightness, *tint = 1.0 + random.uniform(-most, most, (4, len(images)))
    unchanged = np.ones(len(images))
    gains = [
        gain
        for channels in image_channels(inputs)
        for gain in (
            # One channel is depth.
            [brightness * part for part in tint] if channels > 1 else [unchanged]
        )
    ] * inputs.history
    xp = namespace(images)
    gain = as_like(np.stack(gains, axis=1)[..., None, None], images, xp.float32)
    return xp.astype(xp.clip(xp.round(images * gain), 0, BYTE), xp.uint8)


def _shift_on_host(images: np.ndarray, most: int, offsets: np.ndarray) -> np.ndarray:
    """Copy whole rows of pixels: a processor takes 4 times as long to gather single ones."""
    batch, _, height, width = images.shape
    border = (most, most)
    padded = np.pad(images, ((0, 0), (0, 0), border, border), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (height, width), (2, 3))
    top, left = offsets[..., 0] + most
    return windows[np.arange(batch), :, top, left]
