"""Types of the entries that describe a run (`RunInfo`), checked where a file is read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

SCAN_YAWS = "scan_yaws"
"""Key of `RunInfo.layout`: `ObjectType.scan_yaw` [rad] by type of object, without those that are 0."""
ACTION_TABLE = "action_table"
"""Key of `RunInfo.layout`: the entries of an action as `robots.controllers.table.ActionEntry` has them; older runs tell
their names alone (``actions``)."""
MAX_LAYOUT_NUMBER = 10**6
"""Largest size of a state, column, or heading of a scan in the layout of a run."""
_MISSING = object()


def check_entries(values: Any) -> None:
    """Check the JSON data of a run; entries that are not there, or that later versions added, are not checked.

    Raises:
        ValueError: it is no object, has no config, or an entry has another type than mjhab writes.
    """
    if not isinstance(values, Mapping) or "config" not in values:
        raise ValueError("what describes a run is no JSON object with a config")
    for path, (is_right, wanted) in _ENTRIES.items():
        found: Any = values
        for name in path.split("/"):
            found = found.get(name, _MISSING) if isinstance(found, Mapping) else _MISSING
        if found is not _MISSING and not is_right(found):
            raise ValueError(f"{path} of a run is {wanted}, not {str(found)[:60]!r}")


def _is_object(value: Any) -> bool:
    return isinstance(value, Mapping)


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_texts(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(isinstance(one, str) for one in value)


def _is_number(value: Any, *kinds: type[float]) -> bool:
    # A size of 10**12 would be allocated before anything else fails.
    return isinstance(value, kinds) and abs(value) <= MAX_LAYOUT_NUMBER


def _is_yaws(value: Any) -> bool:
    return isinstance(value, Mapping) and all(
        _is_number(one, int, float) for one in value.values()
    )


def _is_sizes(value: Any) -> bool:
    return isinstance(value, Mapping) and all(
        _is_number(one, int) for one in value.values()
    )


def _is_columns(value: Any) -> bool:
    return isinstance(value, Mapping) and all(
        isinstance(row, list) and all(_is_number(one, int) for one in row)
        for row in value.values()
    )


def _is_objects(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(
        isinstance(one, Mapping) for one in value
    )


_OBJECT = (_is_object, "an object")
_TEXT = (_is_text, "a text")
_TEXTS = (_is_texts, "a list of texts")
_ENTRIES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "config": _OBJECT,
    "config/env": _OBJECT,
    "config/policy": _OBJECT,
    "config/policy/name": _TEXT,
    "options": _OBJECT,
    "versions": _OBJECT,
    "commit": _TEXT,
    "machine": _TEXT,
    "layout": _OBJECT,
    "layout/objects": _TEXTS,
    "layout/links": _TEXTS,
    "layout/joints": _TEXTS,
    "layout/actions": _TEXTS,
    "layout/taints": _TEXTS,
    "layout/segments": _TEXTS,
    "layout/robot": _TEXT,
    "layout/stage": _TEXT,
    "layout/cameras": _OBJECT,
    "layout/sizes": (_is_sizes, "an object of whole numbers"),
    "layout/columns": (_is_columns, "an object of lists of whole numbers"),
    f"layout/{ACTION_TABLE}": (_is_objects, "a list of objects"),
    f"layout/{SCAN_YAWS}": (_is_yaws, "an object of numbers"),
    "assets": _TEXT,
    "licence": _TEXT,
    "absent": _TEXTS,
}
"""Entries of a run by path: the check, and what it asks for. Readers rely on these types."""
