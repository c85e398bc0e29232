"""``mjhab homes render``: an image of one home, or a sheet with all homes of a pack."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mjhab.cli.options.homes import HomesRenderOptions
from mjhab.cli.output import at_least, print_json
from mjhab.cli.worlds.home_names import find_home, homes_of_split
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.progress import progress_bar

PNG = ".png"
HTML = ".html"
ONE_SIZE = (1200, 900)
SHEET_SIZE = (400, 300)
"""Default width and height of a single image, and of each image on a sheet [px]."""


def render(options: HomesRenderOptions) -> int:
    """Render one home or a sheet of homes."""
    width, height = SHEET_SIZE if options.all else ONE_SIZE
    size = (
        width if options.width is None else options.width,
        height if options.height is None else options.height,
    )
    at_least("width", size[0], 16)
    at_least("height", size[1], 16)
    check_out(options.out, (PNG, HTML) if options.all else (PNG,))
    if options.all:
        if options.name:
            raise UsageError(
                f"give a home or --all, not both (got {options.name!r} and --all)."
            )
        return render_sheet(options, *size)
    if options.split:
        raise UsageError("--split needs --all: one home is drawn by its name.")
    if not options.name:
        raise UsageError(
            "name a home (see: mjhab homes list), or draw all of them with --all."
        )
    return render_one(options, *size)


def check_out(out: Path, endings: tuple[str, ...]) -> None:
    """Refuse an invalid output file.

    Raises:
        UsageError: the file has another extension, or is a folder.
    """
    if out.suffix.lower() not in endings:
        raise UsageError(f"--out must end with {' or '.join(endings)}, got {out}.")
    if out.is_dir():
        raise UsageError(
            f"--out {out} is a folder; give the name of a {endings[0]} file."
        )


def render_one(options: HomesRenderOptions, width: int, height: int) -> int:
    """Draw one home into a PNG."""
    home = find_home(options.assets, options.name)
    from PIL import Image

    from mjhab.render.views import render_home
    from mjhab.scenes.packs import open_pack

    image = render_home(open_pack(options.assets), home.name, options.view, width, height)
    write_atomic(options.out, Image.fromarray(image).save)
    if options.json:
        height, width = image.shape[:2]
        print_json(
            {
                "home": home.name,
                "view": options.view,
                "width": width,
                "height": height,
                "out": str(options.out),
            }
        )
    else:
        print(f"drew {home.name} ({options.view}) into {options.out}")
    return 0


def render_sheet(options: HomesRenderOptions, width: int, height: int) -> int:
    """Draw all homes of a pack into one PNG or HTML page."""
    from mjhab.render.views import render_homes
    from mjhab.reports.contact_sheet import Tile, save_html, save_png
    from mjhab.scenes.packs import open_pack

    pack: Any = open_pack(options.assets)
    homes = homes_of_split(pack, options.split)
    tiles = []
    with progress_bar("drawing homes", len(homes)) as advance:
        images = render_homes(
            pack, [home.name for home in homes], options.view, width, height
        )
        for home, image in zip(homes, images, strict=True):
            tiles.append(
                Tile(home.name, f"{home.split}, layout {home.macro}", home.note, image)
            )
            advance()
    save = save_png if options.out.suffix.lower() == PNG else save_html
    title = f"{len(tiles)} homes of {pack.name}"
    write_atomic(options.out, lambda temporary: save(temporary, title, tiles))
    if options.json:
        print_json({"homes": len(tiles), "view": options.view, "out": str(options.out)})
    else:
        print(f"drew {len(tiles)} homes ({options.view}) into {options.out}")
    return 0
