"""Cache on disk of furnished homes, because placing furniture is a search, and its result a few kB.

Only the props are stored; everything else is made from the plan of a home in microseconds. The name of a file has a
hash of the code, so that files of other code are not read.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.core.files.cache import cache_dir, read_cached, write_cached
from mjhab.core.files.code_digest import code_digest
from mjhab.scenes.spec import Home, Placement

Key = tuple[int, int]


def _code_digest() -> bytes:
    """Hash of all modules that the furnishing may import, and of the arithmetic that it uses."""
    return hashlib.sha256(arithmetic_digest() + code_digest("scenes", "core")).digest()


def cached_homes(
    pack: str,
    keys: Sequence[Key],
    bare: Callable[[int, int], Home],
    furnish: Callable[[int, int], Home],
) -> tuple[Home, ...]:
    """Return the homes of a pack, from the cache if the same code furnished these keys before.

    Args:
        pack: name of the pack, part of the file's name.
        keys: (macro, micro) of the homes.
        bare: makes a home without props, given macro and micro.
        furnish: makes a home with props, given macro and micro.
    """
    # The arithmetic is part of it, since an arrangement is accepted or not by the last bits of distances.
    digest = hashlib.sha256(_code_digest() + repr(tuple(keys)).encode()).hexdigest()[:24]
    path = cache_dir() / "homes" / f"{pack}-{digest}.json"
    props = read_cached(path, lambda file: _read(file, len(keys)))
    if props is not None:
        return tuple(
            replace(bare(*key), props=row) for key, row in zip(keys, props, strict=True)
        )
    homes = tuple(furnish(*key) for key in keys)
    # Furnished pieces are upright, so that a heading says all of their rotation.
    rows = [[(p.template, p.pos, p.yaw) for p in home.props] for home in homes]
    write_cached(path, lambda temporary: temporary.write_text(json.dumps(rows)))
    return homes


def _read(path: Path, count: int) -> list[tuple[Placement, ...]]:
    """Props of every home; raises ValueError if there are more or fewer homes than ``count``."""
    rows = json.loads(path.read_text(encoding="utf-8"))
    if len(rows) != count:
        raise ValueError(f"{path} has {len(rows)} homes, not {count}")
    return [
        tuple(Placement(name, (x, y, z), yaw) for name, (x, y, z), yaw in row)
        for row in rows
    ]
