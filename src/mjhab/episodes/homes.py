"""The homes of a pack that episodes take place in."""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase

from mjhab.core.errors import fault, unknown_name
from mjhab.episodes.moved_furniture import is_version
from mjhab.scenes.roles import require_roles
from mjhab.scenes.spec import Home, Pack
from mjhab.tasks.household.registry import TASKS


def drawn_homes(pack: Pack) -> list[Home]:
    """Return the homes that episodes are drawn in: all but versions with moved furniture."""
    return [home for home in pack.homes if not is_version(home)]


def homes_of(pack: Pack, split: str) -> list[Home]:
    """Return the homes of a split.

    Raises:
        UsageError: there is none.
    """
    found = [home for home in drawn_homes(pack) if home.split == split]
    if not found:
        raise fault(f"pack {pack.name!r}", f"has no home in split {split!r}.")
    return found


def homes_named(pack: Pack, pattern: str) -> list[Home]:
    """Return the homes whose name matches ``pattern`` with the wildcards ``*``, ``?`` and ``[...]``.

    Raises:
        UsageError: there is none.
    """
    known = drawn_homes(pack)
    found = [home for home in known if fnmatchcase(home.name, pattern)]
    if not found:
        raise unknown_name("home", pattern, [home.name for home in known])
    return found


def require_furniture(pack: Pack, homes: Iterable[Home], task: str) -> None:
    """Check that homes have the furniture that a task needs.

    Raises:
        UsageError: a home lacks some; names the role of the furniture and the homes.
    """
    require_roles(pack, homes, TASKS[task].roles, f"task {task!r}")
