"""Viewer of running worlds and recorded episodes in the browser."""

from __future__ import annotations

import importlib.util

from mjhab.core.errors import UsageError
from mjhab.core.machine import install_extra


def require_viser() -> None:
    """Check that viser, which the viewer needs, is installed.

    Raises:
        UsageError: it is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise UsageError(
            f"mjhab view needs viser, which is not installed: {install_extra('view')}. Without it, --export writes "
            "an episode as a page."
        )
