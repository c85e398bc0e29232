"""Viewer of running worlds and recorded episodes in the browser."""

from __future__ import annotations

from mjhab.core.libraries import require_libraries


def require_viser() -> None:
    """Check that viser, which the viewer needs, is installed.

    Raises:
        UsageError: it is not installed.
    """
    require_libraries("mjhab view without --export", ("viser",), "view")
