"""Hash of source code: a cached result is that of the code that made it."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

_ROOT = Path(__file__).parents[2]


@lru_cache(maxsize=32)
def code_digest(*names: str) -> bytes:
    """SHA-256 of the source of modules, and of packages with all that is below them.

    Args:
        names: below ``mjhab``, with dots: "layout", "render.raster.kernels".

    Raises:
        FileNotFoundError: there is no such module: a digest that misses a file would keep stale results.
    """
    digest = hashlib.sha256()
    for name in names:
        place = _ROOT.joinpath(*name.split("."))
        files = (
            # Sorted, because file systems list in any order.
            sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]
        )
        for file in files:
            # The names, too: a file that moves changes what is imported.
            digest.update(file.relative_to(_ROOT).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.digest()
