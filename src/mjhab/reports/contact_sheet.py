"""A sheet of many images, as a PNG or as an HTML page with embedded images."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjhab.core.names import shortened
from mjhab.reports.pages import base64_text, render_page

if TYPE_CHECKING:
    from markupsafe import Markup

PAPER = (250, 249, 246)
INK = (32, 33, 36)
PALE = (110, 112, 118)
ALERT = (176, 58, 20)
"""Colours of the sheet: background, captions, headings, notes (RGB)."""
JPEG_QUALITY = 88


@dataclass(frozen=True, eq=False)
class Tile:
    """One image (H, W, 3) uint8 with its caption ``name`` and ``note``."""

    name: str
    group: str
    note: str
    image: np.ndarray


def save_png(path: Path, title: str, tiles: Sequence[Tile]) -> None:
    """Write the tiles as a grid with an aspect ratio of about 3:2; each group starts a new row."""
    height, width = tiles[0].image.shape[:2]
    columns = max(1, min(len(tiles), round(math.sqrt(len(tiles) * 1.5 * height / width))))
    cells = _cells(tiles, columns)
    # Captions grow with the pictures, but stay readable below small ones.
    size = max(10, width // 24)
    gap = max(4, width // 40)
    caption = round(size * 3.2)
    head = 3 * size
    rows = cells[-1][0] + 1
    sheet = Image.new(
        "RGB",
        (gap + columns * (width + gap), head + rows * (height + caption) + gap),
        PAPER,
    )
    draw = ImageDraw.Draw(sheet)
    draw.text((gap, gap), title, INK, ImageFont.load_default(1.6 * size))
    font = ImageFont.load_default(size)
    small = ImageFont.load_default(0.8 * size)
    for tile, (row, column) in zip(tiles, cells, strict=True):
        x = gap + column * (width + gap)
        y = head + row * (height + caption)
        sheet.paste(Image.fromarray(tile.image), (x, y))
        below = y + height + 0.15 * size
        draw.text((x, below), tile.name, INK, font)
        draw.text((x + width - font.getlength(tile.group), below), tile.group, PALE, font)
        note = shortened(tile.note, small.getlength, width)
        draw.text((x, below + 1.25 * size), note, ALERT, small)
    sheet.save(path, optimize=True)


def _cells(tiles: Sequence[Tile], columns: int) -> list[tuple[int, int]]:
    """(row, column) of every tile; each group starts a new row."""
    cells: list[tuple[int, int]] = []
    row = 0
    column = 0
    for k, tile in enumerate(tiles):
        if column == columns or (k and tile.group != tiles[k - 1].group):
            row += 1
            column = 0
        cells.append((row, column))
        column += 1
    return cells


def save_html(path: Path, title: str, tiles: Sequence[Tile]) -> None:
    """Write an HTML page with embedded images and a heading per group."""
    groups: dict[str, list[Tile]] = {}
    for tile in tiles:
        groups.setdefault(tile.group, []).append(tile)
    page = render_page(
        "reports/templates/contact_sheet.html", title=title, groups=groups, jpeg=_jpeg
    )
    path.write_text(page, encoding="utf-8")


def _jpeg(tile: Tile) -> Markup:
    """The image of a tile as a JPEG file in base64."""
    buffer = io.BytesIO()
    Image.fromarray(tile.image).save(buffer, "JPEG", quality=JPEG_QUALITY)
    return base64_text(buffer.getvalue())
