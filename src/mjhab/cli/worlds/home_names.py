"""Look-up of homes by name and by split."""

from __future__ import annotations

from typing import Any

from mjhab.core.errors import unknown_name
from mjhab.scenes.pack_source import Assets


def find_home(assets: Assets, name: str) -> Any:
    """Return a home by name.

    Raises:
        UsageError: the pack or the home is unknown.
    """
    from mjhab.scenes.packs import open_pack

    homes = open_pack(assets).homes_by_name
    if name not in homes:
        raise unknown_name("home", name, homes)
    return homes[name]


def homes_of_split(pack: Any, split: str | None) -> list[Any]:
    """Homes of a pack that belong to ``split``, all if it is None.

    Raises:
        UsageError: the pack has no home in that split.
    """
    found = [home for home in pack.homes if split in (None, home.split)]
    if not found:
        raise unknown_name("split", str(split), {home.split for home in pack.homes})
    return found
