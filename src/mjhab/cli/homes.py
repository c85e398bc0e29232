"""``mjhab homes``: list, show and draw the homes of an asset pack."""

from __future__ import annotations

from collections import Counter
from typing import Any

from mjhab.cli.options import HomesListOptions, HomesRenderOptions, HomesShowOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import UsageError, unknown_name

PNG = ".png"


def run_homes(options: HomesListOptions | HomesShowOptions | HomesRenderOptions) -> int:
    """Run one of the three commands and return the exit code."""
    if isinstance(options, HomesListOptions):
        return list_homes(options)
    if isinstance(options, HomesShowOptions):
        return show_home(options)
    return render(options)


def list_homes(options: HomesListOptions) -> int:
    """Print name, pack, split, macro and micro number of every home."""
    from mjhab.scenes.packs import open_pack

    homes = [_row(home) for home in open_pack(options.assets).homes]
    if options.json:
        print_json({"homes": homes})
    else:
        columns = ("name", "pack", "split", "macro", "micro")
        print_table(f"{len(homes)} homes", columns, [[home[key] for key in columns] for home in homes])
    return 0


def show_home(options: HomesShowOptions) -> int:
    """Print size, walls and furniture of one home."""
    home = _home(options.assets, options.name)
    x_min, y_min, x_max, y_max = home.floor
    shown = {
        **_row(home),
        "size_m": [round(x_max - x_min, 3), round(y_max - y_min, 3)],
        "walls": len(home.walls),
        "lights": len(home.lights),
        "props": dict(sorted(Counter(place.template for place in home.props).items())),
        "articulations": sorted(place.template for place in home.articulations),
    }
    if options.json:
        print_json(shown)
        return 0
    facts = [(key, value) for key, value in shown.items() if key not in ("props", "articulations")]
    facts[5:6] = [("size", f"{shown['size_m'][0]} m x {shown['size_m'][1]} m")]
    print_table(f"home {home.name}", ("what", "value"), facts)
    furniture = [(name, count, "") for name, count in shown["props"].items()]
    furniture += [(name, 1, "opens") for name in shown["articulations"]]
    print_table("furniture", ("template", "count", ""), furniture)
    return 0


def render(options: HomesRenderOptions) -> int:
    """Draw one home into a PNG."""
    at_least("width", options.width, 16)
    at_least("height", options.height, 16)
    if options.out.suffix.lower() != PNG:
        raise UsageError(f"--out must end with {PNG}, got {options.out}.")
    if options.out.is_dir():
        raise UsageError(f"--out {options.out} is a folder; give the name of a {PNG} file.")
    home = _home(options.assets, options.name)
    from PIL import Image

    from mjhab.scenes.packs import open_pack
    from mjhab.sim.views import render_home

    image = render_home(open_pack(options.assets), home.name, options.view, options.width, options.height)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(options.out)
    if options.json:
        height, width = image.shape[:2]
        print_json({"home": home.name, "view": options.view, "width": width, "height": height, "out": str(options.out)})
    else:
        print(f"drew {home.name} ({options.view}) into {options.out}")
    return 0


def _home(assets: str, name: str) -> Any:
    from mjhab.scenes.packs import open_pack

    homes = {home.name: home for home in open_pack(assets).homes}
    if name not in homes:
        raise unknown_name("home", name, homes)
    return homes[name]


def _row(home: Any) -> dict[str, Any]:
    return {"name": home.name, "pack": home.pack, "split": home.split, "macro": home.macro, "micro": home.micro}
