"""Furnished homes on disk: placing furniture is a search, its result is a few kB.

Only the props are stored. A home without its props is made from its plan in microseconds, so the file cannot carry
walls or names that the code no longer has; a file of other code has another name.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy

from mjhab.core.files.cache import cache_dir, write_cached
from mjhab.core.files.code_digest import code_digest
from mjhab.scenes.spec import Home, Placement

Key = tuple[int, int]


def _code_digest() -> bytes:
    """Hash of every module the furnishing can reach, and of the libraries whose arithmetic it uses."""
    libraries = f"{np.__version__} {scipy.__version__}".encode()
    return hashlib.sha256(libraries + code_digest("scenes", "core")).digest()


def cached_homes(
    pack: str,
    keys: Sequence[Key],
    bare: Callable[[int, int], Home],
    furnish: Callable[[int, int], Home],
) -> tuple[Home, ...]:
    """Homes of a pack: from the cache when these keys were furnished before by the same code, else furnished.

    Args:
        pack: name of the pack, part of the file's name.
        keys: (macro, micro) of the homes.
        bare: makes a home without props.
        furnish: makes the whole home.
    """
    digest = hashlib.sha256(_code_digest() + repr(tuple(keys)).encode()).hexdigest()[:24]
    path = cache_dir() / "homes" / f"{pack}-{digest}.json"
    props = _read(path, len(keys))
    if props is not None:
        return tuple(replace(bare(*key), props=row) for key, row in zip(keys, props, strict=True))
    homes = tuple(furnish(*key) for key in keys)
    rows = [[(p.template, p.pos, p.yaw) for p in home.props] for home in homes]
    write_cached(path, lambda temporary: temporary.write_text(json.dumps(rows)))
    return homes


def _read(path: Path, count: int) -> list[tuple[Placement, ...]] | None:
    """Props of every home, or None if there is no such file or it is not whole (a disk that filled up)."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        props = [
            tuple(Placement(name, (x, y, z), yaw) for name, (x, y, z), yaw in row) for row in rows
        ]
    except (OSError, ValueError, TypeError):
        return None
    return props if len(props) == count else None
