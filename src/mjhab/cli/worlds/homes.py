"""``mjhab homes``: list, show and draw the homes of an asset pack."""

from __future__ import annotations

from collections import Counter
from typing import Any

from mjhab.cli.options.homes import (
    HomesCheckOptions,
    HomesListOptions,
    HomesRenderOptions,
    HomesShowOptions,
)
from mjhab.cli.output import print_json, print_table
from mjhab.cli.worlds.home_names import find_home


def run_homes(
    options: HomesListOptions | HomesShowOptions | HomesCheckOptions | HomesRenderOptions,
) -> int:
    """Run one of the four commands and return the exit code."""
    if isinstance(options, HomesListOptions):
        return list_homes(options)
    if isinstance(options, HomesShowOptions):
        return show_home(options)
    if isinstance(options, HomesCheckOptions):
        from mjhab.cli.worlds.homes_check import check

        return check(options)
    from mjhab.cli.worlds.homes_render import render

    return render(options)


def list_homes(options: HomesListOptions) -> int:
    """Print name, pack, split, macro and micro number of every home."""
    from mjhab.scenes.packs import open_pack

    homes = [_row(home) for home in open_pack(options.assets).homes]
    if options.json:
        print_json({"homes": homes})
    else:
        columns = ("name", "pack", "split", "macro", "micro")
        print_table(
            f"{len(homes)} homes",
            columns,
            [[home[key] for key in columns] for home in homes],
        )
        print(_variety(homes))
    return 0


def _variety(homes: list[dict[str, Any]]) -> str:
    """Describe how many macro layouts each split has; homes of one macro layout differ by small shifts only."""
    parts = []
    for split in dict.fromkeys(home["split"] for home in homes):
        macros = {home["macro"] for home in homes if home["split"] == split}
        count = sum(home["split"] == split for home in homes)
        layouts = "1 macro layout" if len(macros) == 1 else f"{len(macros)} macro layouts"
        parts.append(f"{split}: {count} homes of {layouts}")
    return (
        f"{'; '.join(parts)}. Homes of one macro layout have the same rooms and kitchen; their furniture is shifted a "
        "little and reassigned."
    )


def show_home(options: HomesShowOptions) -> int:
    """Print size, walls and furniture of one home."""
    home = find_home(options.assets, options.name)
    x_min, y_min, x_max, y_max = home.floor
    shown = {
        **_row(home),
        "size_m": [round(x_max - x_min, 3), round(y_max - y_min, 3)],
        "walls": len(home.walls),
        "lights": len(home.lights),
        "props": dict(sorted(Counter(place.template for place in home.props).items())),
        "articulations": sorted(place.template for place in home.articulations),
        "note": home.note,
        "open_limits": dict(home.open_limits),
    }
    if options.json:
        print_json(shown)
        return 0
    apart = ("props", "articulations", "note", "open_limits")
    facts = [(key, value) for key, value in shown.items() if key not in apart]
    facts[5:6] = [("size", f"{shown['size_m'][0]} m x {shown['size_m'][1]} m")]
    facts += [("note", home.note)] if home.note else []
    facts += [(f"{link} opens to", f"{limit:g}") for link, limit in home.open_limits]
    print_table(f"home {home.name}", ("what", "value"), facts)
    furniture = [(name, count, "") for name, count in shown["props"].items()]
    furniture += [(name, 1, "opens") for name in shown["articulations"]]
    print_table("furniture", ("template", "count", ""), furniture)
    return 0


def _row(home: Any) -> dict[str, Any]:
    return {
        "name": home.name,
        "pack": home.pack,
        "split": home.split,
        "macro": home.macro,
        "micro": home.micro,
    }
