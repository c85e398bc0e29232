"""Worlds and recorded episodes in the browser."""

from __future__ import annotations

import importlib.util

from mjhab.core.errors import UsageError


def require_viser() -> None:
    """Refuse to go on without the library of the page.

    Raises:
        UsageError: it is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise UsageError(
            "mjhab view needs viser, which is not installed: pip install 'mjhab[view]'. Without it, --export writes "
            "an episode as a page."
        )
