"""Textures for the kernels: images with their mip levels in one array, and bilinear sampling."""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np

from mjhab.core.typed.checks import check
from mjhab.render.jit import color_inline, kernel
from mjhab.render.lanes import floor_of, whole_of
from mjhab.render.patterns import pattern_tile
from mjhab.scenes.formats.gltf import MAX_TEXTURE

LEVELS = MAX_TEXTURE.bit_length() + 1
"""Number of mip levels of a texture; each has half the sides of the one before, down to one texel."""
_STEPS = 4096
"""Steps of linear light 0..1 in the tables that average texels."""


class Texels(NamedTuple):
    """T textures with their mip levels.

    Attributes:
        pixels: (P,) u32 texels of all levels by rows, ``r | g << 8 | b << 16``.
        start: (T, LEVELS) i64, index of each level's first texel.
        bits: (T, 2) i32, log2 of width and height of level 0.
    """

    pixels: np.ndarray
    start: np.ndarray
    bits: np.ndarray


class TexturePool:
    """Collect textures; equal ones are stored once."""

    def __init__(self) -> None:
        self._numbers: dict[bytes, int] = {}
        self._images: list[tuple[np.ndarray, bool]] = []

    def add(self, image: np.ndarray) -> int:
        """Add an image (h, w, 3) uint8 sRGB whose sides are powers of two up to `MAX_TEXTURE`; returns its number.

        Raises:
            UsageError: the image has other sides or another type.
        """
        height, width = image.shape[:2]
        odd = any(
            side & (side - 1) or not 0 < side <= MAX_TEXTURE for side in (height, width)
        )
        good = not odd and image.dtype == np.uint8 and image.shape[2:] == (3,)
        check(
            good,
            "texture",
            (image.shape, image.dtype),
            f"(h, w, 3) uint8 with sides that are powers of two up to {MAX_TEXTURE}",
        )
        return self._add(
            hashlib.sha256(image.tobytes() + repr(image.shape).encode()).digest(),
            image,
            False,
        )

    def add_pattern(self, kind: str) -> int:
        """Add the image of a pattern (see `patterns.pattern_tile`); returns its number."""
        key = kind.encode()
        return (
            self._numbers[key]
            if key in self._numbers
            else self._add(key, pattern_tile(kind), True)
        )

    def _add(self, key: bytes, image: np.ndarray, linear: bool) -> int:
        if key not in self._numbers:
            self._numbers[key] = len(self._images)
            self._images.append((image, linear))
        return self._numbers[key]

    def build(self) -> Texels:
        """Compute the mip levels of all textures."""
        bits = np.array(
            [
                (i.shape[1].bit_length() - 1, i.shape[0].bit_length() - 1)
                for i, _ in self._images
            ],
            np.int32,
        )
        bits = bits.reshape(-1, 2)
        sides = [np.maximum(bits[:, k, None] - np.arange(LEVELS), 0) for k in range(2)]
        # In int64, since the sum of all textures may pass 2^31.
        sizes = np.int64(1) << (sides[0] + sides[1]).astype(np.int64)
        start = (np.cumsum(sizes) - sizes.ravel()).reshape(-1, LEVELS).astype(np.int64)
        # At least one: kernels take no empty arrays.
        pixels = np.zeros(max(int(sizes.sum()), 1), np.uint32)
        for k, (image, linear) in enumerate(self._images):
            packed = image.astype(np.uint32)
            first = packed[..., 0] | packed[..., 1] << 8 | packed[..., 2] << 16
            pixels[start[k, 0] : start[k, 0] + first.size] = first.ravel()
            decode, encode = _curves(linear)
            for level in range(1, LEVELS):
                _halve(
                    pixels,
                    start[k, level - 1],
                    start[k, level],
                    sides[0][k, level - 1],
                    sides[1][k, level - 1],
                    decode,
                    encode,
                )
        return Texels(pixels, start, bits)


