"""Words on pictures: a line below, such as the sentence of a subtask, and a mark above, such as that of a teleport."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjhab.core.names import shortened

LINE_SHARE = 0.036
"""Height of the letters by that of the image."""
INK = (255, 255, 255)
MARK_INK = (255, 214, 102)
BEHIND = 0.35
"""Share of its light that a picture keeps behind words."""


def with_words(image: np.ndarray, below: str = "", mark: str = "") -> np.ndarray:
    """A picture with words.

    Args:
        image: (height, width, 3) uint8 sRGB; it is not changed.
        below: a line at the bottom; what does not fit is cut off with three dots. "" for none.
        mark: a short line at the top left; "" for none.

    Returns:
        (height, width, 3) uint8; ``image`` itself without words.
    """
    if not below and not mark:
        return image
    height, width = image.shape[:2]
    # Smaller letters cannot be read.
    size = max(9, round(LINE_SHARE * height))
    font = _font(size)
    bar = round(1.9 * size)
    # The caller's picture may be shown elsewhere without words.
    out = image.copy()
    if below:
        out[height - bar :] = (BEHIND * out[height - bar :]).astype(np.uint8)
    marked = round(font.getlength(mark) + 1.2 * size) if mark else 0
    if mark:
        out[:bar, :marked] = (BEHIND * out[:bar, :marked]).astype(np.uint8)
    drawn = Image.fromarray(out)
    draw = ImageDraw.Draw(drawn)
    if below:
        text = shortened(below, font.getlength, width - 1.2 * size)
        place = (width / 2, height - bar / 2)
        draw.text(place, text, INK, font, anchor="mm")
    if mark:
        draw.text((0.6 * size, bar / 2), mark, MARK_INK, font, anchor="lm")
    return np.asarray(drawn)


@lru_cache(maxsize=4)
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
