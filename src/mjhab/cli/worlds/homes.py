"""``mjhab homes list`` and ``homes show``: the homes of an asset pack."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from mjhab.cli.output import Listing, report
from mjhab.cli.worlds.home_names import find_home
from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.core.typed.flags import Flag

HomeName = Annotated[str, Flag(metavar="HOME", positional=True)]


@dataclass(frozen=True)
class HomesListSpec(EnvSpec):
    """List the homes of an asset pack."""

    env: Annotated[Mapping[str, Any], env_options("assets")] = field(default_factory=dict)
    """The asset pack."""


@dataclass(frozen=True)
class HomesShowSpec(EnvSpec):
    """Show what is in one home."""

    name: HomeName
    """Name of the home (see: mjhab homes list)."""
    env: Annotated[Mapping[str, Any], env_options("assets")] = field(default_factory=dict)
    """The asset pack."""


def list_homes(spec: HomesListSpec, json: bool) -> int:
    """Print name, pack, split, macro and micro number of every home."""
    from mjhab.scenes.packs import open_pack, stage_of

    homes = [_row(home) for home in open_pack(spec.asked.assets).homes]
    columns = ("name", "pack", "split", "macro", "micro")
    rows = [[home[key] for key in columns] for home in homes]
    table = Listing(f"{len(homes)} homes", columns, rows)
    stage = stage_of(spec.asked.assets)
    report(json, {"homes": homes, **stage}, table, _variety(homes))
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


def show_home(spec: HomesShowSpec, json: bool) -> int:
    """Print size, walls and furniture of one home."""
    from mjhab.scenes.packs import stage_of

    home = find_home(spec.asked.assets, spec.name)
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
        **stage_of(spec.asked.assets),
    }
    apart = ("props", "articulations", "note", "open_limits")
    facts = [(key, value) for key, value in shown.items() if key not in apart]
    facts[5:6] = [("size", f"{shown['size_m'][0]} m x {shown['size_m'][1]} m")]
    facts += [("note", home.note)] if home.note else []
    facts += [(f"{link} opens to", f"{limit:g}") for link, limit in home.open_limits]
    furniture = [(name, count, "") for name, count in shown["props"].items()]
    furniture += [(name, 1, "opens") for name in shown["articulations"]]
    report(
        json,
        shown,
        Listing(f"home {home.name}", ("what", "value"), facts),
        Listing("furniture", ("template", "count", ""), furniture),
    )
    return 0


def _row(home: Any) -> dict[str, Any]:
    names = ("name", "pack", "split", "macro", "micro")
    return {name: getattr(home, name) for name in names}
