"""Paths that are made from names."""

from __future__ import annotations

import os
from pathlib import Path

from mjhab.core.errors import UsageError


def below(root: Path, *parts: str | Path) -> Path:
    """The path ``root/parts...``, which lies below ``root``. Whoever makes a path from a name asks here.

    Raises:
        UsageError: it would lie elsewhere, because a part is absolute or has ``..`` in it.
    """
    path = root.joinpath(*parts)
    top = Path(os.path.normpath(root))
    inside = Path(os.path.normpath(path))
    if inside == top or not inside.is_relative_to(top):
        given = "/".join(map(str, parts))
        raise UsageError(f"{given!r} would be written outside of {root}; nothing was written.")
    return path