def _curves(linear: bool) -> tuple[np.ndarray, np.ndarray]:
    """Tables from bytes to linear light and back.

    Args:
        linear: bytes are linear (patterns) rather than sRGB.

    Returns:
        decode (256,): light in units of 1 / `_STEPS`; encode (`_STEPS` + 1,) u32: the nearest byte.
    """
    value = np.arange(256) / 255.0
    light = (
        value
        # Patterns hold shares, not colours, which are averaged as they are.
        if linear
        else np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    )
    # The byte whose light is nearest.
    middles = (light[1:] + light[:-1]) / 2
    encode = np.searchsorted(middles, np.arange(_STEPS + 1) / _STEPS).astype(np.uint32)
    return light * _STEPS, encode


@kernel
def _halve(pixels, source, target, width_bits, height_bits, decode, encode):
    """Write the next mip level: the mean light of 2 x 2 texels; a side of one texel stays.

    ``source``, ``target``: first texels of the two levels in ``pixels``; ``width_bits``, ``height_bits``: log2 of the
    sides of the source; ``decode``, ``encode``: see `_curves`.
    """
    width = 1 << width_bits
    height = 1 << height_bits
    step_x = 1 if width > 1 else 0
    step_y = 1 if height > 1 else 0
    columns = width >> step_x
    rows = height >> step_y
    for y in range(rows):
        for x in range(columns):
            out = np.uint32(0)
            at = source + (y << step_y) * width + (x << step_x)
            for shift in range(0, 24, 8):
                total = 0.0
                for corner in range(4):
                    texel = pixels[
                        at + (corner & 1) * step_x + (corner >> 1) * step_y * width
                    ]
                    total += decode[(texel >> np.uint32(shift)) & np.uint32(255)]
                out |= encode[int(0.25 * total + 0.5)] << np.uint32(shift)
            pixels[target + y * columns + x] = out


@color_inline
def copy_for(texels_per_pixel):
    """Mip level whose texels are about as large as a pixel, for this number of level-0 texels per pixel side."""
    level = np.int64(0)
    most = np.float32(1.42)
    for _ in range(LEVELS - 1):
        level += np.int64(texels_per_pixel > most)
        most *= np.float32(2.0)
    return level


@color_inline
def texels_around(x, y, start, wide, high):
    """The four texels around a point of a mip level, and where between them it lies; the texture repeats.

    Args:
        x, y: the point [texels] from the middle of the first, one f32 or `lanes.LANES` of them.
        start: index of the level's first texel.
        wide, high: log2 of the level's sides.

    Returns:
        Indices of the texels above left, above right, below left, below right; steps of 1/16 across and down, 0..1.
    """
    left = floor_of(x)
    above = floor_of(y)
    i = whole_of(left)
    j = whole_of(above)
    mask_x = np.int32((1 << wide) - 1)
    mask_y = np.int32((1 << high) - 1)
    row = np.int32(1 << wide)
    i0 = i & mask_x
    i1 = (i + 1) & mask_x
    j0 = (j & mask_y) * row + start
    j1 = ((j + 1) & mask_y) * row + start
    steps = np.float32(16.0)
    step = np.float32(1.0 / 16.0)
    across = floor_of((x - left) * steps) * step
    down = floor_of((y - above) * steps) * step
    return j0 + i0, j0 + i1, j1 + i0, j1 + i1, across, down


@color_inline
def _byte(texel, shift):
    return np.float32(np.int32(np.int32(texel >> np.int32(shift)) & np.int32(255)))


@color_inline
def blended_byte(above_left, above_right, below_left, below_right, across, down, shift):
    """One of the bytes of four texels, at the bit ``shift``, interpolated bilinearly: 0..255."""
    a = _byte(above_left, shift)
    b = _byte(below_left, shift)
    a = a + across * (_byte(above_right, shift) - a)
    b = b + across * (_byte(below_right, shift) - b)
    return a + down * (b - a)
