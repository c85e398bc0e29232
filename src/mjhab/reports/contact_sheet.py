"""A sheet of many images, as a PNG or as an HTML page with embedded images."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

PAPER = (250, 249, 246)
INK = (32, 33, 36)
PALE = (110, 112, 118)
ALERT = (176, 58, 20)
"""Colours of the sheet: background, captions, headings, notes (RGB)."""
JPEG_QUALITY = 88

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark; }}
body {{ font: 15px/1.4 system-ui, sans-serif; margin: 1.5rem; background: Canvas; color: CanvasText; }}
h1 {{ font-size: 1.3rem; }} h2 {{ font-size: 1.05rem; margin: 2rem 0 .6rem; }}
.sheet {{ display: grid; gap: 1rem; grid-template-columns: repeat(auto-fill, minmax(min(17rem, 100%), 1fr)); }}
figure {{ margin: 0; }} img {{ width: 100%; height: auto; display: block; border-radius: 6px; }}
figcaption {{ padding: .3rem .1rem; }} figcaption span {{ display: block; color: light-dark(#a03410, #ff9e6d); }}
</style></head><body><h1>{title}</h1>
{body}
</body></html>
"""


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
        draw.text((x, below + 1.25 * size), _fit(tile.note, small, width), ALERT, small)
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


def _fit(
    text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float
) -> str:
    """The text, shortened to fit into ``width`` pixels."""
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "...") > width:
        text = text[:-1]
    return text.rstrip() + "..."


def save_html(path: Path, title: str, tiles: Sequence[Tile]) -> None:
    """Write an HTML page with embedded images and a heading per group."""
    parts = []
    for group in dict.fromkeys(tile.group for tile in tiles):
        members = [tile for tile in tiles if tile.group == group]
        figures = "\n".join(_figure(tile) for tile in members)
        parts.append(
            f'<h2>{html.escape(group)}: {len(members)}</h2>\n<div class="sheet">\n{figures}\n</div>'
        )
    path.write_text(
        _PAGE.format(title=html.escape(title), body="\n".join(parts)), encoding="utf-8"
    )


def _figure(tile: Tile) -> str:
    buffer = io.BytesIO()
    Image.fromarray(tile.image).save(buffer, "JPEG", quality=JPEG_QUALITY)
    data = base64.b64encode(buffer.getvalue()).decode()
    height, width = tile.image.shape[:2]
    name = html.escape(tile.name)
    note = html.escape(tile.note)
    extra = f"<span>{note}</span>" if note else ""
    return (
        f'<figure><img alt="{name}" width="{width}" height="{height}" loading="lazy" '
        f'src="data:image/jpeg;base64,{data}"><figcaption>{name}{extra}</figcaption></figure>'
    )
